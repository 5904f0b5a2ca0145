//! Passes the library's log lines to a callback of the C program. A thread of the library calls the callback.

mod queue;

use std::{
    ffi::{CString, c_void},
    fmt::{Debug, Write as _},
    os::raw::c_char,
    sync::{
        Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU32, Ordering},
    },
};

use axon_shm::{
    ShmError,
    internal::{Made, PerProcess},
};
use tracing::{
    Event, Level, Metadata, Subscriber,
    field::{Field, Visit},
    span::{Attributes, Id, Record},
    subscriber::{Interest, set_global_default},
};

use self::queue::WaitingLines;
use super::{
    callback::User,
    error::{AXON_RET_BAD_ALLOC, AXON_RET_ERROR, CallFailure, axon_ret_t},
    guarded,
};
use crate::text::escaped;

/// Debug: details that help to find a fault.
pub const AXON_LOG_DEBUG: u32 = 10;
/// Informational: normal operation.
pub const AXON_LOG_INFO: u32 = 20;
/// Warning: a problem that the library handles.
pub const AXON_LOG_WARN: u32 = 30;
/// Error: an operation of the library failed.
pub const AXON_LOG_ERROR: u32 = 40;

/// Told of a line: how severe it is (AXON_LOG_*), which part of the library says it, and what. Both
/// strings stand during the call. A line is one line: characters that could steer a terminal are escaped,
/// as in the daemon's log. It is called on a thread of the library's own, which begins with the
/// first line, for one line after another. That thread has nothing else to do and holds nothing that the
/// program may wait for, so the callback may block and may call this interface. Meanwhile 256 lines wait;
/// of more only the number is told. What the callback makes the library say on its thread is not told.
pub type axon_log_t = Option<
    unsafe extern "C" fn(
        user: *const c_void,
        severity: u32,
        part: *const c_char,
        text: *const c_char,
    ),
>;

/// The log of a process. A forked child has one of its own: nobody is told there at first, and what was
/// said before it was forked its parent tells.
#[derive(Default)]
struct Log {
    waiting: WaitingLines,
    slot: Mutex<CallbackSlot>,
    /// A call has returned.
    returned: Condvar,
}

/// The callback that is set, and the one that is being called.
#[derive(Default)]
struct CallbackSlot {
    told: Option<LogCallback>,
    /// Rises with each that is set.
    version: u64,
    /// The version that is being called.
    called: Option<u64>,
}

#[derive(Clone, Copy)]
struct LogCallback {
    function: unsafe extern "C" fn(*const c_void, u32, *const c_char, *const c_char),
    user: User,
}

static LOG: PerProcess<Log> = PerProcess::new();
/// Guards nothing but itself: its loads and stores are relaxed.
static LEAST: AtomicU32 = AtomicU32::new(AXON_LOG_WARN);

/// Has `callback` told of what the library says in this process, in place of the one before, which has
/// returned and is not called any more when this returns; it blocks until then. To set the one that is
/// set already with the same `user` changes nothing, and does not block. Null: nobody is told, as at
/// first. A daemon has a log of its own. A forked child says it again for what it says itself.
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
        let log = Log::current().map_err(|error| CallFailure::new(AXON_RET_BAD_ALLOC, error))?;
        if log.waiting.is_teller() {
            return Err(CallFailure::new(AXON_RET_ERROR, "called from within a log callback"));
        }
        if callback.is_some() && !LogListener::stands() {
            let text = "another part of the program has a global subscriber of tracing";
            return Err(CallFailure::new(AXON_RET_ERROR, text));
        }
        log.set(callback.map(|function| LogCallback { function, user: User(user) }));
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

fn is_wanted(severity: u32) -> bool {
    severity >= LEAST.load(Ordering::Relaxed)
}

/// One log line.
struct LogLine {
    severity: u32,
    part: &'static str,
    text: String,
}

impl LogCallback {
    fn is(&self, other: &Self) -> bool {
        std::ptr::fn_addr_eq(self.function, other.function) && self.user.0 == other.user.0
    }
}

impl Log {
    fn current() -> Result<&'static Self, ShmError> {
        LOG.get(|_| Self::default(), |_, _| {}).map(Made::value)
    }

    fn set(&self, told: Option<LogCallback>) {
        let mut slot = self.slot();
        let same = match (&slot.told, &told) {
            (Some(one), Some(other)) => one.is(other),
            _ => false,
        };
        if same {
            return;
        }
        slot.told = told;
        slot.version += 1;
        let version = slot.version;
        while slot.called.is_some_and(|called| called < version) {
            slot = self.returned.wait(slot).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Calls the program, if it still wants to hear of this. No lock is held meanwhile.
    fn tell(&self, line: &LogLine) {
        let mut slot = self.slot();
        let Some(told) = slot.told.filter(|_| is_wanted(line.severity)) else { return };
        slot.called = Some(slot.version);
        drop(slot);
        // A NUL is escaped, too. A line may quote a peer, and the program shows it on a terminal.
        let text = |text: &str| CString::new(escaped(text)).unwrap_or_default();
        let (part, text) = (text(line.part), text(&line.text));
        // SAFETY: the caller that set it says that it may be called so until it is replaced, and `set` does
        // not return before this call has.
        unsafe { (told.function)(told.user.0, line.severity, part.as_ptr(), text.as_ptr()) };
        self.slot().called = None;
        self.returned.notify_all();
    }

    fn slot(&self) -> MutexGuard<'_, CallbackSlot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Hears all of the process.
struct LogListener;

impl LogListener {
    /// Whether it is this one that hears.
    fn stands() -> bool {
        let _ = set_global_default(Self);
        tracing::dispatcher::get_default(tracing::Dispatch::is::<Self>)
    }
}

impl Subscriber for LogListener {
    // What is wanted may change at any time.
    fn register_callsite(&self, _: &'static Metadata<'static>) -> Interest {
        Interest::sometimes()
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        let teller = || Log::current().is_ok_and(|log| log.waiting.is_teller());
        is_wanted(severity(metadata.level())) && metadata.is_event() && !teller()
    }

    fn event(&self, event: &Event<'_>) {
        let metadata = event.metadata();
        let mut text = Text::default();
        event.record(&mut text);
        let line = LogLine {
            severity: severity(metadata.level()),
            part: metadata.target(),
            text: text.message + &text.values,
        };
        // Without memory to find it by there is no log.
        let Ok(log) = Log::current() else { return };
        log.waiting.say(line, |line| log.tell(&line));
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
struct Text {
    message: String,
    values: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // To write to a string does not fail.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.values, " {name}={value:?}"),
        };
    }
}

#[cfg(test)]
mod tests {
    use std::{
        ffi::CStr,
        sync::{Mutex, mpsc},
    };

    use super::*;
    use crate::ffi::error::AXON_RET_OK;

    /// What a program's logger holds while it publishes what it logs.
    static LOGGER: Mutex<()> = Mutex::new(());

    unsafe extern "C" fn hear(user: *const c_void, _: u32, _: *const c_char, text: *const c_char) {
        // SAFETY: what the test set, which outlives its callback.
        let heard = unsafe { &*user.cast::<Mutex<mpsc::Sender<String>>>() };
        let _held = LOGGER.lock().unwrap();
        // SAFETY: a string that stands during the call.
        let text = unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned();
        tracing::error!("said by a callback");
        let _ = heard.lock().unwrap().send(text);
    }

    #[test]
    fn logging_waits_for_no_callback_and_lines_beyond_the_bound_are_counted() {
        let (sender, heard) = mpsc::channel::<String>();
        let sender = Mutex::new(sender);
        let set = |callback: axon_log_t| {
            // SAFETY: `sender` stands until the callback is taken back, below.
            unsafe { axon_session_log_set_callback(callback, (&raw const sender).cast()) }
        };
        assert_eq!(set(Some(hear)), AXON_RET_OK);
        let held = LOGGER.lock().unwrap();
        for number in 0..300 {
            tracing::error!(number, "said in a test");
        }
        drop(held);
        let mut said = 0;
        // What other tests say meanwhile is heard as well.
        loop {
            let text = heard.recv().unwrap();
            assert!(!text.contains("said by a callback"), "{text}");
            said += u64::from(text.starts_with("said in a test"));
            if let Some(lost) = text.strip_suffix(" more lines than could wait were said") {
                let lost: u64 = lost.parse().unwrap();
                assert!(lost + said >= 300 && said <= 257, "{said} told, {lost} lost");
                break;
            }
        }
        tracing::error!(peer = "\u{1b}[2J\u{202e}", "a peer is named \u{1b}]0;evil\u{7}\n\0");
        let named = loop {
            let text = heard.recv().unwrap();
            if text.starts_with("a peer is named") {
                break text;
            }
        };
        assert!(named.contains(r"named \u{1b}]0;evil\u{7}\u{a}\u{0}"), "{named}");
        assert!(named.chars().all(crate::text::is_plain), "{named:?}");
        tracing::error!("the last");
        while !heard.recv().unwrap().starts_with("the last") {}
        assert_eq!(set(None), AXON_RET_OK);
        tracing::error!("to nobody");
        drop(sender);
        assert!(heard.iter().all(|text| !text.starts_with("to nobody")));
    }
}
