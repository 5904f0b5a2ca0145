//! Sealers and openers, with both back ends.

use std::{io::Read, thread, time::Duration};

use axon_envelope::aead::{Aead, AwsLc, RustCrypto};
use axon_envelope::{
    Channel, Delivery, KeyId, Kind, KmeKey, MESSAGES_PER_KEY, Opener, Route, Sealer, TopicHash,
};
use axon_tests::memory::{Find, Needles, Secret, Stopped};
use axon_tests::{tag_masks, unexpected};

use crate::child::{self, Searched};

const KEYS: usize = 24;
const CONTEXT: [u8; 32] = [0x5a; 32];
const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };
const NOW: Duration = Duration::from_secs(9);
const NONCE_PREFIX: [u8; 8] = *b"no nonce";

fn channel() -> Channel {
    Channel::new("robot-a", "robot-b", CONTEXT).unwrap()
}

fn key_id(number: usize) -> KeyId {
    KeyId::new(format!("bc490419-7d60-487f-adc1-4ddcc177c1{number:02x}")).unwrap()
}

/// In the child: reads the next key, which goes from the pipe into this block and nowhere else.
fn key(input: &mut impl Read) -> KmeKey {
    let mut bytes = Box::new([0; 32]);
    input.read_exact(&mut bytes[..]).unwrap();
    KmeKey::take(&mut bytes)
}

/// Takes keys in, moves their owners about, and uses the keys up.
fn run<A: Aead + 'static>() {
    let mut input = child::input();
    let mut opener = Opener::<A>::with_limits(channel(), Default::default()).unwrap();
    let mut sealers = Vec::new();
    for number in 0..KEYS {
        let (name, key) = (key_id(number), key(&mut input));
        sealers.push(Sealer::<A>::with_nonce_prefix(&channel(), name, key, NONCE_PREFIX));
        opener.add_key(key_id(number), self::key(&mut input)).unwrap();
    }
    child::pause(&mut input);
    // The keys go to another thread, where each message moves them once more.
    let spend = thread::spawn(move || {
        let mut opener = opener;
        for sealer in sealers {
            opener = spend(sealer, opener);
        }
        assert_eq!(opener.key_count(), 0);
        child::pause(&mut input);
        drop(opener);
        child::pause(&mut input);
    });
    spend.join().unwrap();
}

fn spend<A: Aead>(mut sealer: Sealer<A>, mut opener: Opener<A>) -> Opener<A> {
    let mut envelope = vec![0; sealer.overhead() + 1000];
    for index in 0..MESSAGES_PER_KEY {
        let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
        slot.seal_into(ROUTE, &[&[index; 1000]], &mut envelope).unwrap();
        assert_eq!(opener.open_in_place(NOW, ROUTE, &mut envelope).unwrap(), [index; 1000]);
    }
    sealer.retire();
    opener
}

#[test]
fn child() {
    match child::task().as_deref() {
        Some(AwsLc::NAME) => run::<AwsLc>(),
        Some(RustCrypto::NAME) => run::<RustCrypto>(),
        _ => {}
    }
}

fn random_keys() -> Vec<[u8; 32]> {
    let mut random = std::fs::File::open("/dev/urandom").unwrap();
    let mut key = || {
        let mut key = [0; 32];
        random.read_exact(&mut key).unwrap();
        key
    };
    (0..KEYS).map(|_| key()).collect()
}

fn needles(keys: &[[u8; 32]]) -> Needles {
    let mut needles = Needles::default();
    for (number, key) in keys.iter().enumerate() {
        needles.add_key(number, key);
        let id = key_id(number);
        let fields = [b"seal", id.as_bytes(), b"robot-a", b"robot-b", &CONTEXT];
        let mut info = Vec::new();
        for field in fields {
            info.extend_from_slice(&(field.len() as u16).to_be_bytes());
            info.extend_from_slice(field);
        }
        let aead_key = needles.add_derived("AEAD key", number, Some(b"AXQKD001"), key, &[&info]);
        needles.add_ghash_key("GHASH key", number, &aead_key);
        needles.add_tag_masks("tag mask", number, &aead_key, NONCE_PREFIX);
    }
    needles
}

/// The tag of AES-GCM for empty input is the mask of its tag.
#[test]
fn the_masks_of_tags_are_those_of_aes_gcm() {
    let key = random_keys()[0];
    for (index, mask) in (0_u32..).zip(tag_masks(&key, NONCE_PREFIX)) {
        let mut nonce = [0; 12];
        nonce[..8].copy_from_slice(&NONCE_PREFIX);
        nonce[8..].copy_from_slice(&index.to_be_bytes());
        assert_eq!(AwsLc::new(&key).seal_in_place(&nonce, b"", &mut []).unwrap(), mask);
    }
}

fn check(backend: &str) {
    let keys = random_keys();
    let needles = needles(&keys);
    let mut child = Searched::start("envelope::child", backend);
    for key in &keys {
        child.send(key);
        child.send(key);
    }
    child.paused();
    let found = Stopped::new(child.pid()).unwrap().search(&needles).unwrap();
    // Sealer and opener hold one each, and a cipher, whose schedule begins with its key.
    let held = |kind: &'static str, number: usize| {
        found.iter().filter(|find| find.secret == Secret { kind, number }).count()
    };
    let held = |kind| (0..KEYS).map(move |number| held(kind, number)).collect::<Vec<_>>();
    let name = format!("{backend}, keys unspent");
    let is_held = |find: &Find| {
        ["KME key", "AEAD key", "GHASH key"].contains(&find.secret.kind) && !find.on_stack
    };
    assert_eq!(unexpected(&name, &found, is_held), 0, "{name}: parts of secrets are left");
    assert_eq!(held("KME key"), [2; KEYS], "{name}: each is held twice");
    // `aes` keeps the round keys for deciphering apart, of which the last is the key's first half.
    let most = if backend == RustCrypto::NAME { 4 } else { 2 };
    let ciphers = held("AEAD key");
    assert!(ciphers.iter().all(|count| *count <= most), "{name}: {ciphers:?}");
    for what in ["keys spent", "opener dropped"] {
        child.resume();
        child.paused();
        let found = Stopped::new(child.pid()).unwrap().search(&needles).unwrap();
        let name = format!("{backend}, {what}");
        assert_eq!(unexpected(&name, &found, |_| false), 0, "{name}: parts of secrets are left");
    }
    child.resume();
}

#[test]
fn nothing_is_left_behind_with_aws_lc_rs() {
    check(AwsLc::NAME);
}

#[test]
fn nothing_is_left_behind_with_rust_crypto() {
    check(RustCrypto::NAME);
}
