//! A random program of publishers and subscriptions that come and go, checked against ROS 2's
//! rules.

use std::collections::BTreeMap;

use axon_transport::{
    EndpointSpec, Publisher, Subscription,
    events::{EventKind, EventStatus},
    ids::Gid,
};
use proptest::prelude::*;

use super::{
    alone, counted, of_publisher, of_subscription,
    rules::{Profile, same_type},
    support::until,
};

#[derive(Clone, Debug)]
enum Step {
    Publisher(Typed),
    Subscription(Typed),
    /// Ends the endpoint at this index, modulo their number.
    End(u8),
}

#[derive(Clone, Debug)]
struct Typed {
    profile: Profile,
    type_name: &'static str,
    hash: Vec<u8>,
}

fn typed() -> impl Strategy<Value = Typed> {
    let period = || prop_oneof![Just(None), Just(Some(3600)), Just(Some(7200))];
    (any::<[bool; 3]>(), period(), period(), 0..3u8, 0..3u8).prop_map(
        |([reliable, transient_local, manual], deadline, lease, type_name, hash)| Typed {
            profile: Profile {
                reliable,
                transient_local,
                manual,
                deadline,
                lease,
                ..Profile::default()
            },
            type_name: ["T", "T", "U"][usize::from(type_name)],
            // An endpoint may not know the hash.
            hash: vec![hash; usize::from(hash)],
        },
    )
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        typed().prop_map(Step::Publisher),
        typed().prop_map(Step::Subscription),
        any::<u8>().prop_map(Step::End),
    ]
}

enum Ends {
    Publisher(Publisher),
    Subscription(Subscription),
}

struct Living {
    ends: Ends,
    typed: Typed,
}

/// The relation of two endpoints.
enum Relation {
    None,
    Match,
    Qos,
    Type,
}

/// What an endpoint must report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Expected {
    matched: Vec<Gid>,
    ever: u64,
    qos: u64,
    types: u64,
}

impl Living {
    fn gid(&self) -> Gid {
        match &self.ends {
            Ends::Publisher(publisher) => publisher.gid(),
            Ends::Subscription(subscription) => subscription.gid(),
        }
    }

    fn relation(&self, other: &Self) -> Relation {
        let (offers, wants) = match (&self.ends, &other.ends) {
            (Ends::Publisher(_), Ends::Subscription(_)) => (&self.typed, &other.typed),
            (Ends::Subscription(_), Ends::Publisher(_)) => (&other.typed, &self.typed),
            _ => return Relation::None,
        };
        if !same_type((offers.type_name, &offers.hash), (wants.type_name, &wants.hash)) {
            Relation::Type
        } else if offers.profile.falls_short_of(&wants.profile).is_empty() {
            Relation::Match
        } else {
            Relation::Qos
        }
    }

    /// Returns what the endpoint reports; `None` if it changes meanwhile.
    fn reported(&self) -> Option<Expected> {
        let (mut matched, events) = match &self.ends {
            Ends::Publisher(p) => (
                p.matched(),
                [
                    EventKind::PublicationMatched,
                    EventKind::OfferedQosIncompatible,
                    EventKind::PublisherIncompatibleType,
                ]
                .map(|kind| of_publisher(p, kind)),
            ),
            Ends::Subscription(s) => (
                s.matched(),
                [
                    EventKind::SubscriptionMatched,
                    EventKind::RequestedQosIncompatible,
                    EventKind::SubscriptionIncompatibleType,
                ]
                .map(|kind| of_subscription(s, kind)),
            ),
        };
        matched.sort();
        let [all, qos, types] = events;
        let all = super::matched(&all);
        let EventStatus::IncompatibleQos(qos) = qos.take() else { panic!() };
        let (ever, qos, types) = (all.total, qos.count.total, counted(&types).total);
        (all.current == matched.len() as u64).then_some(Expected { matched, ever, qos, types })
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn event_statuses_match_the_model(
        steps in prop::collection::vec(step(), 1..24),
    ) {
        let session = alone();
        let mut living: Vec<Living> = Vec::new();
        let mut model: BTreeMap<Gid, Expected> = BTreeMap::new();
        for step in steps {
            let spec = |typed: &Typed| EndpointSpec::new("/t", typed.type_name, typed.profile.qos()).type_hash(typed.hash.clone());
            let new = match &step {
                Step::Publisher(typed) => Living {
                    ends: Ends::Publisher(session.create_publisher(spec(typed)).unwrap()),
                    typed: typed.clone(),
                },
                Step::Subscription(typed) => Living {
                    ends: Ends::Subscription(session.create_subscription(spec(typed)).unwrap()),
                    typed: typed.clone(),
                },
                Step::End(_) if living.is_empty() => continue,
                Step::End(which) => {
                    let ended = living.swap_remove(usize::from(*which) % living.len()).gid();
                    model.remove(&ended);
                    model.values_mut().for_each(|e| e.matched.retain(|gid| *gid != ended));
                    until("the statuses are as they must be", || {
                        living.iter().all(|l| l.reported().as_ref() == model.get(&l.gid()))
                    });
                    continue;
                }
            };
            let mut expected = Expected::default();
            for other in &living {
                let theirs = model.get_mut(&other.gid()).unwrap();
                for (side, gid) in [(&mut expected, other.gid()), (theirs, new.gid())] {
                    match new.relation(other) {
                        Relation::Match => {
                            side.matched.push(gid);
                            side.matched.sort();
                            side.ever += 1;
                        }
                        Relation::Qos => side.qos += 1,
                        Relation::Type => side.types += 1,
                        Relation::None => {}
                    }
                }
            }
            model.insert(new.gid(), expected);
            living.push(new);
            until("the statuses are as they must be", || {
                living.iter().all(|l| l.reported().as_ref() == model.get(&l.gid()))
            });
        }
    }
}
