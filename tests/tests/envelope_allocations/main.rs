//! Sealing, opening and refusing a message allocates nothing, with either back end, in every way
//! there is to call it, from a key's first message to the tenth, which retires it.
//!
//! Here and not with the crate, which forbids unsafe code: an allocator needs it.

mod count;

use std::time::Duration;

use axon_envelope::aead::{Aead, AwsLc, RustCrypto};
use axon_envelope::{
    Channel, Delivery, KeyId, Kind, KmeKey, Limits, MESSAGES_PER_KEY, OpenError, Opener, Route,
    Sealer, TAG_LEN, TopicHash, inner,
};
use count::{Allocations, NONE, allocations};

const SIZES: [usize; 5] = [0, 1, 64, 5_000, 70_000];
const KEYS: u8 = 3;
const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };
const ELSEWHERE: Route = Route { kind: Kind::Request, ..ROUTE };
const NOW: Duration = Duration::from_secs(9);

fn channel() -> Channel {
    Channel::new("robot-a", "robot-b", [1; 32]).unwrap()
}

fn key_id(number: u8) -> KeyId {
    KeyId::new(format!("bc490419-7d60-487f-adc1-4ddcc177c1{number:02x}")).unwrap()
}

fn sealer<A: Aead>(number: u8) -> Sealer<A> {
    Sealer::with_aead(&channel(), key_id(number), KmeKey::take(&mut [number; 32])).unwrap()
}

/// Holds [`KEYS`] keys, and remembers one retired one, so that the second makes it forget.
fn opener<A: Aead>() -> Opener<A> {
    let mut limits = Limits::default();
    limits.retired_memory = 1;
    let mut opener = Opener::with_limits(channel(), limits).unwrap();
    for number in 0..KEYS {
        opener.add_key(key_id(number), KmeKey::take(&mut [number; 32])).unwrap();
    }
    opener
}

/// One way to seal `plaintext` into `envelope`, which has exactly its size.
type Seal<A> = fn(&mut Sealer<A>, plaintext: &[u8], envelope: &mut [u8]);

fn seal_in_place<A: Aead>(sealer: &mut Sealer<A>, plaintext: &[u8], envelope: &mut [u8]) {
    let start = sealer.header_len();
    envelope[start..start + plaintext.len()].copy_from_slice(plaintext);
    sealer.slot(NOW, Delivery::Reliable).unwrap().seal_in_place(ROUTE, envelope).unwrap();
}

fn seal_into<A: Aead>(sealer: &mut Sealer<A>, plaintext: &[u8], envelope: &mut [u8]) {
    let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
    slot.seal_into(ROUTE, &[plaintext], envelope).unwrap();
}

fn seal_parts_into<A: Aead>(sealer: &mut Sealer<A>, plaintext: &[u8], envelope: &mut [u8]) {
    let (head, tail) = plaintext.split_at(plaintext.len().min(inner::LEN));
    let slot = sealer.slot(NOW, Delivery::BestEffort).unwrap();
    slot.seal_into(ROUTE, &[head, tail], envelope).unwrap();
}

fn seal_detached<A: Aead>(sealer: &mut Sealer<A>, plaintext: &[u8], envelope: &mut [u8]) {
    let (header, rest) = envelope.split_at_mut(sealer.header_len());
    let (body, tag) = rest.split_at_mut(plaintext.len());
    body.copy_from_slice(plaintext);
    let slot = sealer.slot(NOW, Delivery::BestEffort).unwrap();
    tag.copy_from_slice(&slot.seal_detached(ROUTE, header, body).unwrap());
}

/// One way to open `envelope`, with room in `out`.
type Open<A> = fn(&mut Opener<A>, Route, &mut [u8], out: &mut [u8]) -> Result<(), OpenError>;

fn open_in_place<A: Aead>(
    opener: &mut Opener<A>,
    route: Route,
    envelope: &mut [u8],
    _: &mut [u8],
) -> Result<(), OpenError> {
    opener.open_in_place(NOW, route, envelope).map(|_| ())
}

fn open_into<A: Aead>(
    opener: &mut Opener<A>,
    route: Route,
    envelope: &mut [u8],
    out: &mut [u8],
) -> Result<(), OpenError> {
    opener.open_into(NOW, route, envelope, out).map(|_| ())
}

fn open_detached<A: Aead>(
    opener: &mut Opener<A>,
    route: Route,
    envelope: &mut [u8],
    out: &mut [u8],
) -> Result<(), OpenError> {
    let body_len = out.len();
    let (header, rest) = envelope.split_at_mut(envelope.len() - TAG_LEN - body_len);
    let (body, tag) = rest.split_at_mut(body_len);
    opener.open_detached(NOW, route, header, body, (&*tag).try_into().unwrap())
}

fn check<A: Aead>(seal: Seal<A>, open: Open<A>) {
    for size in SIZES {
        let plaintext = vec![0x5a; size];
        let mut opener = opener::<A>();
        for number in 0..KEYS {
            let mut sealer = sealer::<A>(number);
            let mut envelope = vec![0; sealer.overhead() + size];
            let mut out = vec![0; size];
            for index in 0..MESSAGES_PER_KEY {
                let name = format!("{}, {size} bytes, index {index}", A::NAME);
                let ((), sealing) = allocations(|| seal(&mut sealer, &plaintext, &mut envelope));
                assert_eq!(sealing, NONE, "seal: {name}");

                let mut elsewhere = envelope.clone();
                let mut replay = envelope.clone();
                let (result, refusing) =
                    allocations(|| open(&mut opener, ELSEWHERE, &mut elsewhere, &mut out));
                assert!(result.is_err(), "{name}");
                assert_eq!(refusing, NONE, "refuse: {name}");

                let (result, opening) =
                    allocations(|| open(&mut opener, ROUTE, &mut envelope, &mut out));
                result.unwrap();
                assert_eq!(opening, NONE, "open: {name}");

                let (result, refusing) =
                    allocations(|| open(&mut opener, ROUTE, &mut replay, &mut out));
                assert!(result.is_err(), "{name}");
                assert_eq!(refusing, NONE, "refuse a replay: {name}");
            }
        }
        assert_eq!(opener.key_count(), 0);
    }
}

/// Refuses one message. The first refusal on a thread allocates nothing with RustCrypto; aws-lc sets up the thread's
/// error queue.
fn refuse_once<A: Aead>() -> Allocations {
    let mut envelope = vec![0; sealer::<A>(0).overhead()];
    seal_into(&mut sealer::<A>(0), &[], &mut envelope);
    let mut opener = opener::<A>();
    let (result, refusing) =
        allocations(|| open_in_place(&mut opener, ELSEWHERE, &mut envelope, &mut []));
    assert!(result.is_err());
    refusing
}

fn check_all<A: Aead>() {
    check::<A>(seal_in_place, open_in_place);
    check::<A>(seal_into, open_into);
    check::<A>(seal_parts_into, open_into);
    check::<A>(seal_detached, open_detached);
}

#[test]
fn no_message_allocates_with_aws_lc_rs() {
    assert_eq!(refuse_once::<AwsLc>().rust, 0);
    check_all::<AwsLc>();
}

#[test]
fn no_message_allocates_with_rust_crypto() {
    assert_eq!(refuse_once::<RustCrypto>(), NONE);
    check_all::<RustCrypto>();
}

#[test]
fn an_allocation_would_have_been_counted() {
    let (_, boxed) = allocations(|| std::hint::black_box(Box::new([1_u8; 64])));
    assert_eq!(boxed.rust, 1);
    let (_, key) = allocations(|| RustCrypto::new(&[1; 32]));
    assert_eq!(key.rust, 1);
    if cfg!(all(target_os = "linux", target_env = "gnu")) {
        assert_eq!((boxed.c, key.c), (1, 1));
        // The key schedule of AWS-LC is in C memory.
        let (_, key) = allocations(|| AwsLc::new(&[1; 32]));
        assert!(key.c > key.rust, "{key:?}");
    }
}
