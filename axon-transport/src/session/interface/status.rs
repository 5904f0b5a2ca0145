//! Requests the daemon's status over the session's connection.

use std::sync::PoisonError;

use axon_shm::ShmError;

use crate::{
    config::DaemonPolicy,
    session::{
        core::Outgoing,
        daemon::{
            address::Address,
            daemon_status,
            status::{ANSWER, status_text},
            status_text::StatusAnswer,
        },
        error::SessionError,
        handle::Session,
    },
    wire::session::SessionMessage,
};

impl Session {
    /// Returns the daemon's status: the JSON of [`Status`](crate::status::Status).
    ///
    /// # Errors
    /// When there is no daemon or it does not answer in time.
    pub fn status_json(&self) -> Result<String, SessionError> {
        let (shared, core) = (self.shared(), self.core());
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let _asking = shared.asking.lock().unwrap_or_else(PoisonError::into_inner);
        if core.config.daemon == DaemonPolicy::Off {
            return Err(SessionError::Off);
        }
        if self.is_relayed() {
            return daemon_status(&core.config);
        }
        if !core.link.ask_status() {
            return Err(SessionError::Disconnected);
        }
        core.tell(Outgoing::message(SessionMessage::StatusRequest));
        shared.wait_changed(ANSWER, || !core.link.awaits_status());
        match core.link.take_status() {
            StatusAnswer::Whole(bytes) => status_text(bytes),
            StatusAnswer::Lost => Err(SessionError::Disconnected),
            StatusAnswer::None | StatusAnswer::Parts(_) => {
                Err(SessionError::Silent { address: Address::of(&core.config).to_string() })
            }
        }
    }
}
