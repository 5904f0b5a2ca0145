//! Code that several test files need.
#![allow(dead_code, reason = "each test file uses its part")]

use std::time::Duration;

use axon_envelope::{Channel, Delivery, KeyId, Kind, KmeKey, Opener, Route, Sealer, TopicHash};

pub(crate) const START: Duration = Duration::from_secs(1_000);
pub(crate) const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };

pub(crate) fn channel() -> Channel {
    Channel::new("alice", "bob", [1; 32]).unwrap()
}

pub(crate) fn key_id(name: &str) -> KeyId {
    KeyId::new(name).unwrap()
}

pub(crate) fn key(byte: u8) -> KmeKey {
    KmeKey::take(&mut [byte; 32])
}

pub(crate) fn sealer(name: &str, byte: u8) -> Sealer {
    Sealer::new(&channel(), key_id(name), key(byte)).unwrap()
}

/// Creates an opener on [`channel`] that holds one key.
pub(crate) fn opener(name: &str, byte: u8) -> Opener {
    let mut opener = Opener::new(channel()).unwrap();
    opener.add_key(key_id(name), key(byte)).unwrap();
    opener
}

pub(crate) fn seal(
    sealer: &mut Sealer,
    route: Route,
    delivery: Delivery,
    plaintext: &[u8],
) -> Vec<u8> {
    let mut out = vec![0; sealer.overhead() + plaintext.len()];
    let slot = sealer.slot(START, delivery).unwrap();
    assert_eq!(slot.seal_into(route, &[plaintext], &mut out).unwrap(), out.len());
    out
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(crate) fn unhex(text: &str) -> Vec<u8> {
    assert!(text.len().is_multiple_of(2), "odd number of hexadecimal digits");
    let byte = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
    (0..text.len()).step_by(2).map(byte).collect()
}
