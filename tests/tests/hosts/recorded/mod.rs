//! Computes the secrets of connections in `qkd` from the recorded handshakes and the KME's keys.
//!
//! In `psk_ke` no other input is needed, because there is no key exchange. So both ends can be released daemons, which
//! reveal no secret. In `psk_dhe_ke` one end has to reveal the shared secret of the key exchange.

mod envelopes;
mod packets;

use std::collections::BTreeMap;

use axon_tests::{
    memory::Needles,
    schedule::{Mode, Schedule, Secret, Terms, flights},
};
use axon_tls::{Cipher, PskKex};

pub(crate) use self::envelopes::Nonces;
use self::packets::{Kind, Opens, Packet, Stream, packets};
use super::{
    mode::{Drawn, SAE},
    wire::Wire,
};

/// The labels of the exporters that a daemon asks a connection in `qkd` for, and that go into keys.
pub(crate) const EXPORTERS: [&str; 2] = ["EXPORTER-AXQKD001", "EXPORTER-axon-ready"];
/// The label of one whose value is signed: it opens nothing, and nothing is made of it.
const SIGNED: &str = "EXPORTER-axon-session-owner";

/// The secrets of a connection that was established.
pub(crate) struct Connection {
    /// Secrets that the connection uses as long as it stands.
    pub(crate) in_use: Vec<Secret>,
    /// The others.
    pub(crate) used_up: Vec<Secret>,
    /// The key_ID of the connection's key.
    pub(crate) key_id: String,
    /// The output of the envelope's exporter.
    pub(crate) context: Vec<u8>,
    /// The first traffic secret and those of the next key updates, the client's and the server's.
    traffic: [[Vec<u8>; 3]; 2],
}

impl Connection {
    /// Computes the secrets of a connection with the key in `terms`.
    fn new(terms: Terms<'_>, transcript: &[u8], shared: Option<&[u8]>) -> Self {
        let schedule = Schedule::new(terms, transcript, shared);
        let is_psk = |secret: &&Secret| secret.name == "pre-shared key";
        // A daemon erases it when the handshake is complete.
        let psk = schedule.in_use().iter().filter(is_psk).cloned();
        let mut used_up: Vec<_> = psk.chain(schedule.used_up().iter().cloned()).collect();
        let mut in_use: Vec<_> =
            schedule.in_use().iter().filter(|secret| !is_psk(secret)).cloned().collect();
        let traffic = ["client", "server"].map(|end| {
            [0, 1, 2].map(|update| {
                let name = format!("{end} traffic secret {update}");
                let mut all = used_up.iter().chain(&in_use);
                all.find(|secret| secret.name == name).unwrap().bytes.clone()
            })
        });
        let mut context = Vec::new();
        for label in EXPORTERS.into_iter().chain([SIGNED]) {
            let [of_label, exported] = schedule.export(label).expect("the schedule is complete");
            used_up.push(Secret::new(format!("secret of {label}"), &of_label));
            if label != SIGNED {
                in_use.push(Secret::new(label, &exported));
            }
            if label == EXPORTERS[0] {
                context = exported;
            }
        }
        Self { in_use, used_up, key_id: terms.key_id.to_owned(), context, traffic }
    }

    /// Adds the connection's secrets to the needles, with the kinds [`IN_USE`] and [`USED_UP`].
    pub(crate) fn add_to(&self, needles: &mut Needles, number: usize) {
        for (kind, secrets) in [(IN_USE, &self.in_use), (USED_UP, &self.used_up)] {
            for secret in secrets {
                needles.add(kind, number, &secret.bytes);
            }
        }
    }
}

/// Secrets that a connection uses as long as it stands.
pub(crate) const IN_USE: &str = "secret of a connection";
/// Secrets that a connection has no use for.
pub(crate) const USED_UP: &str = "secret of a connection's handshake";

/// The handshake bytes of each end of a connection: the client and the server.
#[derive(Default)]
struct Streams([Stream; 2]);

impl Streams {
    fn take(&mut self, opens: &[Opens; 2], packet: &Packet<'_>) {
        for (stream, opens) in self.0.iter_mut().zip(opens) {
            if let Some(frames) = opens.open(packet) {
                stream.add(&frames);
            }
        }
    }

    fn bytes(&self) -> [Vec<u8>; 2] {
        self.0.each_ref().map(Stream::bytes)
    }
}

/// Returns the connections whose handshakes the wire has recorded from beginning to end. In `psk_dhe_ke`, `shared` is
/// the result of the key exchange.
pub(crate) fn connections(
    wire: &Wire,
    cipher: Cipher,
    drawn: &Drawn,
    shared: Option<&[u8]>,
) -> Vec<Connection> {
    let mode = Mode::Psk(if shared.is_some() { PskKex::PskDheKe } else { PskKex::PskKe });
    let datagrams = wire.handshakes.lock().unwrap().clone();
    let packets: Vec<_> = datagrams.iter().flat_map(|datagram| packets(datagram)).collect();
    let of = |kind| packets.iter().filter(move |packet: &&Packet<'_>| packet.kind == kind);
    // The first connection ID that a client sends to makes the keys of its Initial packets. The others open nothing.
    let mut initials = BTreeMap::new();
    for packet in of(Kind::Initial) {
        let destination = packet.destination;
        initials
            .entry(destination)
            .or_insert_with(|| (Opens::initial(destination), Streams::default()));
    }
    for (opens, streams) in initials.values_mut() {
        of(Kind::Initial).for_each(|packet| streams.take(opens, packet));
    }
    let mut connections = Vec::new();
    for (_, streams) in initials.values() {
        let [client, server] = streams.bytes();
        let Some((terms, hellos)) = begun(&client, &server, cipher, mode, drawn) else { continue };
        let opens = Schedule::of_handshake(terms, &hellos, shared)
            .map(|secret| Opens::with(cipher, &secret));
        let mut streams = Streams::default();
        of(Kind::Handshake).for_each(|packet| streams.take(&opens, packet));
        let [client, server] = streams.bytes();
        let transcript = [hellos, server, client].concat();
        if flights(&transcript).is_some() {
            connections.push(Connection::new(terms, &transcript, shared));
        }
    }
    connections
}

/// Returns the terms and both hellos of a handshake that a server answered.
fn begun<'a>(
    client: &[u8],
    server: &[u8],
    cipher: Cipher,
    mode: Mode,
    drawn: &'a Drawn,
) -> Option<(Terms<'a>, Vec<u8>)> {
    let is = |message: &[u8], kind| message.first() == Some(&kind);
    if !is(client, 1) || !is(server, 2) {
        return None;
    }
    let holds = |text: &str| client.windows(text.len()).any(|at| at == text.as_bytes());
    let (key_id, key) = drawn.iter().find(|(key_id, _)| holds(key_id))?;
    let mut saes = SAE;
    if !holds(&format!(":{}:", saes[0])) {
        saes.reverse();
    }
    let [client_sae, server_sae] = saes;
    let terms = Terms { cipher, mode, key, key_id, client: client_sae, server: server_sae };
    Some((terms, [client, server].concat()))
}
