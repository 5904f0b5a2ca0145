//! Tests the cost and the text of a refusal. An AEAD that keeps a record counts the work, because the clock proves
//! nothing in a test.
//!
//! The record is the AEAD's view: which operation, and over how many bytes of header and body. It
//! has to be the same for each cause.

mod common;

use std::cell::RefCell;
use std::time::Duration;

use axon_envelope::aead::{Aead, AeadError, DefaultAead};
use axon_envelope::{
    Channel, Delivery, Header, HeaderError, IndexMask, Kind, Limits, OpenError, Opener,
    RefusalCause, Route, Sealer, TopicHash,
};
use common::{ROUTE, START, channel, key, key_id};

/// One use of the AEAD.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Work {
    KeySetUp,
    Seal,
    OpenInPlace { aad: usize, body: usize },
    OpenApart { aad: usize, body: usize },
}

thread_local! {
    /// The work on this thread since the last call of [`recorded`]. Each test has its own thread.
    static RECORD: RefCell<Vec<Work>> = const { RefCell::new(Vec::new()) };
}

fn record(work: Work) {
    RECORD.with_borrow_mut(|record| record.push(work));
}

fn recorded() -> Vec<Work> {
    RECORD.take()
}

/// The real AEAD behind a record of its use.
struct Recorded(DefaultAead);

impl Aead for Recorded {
    const NAME: &'static str = "recorded";

    fn new(key: &[u8; 32]) -> Self {
        record(Work::KeySetUp);
        Self(DefaultAead::new(key))
    }

    fn seal_in_place(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; 16], AeadError> {
        record(Work::Seal);
        self.0.seal_in_place(nonce, aad, in_out)
    }

    fn seal_apart(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        plaintext: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; 16], AeadError> {
        record(Work::Seal);
        self.0.seal_apart(nonce, aad, plaintext, ciphertext)
    }

    fn open_in_place(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        in_out: &mut [u8],
        tag: &[u8; 16],
    ) -> Result<(), AeadError> {
        record(Work::OpenInPlace { aad: aad.len(), body: in_out.len() });
        self.0.open_in_place(nonce, aad, in_out, tag)
    }

    fn open_apart(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        ciphertext: &[u8],
        tag: &[u8; 16],
        plaintext: &mut [u8],
    ) -> Result<(), AeadError> {
        record(Work::OpenApart { aad: aad.len(), body: ciphertext.len() });
        self.0.open_apart(nonce, aad, ciphertext, tag, plaintext)
    }
}

const BODY: &[u8] = &[0x5a; 777];
/// Key_IDs of one length, so that every envelope here has the same.
const HELD: &str = "held";
const GONE: &str = "gone";
const LOST: &str = "lost";

fn sealer_on(channel: &Channel, name: &str) -> Sealer<Recorded> {
    Sealer::with_nonce_prefix(channel, key_id(name), key(1), [3; 8])
}

fn seal(sealer: &mut Sealer<Recorded>, route: Route) -> Vec<u8> {
    let mut envelope = vec![0; sealer.overhead() + BODY.len()];
    let slot = sealer.slot(START, Delivery::Reliable).unwrap();
    slot.seal_into(route, &[BODY], &mut envelope).unwrap();
    envelope
}

fn on(channel: &Channel) -> Vec<u8> {
    seal(&mut sealer_on(channel, HELD), ROUTE)
}

/// Holds [`HELD`], of which index 0 has opened and the rest may, and [`LOST`], of which RETIRE
/// called only index 0 used; [`GONE`] is retired.
fn opener() -> Opener<Recorded> {
    let mut opener = Opener::with_limits(channel(), Limits::default()).unwrap();
    for name in [HELD, GONE, LOST] {
        opener.add_key(key_id(name), key(1)).unwrap();
    }
    let mut first = on(&channel());
    opener.open_in_place(START, ROUTE, &mut first).unwrap();
    opener.retire(START, GONE.as_bytes(), IndexMask::EMPTY, IndexMask::EMPTY).unwrap();
    let zero = IndexMask::from_bits(1).unwrap();
    opener.retire(START, LOST.as_bytes(), zero, zero).unwrap();
    assert_eq!(opener.key_count(), 2);
    opener
}

/// Returns every way to be refused, on an [`opener`].
fn refused() -> Vec<(&'static str, RefusalCause, Vec<u8>)> {
    use RefusalCause::*;

    let second = |channel: &Channel, name, route| {
        let mut sealer = sealer_on(channel, name);
        seal(&mut sealer, ROUTE);
        seal(&mut sealer, route)
    };
    let honest = || second(&channel(), HELD, ROUTE);
    let header_len = Header::parse(&honest()).unwrap().1;
    let changed = |at: usize| {
        let mut envelope = honest();
        envelope[at] ^= 1;
        envelope
    };
    let index = |index: u8| {
        let mut envelope = honest();
        envelope[10] = index;
        envelope[header_len - 1] = index;
        envelope
    };
    let other_channel = |sender: &str, receiver: &str, context: u8| {
        second(&Channel::new(sender, receiver, [context; 32]).unwrap(), HELD, ROUTE)
    };
    let other_topic = Route { topic: TopicHash([8; 16]), ..ROUTE };
    let other_kind = Route { kind: Kind::Response, ..ROUTE };

    vec![
        ("unknown key_ID", UnknownKey, second(&channel(), "else", ROUTE)),
        ("replay", Replayed, on(&channel())),
        ("retired key", Retired, second(&channel(), GONE, ROUTE)),
        ("retired index", Retired, second(&channel(), LOST, ROUTE)),
        ("index 10", IndexOutOfRange, index(10)),
        ("index 255", IndexOutOfRange, index(255)),
        ("index changed to another that may open", Unauthentic, index(5)),
        ("other sender", WrongSender, other_channel("mally", "bob", 1)),
        ("other receiver", Unauthentic, other_channel("alice", "rob", 1)),
        ("other context", Unauthentic, other_channel("alice", "bob", 2)),
        ("other topic", WrongRoute, second(&channel(), HELD, other_topic)),
        ("other kind", WrongRoute, second(&channel(), HELD, other_kind)),
        ("first byte of the body", Unauthentic, changed(header_len)),
        ("last byte of the tag", Unauthentic, changed(honest().len() - 1)),
        ("nonce", Unauthentic, changed(header_len - 12)),
    ]
}

/// Returns the texts that a program which prints or passes on the error reveals.
fn aloud(error: &OpenError) -> (String, String) {
    assert!(std::error::Error::source(error).is_none());
    (error.to_string(), format!("{error:?} {error:#?}"))
}

#[test]
fn each_refusal_is_one_open_over_everything_and_reads_the_same() {
    let mut causes = Vec::new();
    let mut said = Vec::new();
    for (name, cause, mut envelope) in refused() {
        let mut opener = opener();
        let (header_len, len) = (Header::parse(&envelope).unwrap().1, envelope.len());
        let (aad, body) = (header_len, BODY.len());
        let mut out = vec![0xaa; body + 1];
        recorded();

        let error = opener.open_into(START, ROUTE, &envelope, &mut out).unwrap_err();
        assert_eq!(recorded(), [Work::OpenApart { aad, body }], "{name}");
        assert_eq!(error.cause(), Some(cause), "{name}");
        said.push(aloud(&error));
        assert_eq!(out, [&[0; BODY.len()][..], &[0xaa]].concat(), "{name}");

        let (header, rest) = envelope.split_at_mut(header_len);
        let (in_out, tag) = rest.split_at_mut(body);
        let (mut in_out, tag) = (in_out.to_vec(), (&*tag).try_into().unwrap());
        let error = opener.open_detached(START, ROUTE, header, &mut in_out, tag).unwrap_err();
        assert_eq!(recorded(), [Work::OpenInPlace { aad, body }], "{name}");
        assert_eq!(error.cause(), Some(cause), "{name}");
        said.push(aloud(&error));
        assert_eq!(in_out, [0; BODY.len()], "{name}");

        let error = opener.open_in_place(START, ROUTE, &mut envelope).unwrap_err();
        assert_eq!(recorded(), [Work::OpenInPlace { aad, body }], "{name}");
        assert_eq!(error.cause(), Some(cause), "{name}");
        said.push(aloud(&error));
        assert_eq!(envelope[header_len..len - 16], [0; BODY.len()], "{name}");

        // A refusal changes nothing: what may open still does.
        let mut sealer = sealer_on(&channel(), HELD);
        seal(&mut sealer, ROUTE);
        opener.open_in_place(START, ROUTE, &mut seal(&mut sealer, ROUTE)).unwrap();
        causes.push(cause);
    }
    said.dedup();
    assert_eq!(said.len(), 1, "refusals can be told apart: {said:?}");

    causes.sort_unstable();
    causes.dedup();
    use RefusalCause::*;
    let all =
        [WrongSender, WrongRoute, IndexOutOfRange, UnknownKey, Retired, Replayed, Unauthentic];
    assert_eq!(causes, all, "a cause is not covered");
}

#[test]
fn opening_a_valid_message_costs_the_same_work_as_a_refusal() {
    let mut opener = opener();
    let mut sealer = sealer_on(&channel(), HELD);
    seal(&mut sealer, ROUTE);
    let envelope = seal(&mut sealer, ROUTE);
    let aad = sealer.header_len();
    recorded();
    opener.open_into(START, ROUTE, &envelope, &mut [0; BODY.len()]).unwrap();
    assert_eq!(recorded(), [Work::OpenApart { aad, body: BODY.len() }]);
}

#[test]
fn a_key_that_age_alone_has_ended_costs_the_same() {
    let mut opener = opener();
    let mut sealer = sealer_on(&channel(), HELD);
    seal(&mut sealer, ROUTE);
    let envelope = seal(&mut sealer, ROUTE);
    let over: Duration = START + opener.limits().max_age;
    recorded();
    let error = opener.open_into(over, ROUTE, &envelope, &mut [0; BODY.len()]).unwrap_err();
    assert_eq!(error.cause(), Some(RefusalCause::Retired));
    let work = Work::OpenApart { aad: sealer.header_len(), body: BODY.len() };
    assert_eq!(recorded(), [work]);
}

#[test]
fn a_malformed_header_is_refused_with_its_error_and_without_decryption() {
    let honest = on(&channel());
    let with = |at: usize, byte: u8| {
        let mut envelope = honest.clone();
        envelope[at] = byte;
        envelope
    };
    let malformed = [
        (HeaderError::Magic, with(7, b'2')),
        (HeaderError::Kind(3), with(8, 3)),
        (HeaderError::Flags(1), with(9, 1)),
        (HeaderError::NonceIndex, with(10, 4)),
        (HeaderError::EmptySender, with(27, 0)),
        (HeaderError::EmptyKeyId, with(28 + "alice".len(), 0)),
        (HeaderError::Truncated { needed: 8, given: 0 }, Vec::new()),
    ];
    let mut opener = opener();
    recorded();
    for (expected, mut envelope) in malformed {
        let before = envelope.clone();
        for _ in 0..2 {
            let mut out = [0xaa; BODY.len()];
            let apart = opener.open_into(START, ROUTE, &envelope, &mut out).unwrap_err();
            let in_place = opener.open_in_place(START, ROUTE, &mut envelope).unwrap_err();
            for error in [apart, in_place] {
                assert!(matches!(&error, OpenError::Header(e) if *e == expected), "{error}");
                assert_eq!(error.cause(), None);
            }
            assert_eq!(out, [0xaa; BODY.len()], "touched");
            assert_eq!(envelope, before, "touched");
        }
    }
    assert_eq!(recorded(), []);
}

#[test]
fn an_unknown_key_id_sets_up_no_key() {
    // The decoy is made once, with the opener; what a stranger's key_ID costs does not grow.
    let mut opener: Opener<Recorded> = Opener::with_limits(channel(), Limits::default()).unwrap();
    // Each set-up is followed by one of a public key, which overwrites what the first left behind.
    assert_eq!(recorded(), [Work::KeySetUp, Work::KeySetUp]);
    for name in ["one", "two"] {
        let envelope = seal(&mut sealer_on(&channel(), name), ROUTE);
        recorded();
        opener.open_into(START, ROUTE, &envelope, &mut [0; BODY.len()]).unwrap_err();
        assert_eq!(recorded().len(), 1);
    }
}
