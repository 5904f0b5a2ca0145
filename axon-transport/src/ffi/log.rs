//! What the library logs, for the program to hear.

use std::{
    cell::Cell,
    ffi::{CString, c_void},
    fmt::{Debug, Write as _},
    os::raw::c_char,
    sync::{
        PoisonError, RwLock,
        atomic::{AtomicU32, Ordering},
    },
};

use tracing::{
    Event, Level, Metadata, Subscriber,
    field::{Field, Visit},
    span::{Attributes, Id, Record},
    subscriber::{Interest, set_global_default},
};

use super::{
    callback::User,
    error::{AXON_RET_ERROR, Failure, axon_ret_t},
    guarded,
};

/// What helps to find a fault.
pub const AXON_LOG_DEBUG: u32 = 10;
/// What is as it should be.
pub const AXON_LOG_INFO: u32 = 20;
/// What is not, and is coped with.
pub const AXON_LOG_WARN: u32 = 30;
/// What does not work for it.
pub const AXON_LOG_ERROR: u32 = 40;

/// Told of a line: how severe it is (AXON_LOG_*), which part of the library says it, and what. Both
/// strings stand during the call. It is called by whatever thread has something to say, must not
/// block, and what it makes the library say is not told.
pub type axon_log_t = Option<
    unsafe extern "C" fn(
        user: *const c_void,
        severity: u32,
        part: *const c_char,
        text: *const c_char,
    ),
>;

/// Who is told, and with what.
type Told = (unsafe extern "C" fn(*const c_void, u32, *const c_char, *const c_char), User);

static TOLD: RwLock<Option<Told>> = RwLock::new(None);
/// Guards nothing but itself: its loads and stores are relaxed.
static LEAST: AtomicU32 = AtomicU32::new(AXON_LOG_WARN);

thread_local! {
    /// Whether the function is being called on this thread.
    static TELLING: Cell<bool> = const { Cell::new(false) };
}

/// Has `callback` told of what the library says in this process, in place of the one before, which has
/// returned and is not called any more when this returns. Null: nobody is told, as at first. A daemon
/// has a log of its own.
///
/// AXON_RET_ERROR: it is called from within a callback, or a part of the program in Rust has what the
/// library says already (a global `tracing` subscriber).
///
/// # Safety
/// `callback` may be called with `user` from any thread until it is replaced.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_log_set_callback(
    callback: axon_log_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| {
        if TELLING.get() {
            return Err(Failure::new(AXON_RET_ERROR, "called from within a log callback"));
        }
        let mut told = TOLD.write().unwrap_or_else(PoisonError::into_inner);
        if callback.is_some() && !Listener::stands() {
            let text = "another part of the program has a global subscriber of tracing";
            return Err(Failure::new(AXON_RET_ERROR, text));
        }
        *told = callback.map(|function| (function, User(user)));
        Ok(())
    })
}

/// How severe a line must be at least to be told: AXON_LOG_WARN at first. A severity between those that
/// have a name is as good as any.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_log_set_severity(severity: u32) -> axon_ret_t {
    guarded(|| {
        LEAST.store(severity, Ordering::Relaxed);
        Ok(())
    })
}

fn severity(level: &Level) -> u32 {
    match *level {
        Level::ERROR => AXON_LOG_ERROR,
        Level::WARN => AXON_LOG_WARN,
        Level::INFO => AXON_LOG_INFO,
        _ => AXON_LOG_DEBUG,
    }
}

/// Hears all of the process.
struct Listener;

impl Listener {
    /// Whether it is this one that hears.
    fn stands() -> bool {
        let _ = set_global_default(Self);
        tracing::dispatcher::get_default(tracing::Dispatch::is::<Self>)
    }
}

impl Subscriber for Listener {
    // What is wanted may change at any time.
    fn register_callsite(&self, _: &'static Metadata<'static>) -> Interest {
        Interest::sometimes()
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        severity(metadata.level()) >= LEAST.load(Ordering::Relaxed) && metadata.is_event()
    }

    fn event(&self, event: &Event<'_>) {
        if TELLING.replace(true) {
            return;
        }
        let told = TOLD.read().unwrap_or_else(PoisonError::into_inner);
        if let Some((function, User(user))) = *told {
            let metadata = event.metadata();
            let mut line = Line::default();
            event.record(&mut line);
            let text = |text: String| CString::new(text.replace('\0', " ")).unwrap_or_default();
            let (part, text) = (text(metadata.target().to_owned()), text(line.text()));
            // SAFETY: whoever set it says that it may be called so until it is replaced, for which
            // the lock would be needed.
            unsafe { function(user, severity(metadata.level()), part.as_ptr(), text.as_ptr()) };
        }
        drop(told);
        TELLING.set(false);
    }

    // Spans are not shown: there is one of them, and it is not entered.
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// An event as text: what it says, and then its values.
#[derive(Default)]
struct Line {
    message: String,
    values: String,
}

impl Line {
    fn text(self) -> String {
        self.message + &self.values
    }
}

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // To write to a string does not fail.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.values, " {name}={value:?}"),
        };
    }
}
