//! Takes a connection from a completed TLS handshake to the wait for its election: HELLO in both directions and, in
//! qkd, the proof of the client's name (`docs/formats.md`, sections 2 and 6).
//!
//! After each call that changes the machine, its owner drains [`poll_message`](Opening::poll_message), then
//! [`poll_request`](Opening::poll_request), then [`poll_outcome`](Opening::poll_outcome). Key announcements that the
//! keyring has for the connection go on its control stream before any message that the owner sends because of the
//! outcome: ELECTED must not overtake READY.

use std::{collections::VecDeque, fmt, mem, net::SocketAddr, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_tls::{Negotiated, qkd::PskIdentity};
use axon_transport::config::{ClassicAuth, Config, Security};
use quinn_proto::ConnectionError;
use rustls_pki_types::CertificateDer;

use super::proving::Proving;
use crate::{
    engine::{
        keyring::Keyring,
        link::failure::{HELLO_TIMEOUT, LinkFailure, admits, agreed, names_its_host, reused},
        quic::control_stream::{ControlError, FrameLimits},
        refusal::Refusal,
    },
    keys::{Answer, Completion, Exporters, KmeRequest, RequestOrigin},
    link::{CloseCode, FrameError, LinkHello, LinkMessage, MessageOrder, Side, check},
};

#[cfg(test)]
mod tests;

/// The facts of a completed TLS handshake.
pub(crate) struct Handshake {
    /// This daemon's number for the connection.
    pub(crate) connection: u64,
    /// The role of this side.
    pub(crate) side: Side,
    /// The peer's address.
    pub(crate) remote: SocketAddr,
    /// The agreed parameters; `None` while the handshake is not complete.
    pub(crate) negotiated: Option<Negotiated>,
    /// The TLS exporters of the connection. They are used in qkd alone.
    pub(crate) exporters: Option<Exporters>,
    /// The peer's certificates, or one raw public key.
    pub(crate) chain: Vec<CertificateDer<'static>>,
    /// The SAE that the client dialled, in qkd.
    pub(crate) dialled: Option<String>,
}

/// One connection between its TLS handshake and its election.
pub(crate) struct Opening {
    connection: u64,
    side: Side,
    remote: SocketAddr,
    ours: LinkHello,
    /// True if the settings are those of qkd.
    qkd: bool,
    /// In `ca`: the certificates that have to name the peer's host.
    chain: Option<Vec<CertificateDer<'static>>>,
    negotiated: Option<Negotiated>,
    exporters: Option<Exporters>,
    order: MessageOrder,
    step: OpeningStep,
    /// The time at which the step ends at the latest.
    until: Option<Duration>,
    /// True if both HELLOs were checked.
    greeted: bool,
    /// True if the opening succeeded.
    opened: bool,
    messages: VecDeque<LinkMessage>,
    outcome: Option<Result<OpenedConnection, RefusedConnection>>,
}

enum OpeningStep {
    /// Server in qkd: the ledger of used keys checks the PSK of this SAE.
    Recording(String),
    /// The peer's HELLO is due, in qkd with this SAE.
    Hello(Option<String>),
    /// The client's name is being proven. The second field is the peer's HELLO.
    Proof(Box<Proving>, Box<LinkHello>),
    Over,
}

/// A connection whose peer sent HELLO and, in qkd, proved its name.
pub(crate) struct OpenedConnection {
    /// The peer's HELLO.
    pub(crate) hello: LinkHello,
    /// The agreed parameters of the handshake.
    pub(crate) negotiated: Negotiated,
    /// Checks the order of the next messages.
    pub(crate) order: MessageOrder,
    /// The key material of the connection, in messages10. Its receiver is attached to the keyring.
    pub(crate) sealing: Option<Sealing>,
}

/// The key material that [`Keyring::attach_sender`] takes once the connection is elected.
pub(crate) struct Sealing {
    /// Exporters that bind the message keys to this connection.
    pub(crate) exporters: Exporters,
    /// Server: the key that proved the client's name, its first sending key.
    pub(crate) first: Option<(KeyId, KmeKey)>,
}

/// The reason for which a connection does not become a link. The keyring has released the connection.
#[derive(Debug)]
pub(crate) struct RefusedConnection {
    /// The refusal for log and status.
    pub(crate) refusal: Refusal,
    /// The code and text with which this side closes the connection, if it does. The text may be longer than a close
    /// permits.
    pub(crate) close: Option<(CloseCode, String)>,
}

impl fmt::Debug for OpenedConnection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("OpenedConnection").field("hello", &self.hello).finish_non_exhaustive()
    }
}

impl fmt::Debug for Opening {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut debug = f.debug_struct("Opening");
        debug.field("connection", &self.connection).field("side", &self.side);
        debug.finish_non_exhaustive()
    }
}

impl Opening {
    /// Starts the opening of a connection whose TLS handshake is complete.
    ///
    /// `ours` is this side's HELLO, `closed` the reason for which this host accepts no new peer at present, and
    /// `keyring` that of a daemon in qkd.
    pub(crate) fn new(
        now: Duration,
        handshake: Handshake,
        ours: LinkHello,
        config: &Config,
        closed: Option<String>,
        mut keyring: Option<&mut Keyring>,
    ) -> Self {
        let Handshake { connection, side, remote, negotiated, exporters, chain, dialled } =
            handshake;
        let ca = matches!(&config.security, Security::Classic(c) if c.auth == ClassicAuth::Ca);
        let qkd = matches!(&config.security, Security::Qkd(_));
        let mut opening = Self {
            connection,
            side,
            remote,
            ours,
            qkd,
            chain: ca.then_some(chain),
            negotiated: None,
            exporters,
            order: MessageOrder::new(side, qkd),
            step: OpeningStep::Hello(None),
            until: None,
            greeted: false,
            opened: false,
            messages: VecDeque::new(),
            outcome: None,
        };
        let begun = agreed(config, negotiated).and_then(|negotiated| {
            admits(closed)?;
            opening.begin(now, negotiated, dialled, keyring.as_deref_mut())
        });
        if let Err(failure) = begun {
            opening.fail(now, failure, None, keyring);
        }
        opening
    }

    /// Returns whether the owner may read the next message from the control stream. Until then the peer's messages wait
    /// in the stream.
    pub(crate) fn reads(&self) -> bool {
        match &self.step {
            OpeningStep::Hello(_) => true,
            OpeningStep::Proof(proving, _) => proving.reads(),
            OpeningStep::Recording(_) | OpeningStep::Over => false,
        }
    }

    /// Returns the limits of the next frame.
    pub(crate) fn limits(&self) -> FrameLimits {
        match (self.greeted, self.opened) {
            (_, true) => FrameLimits::PROVEN,
            (true, false) => FrameLimits::UNPROVEN,
            (false, false) => FrameLimits::BEFORE_HELLO,
        }
    }

    /// Handles a message of a known type. The owner calls it only while [`reads`](Self::reads) allows it: a message at
    /// another time ends the opening.
    pub(crate) fn handle_message(
        &mut self,
        now: Duration,
        message: &LinkMessage,
        mut keyring: Option<&mut Keyring>,
    ) {
        let taken = if self.reads() {
            self.take(now, message, keyring.as_deref_mut())
        } else {
            let text = "a message was read before its time";
            Err(LinkFailure::Ours(CloseCode::Internal, text.into()))
        };
        match taken {
            Ok(()) => self.advance(now, keyring),
            Err(failure) => self.fail(now, failure, None, keyring),
        }
    }

    /// Handles bytes of the control stream that are no frame.
    pub(crate) fn handle_unreadable(
        &mut self,
        now: Duration,
        error: FrameError,
        keyring: Option<&mut Keyring>,
    ) {
        self.fail(now, ControlError::Frame(error).into(), None, keyring);
    }

    /// Handles the end of the control stream by the peer; the connection is still up.
    pub(crate) fn handle_ended(&mut self, now: Duration, why: &str, keyring: Option<&mut Keyring>) {
        self.fail(now, ControlError::Ended(why.to_owned()).into(), None, keyring);
    }

    /// Handles the end of the connection.
    pub(crate) fn handle_lost(
        &mut self,
        now: Duration,
        error: &ConnectionError,
        keyring: Option<&mut Keyring>,
    ) {
        self.fail(now, LinkFailure::Connection, Some(error), keyring);
    }

    /// Handles the KME's answer to a request of this opening.
    pub(crate) fn handle_answer(
        &mut self,
        now: Duration,
        answer: Answer,
        keyring: Option<&mut Keyring>,
    ) {
        if let OpeningStep::Proof(proving, _) = &mut self.step {
            proving.handle_answer(now, answer);
        }
        self.advance(now, keyring);
    }

    /// Handles the ledger's record of the handshake's PSK; `first` if it was new there.
    pub(crate) fn handle_recorded(
        &mut self,
        now: Duration,
        first: bool,
        keyring: Option<&mut Keyring>,
    ) {
        let OpeningStep::Recording(sae) = &mut self.step else { return };
        let sae = mem::take(sae);
        match first {
            true => self.greet(now, Some(sae)),
            false => self.fail(now, reused(), None, keyring),
        }
    }

    /// Returns the next message for the control stream.
    pub(crate) fn poll_message(&mut self) -> Option<LinkMessage> {
        self.messages.pop_front()
    }

    /// Returns the next call to the KME, if any.
    pub(crate) fn poll_request(&mut self, now: Duration) -> Option<(RequestOrigin, KmeRequest)> {
        match &mut self.step {
            OpeningStep::Proof(proving, _) => proving.poll_request(now),
            _ => None,
        }
    }

    /// Returns the outcome of the opening, once. The owner also polls it after each change of the connection's keys
    /// ([`Keyring::poll_changed`]).
    pub(crate) fn poll_outcome(
        &mut self,
        now: Duration,
        keyring: Option<&mut Keyring>,
    ) -> Option<Result<OpenedConnection, RefusedConnection>> {
        self.advance(now, keyring);
        self.outcome.take()
    }

    /// Returns when to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let proof = match &self.step {
            OpeningStep::Proof(proving, _) => proving.poll_timeout(),
            _ => None,
        };
        [self.until, proof].into_iter().flatten().min()
    }

    /// Ends a step whose time is over, and repeats a KME request that is due.
    pub(crate) fn handle_timeout(&mut self, now: Duration, mut keyring: Option<&mut Keyring>) {
        if let OpeningStep::Proof(proving, _) = &mut self.step {
            proving.handle_timeout(now);
        }
        self.advance(now, keyring.as_deref_mut());
        if self.until.is_none_or(|until| now < until) {
            return;
        }
        let late = match &self.step {
            OpeningStep::Hello(_) => {
                LinkFailure::Ours(CloseCode::OutOfOrder, "no HELLO within 5 s".into())
            }
            OpeningStep::Proof(proving, _) => {
                let text = format!("no proof within {:?}", proving.limit());
                LinkFailure::Ours(CloseCode::KeySupply, text)
            }
            OpeningStep::Recording(_) | OpeningStep::Over => return,
        };
        self.fail(now, late, None, keyring);
    }

    /// Starts the first step. A server in qkd reads the peer's SAE from the identity of the PSK. It spends the PSK
    /// here, because the client's Finished was verified. A client in qkd expects the SAE that it dialled.
    fn begin(
        &mut self,
        now: Duration,
        negotiated: Negotiated,
        dialled: Option<String>,
        keyring: Option<&mut Keyring>,
    ) -> Result<(), LinkFailure> {
        if !self.qkd {
            self.negotiated = Some(negotiated);
            self.greet(now, None);
            return Ok(());
        }
        let without_keys = || LinkFailure::Ours(CloseCode::Internal, "no keys in qkd".into());
        let keyring = keyring.ok_or_else(without_keys)?;
        match self.side {
            Side::Client => self.greet(now, dialled),
            Side::Server => {
                let identity = negotiated.psk_identity.as_deref().unwrap_or_default();
                let parsed = PskIdentity::parse(identity)
                    .map_err(|e| LinkFailure::Ours(CloseCode::Internal, e.to_string()))?;
                match keyring.spent(now, self.connection, identity, parsed.key_id()) {
                    Completion::First => {
                        self.step = OpeningStep::Recording(parsed.client_sae().to_owned());
                    }
                    Completion::Reused => return Err(reused()),
                }
            }
        }
        self.negotiated = Some(negotiated);
        Ok(())
    }

    /// Sends the client's HELLO. Both sides then wait for the peer's.
    fn greet(&mut self, now: Duration, psk_sae: Option<String>) {
        if self.side == Side::Client {
            self.messages.push_back(LinkMessage::Hello(self.ours.clone()));
        }
        self.step = OpeningStep::Hello(psk_sae);
        self.until = Some(now + HELLO_TIMEOUT);
    }

    /// Handles the message that the step waits for.
    fn take(
        &mut self,
        now: Duration,
        message: &LinkMessage,
        keyring: Option<&mut Keyring>,
    ) -> Result<(), LinkFailure> {
        let out_of_order = |text: String| LinkFailure::Ours(CloseCode::OutOfOrder, text);
        self.order.accept(message).map_err(|e| out_of_order(e.to_string()))?;
        match (&mut self.step, message, keyring) {
            (OpeningStep::Hello(psk_sae), LinkMessage::Hello(theirs), keyring) => {
                check(&self.ours, theirs, psk_sae.as_deref())
                    .map_err(|m| LinkFailure::Ours(m.code, m.to_string()))?;
                if let Some(chain) = &self.chain {
                    names_its_host(chain, theirs)?;
                }
                self.greeted(now, theirs, keyring)
            }
            (OpeningStep::Hello(_), ..) => Err(out_of_order("HELLO must come first".into())),
            (OpeningStep::Proof(proving, _), LinkMessage::Keys(message), Some(keyring)) => {
                proving.handle_message(now, message, keyring)
            }
            // KEEPALIVE.
            _ => Ok(()),
        }
    }

    /// Handles the peer's valid HELLO.
    fn greeted(
        &mut self,
        now: Duration,
        theirs: &LinkHello,
        keyring: Option<&mut Keyring>,
    ) -> Result<(), LinkFailure> {
        if self.side == Side::Server {
            self.messages.push_back(LinkMessage::Hello(self.ours.clone()));
        }
        self.greeted = true;
        self.order.hello_checked(theirs.daemon < self.ours.daemon);
        if !self.qkd {
            self.open(theirs.clone(), None);
            return Ok(());
        }
        let internal = |text: &str| LinkFailure::Ours(CloseCode::Internal, text.into());
        let keyring = keyring.ok_or_else(|| internal("no keys to prove the client's name with"))?;
        let sae = theirs.sae.as_deref().ok_or_else(|| internal("no SAE ID to prove"))?;
        let exporters = self.exporters.as_ref().ok_or_else(|| internal("no TLS exporter"))?;
        let (connection, source) = (self.connection, self.remote.ip());
        let proving = match self.side {
            Side::Server => Proving::demand(now, connection, source, sae, exporters, keyring),
            Side::Client => Proving::give(now, connection, source, sae, exporters, keyring)?,
        };
        self.until = Some(now + proving.limit());
        self.step = OpeningStep::Proof(Box::new(proving), Box::new(theirs.clone()));
        Ok(())
    }

    /// Takes the proof's messages and its outcome.
    fn advance(&mut self, now: Duration, keyring: Option<&mut Keyring>) {
        let (OpeningStep::Proof(proving, hello), Some(keyring)) = (&mut self.step, keyring) else {
            return;
        };
        while let Some(message) = proving.poll_message() {
            self.messages.push_back(LinkMessage::Keys(message));
        }
        let Some(exporters) = &self.exporters else { return };
        match proving.poll_outcome(now, exporters, keyring) {
            None => {}
            Some(Err(failure)) => self.fail(now, failure, None, Some(keyring)),
            Some(Ok(first)) => {
                let hello = (**hello).clone();
                let exporters = self.exporters.take().filter(|_| keyring.seals_messages());
                self.order.proven();
                self.open(hello, exporters.map(|exporters| Sealing { exporters, first }));
            }
        }
    }

    /// Ends the opening with success: the connection awaits its election.
    fn open(&mut self, hello: LinkHello, sealing: Option<Sealing>) {
        self.step = OpeningStep::Over;
        self.until = None;
        self.opened = true;
        let order = self.order.clone();
        if let Some(negotiated) = self.negotiated.take() {
            self.outcome = Some(Ok(OpenedConnection { hello, negotiated, order, sealing }));
        }
    }

    /// Ends the opening with a failure. `ended` is the connection's error, if it ended.
    fn fail(
        &mut self,
        now: Duration,
        failure: LinkFailure,
        ended: Option<&ConnectionError>,
        keyring: Option<&mut Keyring>,
    ) {
        if matches!(self.step, OpeningStep::Over) && !matches!(self.outcome, Some(Ok(_))) {
            return;
        }
        let (refusal, close) = failure.into_refusal(ended);
        self.outcome = Some(Err(RefusedConnection { refusal, close }));
        self.until = None;
        if let Some(keyring) = keyring {
            // Before the drop of the proof, which counts as failed at this time.
            keyring.set_time(now);
            keyring.forget_connection(now, self.connection);
        }
        self.step = OpeningStep::Over;
    }
}
