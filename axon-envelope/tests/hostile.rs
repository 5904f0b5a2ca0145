//! Everything an attacker or a broken peer can do to one envelope.

mod common;

use std::collections::HashSet;
use std::time::Duration;

use axon_envelope::aead::{Aead, AeadError};
use axon_envelope::{
    Delivery, Header, HeaderError, Kind, Limits, MESSAGES_PER_KEY, OpenError, Opener, RefusalCause,
    Route, SealError, Sealer, Spent, TAG_LEN, TopicHash,
};
use common::{ROUTE, START, channel, key, key_id, opener, seal, sealer};

const PLAINTEXT: &[u8] = b"what the receiver acts on";

#[test]
fn no_changed_bit_opens_and_the_honest_envelope_still_does() {
    let mut opener = opener("key", 1);
    let envelope = seal(&mut sealer("key", 1), ROUTE, Delivery::Reliable, PLAINTEXT);
    let mut out = vec![0; PLAINTEXT.len()];
    for bit in 0..envelope.len() * 8 {
        let mut changed = envelope.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        let parsed = Header::parse(&changed).map(|(header, _)| header.route);
        match opener.open_into(START, parsed.unwrap_or(ROUTE), &changed, &mut out) {
            Err(OpenError::Header(_)) => {}
            // A shorter or longer ID moves the body, so the plaintext's length differs.
            Err(OpenError::BufferTooSmall { .. }) => assert!(bit / 8 < 27 + 1 + 5 + 1 + 3),
            Err(OpenError::Refused(_)) => assert!(out.iter().all(|byte| *byte == 0)),
            other => panic!("bit {bit}: {other:?}"),
        }
        assert!(opener.open_in_place(START, ROUTE, &mut changed).is_err(), "bit {bit}");
    }
    assert_eq!(opener.open_into(START, ROUTE, &envelope, &mut out).unwrap(), PLAINTEXT.len());
    assert_eq!(out, PLAINTEXT);
}

#[test]
fn no_cut_and_no_extension_opens() {
    let mut opener = opener("key", 1);
    let mut sealer = sealer("key", 1);
    let envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT);
    let least = sealer.overhead();
    for cut in 0..envelope.len() {
        let mut shorter = envelope[..cut].to_vec();
        match opener.open_in_place(START, ROUTE, &mut shorter) {
            Err(OpenError::Header(HeaderError::Truncated { needed, given })) => {
                assert!(cut < least && given == cut && needed > cut && needed <= least);
            }
            Err(OpenError::Refused(refusal)) => {
                assert!(cut >= least);
                assert_eq!(refusal.cause(), RefusalCause::Unauthentic);
            }
            other => panic!("cut at {cut}: {other:?}"),
        }
    }
    let mut longer = [&envelope[..], &[0]].concat();
    let error = opener.open_in_place(START, ROUTE, &mut longer).unwrap_err();
    assert_eq!(error.cause(), Some(RefusalCause::Unauthentic));
    assert!(opener.open_in_place(START, ROUTE, &mut envelope.clone()).is_ok());
}

#[test]
fn nothing_opens_twice_by_any_way_of_opening() {
    let mut opener = opener("key", 1);
    let mut sealer = sealer("key", 1);
    let header_len = sealer.header_len();
    let envelopes: Vec<_> =
        (0..3).map(|_| seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT)).collect();
    for round in 0..3 {
        for (first, envelope) in envelopes.iter().enumerate() {
            let results = [0, 1, 2].map(|way| {
                let mut copy = envelope.clone();
                match (way + first) % 3 {
                    0 => opener.open_in_place(START, ROUTE, &mut copy).map(|_| ()),
                    1 => opener.open_into(START, ROUTE, envelope, &mut copy).map(|_| ()),
                    _ => {
                        let (header, rest) = copy.split_at_mut(header_len);
                        let (body, tag) = rest.split_at_mut(PLAINTEXT.len());
                        let tag: &[u8; TAG_LEN] = (&*tag).try_into().unwrap();
                        opener.open_detached(START, ROUTE, header, body, tag)
                    }
                }
            });
            for (way, result) in results.into_iter().enumerate() {
                if (round, way) == (0, 0) {
                    result.unwrap();
                } else {
                    assert_eq!(result.unwrap_err().cause(), Some(RefusalCause::Replayed));
                }
            }
        }
    }
}

#[test]
fn a_route_other_than_expected_is_refused_and_uses_nothing_up() {
    let mut opener = opener("key", 1);
    let envelope = seal(&mut sealer("key", 1), ROUTE, Delivery::Reliable, PLAINTEXT);
    for wrong in [
        Route { kind: Kind::Request, ..ROUTE },
        Route { kind: Kind::Response, ..ROUTE },
        Route { topic: TopicHash([8; 16]), ..ROUTE },
    ] {
        let error = opener.open_in_place(START, wrong, &mut envelope.clone()).unwrap_err();
        assert_eq!(error.cause(), Some(RefusalCause::WrongRoute));
    }
    assert!(opener.open_in_place(START, ROUTE, &mut envelope.clone()).is_ok());
}

#[test]
fn a_refused_envelope_leaves_no_plaintext_behind() {
    let mut opener = opener("key", 1);
    let mut sealer = sealer("key", 1);
    let header_len = sealer.header_len();
    let envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT);
    opener.open_in_place(START, ROUTE, &mut envelope.clone()).unwrap();

    // A replay decrypts well: what matters is that the caller does not get to see it.
    let mut replay = envelope.clone();
    opener.open_in_place(START, ROUTE, &mut replay).unwrap_err();
    assert!(replay[header_len..][..PLAINTEXT.len()].iter().all(|byte| *byte == 0));
    let mut out = vec![0xaa; PLAINTEXT.len() + 1];
    opener.open_into(START, ROUTE, &envelope, &mut out).unwrap_err();
    assert!(out[..PLAINTEXT.len()].iter().all(|byte| *byte == 0));
    assert_eq!(out[PLAINTEXT.len()], 0xaa, "written beyond the message");
}

#[test]
fn a_short_buffer_uses_nothing_up_on_either_side() {
    let mut opener = opener("key", 1);
    let mut sealer = sealer("key", 1);
    let needed = sealer.overhead() + PLAINTEXT.len();
    for given in 0..needed {
        let mut out = vec![0xaa; given];
        for parts in [&[PLAINTEXT][..], &[&PLAINTEXT[..3], &PLAINTEXT[3..]]] {
            let slot = sealer.slot(START, Delivery::Reliable).unwrap();
            let error = slot.seal_into(ROUTE, parts, &mut out).unwrap_err();
            assert_eq!(error, SealError::Buffer { needed, given });
        }
        assert!(out.iter().all(|byte| *byte == 0xaa));
    }
    let mut frame = vec![0; sealer.overhead() - 1];
    let slot = sealer.slot(START, Delivery::Reliable).unwrap();
    slot.seal_in_place(ROUTE, &mut frame).unwrap_err();
    let slot = sealer.slot(START, Delivery::Reliable).unwrap();
    slot.seal_detached(ROUTE, &mut [0; 3], &mut frame).unwrap_err();
    assert_eq!((sealer.remaining(), sealer.mask_used().len()), (MESSAGES_PER_KEY, 0));

    let envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT);
    for given in 0..PLAINTEXT.len() {
        match opener.open_into(START, ROUTE, &envelope, &mut vec![0; given]) {
            Err(OpenError::BufferTooSmall { needed, given: told }) => {
                assert_eq!((needed, told), (PLAINTEXT.len(), given));
            }
            other => panic!("{other:?}"),
        }
    }
    opener.open_into(START, ROUTE, &envelope, &mut [0; PLAINTEXT.len()]).unwrap();
}

#[test]
fn there_is_no_eleventh_message_and_none_after_an_hour() {
    let mut full = sealer("key", 1);
    for index in 0..10 {
        let slot = full.slot(START, Delivery::BestEffort).unwrap();
        assert_eq!(slot.index(), index);
        // The dropped permit has used nothing up.
        seal(&mut full, ROUTE, Delivery::BestEffort, PLAINTEXT);
    }
    assert_eq!(full.slot(START, Delivery::Reliable).err(), Some(Spent::Messages));
    assert_eq!(full.retire().used.bits(), 0x3ff);

    let mut old = sealer("key", 1);
    let hour = Duration::from_secs(3600);
    // A key waits for its first message as long as it has to.
    assert_eq!(old.spent(START * 1_000), None);
    seal(&mut old, ROUTE, Delivery::Reliable, PLAINTEXT);
    assert_eq!(old.spent(START + hour - Duration::from_nanos(1)), None);
    assert_eq!(old.slot(START + hour, Delivery::Reliable).err(), Some(Spent::Age));
    assert_eq!(old.slot(Duration::MAX, Delivery::Reliable).err(), Some(Spent::Age));
    let backwards = old.slot(START, Delivery::Reliable).err();
    assert_eq!(backwards, Some(Spent::Age), "an old key is young again");
}

#[test]
fn a_header_with_something_behind_it_is_malformed_when_given_apart() {
    let mut opener = opener("key", 1);
    let mut sealer = sealer("key", 1);
    let mut header = vec![0; sealer.header_len()];
    let mut body = PLAINTEXT.to_vec();
    let slot = sealer.slot(START, Delivery::Reliable).unwrap();
    let tag = slot.seal_detached(ROUTE, &mut header, &mut body).unwrap();

    let longer = [&header[..], &[0]].concat();
    match opener.open_detached(START, ROUTE, &longer, &mut body.clone(), &tag) {
        Err(OpenError::Header(HeaderError::Trailing(1))) => {}
        other => panic!("{other:?}"),
    }
    opener.open_detached(START, ROUTE, &header, &mut body, &tag).unwrap();
    assert_eq!(body, PLAINTEXT);
}

#[test]
fn nonces_begin_at_random_and_stay_apart_by_index() {
    let nonces = |envelopes: Vec<Vec<u8>>| -> Vec<[u8; 12]> {
        envelopes.iter().map(|envelope| Header::parse(envelope).unwrap().0.nonce).collect()
    };
    // One key in the hands of several sealers is against the rules, and still repeats no nonce.
    let mut all = HashSet::new();
    for _ in 0..8 {
        let mut sealer = sealer("key", 1);
        let envelopes = (0..10).map(|_| seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT));
        let nonces = nonces(envelopes.collect());
        assert!(nonces.iter().all(|nonce| nonce[..8] == nonces[0][..8]));
        all.extend(nonces);
    }
    assert_eq!(all.len(), 80);
}

/// An AEAD that fails, and leaves something of its own in the buffer.
struct Failing;

const RUBBISH: u8 = 0xee;

impl Aead for Failing {
    const NAME: &'static str = "failing";

    fn new(_: &[u8; 32]) -> Self {
        Self
    }

    fn seal_in_place(
        &self,
        _: &[u8; 12],
        _: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        in_out.fill(RUBBISH);
        Err(AeadError)
    }

    fn seal_apart(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        _: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        self.seal_in_place(nonce, aad, ciphertext)
    }

    fn open_in_place(
        &self,
        _: &[u8; 12],
        _: &[u8],
        in_out: &mut [u8],
        _: &[u8; TAG_LEN],
    ) -> Result<(), AeadError> {
        in_out.fill(RUBBISH);
        Err(AeadError)
    }

    fn open_apart(
        &self,
        nonce: &[u8; 12],
        aad: &[u8],
        _: &[u8],
        tag: &[u8; TAG_LEN],
        plaintext: &mut [u8],
    ) -> Result<(), AeadError> {
        self.open_in_place(nonce, aad, plaintext, tag)
    }
}

#[test]
fn an_index_whose_sealing_failed_stays_taken() {
    let mut sealer = Sealer::<Failing>::with_aead(&channel(), key_id("key"), key(1)).unwrap();
    let mut frame = vec![0; sealer.overhead() + PLAINTEXT.len()];
    for index in 0..MESSAGES_PER_KEY {
        let slot = sealer.slot(START, Delivery::Reliable).unwrap();
        assert_eq!(slot.index(), index);
        let error = match index % 2 {
            0 => slot.seal_into(ROUTE, &[PLAINTEXT], &mut frame).unwrap_err(),
            _ => slot.seal_in_place(ROUTE, &mut frame).unwrap_err(),
        };
        assert_eq!(error, SealError::Aead);
    }
    assert_eq!(sealer.slot(START, Delivery::Reliable).err(), Some(Spent::Messages));
    // The receiver must not wait for what was never sent.
    let retirement = sealer.retire();
    assert!(retirement.used.is_empty() && retirement.reliable.is_empty());
}

#[test]
fn a_key_whose_sealing_failed_is_not_given_to_another_connection() {
    let mut sealer = Sealer::<Failing>::with_aead(&channel(), key_id("key"), key(1)).unwrap();
    let slot = sealer.slot(START, Delivery::Reliable).unwrap();
    slot.seal_into(ROUTE, &[PLAINTEXT], &mut [0; 200]).unwrap_err();
    assert!(sealer.into_unused().is_err());
}

#[test]
fn a_failing_aead_leaves_no_plaintext() {
    let mut opener = Opener::<Failing>::with_limits(channel(), Limits::default()).unwrap();
    opener.add_key(key_id("key"), key(1)).unwrap();
    let mut sealer = sealer("key", 1);
    let header_len = sealer.header_len();
    let mut envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, PLAINTEXT);
    let mut out = vec![0xaa; PLAINTEXT.len()];
    opener.open_into(START, ROUTE, &envelope, &mut out).unwrap_err();
    assert!(out.iter().all(|byte| *byte == 0));
    opener.open_in_place(START, ROUTE, &mut envelope).unwrap_err();
    assert!(envelope[header_len..][..PLAINTEXT.len()].iter().all(|byte| *byte == 0));
}
