//! From a completed TLS handshake to a connection that awaits its election: HELLO in both directions and, in
//! qkd, the proof of the client's name (`docs/formats.md`, sections 2 and 6).
//!
//! After each call that changes the machine its owner drains [`poll_message`](Opening::poll_message), then
//! [`poll_request`](Opening::poll_request), then [`poll_outcome`](Opening::poll_outcome). Key announcements
//! that the keyring has for the connection go on its control stream before anything that the owner says
//! because of the outcome: ELECTED must not overtake READY.

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
    /// Which end this side is.
    pub(crate) side: Side,
    /// The peer's address.
    pub(crate) remote: SocketAddr,
    /// What the two sides agreed on; `None` while the handshake is not complete.
    pub(crate) negotiated: Option<Negotiated>,
    /// The TLS exporters of the connection. They are used in qkd alone.
    pub(crate) exporters: Option<Exporters>,
    /// The certificates that the peer showed, or one raw public key.
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
    /// Whether the settings are those of qkd.
    qkd: bool,
    /// In `ca`: the certificates that have to name the peer's host.
    chain: Option<Vec<CertificateDer<'static>>>,
    negotiated: Option<Negotiated>,
    exporters: Option<Exporters>,
    order: MessageOrder,
    step: OpeningStep,
    /// When the step ends at the latest.
    until: Option<Duration>,
    /// Both HELLOs were checked.
    greeted: bool,
    /// The opening succeeded.
    opened: bool,
    messages: VecDeque<LinkMessage>,
    outcome: Option<Result<OpenedConnection, RefusedConnection>>,
}

enum OpeningStep {
    /// Server in qkd: the ledger of used keys is asked about the PSK of this SAE.
    Recording(String),
    /// The peer's HELLO is due, in qkd with this SAE.
    Hello(Option<String>),
    /// The client's name is being proven, and HELLO was this.
    Proof(Box<Proving>, Box<LinkHello>),
    Over,
}

/// A connection whose peer said HELLO and, in qkd, proved its name.
pub(crate) struct OpenedConnection {
    /// The peer's HELLO.
    pub(crate) hello: LinkHello,
    /// What the handshake agreed on.
    pub(crate) negotiated: Negotiated,
    /// Judges the next messages.
    pub(crate) order: MessageOrder,
    /// The key material of the connection, in messages10. Its receiver is attached to the keyring.
    pub(crate) sealing: Option<Sealing>,
}

/// What [`Keyring::attach_sender`] takes once the connection is elected.
pub(crate) struct Sealing {
    /// Bind the message keys to this connection.
    pub(crate) exporters: Exporters,
    /// Server: the key that proved the client's name, its first sending key.
    pub(crate) first: Option<(KeyId, KmeKey)>,
}

/// Why a connection does not become a link. The keyring has let go of it.
#[derive(Debug)]
pub(crate) struct RefusedConnection {
    /// For log and status.
    pub(crate) refusal: Refusal,
    /// The code and text with which this side closes the connection, if it does. The text may be longer
    /// than a close takes.
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
    /// Begins with a connection whose TLS handshake is complete.
    ///
    /// `ours` is this side's HELLO, `closed` why this host accepts no new peer at present, and `keyring` that
    /// of a daemon in qkd.
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

    /// Whether the owner may read the next message from the control stream. What the peer sends
    /// meanwhile waits in the stream.
    pub(crate) fn reads(&self) -> bool {
        match &self.step {
            OpeningStep::Hello(_) => true,
            OpeningStep::Proof(proving, _) => proving.reads(),
            OpeningStep::Recording(_) | OpeningStep::Over => false,
        }
    }

    /// The limits of the next frame.
    pub(crate) fn limits(&self) -> FrameLimits {
        match (self.greeted, self.opened) {
            (_, true) => FrameLimits::PROVEN,
            (true, false) => FrameLimits::UNPROVEN,
            (false, false) => FrameLimits::BEFORE_HELLO,
        }
    }

    /// A message of a known type came. The owner calls it only while [`reads`](Self::reads) allows it: a
    /// message at another time ends the opening.
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

    /// The control stream carries bytes that are no frame.
    pub(crate) fn handle_unreadable(
        &mut self,
        now: Duration,
        error: FrameError,
        keyring: Option<&mut Keyring>,
    ) {
        self.fail(now, ControlError::Frame(error).into(), None, keyring);
    }

    /// The peer ended the control stream; the connection stands.
    pub(crate) fn handle_ended(&mut self, now: Duration, why: &str, keyring: Option<&mut Keyring>) {
        self.fail(now, ControlError::Ended(why.to_owned()).into(), None, keyring);
    }

    /// The connection ended.
    pub(crate) fn handle_lost(
        &mut self,
        now: Duration,
        error: &ConnectionError,
        keyring: Option<&mut Keyring>,
    ) {
        self.fail(now, LinkFailure::Connection, Some(error), keyring);
    }

    /// The KME's answer to a request of this opening.
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

    /// The ledger of used keys recorded the PSK of the handshake; `first` when it was new there.
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

    /// The next message for the control stream.
    pub(crate) fn poll_message(&mut self) -> Option<LinkMessage> {
        self.messages.pop_front()
    }

    /// The next call to the KME, if any.
    pub(crate) fn poll_request(&mut self, now: Duration) -> Option<(RequestOrigin, KmeRequest)> {
        match &mut self.step {
            OpeningStep::Proof(proving, _) => proving.poll_request(now),
            _ => None,
        }
    }

    /// How the opening ended, once. To be polled after each change of the connection's keys
    /// ([`Keyring::poll_changed`]) as well.
    pub(crate) fn poll_outcome(
        &mut self,
        now: Duration,
        keyring: Option<&mut Keyring>,
    ) -> Option<Result<OpenedConnection, RefusedConnection>> {
        self.advance(now, keyring);
        self.outcome.take()
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let proof = match &self.step {
            OpeningStep::Proof(proving, _) => proving.poll_timeout(),
            _ => None,
        };
        [self.until, proof].into_iter().flatten().min()
    }

    /// Ends a step whose time is over, and asks the KME again where that is due.
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

    /// Finds out the peer's SAE by the PSK, in qkd. A server spends the PSK here: the client's Finished was
    /// verified.
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

    /// The client says HELLO, and both sides wait for the peer's.
    fn greet(&mut self, now: Duration, psk_sae: Option<String>) {
        if self.side == Side::Client {
            self.messages.push_back(LinkMessage::Hello(self.ours.clone()));
        }
        self.step = OpeningStep::Hello(psk_sae);
        self.until = Some(now + HELLO_TIMEOUT);
    }

    /// Takes the message that the step waits for.
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

    /// The peer's HELLO is good.
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

    /// Takes from the proof what it has to say, and its end.
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

    /// The connection awaits its election.
    fn open(&mut self, hello: LinkHello, sealing: Option<Sealing>) {
        self.step = OpeningStep::Over;
        self.until = None;
        self.opened = true;
        let order = self.order.clone();
        if let Some(negotiated) = self.negotiated.take() {
            self.outcome = Some(Ok(OpenedConnection { hello, negotiated, order, sealing }));
        }
    }

    /// The connection does not become a link. `ended` is why it ended, if it did.
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
            // Before the proof is dropped, which counts at this time.
            keyring.set_time(now);
            keyring.forget_connection(now, self.connection);
        }
        self.step = OpeningStep::Over;
    }
}
