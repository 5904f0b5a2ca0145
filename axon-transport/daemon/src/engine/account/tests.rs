use super::*;
use crate::link::{ReceivedOf, ReceivedUpTo, RouteReady};
use axon_shm::ids::Gid;

#[test]
fn one_identity_has_one_account_and_dropped_charges_are_refunded() {
    let mut accounts = Accounts::new(100, 1 << 20);
    let (one, again, other) = (accounts.of_one("a"), accounts.of_one("a"), accounts.of_one("b"));
    let charge = one.graph.charge(60).unwrap();
    assert!(again.graph.charge(41).is_none(), "of the same identity");
    assert!(other.graph.charge(100).is_some());
    assert!(again.graph.charge(usize::MAX).is_none());
    assert_eq!(again.graph.held(), 60);
    drop(charge);
    assert!(again.graph.charge(100).is_some());
    drop((one, again));
    assert_eq!(accounts.of_one("a").graph.held(), 0);
    assert_eq!(accounts.open.len(), 2);
}

#[test]
fn identities_with_one_budget_share_all_but_the_limits_of_rules() {
    let mut accounts = Accounts::new(100, 1 << 20);
    let [one, two] = ["a", "b"].map(|identity| accounts.of(identity, "network"));
    let other = accounts.of("c", "another");
    let charge = one.graph.charge(60).unwrap();
    assert!(two.graph.charge(41).is_none() && other.graph.charge(41).is_some());
    let meters = |account: &Account| {
        let Account { routes, relays, lanes, unsent, decoded, denied, .. } = account.clone();
        let Account { stand_ins, unread, messages, refusals, sessions, .. } = account.clone();
        let long = [messages.long, messages.short, refusals, sessions, stand_ins, unread];
        [routes, relays, lanes, unsent, decoded, denied].into_iter().chain(long)
    };
    assert!(meters(&one).zip(meters(&two)).all(|(one, two)| Rc::ptr_eq(&one, &two)));
    assert!(!meters(&one).zip(meters(&other)).any(|(one, other)| Rc::ptr_eq(&one, &other)));
    assert!(Arc::ptr_eq(&one.held, &two.held) && !Rc::ptr_eq(&one.limits, &two.limits));
    let now = Duration::from_secs(1000);
    one.owe(2 * SAID.1, now);
    assert!(two.owe(1, now) > Duration::ZERO && other.owe(1, now) == Duration::ZERO);
    // While one of them is there.
    drop(one);
    let again = accounts.of("a", "network");
    assert_eq!((again.graph.held(), two.graph.held()), (60, 60));
    drop(charge);
}

#[test]
fn memory_held_by_readers_still_counts_when_an_identity_reconnects() {
    let mut accounts = Accounts::new(100, 1000);
    let account = accounts.of_one("a");
    let (ring, pool) = (Arc::clone(&account.held), Arc::clone(&accounts.held.0));
    drop(account);
    assert!(Arc::ptr_eq(&accounts.of_one("a").held, &ring));
    assert!(!Arc::ptr_eq(&accounts.of_one("b").held, &ring));
    assert_eq!((ring.most(), pool.most()), (1000, 2000));
    drop(ring);
    accounts.of_one("c");
    assert_eq!(accounts.held_by.len(), 1, "{:?}", accounts.held_by);
}

#[test]
fn no_identity_exhausts_the_shared_pool() {
    let pool = Meter::new(100);
    let [one, two, three] = [80, 80, 10].map(|most| Meter::within(&pool, most));
    let first = one.charge(50).unwrap();
    assert!(one.charge(1).is_none(), "half of all");
    let second = two.charge(25).unwrap();
    assert!(two.charge(1).is_none() && three.charge(11).is_none());
    assert_eq!((one.left(), two.left(), three.left()), (0, 0, 10));
    drop(first);
    assert_eq!((one.left(), two.left()), (37, 25));
    drop(second);
    assert_eq!((pool.held(), three.charge(10).is_some()), (0, true));
}

#[test]
fn replaced_charge_is_kept_if_the_new_one_exceeds_the_limit() {
    let pool = Meter::new(100);
    // One charge of a closed account, and one of the account that the identity has now.
    let [old, new] = [80, 80].map(|most| Meter::within(&pool, most));
    let [kept, own] = [old.charge(30).unwrap(), new.charge(30).unwrap()];
    assert!(new.charge(10).is_none(), "half of what others leave");
    let kept = kept.exchange(&new, 25).expect_err("20 fit");
    assert_eq!((kept.amount(), old.held(), new.held(), pool.held()), (30, 30, 30, 60));
    let kept = kept.exchange(&new, 20).expect("the 30 are given back");
    assert_eq!((kept.amount(), old.held(), new.held(), pool.held()), (20, 0, 50, 50));
    assert_eq!((old.released(), new.released()), (30, 0));
    // Both charges are now of one meter.
    let kept = kept.exchange(&new, 21).expect_err("half of all");
    assert_eq!((kept.amount(), new.held()), (20, 50));
    let kept = kept.exchange(&new, 5).unwrap();
    drop((kept, own));
    assert_eq!((new.held(), pool.held()), (0, 0));
}

#[test]
fn each_share_takes_half_the_rest_and_grows_when_others_leave() {
    let meter = Meter::new(64);
    let [mut one, mut two, mut three] = [0; 3].map(|_| meter.nothing());
    assert!(meter.share(&mut one) && meter.share(&mut two) && meter.share(&mut three));
    assert_eq!([one.amount(), two.amount(), three.amount()], [32, 16, 8]);
    assert!(!meter.share(&mut one) && !meter.share(&mut three), "it has its share");
    drop(one);
    assert!(meter.share(&mut two));
    assert_eq!((two.amount(), meter.held()), (28, 36));
    drop((two, three));
    assert_eq!(meter.held(), 0);
}

#[test]
fn message_cost_counts_entries_and_frame_cost_counts_unpacked_bytes() {
    let flow = ReceivedOf { route: 1, publisher: Gid::default(), sequence: 1, dropped: 0 };
    let received = |count| LinkMessage::Received(ReceivedUpTo { flows: vec![flow; count] });
    let publishers = vec![Gid::default(); 65_536];
    let ready = LinkMessage::RouteReady(RouteReady { route: 1, publishers });
    assert_eq!((cost(&received(65_536)), cost(&ready)), (2049, 2049));
    // An honest peer sends one after each few samples, and one of a thousand topics at once.
    assert_eq!((cost(&received(1)), cost(&received(1024))), (1, 33));

    let frame = |kind: u8, unpacked: u32| [&[kind][..], &unpacked.to_be_bytes()].concat();
    assert_eq!(cost_of_frame(&frame(0x83, 4 << 20)), 1025);
    // A longer frame costs no more, because it is never decompressed. A frame of unknown type is not decompressed
    // either.
    assert_eq!(cost_of_frame(&frame(0x83, u32::MAX)), 1025);
    assert_eq!(cost_of_frame(&frame(0xff, 4 << 20)), 1);
    assert_eq!(cost_of_frame(&vec![0x7f; 1 << 20]), 257);
    assert_eq!(cost_of_frame(&[8, 0xa0]), 1);
}
