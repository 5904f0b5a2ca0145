//! The KME keys of an attempt in qkd.

use std::{collections::VecDeque, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_transport::config::{Config, Security};

use crate::{
    engine::keyring::{Answered, Keyring},
    keys::{
        Events, Fetched, KeyPurpose, Kme, KmeAnswer, KmeError, KmeRequest, RequestOrigin, UsedKeys,
    },
};

/// The keyring and its KME client.
pub(super) struct Keys {
    pub(super) keyring: Keyring,
    kme: Kme,
    events: Events,
    /// Answers to requests that the full KME client did not take.
    refused: VecDeque<KmeAnswer>,
}

impl Keys {
    /// Starts the keys of an attempt with these settings; `None` in classic. Must run within a tokio runtime.
    ///
    /// # Errors
    /// The settings are not valid for a KME client.
    pub(super) fn start(config: &Config) -> Result<Option<Self>, KmeError> {
        let (Security::Qkd(qkd), Some(keyring)) = (&config.security, Keyring::new(config)) else {
            return Ok(None);
        };
        let (kme, events) = Kme::start(qkd, UsedKeys::in_memory())?;
        Ok(Some(Self { keyring, kme, events, refused: VecDeque::new() }))
    }

    /// Hands a request to the KME client.
    pub(super) fn submit(&mut self, (origin, request): (RequestOrigin, KmeRequest)) {
        if let Err(answer) = self.kme.submit(origin, request) {
            self.refused.push_back(*answer);
        }
    }

    /// Hands the keyring's requests to the KME client.
    pub(super) fn submit_all(&mut self, now: Duration) {
        while let Some(request) = self.keyring.poll_request(now) {
            self.submit(request);
        }
    }

    /// Waits for the next answer. Cancel safe.
    pub(super) async fn answer(&mut self) -> KmeAnswer {
        if let Some(event) = self.refused.pop_front() {
            return event;
        }
        match self.events.recv().await {
            Some(event) => event,
            // The client ended with the runtime.
            None => std::future::pending().await,
        }
    }

    /// Fetches a fresh key for the peer `slave`, for a handshake that no state machine knows.
    ///
    /// # Errors
    /// The KME gave no key; the text says why.
    pub(super) async fn fetch(
        &mut self,
        now: Duration,
        slave: &str,
    ) -> Result<(KeyId, KmeKey), String> {
        let slave = slave.to_owned();
        let request = KmeRequest::Enc { slave, number: 1, purpose: KeyPurpose::Bootstrap };
        // The origin of an opening: the keyring passes the answer on. No opening is under way.
        self.submit((RequestOrigin::Proof(0), request));
        loop {
            let event = self.answer().await;
            let Answered::Opening(_, answer) = self.keyring.handle_answer(now, event) else {
                continue;
            };
            return match answer.outcome {
                Ok(Fetched::Keys(mut keys)) if !keys.is_empty() => Ok(keys.swap_remove(0)),
                Err(failure) => Err(failure.to_string()),
                _ => Err("the KME gave no key".into()),
            };
        }
    }
}
