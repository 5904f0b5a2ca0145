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

/// A function that receives one log line: its severity (AXON_LOG_*), the part of the library that logs it,
/// and the text. Both strings are valid during the call. A text has no line breaks: characters that could
/// control a terminal are escaped, as in the daemon's log.
///
/// The library calls the function on a thread of its own, for one line after the other. The thread starts
/// with the first line. It has no other work and holds no lock that the program may wait for. Therefore the
/// function may block and may call this interface. Up to 256 lines are queued meanwhile. A full
/// queue drops the line of the lowest severity, and reports the number of dropped lines at the severity of the
/// most severe of them. Lines that the library logs on this thread during the function are dropped.
pub type axon_log_t = Option<
    unsafe extern "C" fn(
        user: *const c_void,
        severity: u32,
        part: *const c_char,
        text: *const c_char,
    ),
>;

/// The log of a process. A forked child has a log of its own, which starts without a callback. Lines that
/// were logged before the fork are reported by the parent.
#[derive(Default)]
struct Log {
    waiting: WaitingLines,
    slot: Mutex<CallbackSlot>,
    /// Notified when a call of the callback returns.
    returned: Condvar,
}

/// The current callback, and the version of the callback that is running.
#[derive(Default)]
struct CallbackSlot {
    told: Option<LogCallback>,
    /// Increases with each callback that is set.
    version: u64,
    /// The version of the callback that is running.
    called: Option<u64>,
}

#[derive(Clone, Copy)]
struct LogCallback {
    function: unsafe extern "C" fn(*const c_void, u32, *const c_char, *const c_char),
    user: User,
}

static LOG: PerProcess<Log> = PerProcess::new();
/// The lowest severity that is reported. Loads and stores are relaxed: the value guards no other memory.
static LEAST: AtomicU32 = AtomicU32::new(AXON_LOG_WARN);

/// Sets the callback for the log lines of the library in this process, which replaces the previous one. The
/// call blocks until the previous callback has returned; that one is not called again. Setting the current
/// callback with the same `user` changes nothing and does not block. Null removes the callback; there is none
/// at first. A daemon has a log of its own. A forked child must set a callback for its own log lines.
///
/// AXON_RET_ERROR: the call comes from inside a callback, or Rust code in the program already receives the
/// log lines (a global `tracing` subscriber).
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

/// Sets the lowest severity that is reported, which is AXON_LOG_WARN at first. Values between the named
/// severities are accepted.
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

    /// Calls the callback with the line, if its severity is still wanted. Holds no lock during the call.
    fn tell(&self, line: &LogLine) {
        let mut slot = self.slot();
        let Some(told) = slot.told.filter(|_| is_wanted(line.severity)) else { return };
        slot.called = Some(slot.version);
        drop(slot);
        // A NUL is escaped, too. A line may quote a peer, and the program shows it on a terminal.
        let text = |text: &str| CString::new(escaped(text)).unwrap_or_default();
        let (part, text) = (text(line.part), text(&line.text));
        // SAFETY: the caller allows this call until the callback is replaced. `set` does not return before
        // this call does.
        unsafe { (told.function)(told.user.0, line.severity, part.as_ptr(), text.as_ptr()) };
        self.slot().called = None;
        self.returned.notify_all();
    }

    fn slot(&self) -> MutexGuard<'_, CallbackSlot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The `tracing` subscriber of the process.
struct LogListener;

impl LogListener {
    /// Installs this subscriber if there is none. Returns whether it is the one in force.
    fn stands() -> bool {
        let _ = set_global_default(Self);
        tracing::dispatcher::get_default(tracing::Dispatch::is::<Self>)
    }
}

impl Subscriber for LogListener {
    // The wanted severity may change at any time.
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
        // `Log::current` fails only if memory is short. Then the line is lost.
        let Ok(log) = Log::current() else { return };
        log.waiting.say(line, |line| log.tell(&line));
    }

    // Spans are not reported, so all spans share one ID.
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// An event as text: the message, followed by the values.
#[derive(Default)]
struct Text {
    message: String,
    values: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing to a string does not fail.
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

    /// A lock that the program's logger holds while it publishes its lines.
    static LOGGER: Mutex<()> = Mutex::new(());

    unsafe extern "C" fn hear(user: *const c_void, _: u32, _: *const c_char, text: *const c_char) {
        // SAFETY: the test set this pointer. Its target outlives the callback.
        let heard = unsafe { &*user.cast::<Mutex<mpsc::Sender<String>>>() };
        let _held = LOGGER.lock().unwrap();
        // SAFETY: a string that is valid during the call.
        let text = unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned();
        tracing::error!("said by a callback");
        let _ = heard.lock().unwrap().send(text);
    }

    #[test]
    fn logging_waits_for_no_callback_and_lines_beyond_the_bound_are_counted() {
        let (sender, heard) = mpsc::channel::<String>();
        let sender = Mutex::new(sender);
        let set = |callback: axon_log_t| {
            // SAFETY: `sender` lives until the callback is removed below.
            unsafe { axon_session_log_set_callback(callback, (&raw const sender).cast()) }
        };
        assert_eq!(set(Some(hear)), AXON_RET_OK);
        let held = LOGGER.lock().unwrap();
        for number in 0..300 {
            tracing::error!(number, "said in a test");
        }
        drop(held);
        let mut said = 0;
        // Lines of other tests arrive as well.
        loop {
            let text = heard.recv().unwrap();
            assert!(!text.contains("said by a callback"), "{text}");
            said += u64::from(text.starts_with("said in a test"));
            if let Some((lost, _)) = text.split_once(" log lines were dropped") {
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
