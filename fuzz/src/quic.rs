//! Checks the data that QUIC passes to TLS: CRYPTO frames with any content, of a peer that protects its packets
//! correctly, and datagrams of any sender.

use std::sync::{Arc, LazyLock, Mutex};

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{self, ALPN};
use axon_tls::{Cipher, PskKex};
use quinn_proto::{ClientConfig, ServerConfig, Side};

use crate::tls::{OneKey, psk};
use meddle::{Meddler, meddle};
use pair::{End, Pair};

#[path = "../../axon-tls/tests/common/meddle.rs"]
mod meddle;
#[path = "../../axon-tls/tests/common/pair.rs"]
mod pair;

/// The change that an input asks for; its first byte chose the mode.
#[derive(Clone, Copy, PartialEq)]
enum Change {
    /// Bytes of the handshake are combined with the data by exclusive or, from a position on.
    Xor,
    /// The data comes in between, at a position.
    Insert,
    /// The data stands in place of a whole flight.
    Replace,
    /// The data is a datagram that comes before another one.
    Datagram,
}

/// `mode || who and how || position (2 bytes) || data`
struct Input<'a> {
    mode: u8,
    /// The side whose handshake is changed.
    of: Side,
    change: Change,
    position: usize,
    data: &'a [u8],
}

impl<'a> Input<'a> {
    fn parse(bytes: &'a [u8]) -> Option<Self> {
        let ([mode, how, high, low], data) = bytes.split_first_chunk::<4>()?;
        Some(Self {
            mode: *mode,
            of: if how & 1 == 0 { Side::Client } else { Side::Server },
            change: [Change::Xor, Change::Insert, Change::Replace, Change::Datagram]
                [usize::from(how >> 1 & 3)],
            position: usize::from(*high) << 8 | usize::from(*low),
            data,
        })
    }
}

/// Three key exchanges with two ciphers.
fn configs(mode: u8) -> (ClientConfig, ServerConfig) {
    static AUTH: LazyLock<Auth> = LazyLock::new(|| Auth::None(SigningKey::generate().unwrap()));
    let cipher = Cipher::ALL[usize::from(mode & 1)];
    let kex = match mode >> 1 & 3 {
        0 | 1 => PskKex::ALL[usize::from(mode >> 1 & 1)],
        _ => {
            let client = quic::hybrid_client(&AUTH, cipher, ALPN).unwrap();
            return (client, quic::hybrid_server(&AUTH, cipher, ALPN).unwrap());
        }
    };
    let client = quic::qkd_client(psk(cipher), kex, ALPN).unwrap();
    let server = quic::qkd_server(Arc::new(OneKey(cipher)), cipher, kex, ALPN).unwrap();
    (client, server)
}

/// Passes one end's side of the handshake on as the input asks, and remembers both versions of it.
struct Liar {
    of: Side,
    change: Change,
    position: usize,
    data: Vec<u8>,
    flight: usize,
    genuine: Vec<u8>,
    said: Vec<u8>,
}

impl Liar {
    fn pass(&mut self, from: Side, bytes: &mut Vec<u8>) {
        if from != self.of {
            return;
        }
        let start = self.genuine.len();
        self.genuine.extend_from_slice(bytes);
        match self.change {
            Change::Xor => {
                for (at, byte) in bytes.iter_mut().enumerate() {
                    let of_data = (start + at).checked_sub(self.position);
                    *byte ^= of_data.and_then(|at| self.data.get(at)).copied().unwrap_or(0);
                }
            }
            Change::Insert => {
                if let Some(at) = self.position.checked_sub(start).filter(|at| *at <= bytes.len()) {
                    bytes.splice(at..at, self.data.drain(..));
                }
            }
            Change::Replace if self.flight == self.position => bytes.clone_from(&self.data),
            Change::Replace | Change::Datagram => {}
        }
        self.flight += 1;
        self.said.extend_from_slice(bytes);
    }
}

impl Meddler for Liar {
    fn read(&mut self, bytes: &mut Vec<u8>) {
        self.pass(Side::Client, bytes);
    }

    fn written(&mut self, bytes: &mut Vec<u8>) {
        self.pass(Side::Server, bytes);
    }
}

/// An end that receives another handshake than its peer meant does not complete, and an unchanged one
/// completes on both ends. A connected end reports what was negotiated, and no end does before.
pub fn quic_handshake(data: &[u8]) -> bool {
    let Some(input) = Input::parse(data) else { return false };
    let (client, mut server) = configs(input.mode);
    let liar = Arc::new(Mutex::new(Liar {
        of: input.of,
        change: input.change,
        position: input.position,
        data: input.data.to_vec(),
        flight: 0,
        genuine: Vec::new(),
        said: Vec::new(),
    }));
    meddle(&mut server, Arc::clone(&liar));

    let mut pair = Pair::new(server);
    pair.dial(client);
    // a lie may leave both ends with something to say to each other for long
    for step in 0..50 {
        if input.change == Change::Datagram && step == input.position {
            let (from, to) = match input.of {
                Side::Client => (&pair.client, &mut pair.server),
                Side::Server => (&pair.server, &mut pair.client),
            };
            to.receive(pair.now, from.address, input.data);
        }
        if !pair.step(|_, _| {}) {
            break;
        }
    }

    let liar = liar.lock().unwrap();
    let (heard, hearer) = (
        liar.said.starts_with(&liar.genuine),
        match input.of {
            Side::Client => &mut pair.server,
            Side::Server => &mut pair.client,
        },
    );
    assert!(heard || !hearer.connected, "connected on a handshake that was changed");
    let unchanged = liar.said == liar.genuine;
    let up = pair.is_up();
    // a datagram may end a connection that is not authenticated yet, by the keys that all know
    assert!(up || !unchanged || input.change == Change::Datagram && !input.data.is_empty());
    for end in [&mut pair.client, &mut pair.server] {
        let said = negotiated(end);
        assert!(!end.connected || said, "connected, and on nothing");
    }
    up
}

fn negotiated(end: &mut End) -> bool {
    end.conn.is_some() && end.conn().crypto_session().handshake_data().is_some()
}

/// Every mode, changed in a way that changes nothing; and datagrams that are none.
pub fn quic_handshake_seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for mode in 0..6 {
        for side in 0..2 {
            seeds.push(vec![mode, side, 0, 40, 0, 0]);
            seeds.push(vec![mode, side | 2, 0, 4]);
            seeds.push(vec![mode, side | 4, 0, 200, 1]);
            seeds.push(vec![mode, side | 6, 0, 1, 0xc0, 0, 0, 0, 1, 8, 1, 2, 3, 4]);
        }
    }
    seeds
}
