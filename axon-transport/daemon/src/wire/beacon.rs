//! Encodes and decodes discovery datagrams (formats, section 5).

use std::{net::IpAddr, ops::RangeInclusive};

use axon_shm::ids::DaemonId;
use minicbor::{
    Decode, Decoder, Encode, Encoder,
    bytes::{ByteArray, ByteSlice},
    decode::Error as DecodeError,
    encode::{Error as EncodeError, Write},
};

use super::SecurityTerms;

/// The protocol versions that this release speaks.
pub const PROTOCOLS: RangeInclusive<u8> = 1..=1;
/// Longest datagram, in bytes.
pub const LONGEST: usize = 512;
/// Most addresses in a beacon.
pub const MOST_ADDRESSES: usize = 4;

const MAGIC: &[u8; 4] = b"\x01AXN";
const LONGEST_SAE_ID: usize = 63;

/// One discovery datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Datagram {
    /// "Try me here".
    Beacon(Beacon),
    /// A beacon of a daemon without a protocol version of ours; the rest of it is not read.
    Foreign(Foreign),
    /// A daemon announces that it ends.
    Goodbye {
        /// The domain of the daemon.
        domain: u32,
        /// The one that ends.
        daemon: DaemonId,
    },
    /// Asks for an [`Echo`](Self::Echo): does this address work, and how fast?
    Probe {
        /// The sender.
        daemon: DaemonId,
        /// The nonce that the answer repeats.
        nonce: [u8; 8],
    },
    /// Answers a [`Probe`](Self::Probe).
    Echo {
        /// The sender.
        daemon: DaemonId,
        /// The probe's.
        nonce: [u8; 8],
    },
}

/// A daemon's description of itself. It is neither authenticated nor confidential.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Beacon {
    /// Lowest and highest protocol version spoken.
    pub protocols: (u8, u8),
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The sender.
    pub daemon: DaemonId,
    /// The security terms of its links.
    pub terms: SecurityTerms,
    /// The daemon's SAE ID in qkd: 1 to 63 visible ASCII characters.
    pub sae: Option<String>,
    /// The daemon's QUIC port, not 0.
    pub port: u16,
    /// Addresses that may lead to it, at most four.
    pub addresses: Vec<IpAddr>,
    /// Digest of its graph.
    pub graph: u64,
    /// Whether the sender asks the receiver for its own beacon.
    pub answer_wanted: bool,
    /// Whether the daemon links only within its host and with listed peers.
    pub localhost: bool,
}

/// The part that is read of a beacon in an unknown protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foreign {
    /// Lowest and highest protocol version spoken.
    pub protocols: (u8, u8),
    /// The domain of the daemon.
    pub domain: u32,
    /// The sender.
    pub daemon: DaemonId,
}

/// The reason why bytes are not a discovery datagram.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatagramError {
    /// More than [`LONGEST`] bytes.
    #[error("{0} bytes, at most 512 are accepted")]
    TooLong(usize),
    /// The bytes do not begin as a discovery datagram.
    #[error("not a discovery datagram")]
    Magic,
    /// A kind that this version does not know.
    #[error("kind {0} is unknown")]
    Kind(u8),
    /// The CBOR map cannot be read.
    #[error("malformed map: {0}")]
    Map(#[from] DecodeError),
    /// A key that its kind needs is absent, or its value is out of bounds.
    #[error("key {0} is absent or out of bounds")]
    Key(u8),
    /// Bytes follow the map.
    #[error("{0} bytes after the map")]
    Trailing(usize),
}

/// The map under all kinds; which keys must be there depends on the kind.
#[derive(Default, Encode, Decode)]
#[cbor(map)]
struct Wire<'a> {
    #[n(0)]
    lowest: Option<u8>,
    #[n(1)]
    highest: Option<u8>,
    #[n(2)]
    domain: Option<u32>,
    #[n(3)]
    daemon: Option<DaemonId>,
    #[n(4)]
    mode: Option<u8>,
    #[n(5)]
    key_mode: Option<u8>,
    #[n(6)]
    kex: Option<u8>,
    #[n(7)]
    cipher: Option<u8>,
    #[b(8)]
    sae: Option<&'a str>,
    #[n(9)]
    port: Option<u16>,
    #[n(10)]
    addresses: Option<Addresses>,
    #[n(11)]
    graph: Option<u64>,
    #[n(12)]
    auth: Option<u8>,
    #[n(13)]
    answer_wanted: Option<bool>,
    #[n(14)]
    range: Option<u8>,
    #[n(15)]
    nonce: Option<ByteArray<8>>,
}

/// The part of a beacon whose meaning no protocol version changes.
#[derive(Decode)]
#[cbor(map)]
struct Head {
    #[n(0)]
    lowest: u8,
    #[n(1)]
    highest: u8,
    #[n(2)]
    domain: u32,
    #[n(3)]
    daemon: DaemonId,
}

struct Addresses(Vec<IpAddr>);

impl<C> Encode<C> for Addresses {
    fn encode<W: Write>(&self, e: &mut Encoder<W>, _: &mut C) -> Result<(), EncodeError<W::Error>> {
        e.array(self.0.len() as u64)?;
        for address in &self.0 {
            match address {
                IpAddr::V4(v4) => e.bytes(&v4.octets())?,
                IpAddr::V6(v6) => e.bytes(&v6.octets())?,
            };
        }
        Ok(())
    }
}

impl<'b, C> Decode<'b, C> for Addresses {
    fn decode(d: &mut Decoder<'b>, ctx: &mut C) -> Result<Self, DecodeError> {
        let length = d.array()?.filter(|length| *length <= MOST_ADDRESSES as u64);
        let length = length.ok_or_else(|| DecodeError::message("more than four addresses"))?;
        let mut addresses = Vec::new();
        for _ in 0..length {
            let bytes: &ByteSlice = d.decode_with(ctx)?;
            let v4 = <[u8; 4]>::try_from(&**bytes).map(IpAddr::from);
            let v6 = <[u8; 16]>::try_from(&**bytes).map(IpAddr::from);
            let neither = |_| DecodeError::message("an address is 4 or 16 bytes");
            addresses.push(v4.or(v6).map_err(neither)?);
        }
        Ok(Self(addresses))
    }
}

impl Datagram {
    /// Reads one datagram. Never panics, and allocates less than the bytes it is given.
    pub fn decode(bytes: &[u8]) -> Result<Self, DatagramError> {
        if bytes.len() > LONGEST {
            return Err(DatagramError::TooLong(bytes.len()));
        }
        let Some((&kind, map)) = bytes.strip_prefix(MAGIC).and_then(<[u8]>::split_first) else {
            return Err(DatagramError::Magic);
        };
        match kind {
            1 => {
                let head: Head = minicbor::decode(map)?;
                if head.lowest > head.highest {
                    return Err(DatagramError::Key(0));
                }
                if head.highest < *PROTOCOLS.start() || head.lowest > *PROTOCOLS.end() {
                    let protocols = (head.lowest, head.highest);
                    let Head { domain, daemon, .. } = head;
                    return Ok(Self::Foreign(Foreign { protocols, domain, daemon }));
                }
                Beacon::from_wire(wire(map)?).map(Self::Beacon)
            }
            2 => {
                let wire = wire(map)?;
                let domain = wire.domain.ok_or(DatagramError::Key(2))?;
                let daemon = wire.daemon.ok_or(DatagramError::Key(3))?;
                Ok(Self::Goodbye { domain, daemon })
            }
            3 | 4 => {
                let wire = wire(map)?;
                let daemon = wire.daemon.ok_or(DatagramError::Key(3))?;
                let nonce = wire.nonce.ok_or(DatagramError::Key(15))?.into();
                Ok(match kind {
                    3 => Self::Probe { daemon, nonce },
                    _ => Self::Echo { daemon, nonce },
                })
            }
            other => Err(DatagramError::Kind(other)),
        }
    }

    /// Returns the bytes of this datagram, at most [`LONGEST`] of them.
    pub fn encode(&self) -> Vec<u8> {
        let (kind, wire) = match self {
            Self::Beacon(beacon) => (1, beacon.to_wire()),
            Self::Foreign(Foreign { protocols: (lowest, highest), domain, daemon }) => {
                let (lowest, highest) = (Some(*lowest), Some(*highest));
                let (domain, daemon) = (Some(*domain), Some(*daemon));
                (1, Wire { lowest, highest, domain, daemon, ..Wire::default() })
            }
            Self::Goodbye { domain, daemon } => {
                let (domain, daemon) = (Some(*domain), Some(*daemon));
                (2, Wire { domain, daemon, ..Wire::default() })
            }
            Self::Probe { daemon, nonce } => (3, Wire::of_probe(daemon, nonce)),
            Self::Echo { daemon, nonce } => (4, Wire::of_probe(daemon, nonce)),
        };
        let mut bytes = Vec::with_capacity(192);
        bytes.extend_from_slice(MAGIC);
        bytes.push(kind);
        minicbor::encode(&wire, &mut bytes).expect("writing to memory does not fail");
        debug_assert!(bytes.len() <= LONGEST);
        bytes
    }
}

impl Beacon {
    fn to_wire(&self) -> Wire<'_> {
        Wire {
            lowest: Some(self.protocols.0),
            highest: Some(self.protocols.1),
            domain: Some(self.domain),
            daemon: Some(self.daemon),
            mode: Some(self.terms.mode),
            key_mode: Some(self.terms.key_mode),
            kex: Some(self.terms.kex),
            cipher: Some(self.terms.cipher),
            sae: self.sae.as_deref(),
            port: Some(self.port),
            addresses: Some(Addresses(
                self.addresses.iter().copied().take(MOST_ADDRESSES).collect(),
            )),
            graph: Some(self.graph),
            auth: self.terms.auth,
            answer_wanted: Some(self.answer_wanted),
            range: Some(u8::from(self.localhost)),
            nonce: None,
        }
    }

    fn from_wire(wire: Wire<'_>) -> Result<Self, DatagramError> {
        let need = |value: Option<u8>, key| value.ok_or(DatagramError::Key(key));
        let terms = SecurityTerms {
            mode: need(wire.mode, 4)?,
            key_mode: need(wire.key_mode, 5)?,
            kex: need(wire.kex, 6)?,
            cipher: need(wire.cipher, 7)?,
            auth: wire.auth,
        };
        let visible = |sae: &str| {
            (1..=LONGEST_SAE_ID).contains(&sae.len()) && sae.bytes().all(|b| b.is_ascii_graphic())
        };
        // In qkd a daemon cannot be dialled without a name for the KME.
        if wire.sae.map_or(terms.mode == SecurityTerms::QKD, |sae| !visible(sae)) {
            return Err(DatagramError::Key(8));
        }
        Ok(Self {
            protocols: (need(wire.lowest, 0)?, need(wire.highest, 1)?),
            domain: wire.domain.ok_or(DatagramError::Key(2))?,
            daemon: wire.daemon.ok_or(DatagramError::Key(3))?,
            terms,
            sae: wire.sae.map(str::to_owned),
            port: wire.port.filter(|port| *port != 0).ok_or(DatagramError::Key(9))?,
            addresses: wire.addresses.map_or_else(Vec::new, |addresses| addresses.0),
            graph: wire.graph.unwrap_or(0),
            answer_wanted: wire.answer_wanted.unwrap_or(false),
            localhost: wire.range == Some(1),
        })
    }
}

impl Wire<'_> {
    fn of_probe(daemon: &DaemonId, nonce: &[u8; 8]) -> Self {
        Self { daemon: Some(*daemon), nonce: Some((*nonce).into()), ..Self::default() }
    }
}

fn wire(map: &[u8]) -> Result<Wire<'_>, DatagramError> {
    let mut decoder = Decoder::new(map);
    let wire = decoder.decode()?;
    match map.len() - decoder.position() {
        0 => Ok(wire),
        rest => Err(DatagramError::Trailing(rest)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, option, prelude::*};

    use super::*;

    fn example() -> Beacon {
        Beacon {
            protocols: (1, 1),
            domain: 7,
            daemon: DaemonId([0xda; 16]),
            terms: SecurityTerms { mode: 1, key_mode: 2, kex: 1, cipher: 0, auth: None },
            sae: Some("sae-a".to_owned()),
            port: 61412,
            addresses: vec!["192.0.2.1".parse().unwrap(), "2001:db8::1".parse().unwrap()],
            graph: 0x0102_0304_0506_0708,
            answer_wanted: true,
            localhost: false,
        }
    }

    #[test]
    fn invalid_datagrams_are_refused_with_a_reason() {
        let good = Datagram::Beacon(example()).encode();
        for cut in 0..good.len() {
            assert!(Datagram::decode(&good[..cut]).is_err(), "cut at {cut}");
        }
        let mut long = good.clone();
        long.resize(LONGEST + 1, 0);
        assert!(matches!(Datagram::decode(&long), Err(DatagramError::TooLong(513))));
        long.truncate(LONGEST);
        assert!(matches!(Datagram::decode(&long), Err(DatagramError::Trailing(_))));
        let mut kind = good;
        kind[4] = 9;
        assert!(matches!(Datagram::decode(&kind), Err(DatagramError::Kind(9))));
        kind[0] = 0x41;
        assert!(matches!(Datagram::decode(&kind), Err(DatagramError::Magic)));

        let refused = |change: fn(&mut Beacon)| {
            let mut beacon = example();
            change(&mut beacon);
            match Datagram::decode(&Datagram::Beacon(beacon).encode()) {
                Err(DatagramError::Key(key)) => key,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(refused(|b| b.protocols = (2, 1)), 0);
        assert_eq!(refused(|b| b.port = 0), 9);
        assert_eq!(refused(|b| b.sae = None), 8);
        assert_eq!(refused(|b| b.sae = Some(String::new())), 8);
        assert_eq!(refused(|b| b.sae = Some("x".repeat(64))), 8);
        assert_eq!(refused(|b| b.sae = Some("a\nb".to_owned())), 8);
    }

    #[test]
    fn depth_and_claimed_lengths_cost_nothing() {
        for byte in [0x9f, 0xbf, 0x9b, 0xbb, 0x5b, 0x7b, 0xff, 0xd8, 0x81, 0xa1] {
            for kind in 0..6 {
                let mut bytes = MAGIC.to_vec();
                bytes.push(kind);
                bytes.extend([0xa1, 0x18, 0x63]);
                bytes.resize(LONGEST, byte);
                assert!(Datagram::decode(&bytes).is_err());
            }
        }
    }

    #[test]
    fn unknown_keys_are_skipped_and_unknown_protocols_are_told() {
        // {0: 1, 1: 9, 2: 7, 3: id, 4..7, 9: 5, 99: [1, {"x": h'00'}]}
        let mut bytes = MAGIC.to_vec();
        bytes.extend([1, 0xaa, 0, 1, 1, 9, 2, 7, 3, 0x50]);
        bytes.extend([0xda; 16]);
        bytes.extend([4, 0, 5, 0, 6, 0, 7, 1, 9, 5]);
        bytes.extend([0x18, 99, 0x82, 1, 0xa1, 0x61, b'x', 0x41, 0]);
        match Datagram::decode(&bytes).unwrap() {
            Datagram::Beacon(beacon) => {
                assert_eq!((beacon.protocols, beacon.port, beacon.terms.cipher), ((1, 9), 5, 1));
                assert!(beacon.addresses.is_empty() && !beacon.answer_wanted);
            }
            other => panic!("{other:?}"),
        }
        let foreign = Foreign { protocols: (8, 9), domain: 7, daemon: DaemonId([1; 16]) };
        let foreign = Datagram::Foreign(foreign);
        assert_eq!(Datagram::decode(&foreign.encode()).unwrap(), foreign);
    }

    #[test]
    fn an_echo_is_no_longer_than_its_probe() {
        let (daemon, nonce) = (DaemonId([9; 16]), [7; 8]);
        let probe = Datagram::Probe { daemon, nonce }.encode();
        let echo = Datagram::Echo { daemon, nonce }.encode();
        assert!(echo.len() <= probe.len());
    }

    fn beacons() -> impl Strategy<Value = Beacon> {
        let address = prop_oneof![
            any::<[u8; 4]>().prop_map(IpAddr::from),
            any::<[u8; 16]>().prop_map(IpAddr::from)
        ];
        let terms = (0..2_u8, any::<u8>(), any::<u8>(), any::<u8>(), option::of(any::<u8>()));
        (
            (any::<u32>(), any::<[u8; 16]>(), terms, "[!-~]{1,63}", 1..=u16::MAX),
            (vec(address, 0..=4), any::<u64>(), any::<bool>(), any::<bool>()),
        )
            .prop_map(
                |((domain, daemon, t, sae, port), (addresses, graph, answer_wanted, localhost))| {
                    let (mode, key_mode, kex, cipher, auth) = t;
                    Beacon {
                        protocols: (1, 3),
                        domain,
                        daemon: DaemonId(daemon),
                        terms: SecurityTerms { mode, key_mode, kex, cipher, auth },
                        sae: (mode == SecurityTerms::QKD).then_some(sae),
                        port,
                        addresses,
                        graph,
                        answer_wanted,
                        localhost,
                    }
                },
            )
    }

    proptest! {
        #[test]
        fn beacons_come_back_as_they_were(beacon in beacons()) {
            let datagram = Datagram::Beacon(beacon);
            let bytes = datagram.encode();
            prop_assert!(bytes.len() <= LONGEST);
            prop_assert!(crate::discovery::is_discovery(bytes[0]));
            prop_assert_eq!(Datagram::decode(&bytes).unwrap(), datagram);
        }

        #[test]
        fn no_bytes_make_it_panic(bytes in vec(any::<u8>(), 0..600)) {
            let _ = Datagram::decode(&bytes);
        }

        #[test]
        fn no_map_makes_it_panic(kind in 0..6_u8, map in vec(any::<u8>(), 0..507)) {
            let mut bytes = MAGIC.to_vec();
            bytes.push(kind);
            bytes.extend(map);
            let _ = Datagram::decode(&bytes);
        }

        #[test]
        fn no_damage_makes_it_panic(
            beacon in beacons(),
            damage in vec((any::<proptest::sample::Index>(), any::<u8>()), 1..6),
        ) {
            let mut bytes = Datagram::Beacon(beacon).encode();
            for (index, byte) in damage {
                let at = index.index(bytes.len());
                bytes[at] = byte;
            }
            if let Ok(datagram) = Datagram::decode(&bytes) {
                prop_assert!(datagram.encode().len() <= LONGEST);
            }
        }
    }
}
