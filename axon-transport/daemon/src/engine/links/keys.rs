//! The keys of the links: passes on the answers of the KME and the ledger, and provides the protection of messages.

use std::{collections::HashSet, time::Duration};

use super::{LinkEvent, LinkPhase, Links};
use crate::{
    engine::{
        keyring::Answered,
        quic::connection::Carrier,
        sample::protection::{Open, Seal},
    },
    keys,
    link::LinkMessage,
};

impl Links {
    /// Passes on the messages and changes of the keyring.
    pub(super) fn pass_keys_on(&mut self, now: Duration) {
        let mut changed = HashSet::new();
        while let Some(keyring) = &mut self.keyring {
            if let Some((connection, message)) = keyring.poll_message(now) {
                self.send(connection, &LinkMessage::Keys(message), now);
            } else if let Some(connection) = keyring.poll_changed(now) {
                changed.insert(connection);
            } else {
                break;
            }
        }
        for number in changed {
            self.go_on_opening(number, now);
            if let Some(daemon) = self.table.daemon(number) {
                self.outbox.event(LinkEvent::Keys(daemon));
            }
        }
    }

    /// Handles an answer of the KME, or of the ledger of used keys.
    pub(in crate::engine) fn handle_key_event(&mut self, now: Duration, event: keys::KmeAnswer) {
        let Some(keyring) = &mut self.keyring else { return };
        match keyring.handle_answer(now, event) {
            Answered::Here => {}
            Answered::Dialler => self.dials.handle_key(),
            Answered::Opening(number, answer) => {
                if let Some(opening) = self.table.opening_mut(number) {
                    opening.handle_answer(now, answer, self.keyring.as_mut());
                    self.go_on_opening(number, now);
                }
            }
        }
    }

    /// Handles that the ledger of used keys recorded the key of a connection; `first` if it was new.
    pub(in crate::engine) fn handle_recorded(&mut self, now: Duration, number: u64, first: bool) {
        if let Some(opening) = self.table.opening_mut(number) {
            opening.handle_recorded(now, first, self.keyring.as_mut());
            self.go_on_opening(number, now);
        }
    }

    /// Returns the next request to the KME.
    pub(in crate::engine) fn poll_request(
        &mut self,
        now: Duration,
    ) -> Option<(keys::RequestOrigin, keys::KmeRequest)> {
        self.keyring.as_mut()?;
        for (_, link) in self.table.iter_mut() {
            if let LinkPhase::Opening(opening) = &mut link.phase
                && let Some(request) = opening.poll_request(now)
            {
                return Some(request);
            }
        }
        self.keyring.as_mut()?.poll_request(now)
    }

    /// Returns the next key to record in the ledger of used keys, and its connection.
    pub(in crate::engine) fn poll_record(&mut self) -> Option<(u64, String)> {
        self.keyring.as_mut()?.poll_record()
    }

    /// Returns the connection of a link as a carrier of samples.
    pub(in crate::engine) fn carrier(&mut self, number: u64, now: Duration) -> Option<Carrier<'_>> {
        let connection = self.connections.get_mut(number)?;
        let seals = self.table.get(number)?.peer.as_ref()?.seals;
        let seal = match self.keyring.as_mut().filter(|_| seals) {
            Some(keyring) => match keyring.sender(number) {
                Some(sender) => Seal::Envelope { sender, connection: number },
                None => return None,
            },
            None => Seal::Link,
        };
        Some(connection.carrier(seal, now))
    }

    /// Returns the connection of a link, the opener of its messages, and whether it carries copies alone.
    pub(in crate::engine) fn reader(
        &mut self,
        number: u64,
    ) -> Option<(&mut quinn_proto::Connection, Open<'_>, bool)> {
        let connection = self.connections.get_mut(number)?;
        let link = self.table.get(number)?;
        let copies_alone = link.carries_copies();
        if !link.carries() && !copies_alone {
            return None;
        }
        let seals = link.peer.as_ref()?.seals;
        let open = match self.keyring.as_mut().filter(|_| seals) {
            Some(keyring) => {
                let receiver = keyring.receiver(number)?;
                Open::Envelope { receiver, connection: number }
            }
            None => Open::Link,
        };
        Some((&mut connection.quic, open, copies_alone))
    }
}
