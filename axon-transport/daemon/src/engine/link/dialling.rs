//! Dials a peer: each candidate address in turn. In qkd all addresses are dialled with the same bootstrap key. The key
//! is dialled again until the peer's KME has it, or until the dialler gives the key up and requests another one
//! (`docs/formats.md`, section 2).
//!
//! The machine has no `handle_timeout`: [`poll_action`](Dialling::poll_action) does the work that is due.

use std::{fmt, net::SocketAddr, sync::Arc, time::Duration};

use axon_envelope::KeyId;
use quinn_proto::{ConnectError, ConnectionError};

use crate::{
    engine::{
        keyring::{Keyring, warn_disagreement},
        link::target::{
            DECRYPT_ERROR, DialTarget, HANDSHAKE_TIMEOUT, UNKNOWN_PSK_IDENTITY, dial_limit,
        },
        refusal::Refusal,
    },
    keys::{Completion, DialDecision, DialKey},
    link::CloseCode,
};

#[cfg(test)]
mod tests;

/// Longest wait for a key before the dialler is asked again.
const ASK_AGAIN: Duration = Duration::from_secs(1);
/// Longest wait for a key. A dial with a longer wait fails; discovery dials again.
const LONGEST_WAIT: Duration = Duration::from_secs(2);

/// One dial of one peer.
pub(crate) struct Dialling {
    target: DialTarget,
    /// The time at which the whole dial ends: `limit` after its start.
    deadline: Duration,
    limit: Duration,
    state: DialPhase,
    /// Reason of the last wait; a wait is logged only if its reason differs from this one.
    waited_for: String,
}

enum DialPhase {
    /// The dial has to choose the key of the next attempt; in classic there is none.
    Choose,
    /// The dial has no usable key before this time, or before the dialler has an answer.
    WaitForKey(Duration),
    /// The dial has to try the addresses from `next` on.
    Try(DialRound),
    /// A handshake with the address before `next` is in flight until this time.
    Connecting(DialRound, Duration),
    /// The handshake with the address before `next` ended with this outcome.
    Ended(DialRound, HandshakeOutcome),
    /// The connection was discarded: the dial ends with the next poll.
    Ending(Refusal),
    /// The dial ended.
    Over,
}

/// One pass over the addresses, in qkd under one key.
struct DialRound {
    attempt: Option<Arc<DialKey>>,
    next: usize,
    /// Error of the last address.
    last: String,
}

impl DialRound {
    fn new(attempt: Option<Arc<DialKey>>) -> Self {
        Self { attempt, next: 0, last: "no address to dial".into() }
    }
}

/// The outcome of a handshake.
enum HandshakeOutcome {
    Connected,
    Failed(ConnectionError),
    /// No packet was sent.
    Unreachable(String),
    /// The TLS settings do not make a valid client.
    Unusable(String),
}

/// The owner's next action.
#[derive(Debug)]
pub(crate) enum DialAction {
    /// Start a handshake with this address, in qkd under this key.
    Connect {
        /// The address.
        address: SocketAddr,
        /// The PSK, in qkd.
        attempt: Option<Arc<DialKey>>,
    },
    /// Close the connection of the last [`Connect`](Self::Connect). The dial ignores later events of that connection.
    Close {
        /// The application error code.
        code: CloseCode,
        /// The reason for the peer.
        reason: &'static str,
    },
    /// The handshake of the last [`Connect`](Self::Connect) is complete: the opening begins. The dial is over.
    Open,
    /// No address became a connection. The dial is over.
    Failed(Refusal),
}

/// Ends a handshake that takes too long. The peer sees the same close as for a dropped connection.
const ABANDON: DialAction = DialAction::Close { code: CloseCode::Goodbye, reason: "" };

impl fmt::Debug for Dialling {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Dialling").field("target", &self.target).finish_non_exhaustive()
    }
}

impl Dialling {
    /// Starts a dial of `target`, in qkd with the keys of this daemon.
    pub(crate) fn new(now: Duration, target: DialTarget, keyring: Option<&Keyring>) -> Self {
        let limit = dial_limit(keyring.map(|keyring| keyring.config.kme_answer_timeout));
        let (state, waited_for) = (DialPhase::Choose, String::new());
        Self { target, deadline: now + limit, limit, state, waited_for }
    }

    /// Returns the peer that is dialled.
    pub(crate) fn target(&self) -> &DialTarget {
        &self.target
    }

    /// Handles a complete handshake.
    pub(crate) fn handle_connected(&mut self) {
        self.end(HandshakeOutcome::Connected);
    }

    /// Handles a connection that ended before its handshake was complete.
    pub(crate) fn handle_failed(&mut self, error: &ConnectionError) {
        self.end(HandshakeOutcome::Failed(error.clone()));
    }

    /// Handles an address with which no handshake could be started: no local address reaches it, or QUIC refused with
    /// this error.
    pub(crate) fn handle_unreachable(&mut self, error: Option<&ConnectError>) {
        let DialPhase::Connecting(round, _) = &self.state else { return };
        let address = self.target.addresses[round.next - 1];
        self.end(HandshakeOutcome::Unreachable(match error {
            None => {
                format!("{address} cannot be reached from the addresses in AXON_BIND_ADDRS")
            }
            Some(error) => format!("{address}: {error}"),
        }));
    }

    /// Handles settings, or a key, that do not make a valid TLS client.
    pub(crate) fn handle_unusable(&mut self, error: impl fmt::Display) {
        self.end(HandshakeOutcome::Unusable(error.to_string()));
    }

    /// Handles a KME answer that the dialler took: a dial that waits for a key asks for it again.
    pub(crate) fn handle_key(&mut self) {
        if let DialPhase::WaitForKey(_) = self.state {
            self.state = DialPhase::Choose;
        }
    }

    /// Returns when to call [`poll_action`](Self::poll_action) without other cause.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        match &self.state {
            DialPhase::Over => None,
            DialPhase::WaitForKey(until) | DialPhase::Connecting(_, until) => {
                Some((*until).min(self.deadline))
            }
            // The action is due at once.
            _ => Some(Duration::ZERO),
        }
    }

    /// Returns the next action, if any. `keyring` is that of a daemon in qkd.
    pub(crate) fn poll_action(
        &mut self,
        now: Duration,
        mut keyring: Option<&mut Keyring>,
    ) -> Option<DialAction> {
        loop {
            match std::mem::replace(&mut self.state, DialPhase::Over) {
                DialPhase::Over => return None,
                DialPhase::Ending(refusal) => return Some(DialAction::Failed(refusal)),
                DialPhase::Ended(round, outcome) => {
                    let action = self.ended(now, round, outcome, keyring.as_deref_mut());
                    if action.is_some() {
                        return action;
                    }
                }
                state if now >= self.deadline => {
                    let late = Refusal::network(format!("no answer within {:?}", self.limit));
                    if let DialPhase::Connecting(..) = state {
                        self.state = DialPhase::Ending(late);
                        return Some(ABANDON);
                    }
                    return Some(DialAction::Failed(late));
                }
                DialPhase::Connecting(round, until) if now < until => {
                    self.state = DialPhase::Connecting(round, until);
                    return None;
                }
                DialPhase::Connecting(round, _) => {
                    self.silent(round);
                    return Some(ABANDON);
                }
                DialPhase::WaitForKey(until) if now < until => {
                    self.state = DialPhase::WaitForKey(until);
                    return None;
                }
                DialPhase::WaitForKey(_) | DialPhase::Choose => {
                    let action = self.choose(now, keyring.as_deref_mut());
                    if action.is_some() {
                        return action;
                    }
                }
                DialPhase::Try(mut round) => {
                    let Some(address) = self.target.addresses.get(round.next).copied() else {
                        let refusal = Refusal::network(&round.last);
                        match self.refused(now, &round, refusal, keyring.as_deref_mut()) {
                            Some(action) => return Some(action),
                            None => continue,
                        }
                    };
                    round.next += 1;
                    let attempt = round.attempt.clone();
                    self.state = DialPhase::Connecting(round, now + HANDSHAKE_TIMEOUT);
                    return Some(DialAction::Connect { address, attempt });
                }
            }
        }
    }

    fn end(&mut self, outcome: HandshakeOutcome) {
        match std::mem::replace(&mut self.state, DialPhase::Over) {
            DialPhase::Connecting(round, _) => self.state = DialPhase::Ended(round, outcome),
            // An event of a connection that the dial discarded.
            other => self.state = other,
        }
    }

    /// Chooses the key of the next round.
    fn choose(&mut self, now: Duration, keyring: Option<&mut Keyring>) -> Option<DialAction> {
        let Some(keyring) = keyring else {
            self.state = DialPhase::Try(DialRound::new(None));
            return None;
        };
        let Some(sae) = self.target.sae.as_deref() else {
            let text = "the peer states no SAE ID: it is not in qkd";
            return Some(DialAction::Failed(Refusal::here(CloseCode::Mode, text)));
        };
        match keyring.dial(now, sae) {
            DialDecision::Refused(reason) => {
                Some(DialAction::Failed(Refusal::here(CloseCode::NotAllowed, reason)))
            }
            DialDecision::Wait { until, why } => {
                // Failed until the next dial: the dialler is in its backoff.
                if until.is_some_and(|until| until > now + LONGEST_WAIT) {
                    return Some(DialAction::Failed(Refusal::here(CloseCode::KeySupply, why)));
                }
                if self.waited_for != why {
                    tracing::debug!(peer = sae, why, "dial waits");
                    self.waited_for = why;
                }
                let again = now + ASK_AGAIN;
                self.state = DialPhase::WaitForKey(until.map_or(again, |until| until.min(again)));
                None
            }
            DialDecision::Attempt(attempt) => {
                self.state = DialPhase::Try(DialRound::new(Some(Arc::new(attempt))));
                None
            }
        }
    }

    /// Handles the end of a handshake. Returns the next action, if there is one.
    fn ended(
        &mut self,
        now: Duration,
        mut round: DialRound,
        outcome: HandshakeOutcome,
        keyring: Option<&mut Keyring>,
    ) -> Option<DialAction> {
        match outcome {
            HandshakeOutcome::Connected => Some(self.connected(now, &round, keyring)),
            HandshakeOutcome::Unusable(error) => {
                Some(DialAction::Failed(Refusal::here(CloseCode::Internal, error)))
            }
            HandshakeOutcome::Unreachable(reason) => {
                round.last = reason;
                self.state = DialPhase::Try(round);
                None
            }
            HandshakeOutcome::Failed(ConnectionError::TimedOut) => {
                self.silent(round);
                None
            }
            // The peer that answers at one address answers at all of them.
            HandshakeOutcome::Failed(error) => {
                self.refused(now, &round, Refusal::of(&error), keyring)
            }
        }
    }

    /// Records that the address before `next` did not answer.
    fn silent(&mut self, mut round: DialRound) {
        let address = self.target.addresses[round.next - 1];
        round.last = format!("{address} does not answer");
        self.state = DialPhase::Try(round);
    }

    /// Handles a complete handshake: in qkd its key is spent.
    fn connected(
        &mut self,
        now: Duration,
        round: &DialRound,
        keyring: Option<&mut Keyring>,
    ) -> DialAction {
        let spent = |(keyring, sae, key_id): (&mut Keyring, &str, &KeyId)| {
            keyring.dialler().handle_success(now, sae, key_id) == Completion::First
        };
        if round.attempt.is_none() || self.key(round, keyring).is_some_and(spent) {
            return DialAction::Open;
        }
        let (code, reason) = (CloseCode::KeyReused, "this PSK has completed a handshake before");
        self.state = DialPhase::Ending(Refusal::here(code, reason));
        DialAction::Close { code, reason }
    }

    /// Handles a failed round: in qkd the key may be dialled again.
    fn refused(
        &mut self,
        now: Duration,
        round: &DialRound,
        refusal: Refusal,
        keyring: Option<&mut Keyring>,
    ) -> Option<DialAction> {
        let Some((keyring, sae, key_id)) = self.key(round, keyring) else {
            return Some(DialAction::Failed(refusal));
        };
        match refusal.alert {
            Some(UNKNOWN_PSK_IDENTITY) => {
                tracing::debug!(peer = sae, %refusal, "the peer does not have the key yet");
                keyring.dialler().handle_refusal(now, sae, key_id);
            }
            Some(DECRYPT_ERROR) => {
                tracing::debug!(peer = sae, %refusal, "the peer has another key");
                if keyring.dialler().handle_mismatch(now, sae, key_id) {
                    let what = format_args!("key_ID {key_id}");
                    warn_disagreement(&keyring.config, sae, &what);
                }
            }
            _ => {
                keyring.dialler().handle_silence(now, sae, key_id);
                return Some(DialAction::Failed(refusal));
            }
        }
        self.state = DialPhase::Choose;
        None
    }

    /// Returns the keyring, the peer's SAE ID and the key of a round; `None` in classic.
    fn key<'a>(
        &'a self,
        round: &'a DialRound,
        keyring: Option<&'a mut Keyring>,
    ) -> Option<(&'a mut Keyring, &'a str, &'a KeyId)> {
        let (keyring, attempt) = (keyring?, round.attempt.as_deref()?);
        Some((keyring, self.target.sae.as_deref()?, &attempt.key_id))
    }
}
