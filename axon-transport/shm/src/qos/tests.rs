//! Tests matching against the rules of ROS 2, which are written out a second time as a table.

use std::time::Duration;

use proptest::prelude::*;

use super::*;

/// Offered, requested, and whether they are compatible: every pair of each policy.
const RELIABILITY: [(Reliability, Reliability, bool); 4] = [
    (Reliability::BestEffort, Reliability::BestEffort, true),
    (Reliability::BestEffort, Reliability::Reliable, false),
    (Reliability::Reliable, Reliability::BestEffort, true),
    (Reliability::Reliable, Reliability::Reliable, true),
];
const DURABILITY: [(Durability, Durability, bool); 4] = [
    (Durability::Volatile, Durability::Volatile, true),
    (Durability::Volatile, Durability::TransientLocal, false),
    (Durability::TransientLocal, Durability::Volatile, true),
    (Durability::TransientLocal, Durability::TransientLocal, true),
];
const LIVELINESS: [(Liveliness, Liveliness, bool); 4] = [
    (Liveliness::Automatic, Liveliness::Automatic, true),
    (Liveliness::Automatic, Liveliness::ManualByTopic, false),
    (Liveliness::ManualByTopic, Liveliness::Automatic, true),
    (Liveliness::ManualByTopic, Liveliness::ManualByTopic, true),
];
const SEVEN: Option<Duration> = Some(Duration::from_nanos(7));
/// Values of deadline and lease, with x < y.
const X: Option<Duration> = Some(Duration::from_nanos(5));
const Y: Option<Duration> = Some(Duration::from_nanos(6));
const PERIOD: [(Option<Duration>, Option<Duration>, bool); 9] = [
    (None, None, true),
    (None, X, false),
    (None, Y, false),
    (X, None, true),
    (X, X, true),
    (X, Y, true),
    (Y, None, true),
    (Y, X, false),
    (Y, Y, true),
];

#[test]
fn every_combination_of_policies_is_judged_as_the_table_says() {
    let mut judged = 0;
    for (o_rel, r_rel, rel) in RELIABILITY {
        for (o_dur, r_dur, dur) in DURABILITY {
            for (o_live, r_live, live) in LIVELINESS {
                for (o_dead, r_dead, dead) in PERIOD {
                    for (o_lease, r_lease, lease) in PERIOD {
                        let side = |reliability, durability, liveliness, deadline, lease| Qos {
                            reliability,
                            durability,
                            liveliness,
                            deadline,
                            lease,
                            ..Qos::default()
                        };
                        let offered = side(o_rel, o_dur, o_live, o_dead, o_lease);
                        let requested = side(r_rel, r_dur, r_live, r_dead, r_lease);
                        let expected: Vec<Incompatible> = [
                            (rel, Incompatible::Reliability),
                            (dur, Incompatible::Durability),
                            (dead, Incompatible::Deadline),
                            (live, Incompatible::Liveliness),
                            (lease, Incompatible::LivelinessLease),
                        ]
                        .into_iter()
                        .filter_map(|(ok, policy)| (!ok).then_some(policy))
                        .collect();
                        let found: Vec<_> = incompatibilities(&offered, &requested).collect();
                        assert_eq!(found, expected, "{offered:?} {requested:?}");
                        let first = expected.first().copied().map_or(Ok(()), Err);
                        assert_eq!(compatible(&offered, &requested), first);
                        judged += 1;
                    }
                }
            }
        }
    }
    assert_eq!(judged, 4 * 4 * 4 * 9 * 9);
}

fn qos() -> impl Strategy<Value = Qos> {
    let period = || prop_oneof![Just(None), (1u64..4).prop_map(|n| Some(Duration::from_nanos(n)))];
    (any::<[bool; 4]>(), period(), period(), 1u32..20).prop_map(
        |([reliable, latched, manual, all], deadline, lease, depth)| Qos {
            reliability: if reliable { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if latched { Durability::TransientLocal } else { Durability::Volatile },
            history: if all { History::KeepAll } else { History::KeepLast },
            depth,
            deadline,
            lifespan: None,
            liveliness: if manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            lease,
        },
    )
}

fn request() -> impl Strategy<Value = QosRequest> {
    (qos(), any::<[u8; 5]>()).prop_map(|(qos, open)| {
        fn leave<T>(choice: &mut Choice<T>, open: u8) {
            match open % 3 {
                0 => *choice = Choice::SystemDefault,
                1 => *choice = Choice::BestAvailable,
                _ => {}
            }
        }
        let mut request = QosRequest::from(qos);
        leave(&mut request.reliability, open[0]);
        leave(&mut request.durability, open[1]);
        leave(&mut request.deadline, open[2]);
        leave(&mut request.liveliness, open[3]);
        leave(&mut request.lease, open[4]);
        request
    })
}

/// Returns how many endpoints are compatible.
fn matched(others: &[Qos], goes: impl Fn(&Qos) -> bool) -> usize {
    others.iter().filter(|q| goes(q)).count()
}

proptest! {
    #[test]
    fn best_available_profile_matches_every_endpoint(others in prop::collection::vec(qos(), 0..6)) {
        let best = QosRequest::best_available();
        let subscription = best.for_subscription(&others);
        let publisher = best.for_publisher(&others);
        prop_assert_eq!(matched(&others, |q| compatible(q, &subscription).is_ok()), others.len());
        prop_assert_eq!(matched(&others, |q| compatible(&publisher, q).is_ok()), others.len());
    }

    /// If any single policy is raised by one level, at least one endpoint no longer matches.
    #[test]
    fn no_stricter_profile_matches_every_endpoint(others in prop::collection::vec(qos(), 1..6)) {
        let mine = QosRequest::best_available().for_subscription(&others);
        let mut higher = Vec::new();
        if mine.reliability == Reliability::BestEffort {
            higher.push(Qos { reliability: Reliability::Reliable, ..mine });
        }
        if mine.durability == Durability::Volatile {
            higher.push(Qos { durability: Durability::TransientLocal, ..mine });
        }
        if mine.liveliness == Liveliness::Automatic {
            higher.push(Qos { liveliness: Liveliness::ManualByTopic, ..mine });
        }
        let least = Duration::from_nanos(1);
        let shorter = |period: Option<Duration>| Some(period.map_or(3 * least, |p| p - least));
        higher.push(Qos { deadline: shorter(mine.deadline), ..mine });
        higher.push(Qos { lease: shorter(mine.lease), ..mine });
        for raised in higher {
            let left_out = others.iter().any(|q| compatible(q, &raised).is_err());
            prop_assert!(left_out, "{:?} would do as well as {:?}", raised, mine);
        }
    }

    #[test]
    fn an_exact_request_resolves_to_itself(mine in qos(), others in prop::collection::vec(qos(), 0..4)) {
        let request = QosRequest::from(mine);
        prop_assert_eq!(request.for_publisher(&others), mine);
        prop_assert_eq!(request.for_subscription(&others), mine);
        prop_assert_eq!(request.for_service(), mine);
    }

    /// A verdict on open profiles holds for every resolution of them.
    #[test]
    fn a_verdict_holds_for_every_resolution(
        offered in request(),
        requested in request(),
        publishers in prop::collection::vec(qos(), 0..4),
        subscriptions in prop::collection::vec(qos(), 0..4),
    ) {
        let offer = offered.for_publisher(&subscriptions);
        let wish = requested.for_subscription(&publishers);
        let found: Vec<_> = incompatibilities(&offer, &wish).collect();
        match check(&offered, &requested) {
            Compatibility::Compatible => prop_assert_eq!(found, vec![]),
            Compatibility::Unknown(open) => {
                prop_assert!(!open.is_empty());
                prop_assert!(found.iter().all(|policy| open.contains(policy)));
            }
            Compatibility::Incompatible(certain) => {
                prop_assert!(certain.iter().all(|policy| found.contains(policy)));
            }
        }
    }

    /// Profiles without open policies leave nothing unknown.
    #[test]
    fn closed_profiles_are_judged_as_they_are(offered in qos(), requested in qos()) {
        let found: Vec<_> = incompatibilities(&offered, &requested).collect();
        let verdict = check(&offered.into(), &requested.into());
        if found.is_empty() {
            prop_assert_eq!(verdict, Compatibility::Compatible);
        } else {
            prop_assert_eq!(verdict, Compatibility::Incompatible(found));
        }
    }
}

#[test]
fn open_policies_resolve_to_the_default() {
    assert_eq!(QosRequest::default().for_publisher(&[Qos::sensor_data()]), Qos::default());
    assert_eq!(QosRequest::default().for_subscription(&[Qos::sensor_data()]), Qos::default());
    assert_eq!(QosRequest::best_available().for_service(), Qos::default());
}

#[test]
fn a_deadline_that_one_publisher_does_not_offer_is_not_requested() {
    let with = Qos { deadline: SEVEN, ..Qos::default() };
    let best = QosRequest::best_available();
    assert_eq!(best.for_subscription(&[with]).deadline, SEVEN);
    assert_eq!(best.for_subscription(&[with, Qos::default()]).deadline, None);
    assert_eq!(best.for_publisher(&[with, Qos::default()]).deadline, SEVEN);
}
