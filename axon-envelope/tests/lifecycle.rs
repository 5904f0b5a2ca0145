//! Tests the lifetime of a key: RETIRE, age, count, and a change of connection.

mod common;

use std::time::Duration;

use axon_envelope::{
    AddKeyError, Channel, Delivery, IndexMask, KeyId, Limits, Opener, RefusalCause, RetireError,
    RetireOutcome, Sealer,
};
use common::{ROUTE, START, channel, key, key_id, opener, seal, sealer};

const GRACE: Duration = Duration::from_secs(5);

fn mask(bits: u16) -> IndexMask {
    IndexMask::from_bits(bits).unwrap()
}

fn open(opener: &mut Opener, now: Duration, envelope: &[u8]) -> Result<(), RefusalCause> {
    match opener.open_in_place(now, ROUTE, &mut envelope.to_vec()) {
        Ok(_) => Ok(()),
        Err(error) => Err(error.cause().unwrap()),
    }
}

/// Seals six messages, best effort and reliable in turn: 1, 3 and 5 are reliable.
fn six(name: &str) -> (Vec<Vec<u8>>, Sealer) {
    let mut sealer = sealer(name, 1);
    let deliveries = [Delivery::BestEffort, Delivery::Reliable].into_iter().cycle().take(6);
    let envelopes = deliveries.map(|d| seal(&mut sealer, ROUTE, d, b"x")).collect();
    (envelopes, sealer)
}

#[test]
fn the_tenth_message_retires_the_key() {
    let (mut opener, mut sealer) = (opener("key", 1), sealer("key", 1));
    for _ in 0..10 {
        assert!(opener.contains(b"key"));
        let envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, b"x");
        assert_eq!(open(&mut opener, START, &envelope), Ok(()));
        if opener.contains(b"key") {
            assert_eq!(open(&mut opener, START, &envelope), Err(RefusalCause::Replayed));
        } else {
            assert_eq!(open(&mut opener, START, &envelope), Err(RefusalCause::Retired));
        }
    }
    assert_eq!(opener.key_count(), 0);
    assert_eq!(
        opener.retire(START, b"key", IndexMask::ALL, IndexMask::ALL),
        Ok(RetireOutcome::NotHeld)
    );
    assert_eq!(opener.add_key(key_id("key"), key(1)), Err(AddKeyError::Retired));
}

#[test]
fn retire_waits_for_the_reliable_and_five_seconds_for_the_rest() {
    let (mut opener, (envelopes, sealer)) = (opener("key", 1), six("key"));
    assert_eq!(open(&mut opener, START, &envelopes[1]), Ok(()));
    let retirement = sealer.retire();
    assert_eq!((retirement.used, retirement.reliable), (mask(0b111111), mask(0b101010)));

    let outcome = opener.retire(START, b"key", retirement.used, retirement.reliable);
    assert_eq!(outcome, Ok(RetireOutcome::Waiting(mask(0b111101))));
    let late = START + GRACE - Duration::from_nanos(1);
    assert_eq!(open(&mut opener, late, &envelopes[0]), Ok(()));
    // Told again, nothing is waited for any longer than before.
    opener.retire(late, b"key", retirement.used, retirement.reliable).unwrap();
    let over = START + GRACE;
    assert_eq!(open(&mut opener, over, &envelopes[2]), Err(RefusalCause::Retired));
    assert_eq!(open(&mut opener, over, &envelopes[3]), Ok(()));
    assert_eq!(opener.expire(over).keys, 0);
    // A reliable message is waited for long after that.
    let much_later = START + opener.limits().max_age - Duration::from_nanos(1);
    assert_eq!(opener.expire(much_later).keys, 0);
    assert_eq!(open(&mut opener, much_later, &envelopes[5]), Ok(()));
    assert!(!opener.contains(b"key"));
    assert_eq!(open(&mut opener, much_later, &envelopes[4]), Err(RefusalCause::Retired));
    // The second and the fourth best-effort message never came, whatever ended the key.
    let expired = opener.expire(much_later);
    assert_eq!((expired.keys, expired.messages_missing), (0, 2));
    assert_eq!(opener.expire(much_later).messages_missing, 0, "counted twice");
}

#[test]
fn a_reliable_message_that_never_comes_holds_its_key_for_a_while_only() {
    let (mut opener, (envelopes, sealer)) = (opener("key", 1), six("key"));
    let max_age = opener.limits().max_age;
    let (retired_at, retirement) = (START * 7, sealer.retire());
    let (used, reliable) = (retirement.used, retirement.reliable);
    // No message has opened yet: the time counts from RETIRE, and only from the first one.
    opener.retire(retired_at, b"key", used, reliable).unwrap();
    let last = retired_at + max_age - Duration::from_nanos(1);
    opener.retire(last, b"key", used, reliable).unwrap();
    assert_eq!(open(&mut opener, last, &envelopes[1]), Ok(()));
    assert_eq!(opener.expire(last).keys, 0);

    let over = retired_at + max_age;
    assert_eq!(open(&mut opener, over, &envelopes[3]), Err(RefusalCause::Retired));
    let expired = opener.expire(over);
    assert_eq!((expired.keys, expired.messages_missing), (1, 5));
    assert_eq!(opener.key_count(), 0);
    assert_eq!(opener.add_key(key_id("key"), key(1)), Err(AddKeyError::Retired));
}

#[test]
fn keys_pinned_by_lost_messages_make_room_again() {
    let mut limits = Limits::default();
    limits.max_keys = 3;
    let mut opener: Opener = Opener::with_limits(channel(), limits).unwrap();
    for name in ["a", "b", "c"] {
        opener.add_key(key_id(name), key(1)).unwrap();
        opener.retire(START, name.as_bytes(), mask(1), mask(1)).unwrap();
    }
    assert_eq!(opener.add_key(key_id("d"), key(1)), Err(AddKeyError::Full(3)));
    assert_eq!(opener.expire(START + limits.max_age).keys, 3);
    assert_eq!(opener.add_key(key_id("d"), key(1)), Ok(()));
}

#[test]
fn best_effort_messages_that_never_came_are_counted_when_the_key_goes() {
    let (mut opener, (envelopes, sealer)) = (opener("key", 1), six("key"));
    for reliable in [1, 3, 5] {
        assert_eq!(open(&mut opener, START, &envelopes[reliable]), Ok(()));
    }
    let retirement = sealer.retire();
    opener.retire(START, b"key", retirement.used, retirement.reliable).unwrap();
    assert_eq!(opener.expire(START + GRACE - Duration::from_nanos(1)).keys, 0);
    let expired = opener.expire(START + GRACE);
    assert_eq!((expired.keys, expired.messages_missing), (1, 3));
    assert_eq!(opener.key_count(), 0);
    assert_eq!(open(&mut opener, START, &envelopes[0]), Err(RefusalCause::Retired));
}

#[test]
fn an_unused_index_does_not_open_after_retire() {
    let mut opener = opener("key", 1);
    let mut copy = sealer("key", 1);
    let held_back: Vec<_> =
        (0..3).map(|_| seal(&mut copy, ROUTE, Delivery::Reliable, b"x")).collect();
    let outcome = opener.retire(START, b"key", mask(0b011), mask(0b011));
    assert_eq!(outcome, Ok(RetireOutcome::Waiting(mask(0b011))));
    assert_eq!(open(&mut opener, START, &held_back[2]), Err(RefusalCause::Retired));
    assert_eq!(open(&mut opener, START, &held_back[0]), Ok(()));
}

#[test]
fn a_retire_that_contradicts_itself_or_the_facts_changes_nothing() {
    let (mut opener, (envelopes, _)) = (opener("key", 1), six("key"));
    let error = opener.retire(START, b"key", mask(1), mask(3)).unwrap_err();
    assert_eq!(error, RetireError::Masks { used: mask(1), reliable: mask(3) });
    open(&mut opener, START, &envelopes[1]).unwrap();
    let error = opener.retire(START, b"key", mask(1), mask(1)).unwrap_err();
    assert_eq!(error, RetireError::OpenedUnused { used: mask(1), opened: mask(2) });
    assert_eq!(open(&mut opener, START, &envelopes[5]), Ok(()));
    let unknown = opener.retire(START, b"no such key", mask(1), mask(1));
    assert_eq!(unknown, Ok(RetireOutcome::NotHeld));
}

#[test]
fn a_retire_without_messages_erases_at_once() {
    let mut opener = opener("key", 1);
    let outcome = opener.retire(START, b"key", IndexMask::EMPTY, IndexMask::EMPTY);
    assert_eq!(outcome, Ok(RetireOutcome::Erased));
    assert_eq!(opener.key_count(), 0);
}

#[test]
fn a_key_that_is_never_retired_grows_too_old() {
    let (mut opener, (envelopes, _)) = (opener("key", 1), six("key"));
    let max_age = opener.limits().max_age;
    let first = START * 100; // no first message, no age
    assert_eq!(open(&mut opener, first, &envelopes[0]), Ok(()));
    let last = first + max_age - Duration::from_nanos(1);
    assert_eq!(open(&mut opener, last, &envelopes[1]), Ok(()));
    assert_eq!(opener.expire(last).keys, 0);
    assert_eq!(open(&mut opener, first + max_age, &envelopes[2]), Err(RefusalCause::Retired));
    // Neither a late RETIRE nor a clock that goes backwards brings it back.
    let (other, _) = six("other");
    opener.add_key(key_id("other"), key(1)).unwrap();
    assert_eq!(open(&mut opener, first, &other[0]), Ok(()));
    assert_eq!(open(&mut opener, first, &envelopes[2]), Err(RefusalCause::Retired));
    let outcome = opener.retire(first + max_age, b"key", mask(0b111111), mask(0b111111));
    assert_eq!(outcome, Ok(RetireOutcome::NotHeld));
    assert_eq!(open(&mut opener, first + max_age, &envelopes[2]), Err(RefusalCause::Retired));
    assert_eq!(opener.expire(first + max_age * 2).keys, 1);
    assert_eq!(opener.key_count(), 0);
}

#[test]
fn the_cap_refuses_the_next_key_until_one_is_retired() {
    let mut opener = Opener::new(channel()).unwrap();
    for number in 0..4096 {
        opener.add_key(key_id(&number.to_string()), key(1)).unwrap();
    }
    assert_eq!(opener.add_key(key_id("more"), key(1)), Err(AddKeyError::Full(4096)));
    assert_eq!(opener.add_key(key_id("17"), key(2)), Err(AddKeyError::Held));
    opener.retire(START, b"17", IndexMask::EMPTY, IndexMask::EMPTY).unwrap();
    assert_eq!(opener.add_key(key_id("17"), key(1)), Err(AddKeyError::Retired));
    opener.add_key(key_id("more"), key(1)).unwrap();
    assert_eq!(opener.key_count(), 4096);
}

#[test]
fn the_memory_of_retired_keys_is_bounded_and_forgets_the_oldest() {
    let mut limits = Limits::default();
    limits.retired_memory = 2;
    let mut opener: Opener = Opener::with_limits(channel(), limits).unwrap();
    for name in ["a", "b", "c"] {
        opener.add_key(key_id(name), key(1)).unwrap();
        opener.retire(START, name.as_bytes(), IndexMask::EMPTY, IndexMask::EMPTY).unwrap();
    }
    assert_eq!(opener.add_key(key_id("b"), key(1)), Err(AddKeyError::Retired));
    assert_eq!(opener.add_key(key_id("c"), key(1)), Err(AddKeyError::Retired));
    assert_eq!(opener.add_key(key_id("a"), key(1)), Ok(()));
}

#[test]
fn an_unused_key_moves_to_the_next_connection_and_a_used_one_does_not() {
    let next = Channel::new("alice", "bob", [2; 32]).unwrap();
    let mut old_opener = opener("unused", 1);
    old_opener.add_key(key_id("used"), key(2)).unwrap();
    let unused = sealer("unused", 1);
    let mut used = sealer("used", 2);
    let old_envelope = seal(&mut used, ROUTE, Delivery::Reliable, b"x");
    open(&mut old_opener, START, &old_envelope).unwrap();

    assert!(used.into_unused().is_err());
    assert!(old_opener.take_unused(b"used").is_none());
    let names: Vec<&KeyId> = old_opener.unused_keys().collect();
    assert_eq!(names, [&key_id("unused")]);

    let (id, key) = unused.into_unused().unwrap();
    let mut sealer = Sealer::new(&next, id, key).unwrap();
    let mut opener: Opener = Opener::new(next).unwrap();
    let (id, key) = old_opener.take_unused(b"unused").unwrap();
    assert!(old_opener.take_unused(b"unused").is_none());
    opener.add_key(id, key).unwrap();

    let envelope = seal(&mut sealer, ROUTE, Delivery::Reliable, b"new connection");
    assert_eq!(open(&mut old_opener, START, &envelope), Err(RefusalCause::UnknownKey));
    assert_eq!(open(&mut opener, START, &envelope), Ok(()));
}

#[test]
fn nothing_of_an_earlier_connection_opens_after_a_restart() {
    let envelope = seal(&mut sealer("key", 1), ROUTE, Delivery::Reliable, b"x");
    let next = Channel::new("alice", "bob", [2; 32]).unwrap();
    let mut restarted: Opener = Opener::new(next).unwrap();
    restarted.add_key(key_id("key"), key(1)).unwrap();
    assert_eq!(open(&mut restarted, START, &envelope), Err(RefusalCause::Unauthentic));
}
