//! Reads the first messages of a connection, before it is admitted as a session: optionally the session's
//! key, then HELLO.

use std::sync::Arc;

use axon_shm::internal::descriptors::{self, PassedFd};
use axon_transport::internal::{
    OWNER, SessionKey,
    session::daemon::socket::{self, ReceivedMessage, SocketError},
    wire::session::{SessionHello, SessionMessage, SessionRefused},
};
use tokio::io::unix::AsyncFd;
use zeroize::Zeroize;

use super::{
    admission::unshared,
    descriptors::SpareDescriptors,
    session_connection::{receive, say},
};

/// Maximum number of messages of unknown types before HELLO.
const UNKNOWN: u32 = 8;

/// The first messages of a connection.
pub(super) struct PreHelloMessage {
    pub(super) hello: SessionHello,
    pub(super) descriptors: Vec<PassedFd>,
    /// The key that came before HELLO, from which the session's id is made.
    pub(super) key: Option<Arc<SessionKey>>,
    /// True if its descriptors were left in the socket, because there is no space for them.
    pub(super) is_crowded: bool,
}

impl PreHelloMessage {
    /// Returns whether the key, if one came, matches the id.
    pub(super) fn is_its_own(&self) -> Result<(), Box<SessionRefused>> {
        match &self.key {
            Some(key) if key.id() != self.hello.session => {
                let text = "the session's id is not made of the key that it handed over";
                Err(Box::new(SessionRefused::because(text.into())))
            }
            _ => Ok(()),
        }
    }
}

/// Waits for HELLO. Returns `None` if another message comes. If descriptors are short and there is none for another
/// session, those of HELLO stay in the socket: its sender could delay their close.
pub(super) async fn first(
    spare: &SpareDescriptors,
    socket: &AsyncFd<PassedFd>,
    has_room: impl Fn() -> bool,
) -> Option<PreHelloMessage> {
    let mut buffer = Vec::new();
    let mut unknown = 0;
    let mut key = None;
    loop {
        let mut ready = socket.readable().await.ok()?;
        let fd = socket.get_ref();
        if descriptors::is_tight() && descriptors::carries_descriptors(fd) && !has_room() {
            let Ok(SessionMessage::Hello(hello)) = socket::look(fd, &mut buffer) else {
                return None;
            };
            let descriptors = Vec::new();
            return Some(PreHelloMessage { hello, descriptors, key, is_crowded: true });
        }
        match receive(spare, fd, &mut buffer) {
            Ok(ReceivedMessage { message: SessionMessage::Hello(hello), descriptors }) => {
                return Some(PreHelloMessage { hello, descriptors, key, is_crowded: false });
            }
            Ok(ReceivedMessage { message: SessionMessage::Unknown(OWNER), descriptors })
                if key.is_none() && descriptors.is_empty() =>
            {
                // A packet that is no key ends the connection, so there is at most one.
                let its_key = SessionKey::from_packet(&buffer);
                buffer.zeroize();
                key = Some(Arc::new(its_key?));
            }
            // A later version may send other messages first; a flood of them would keep all other connections waiting.
            Ok(ReceivedMessage { message: SessionMessage::Unknown(_), descriptors })
                if unknown < UNKNOWN && descriptors.is_empty() =>
            {
                unknown += 1;
            }
            Err(SocketError::NotReady) => ready.clear_ready(),
            // The cause is not a lack of descriptors here: some process keeps them back.
            Err(SocketError::NoDescriptors)
                if !descriptors::is_clogged() && spare.can_keep_caller() =>
            {
                let text = "its descriptors do not arrive".to_owned();
                say(socket, SessionMessage::Refused(*unshared(text)), &[]);
                return None;
            }
            Ok(_) | Err(_) => return None,
        }
        // A socket that stays readable must not keep other connections, or the time limit, from their turn.
        tokio::task::yield_now().await;
    }
}
