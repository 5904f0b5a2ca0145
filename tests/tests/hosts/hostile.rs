//! Bytes of no good will at every door of both hosts, while samples flow.

use std::{
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    os::fd::OwnedFd,
};

use axon_tests::{Sizes, Tally};
use axon_transport::internal::session::daemon::{address::Address, socket};

use super::{
    mode::{Kmes, Settings, classic},
    pair::{Host, Plan},
};

/// Numbers without end, the same in each run.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.roll() % bound as u64) as usize
    }

    fn bytes(&mut self, length: usize) -> Vec<u8> {
        (0..length).map(|_| self.roll() as u8).collect()
    }
}

/// Returns a beacon as `docs/formats.md` specifies it, and as host `host` could send it, in classic.
fn beacon(host: &Host) -> Vec<u8> {
    let mut bytes = b"\x01AXN\x01".to_vec();
    // A map: version 1 to 1, the domain, a daemon id, classic, port, one address, answer wanted.
    bytes.extend([0xae, 0, 1, 1, 1, 2, 0x18, host.domain() as u8, 3, 0x50]);
    bytes.extend([0x5a; 16]);
    bytes.extend([4, 0, 5, 0, 6, 0, 7, 0, 9, 0x19, 0xf0, 0x00]);
    bytes.extend([10, 0x81, 0x44]);
    bytes.extend(host.address.octets());
    bytes.extend([11, 0, 12, 0, 13, 0xf5, 14, 0]);
    bytes
}

/// Returns mutations of a beacon: truncated, mutated, padded. The first is the whole beacon.
fn mutations(dice: &mut Dice, whole: &[u8]) -> Vec<Vec<u8>> {
    let mut all = vec![whole.to_vec()];
    all.extend((0..whole.len()).map(|length| whole[..length].to_vec()));
    for _ in 0..400 {
        let mut bytes = whole.to_vec();
        for _ in 0..=dice.below(4) {
            let at = dice.below(bytes.len());
            bytes[at] = dice.roll() as u8;
        }
        let padding = if dice.below(4) == 0 { 600 } else { 0 };
        bytes.extend(dice.bytes(padding));
        all.push(bytes);
    }
    all
}

fn to_udp(dice: &mut Dice, host: &Host) {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let port = host.status().port.unwrap();
    let shared = 61_000 + host.domain() as u16;
    let group = Ipv4Addr::new(239, 255, 88, 1 + (host.domain() % 254) as u8);
    let doors = [(host.address, port), (host.address, shared), (group, shared)];
    let mut datagrams = mutations(dice, &beacon(host));
    for length in [0, 1, 2, 20, 60, 1_200, 1_452, 9_000] {
        for first in 0..=255 {
            // Every first byte: the long and short headers of QUIC among them.
            let mut bytes = dice.bytes(length);
            if let Some(byte) = bytes.first_mut() {
                *byte = first;
            }
            if let Some(version) = bytes.get_mut(1..5) {
                version.copy_from_slice(&[0, 0, 0, first & 1]);
            }
            datagrams.push(bytes);
        }
    }
    for datagram in &datagrams {
        for door in doors {
            // Without a multicast route the datagram cannot come from there either.
            let _ = socket.send_to(datagram, SocketAddrV4::new(door.0, door.1));
        }
    }
}

fn to_session_socket(dice: &mut Dice, host: &Host) {
    let address = Address::of(&host.config());
    for round in 0..200 {
        let Ok(stranger) = address.connect() else { continue };
        for _ in 0..=dice.below(3) {
            let length = if round % 10 == 0 { 40_000 } else { 1 + dice.below(300) };
            let mut bytes = dice.bytes(length);
            // Types that there are, and a map behind them, get further.
            if round % 2 == 0 {
                bytes[0] = 1 + dice.below(14) as u8;
                if let Some(map) = bytes.get_mut(1) {
                    *map = 0xa0 | (dice.below(8) as u8);
                }
            }
            let descriptors: Vec<OwnedFd> =
                (0..dice.below(4)).map(|_| std::io::pipe().unwrap().0.into()).collect();
            let borrowed: Vec<_> = descriptors.iter().map(std::os::fd::AsFd::as_fd).collect();
            // It is closed on him some time.
            let _ = socket::send(&stranger, &bytes, &borrowed);
        }
    }
}

fn molest(settings: [Settings; 2]) {
    let hosts = Plan::new(settings).start();
    let [a, b] = &hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut here = a.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 2, None);
    there.wait_taken(50);
    let mut dice = Dice(0x00c0_ffee);
    for host in &hosts {
        to_udp(&mut dice, host);
        to_session_socket(&mut dice, host);
    }
    let now = publisher.published();
    there.wait_taken(now + 50);
    let sent = publisher.stop();
    for subscriber in [&mut here, &mut there] {
        subscriber.wait_taken(sent);
        let all = Tally { taken: sent, first: 1, last: sent, ..Tally::default() };
        assert_eq!(subscriber.tally(), all);
    }
    for host in &hosts {
        assert!(host.is_first_daemon(), "the daemon lives");
        host.link();
    }
    for node in [publisher, here, there] {
        node.finish();
    }
}

#[test]
fn in_classic_nothing_is_lost() {
    molest([classic(&[]), classic(&[])]);
}

#[test]
fn in_messages10_nothing_is_lost() {
    let kmes = Kmes::start();
    molest([0, 1].map(|host| kmes.settings(host, &[])));
}
