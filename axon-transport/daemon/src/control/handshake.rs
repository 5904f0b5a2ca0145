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

/// Messages of unknown types that may come before HELLO.
const UNKNOWN: u32 = 8;

/// What a connection begins with.
pub(super) struct PreHelloMessage {
    pub(super) hello: SessionHello,
    pub(super) descriptors: Vec<PassedFd>,
    /// What came before: the key that the session's id is made of.
    pub(super) key: Option<Arc<SessionKey>>,
    /// Its descriptors were left where they are, since there is no room for them.
    pub(super) is_crowded: bool,
}

impl PreHelloMessage {
    /// Whether the key that came, if one did, is that of the id.
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

/// Waits for HELLO; `None` when something else comes. Where descriptors are short and there is no room for another
/// session, those of HELLO stay in the socket: its sender could make their closing last.
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
                // One that is no key ends the connection: it comes once at most.
                let its_key = SessionKey::from_packet(&buffer);
                buffer.zeroize();
                key = Some(Arc::new(its_key?));
            }
            // A later version may say something first; a flood would keep everybody else waiting.
            Ok(ReceivedMessage { message: SessionMessage::Unknown(_), descriptors })
                if unknown < UNKNOWN && descriptors.is_empty() =>
            {
                unknown += 1;
            }
            Err(SocketError::NotReady) => ready.clear_ready(),
            // Not for want of room here: somebody keeps them back.
            Err(SocketError::NoDescriptors)
                if !descriptors::is_clogged() && spare.can_keep_caller() =>
            {
                let text = "its descriptors do not arrive".to_owned();
                say(socket, SessionMessage::Refused(*unshared(text)), &[]);
                return None;
            }
            Ok(_) | Err(_) => return None,
        }
        // A socket that stays readable must not keep the others, or the time limit, from their turn.
        tokio::task::yield_now().await;
    }
}
