//! Tests openings: hostile peers first, then two openings against each other, in every mode.

mod hostile;
mod proof;
mod succeed;

use std::{
    collections::VecDeque,
    sync::{Arc, OnceLock},
};

use axon_shm::ids::DaemonId;
use axon_tls::{
    Cipher, KeyExchange, hybrid,
    identity::{Auth, SigningKey},
    quic::ALPN,
    rustls::{ClientConnection, ServerConnection, pki_types::ServerName},
};
use axon_transport::config::KeyMode;

use super::*;
use crate::{
    engine::{
        keyring::{
            Answered,
            tests::{Kmes, config, exporters, id, ms, s},
        },
        refusal::RefusedBy,
    },
    keys::{KeyMessage, KmeAnswer},
};

/// The number of the connection, at both ends.
const LINK: u64 = 7;
const CLIENT: DaemonId = DaemonId([1; 16]);
const SERVER: DaemonId = DaemonId([2; 16]);

/// Returns the agreed parameters of a handshake in classic: the type has no other constructor.
fn hybrid() -> Negotiated {
    static AGREED: OnceLock<Negotiated> = OnceLock::new();
    let handshake = || {
        let auth = || Auth::None(SigningKey::generate().unwrap());
        let client = hybrid::client_config(&auth(), Cipher::default(), ALPN).unwrap();
        let server = hybrid::server_config(&auth(), Cipher::default(), ALPN).unwrap();
        let name = ServerName::try_from("axon").unwrap();
        let mut client = ClientConnection::new(Arc::new(client), name).unwrap();
        let mut server = ServerConnection::new(Arc::new(server)).unwrap();
        while client.is_handshaking() || server.is_handshaking() {
            let (mut wire, mut back) = (Vec::new(), Vec::new());
            client.write_tls(&mut wire).unwrap();
            let mut wire = &wire[..];
            while !wire.is_empty() {
                server.read_tls(&mut wire).unwrap();
                server.process_new_packets().unwrap();
            }
            server.write_tls(&mut back).unwrap();
            let mut back = &back[..];
            while !back.is_empty() {
                client.read_tls(&mut back).unwrap();
                client.process_new_packets().unwrap();
            }
        }
        hybrid::negotiated(&client).unwrap()
    };
    AGREED.get_or_init(handshake).clone()
}

/// Returns the agreed parameters of a handshake of SAE `sae-a` under the key `key_id`.
fn psk(key_id: &str) -> Negotiated {
    let mut negotiated = hybrid();
    negotiated.key_exchange = KeyExchange::PskKe;
    negotiated.psk_identity = Some(PskIdentity::new("sae-a", key_id).unwrap().to_bytes());
    negotiated
}

/// Returns the settings of either end: in classic without a key mode.
fn settings(side: Side, key_mode: Option<KeyMode>) -> Config {
    match (side, key_mode) {
        (_, None) => Config::default(),
        (Side::Client, Some(key_mode)) => config("sae-a", key_mode),
        (Side::Server, Some(key_mode)) => config("sae-b", key_mode),
    }
}

fn facts(side: Side, key_mode: Option<KeyMode>) -> Handshake {
    Handshake {
        connection: LINK,
        side,
        remote: ([10, 0, 0, 1], 4433).into(),
        negotiated: Some(if key_mode.is_some() { psk("bootstrap") } else { hybrid() }),
        exporters: Some(exporters(1)),
        chain: Vec::new(),
        dialled: (side == Side::Client && key_mode.is_some()).then(|| "sae-b".to_owned()),
    }
}

fn ours(side: Side, settings: &Config) -> LinkHello {
    LinkHello::new(settings, if side == Side::Client { CLIENT } else { SERVER })
}

/// Returns the HELLO that the peer of `side` sends.
fn theirs(side: Side, key_mode: Option<KeyMode>) -> LinkHello {
    ours(side.peer(), &settings(side.peer(), key_mode))
}

impl Side {
    fn peer(self) -> Self {
        match self {
            Self::Client => Self::Server,
            Self::Server => Self::Client,
        }
    }
}

/// One end of a connection.
struct End {
    opening: Opening,
    ring: Option<Keyring>,
    /// Messages in flight to it.
    inbox: VecDeque<LinkMessage>,
    outcome: Option<Result<OpenedConnection, RefusedConnection>>,
    /// The key that it announced, if the test recorded it.
    announced: Option<KeyId>,
}

impl End {
    fn with(now: Duration, facts: Handshake, settings: &Config, ring: Option<Keyring>) -> Self {
        Self::greeting(now, ours(facts.side, settings), facts, settings, ring)
    }

    fn greeting(
        now: Duration,
        ours: LinkHello,
        facts: Handshake,
        settings: &Config,
        mut ring: Option<Keyring>,
    ) -> Self {
        let opening = Opening::new(now, facts, ours, settings, None, ring.as_mut());
        Self { opening, ring, inbox: VecDeque::new(), outcome: None, announced: None }
    }

    /// Returns an end whose handshake is complete.
    fn new(now: Duration, side: Side, key_mode: Option<KeyMode>) -> Self {
        let settings = settings(side, key_mode);
        let ring = Keyring::new(&settings);
        Self::with(now, facts(side, key_mode), &settings, ring)
    }

    /// Returns an end that waits for HELLO.
    fn awaiting_hello(now: Duration, side: Side, key_mode: Option<KeyMode>) -> Self {
        let mut end = Self::new(now, side, key_mode);
        end.opening.handle_recorded(now, true, end.ring.as_mut());
        assert!(end.opening.reads());
        end
    }

    /// Returns an end that has the peer's HELLO, in qkd.
    fn greeted(now: Duration, side: Side, key_mode: KeyMode) -> Self {
        let mut end = Self::awaiting_hello(now, side, Some(key_mode));
        end.hears(now, &LinkMessage::Hello(theirs(side, Some(key_mode))));
        end
    }

    /// Returns a server that announced `key-1`.
    fn announced(now: Duration, key_mode: KeyMode, kmes: &mut Kmes) -> Self {
        let mut end = Self::greeted(now, Side::Server, key_mode);
        end.ask(now, kmes);
        assert!(end.outcome(now).is_none());
        let messages: Vec<_> = std::iter::from_fn(|| end.opening.poll_message()).collect();
        let [LinkMessage::Hello(_), LinkMessage::Keys(KeyMessage::Announce(key_ids))] =
            &messages[..]
        else {
            panic!("{messages:?}");
        };
        assert_eq!(key_ids[..], [id("key-1")]);
        end
    }

    fn hears(&mut self, now: Duration, message: &LinkMessage) {
        self.opening.handle_message(now, message, self.ring.as_mut());
    }

    fn outcome(&mut self, now: Duration) -> Option<Result<OpenedConnection, RefusedConnection>> {
        self.opening.poll_outcome(now, self.ring.as_mut())
    }

    #[track_caller]
    fn refused(&mut self, now: Duration) -> RefusedConnection {
        let refused = self.outcome(now).expect("the opening ended").expect_err("refused");
        assert!(self.outcome(now).is_none(), "an opening ends once");
        assert!(!self.opening.reads());
        assert_eq!(self.opening.poll_timeout(), None);
        assert!(self.opening.poll_request(now).is_none());
        refused
    }

    /// Checks that the end refuses with this name, and closes with the code of that name and the reason. Returns the
    /// text for the peer.
    #[track_caller]
    fn refuses(&mut self, now: Duration, name: &str) -> String {
        let RefusedConnection { refusal, close } = self.refused(now);
        assert_eq!((refusal.by, &*refusal.name), (RefusedBy::Here, name), "{refusal}");
        let (code, told) = close.expect("this side closes");
        assert_eq!((code.name(), &*told), (name, &*refusal.reason));
        told
    }

    /// Answers the end's requests to the KME. Returns whether there were any.
    fn ask(&mut self, now: Duration, kmes: &mut Kmes) -> bool {
        let mut asked = Vec::new();
        asked.extend(std::iter::from_fn(|| self.opening.poll_request(now)));
        if let Some(ring) = &mut self.ring {
            asked.extend(std::iter::from_fn(|| ring.poll_request(now)));
        }
        let any = !asked.is_empty();
        for (origin, request) in asked {
            let event = KmeAnswer { origin, answer: kmes.answer(request) };
            let Some(ring) = &mut self.ring else { unreachable!() };
            if let Answered::Opening(link, answer) = ring.handle_answer(now, event) {
                assert_eq!(link, LINK);
                self.opening.handle_answer(now, answer, Some(ring));
            }
        }
        any
    }

    /// Polls the end until nothing happens. Returns whether anything did, and its messages.
    fn step(&mut self, now: Duration, kmes: &mut Kmes) -> (bool, Vec<LinkMessage>) {
        let mut busy = false;
        while self.opening.reads()
            && let Some(message) = self.inbox.pop_front()
        {
            self.hears(now, &message);
            busy = true;
        }
        if let Some(ring) = &mut self.ring
            && let Some((link, _)) = ring.poll_record()
        {
            assert_eq!(link, LINK);
            self.opening.handle_recorded(now, true, Some(ring));
            busy = true;
        }
        busy |= self.ask(now, kmes);
        let mut said: Vec<_> = std::iter::from_fn(|| self.opening.poll_message()).collect();
        if let Some(ring) = &mut self.ring {
            let messages = std::iter::from_fn(|| ring.poll_message(now));
            said.extend(messages.map(|(_, message)| LinkMessage::Keys(message)));
        }
        if let Some(outcome) = self.outcome(now) {
            assert!(self.outcome.is_none());
            self.outcome = Some(outcome);
        }
        (busy || !said.is_empty(), said)
    }

    fn opened(&mut self) -> OpenedConnection {
        self.outcome.take().expect("the opening ended").unwrap()
    }
}

/// Both ends of a connection.
struct Pair {
    now: Duration,
    kmes: Kmes,
    client: End,
    server: End,
    /// The names of the messages, in their order, each with the side that sent it.
    said: Vec<(Side, &'static str)>,
}

impl Pair {
    fn new(key_mode: Option<KeyMode>) -> Self {
        let now = s(1);
        Self {
            now,
            kmes: Kmes::default(),
            client: End::new(now, Side::Client, key_mode),
            server: End::new(now, Side::Server, key_mode),
            said: Vec::new(),
        }
    }

    /// Polls the client, then the server. Returns whether anything happened.
    fn pass(&mut self) -> bool {
        let (client, said) = self.client.step(self.now, &mut self.kmes);
        self.said.extend(said.iter().map(|m| (Side::Client, m.name())));
        self.server.inbox.extend(said);
        let (server, said) = self.server.step(self.now, &mut self.kmes);
        self.said.extend(said.iter().map(|m| (Side::Server, m.name())));
        self.client.inbox.extend(said);
        client || server
    }

    /// Polls both ends until nothing happens at this time.
    fn run(&mut self) {
        while self.pass() {}
    }

    /// Moves the clock until both ends are done.
    fn run_on(&mut self) {
        for _ in 0..1000 {
            self.run();
            let ends = [&self.client, &self.server];
            let due = ends.iter().filter_map(|end| end.opening.poll_timeout()).min();
            let rings = ends.iter().filter_map(|end| Some(end.ring.as_ref()?.poll_timeout())).min();
            let Some(due) = due else { return };
            self.now = self.now.max(due.min(rings.unwrap_or(due)));
            for end in [&mut self.client, &mut self.server] {
                if let Some(ring) = &mut end.ring {
                    ring.handle_timeout(self.now);
                }
                end.opening.handle_timeout(self.now, end.ring.as_mut());
            }
        }
        panic!("the openings do not end");
    }
}
