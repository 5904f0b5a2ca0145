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

/// The result of a call: `AXON_RET_OK`, or the reason for the failure.
pub type axon_ret_t = i32;

/// The call succeeded.
pub const AXON_RET_OK: axon_ret_t = 0;
/// The call failed for a reason without a code of its own. The text of the error states the reason.
pub const AXON_RET_ERROR: axon_ret_t = 1;
/// The call timed out.
pub const AXON_RET_TIMEOUT: axon_ret_t = 2;
/// An argument is null although it must not be, not UTF-8, or out of bounds.
pub const AXON_RET_INVALID_ARGUMENT: axon_ret_t = 3;
/// A handle names no object: the handle is 0, was destroyed, or is of another kind.
pub const AXON_RET_INVALID_HANDLE: axon_ret_t = 4;
/// Memory, file descriptors or handles are short: of the process, of the host's shared memory, or of the publisher,
/// whose loans and readers hold the rest.
pub const AXON_RET_BAD_ALLOC: axon_ret_t = 5;
/// A setting is wrong. The text of the error names the variable.
pub const AXON_RET_CONFIG: axon_ret_t = 6;
/// The handle belongs to the parent of this forked process. The child must open a session of its own.
pub const AXON_RET_FORKED: axon_ret_t = 7;
/// The program was compiled against another version of the header than the library's.
pub const AXON_RET_ABI: axon_ret_t = 8;
/// The graph has no node of that name.
pub const AXON_RET_NO_NODE: axon_ret_t = 9;
/// The library caught a panic: a defect of AXON. The call may have done part of its work.
pub const AXON_RET_PANIC: axon_ret_t = 10;
/// The permissions of the session's enclave do not allow the endpoint. The text of the error names the topic,
/// the enclave, the file and the line in the file.
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

    /// Prefixes the text with the name of the failed object.
    pub(super) fn of(self, whose: impl Display) -> Self {
        Self { text: format!("{whose}: {}", self.text), ..self }
    }

    /// Prefixes the text with the kind, topic and node of the failed endpoint.
    pub(super) fn of_endpoint(self, endpoint: &Endpoint) -> Self {
        self.of(Named(endpoint))
    }

    /// Stores the text as this thread's last error and returns the code.
    pub(super) fn note(self) -> axon_ret_t {
        let text = CString::new(self.text.replace('\0', " ")).unwrap_or_default();
        // A thread that is ending has no storage for the text any more.
        let _ = LAST.try_with(|last| last.replace(text));
        self.code
    }
}

/// Formats an endpoint for an error text.
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

/// Returns the text of the last failed call in this thread: the failed operation, its topic and node, the
/// cause, and the remedy. The text is empty if no call failed. It stays valid until the next failed call in
/// this thread. A thread that is ending gets null.
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
