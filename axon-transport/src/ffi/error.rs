//! Return codes, and the text of the last error.

use std::{
    cell::RefCell,
    ffi::CString,
    fmt::{self, Display},
    os::raw::c_char,
    ptr,
};

use axon_shm::{PublishError, ShmError};

use crate::{
    graph::{Endpoint, EndpointKind},
    session::SessionError,
};

/// What a call returns: `AXON_RET_OK`, or why it did not do what it was asked.
pub type axon_ret_t = i32;

/// It worked.
pub const AXON_RET_OK: axon_ret_t = 0;
/// It did not, for a reason that only the text tells.
pub const AXON_RET_ERROR: axon_ret_t = 1;
/// The time was over first.
pub const AXON_RET_TIMEOUT: axon_ret_t = 2;
/// An argument is null where it must not be, not UTF-8, or out of bounds.
pub const AXON_RET_INVALID_ARGUMENT: axon_ret_t = 3;
/// A handle names nothing: it is 0, was destroyed, or is of another kind.
pub const AXON_RET_INVALID_HANDLE: axon_ret_t = 4;
/// Memory, descriptors or handles are short.
pub const AXON_RET_BAD_ALLOC: axon_ret_t = 5;
/// A setting is wrong; the text names the variable.
pub const AXON_RET_CONFIG: axon_ret_t = 6;
/// The handle belongs to a process of which this one is a fork. A child opens a session of its own.
pub const AXON_RET_FORKED: axon_ret_t = 7;
/// The program was compiled against another version of this header than the library's.
pub const AXON_RET_ABI: axon_ret_t = 8;
/// There is no node of that name.
pub const AXON_RET_NO_NODE: axon_ret_t = 9;
/// A defect of the library was caught. What the call should have done may be half done.
pub const AXON_RET_PANIC: axon_ret_t = 10;
/// The permissions of the session's enclave do not allow the endpoint; the text names the topic, the
/// enclave, the file and its line.
pub const AXON_RET_DENIED: axon_ret_t = 11;

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// A call that failed.
#[derive(Debug)]
pub(super) struct CallFailure {
    code: axon_ret_t,
    text: String,
}

impl CallFailure {
    pub(super) fn new(code: axon_ret_t, text: impl Display) -> Self {
        Self { code, text: text.to_string() }
    }

    pub(super) fn argument(text: impl Display) -> Self {
        Self::new(AXON_RET_INVALID_ARGUMENT, text)
    }

    /// Says of what the failure is.
    pub(super) fn of(self, whose: impl Display) -> Self {
        Self { text: format!("{whose}: {}", self.text), ..self }
    }

    /// Says of which endpoint.
    pub(super) fn of_endpoint(self, endpoint: &Endpoint) -> Self {
        self.of(Named(endpoint))
    }

    /// Keeps the text for this thread.
    pub(super) fn note(self) -> axon_ret_t {
        let text = CString::new(self.text.replace('\0', " ")).unwrap_or_default();
        // A thread that is ending has nowhere to keep it.
        let _ = LAST.try_with(|last| last.replace(text));
        self.code
    }
}

/// An endpoint in an error.
struct Named<'a>(&'a Endpoint);

impl Display for Named<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Endpoint { kind, topic, node, namespace, .. } = self.0;
        let what = match kind {
            EndpointKind::Publisher => "publisher of",
            EndpointKind::Subscription => "subscription of",
            EndpointKind::Server => "server of",
            EndpointKind::Client => "client of",
            EndpointKind::Node => "node",
        };
        let slash = if namespace.ends_with('/') { "" } else { "/" };
        if *kind == EndpointKind::Node {
            return write!(f, "{what} {namespace}{slash}{node}");
        }
        write!(f, "{what} {topic} (node {namespace}{slash}{node})")
    }
}

impl From<SessionError> for CallFailure {
    fn from(error: SessionError) -> Self {
        let code = match &error {
            SessionError::Memory(ShmError::Forked) => AXON_RET_FORKED,
            SessionError::Memory(ShmError::AlreadyLed(_)) => AXON_RET_ERROR,
            SessionError::Memory(_) => AXON_RET_BAD_ALLOC,
            SessionError::Config(_) | SessionError::Mismatch { .. } => AXON_RET_CONFIG,
            #[cfg(feature = "sros2")]
            SessionError::Permissions(_) => AXON_RET_CONFIG,
            #[cfg(feature = "sros2")]
            SessionError::Permission { .. } => AXON_RET_DENIED,
            SessionError::Endpoint { .. }
            | SessionError::Node { .. }
            | SessionError::OtherSession => AXON_RET_INVALID_ARGUMENT,
            _ => AXON_RET_ERROR,
        };
        Self::new(code, error)
    }
}

impl From<PublishError> for CallFailure {
    fn from(error: PublishError) -> Self {
        let code = match &error {
            PublishError::Blocked { .. } => AXON_RET_TIMEOUT,
            PublishError::Forked => AXON_RET_FORKED,
            PublishError::TooLarge { .. } => AXON_RET_INVALID_ARGUMENT,
            _ => AXON_RET_BAD_ALLOC,
        };
        Self::new(code, error)
    }
}

/// What went wrong in the last call of this thread that failed: what, of which topic and node, why,
/// and what to do. Empty where none has. The text stands until the next call that fails in this
/// thread; it is null in a thread that is ending.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_last_error() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(ptr::null())
}

#[cfg(test)]
mod tests {
    use axon_shm::ids::Gid;

    use super::*;

    #[test]
    fn only_a_full_history_is_a_timeout_of_publish() {
        let code = |error: PublishError| CallFailure::from(error).code;
        let reader = Gid([7; 16]);
        assert_eq!(code(PublishError::Blocked { reader }), AXON_RET_TIMEOUT);
        let short = PublishError::NoMemory { needed: 8, available: 0, keeper: None };
        assert_eq!(code(short), AXON_RET_BAD_ALLOC);
        assert_eq!(code(PublishError::Loaned { loans: 1 }), AXON_RET_BAD_ALLOC);
        assert_eq!(code(PublishError::TooLarge { len: 2, max: 1 }), AXON_RET_INVALID_ARGUMENT);
        assert_eq!(code(PublishError::Forked), AXON_RET_FORKED);
    }
}
