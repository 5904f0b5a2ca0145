use std::collections::{HashMap, HashSet};

use axon_envelope::Delivery;
use proptest::prelude::*;

use super::{Pair, ms};
use crate::keys::{KeyMessage, request::FailureKind};

#[derive(Clone, Debug)]
enum Step {
    Seal { reliable: bool, arrives: bool },
    Pass(u32),
    Run,
    Fail(u8),
    Connect,
    Lose,
    Dry(Option<u32>),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        20 => (any::<bool>(), any::<bool>())
            .prop_map(|(reliable, arrives)| Step::Seal { reliable, arrives }),
        2 => (0u32..5_000).prop_map(Step::Pass),
        1 => (0u32..4_000_000).prop_map(Step::Pass),
        6 => Just(Step::Run),
        2 => any::<u8>().prop_map(Step::Fail),
        1 => Just(Step::Connect),
        1 => Just(Step::Lose),
        1 => proptest::option::of(0u32..20).prop_map(Step::Dry),
    ];
    proptest::collection::vec(step, 1..300)
}

proptest! {
    /// No key seals an eleventh message. A key seals only on the connection on which it is READY, and on no two
    /// connections. Each sealed message opens.
    #[test]
    fn keys_are_used_as_they_should(steps in steps()) {
        let mut pair = Pair::new();
        let mut used: HashMap<String, (u64, u32)> = HashMap::new();
        let mut seen_indexes = HashSet::new();
        for step in steps {
            match step {
                Step::Seal { reliable, arrives } => {
                    let delivery = match reliable {
                        true => Delivery::Reliable,
                        false => Delivery::BestEffort,
                    };
                    pair.sender.demand(pair.now, 1);
                    let Ok(envelope) = pair.seal(delivery) else { continue };
                    let (header, _) = axon_envelope::Header::parse(&envelope).unwrap();
                    let name = String::from_utf8(header.key_id.to_vec()).unwrap();
                    let new = seen_indexes.insert((name.clone(), header.index));
                    prop_assert!(new, "an index twice");
                    let (conn, messages) = used.entry(name.clone()).or_insert((pair.conn, 0));
                    *messages += 1;
                    prop_assert!(*messages <= 10, "an eleventh message");
                    prop_assert_eq!(*conn, pair.conn, "one key on two connections");
                    let ready = pair.log.iter().any(|m| match m {
                        KeyMessage::Ready { key_id, .. } => key_id.as_bytes() == name.as_bytes(),
                        _ => false,
                    });
                    prop_assert!(ready, "not READY");
                    if arrives || reliable {
                        pair.open(envelope).unwrap();
                    }
                }
                Step::Pass(millis) => pair.now += ms(millis.into()),
                Step::Run => pair.run(),
                Step::Fail(n) => {
                    use FailureKind::{Ambiguous, Busy, Refused, Unavailable};
                    let kind = [Ambiguous, Unavailable, Refused, Busy][n as usize % 4];
                    pair.kmes.failures = vec![kind; n as usize / 32];
                }
                Step::Connect => {
                    pair.connect();
                    pair.run();
                    pair.close(pair.conn - 1);
                }
                Step::Lose => {
                    pair.close(pair.conn);
                    pair.connect();
                }
                Step::Dry(left) => pair.kmes.left = left,
            }
            pair.receiver.handle_timeout(pair.now);
            let s = pair.sender.statistics(pair.now);
            prop_assert!(s.ready + s.announced + s.asked <= 4096);
        }
    }
}
