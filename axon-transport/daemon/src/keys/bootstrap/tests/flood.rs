use super::{
    acceptor::{identity, new},
    *,
};

#[derive(Clone, Debug)]
enum Step {
    LookUp { source: u8, sae: u8, key: u16 },
    Answer { which: usize, kind: u8 },
    Spend { sae: u8, key: u16 },
    Pass(u16),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        8 => (any::<u8>(), 0u8..4, 0u16..600)
            .prop_map(|(source, sae, key)| Step::LookUp { source, sae, key }),
        3 => (any::<usize>(), 0u8..4).prop_map(|(which, kind)| Step::Answer { which, kind }),
        1 => (0u8..2, 0u16..600).prop_map(|(sae, key)| Step::Spend { sae, key }),
        2 => (0u16..400).prop_map(Step::Pass),
    ];
    proptest::collection::vec(step, 1..400)
}

proptest! {
    /// Calls to the KME stay within their limits for any invented identities from any sources.
    #[test]
    fn calls_stay_within_bounds(steps in steps(), star: bool) {
        let peers = if star { QkdPeers::Any } else { listed(&["sae-0", "sae-1"]) };
        let (acceptor, clock) = new(peers);
        let mut in_flight = Vec::<KmeRequest>::new();
        let mut asked_at = Vec::<(String, Duration)>::new();
        let mut spent = std::collections::HashSet::new();
        for step in steps {
            match step {
                Step::LookUp { source, sae, key } => {
                    let bytes = identity(&format!("sae-{sae}"), &format!("k{key}"));
                    let found = acceptor.prefetch(IpAddr::from([10, 0, 0, source]), &bytes);
                    if spent.contains(&key) && (star || sae < 2) {
                        prop_assert_eq!(found, Lookup::Spent);
                    }
                }
                Step::Answer { which, kind } if !in_flight.is_empty() => {
                    let request = in_flight.swap_remove(which % in_flight.len());
                    let KmeRequest::Dec { key_ids, .. } = &request else { unreachable!() };
                    let name = key_ids[0].to_string();
                    acceptor.handle_answer(match kind {
                        0 => failed(request, FailureKind::Refused),
                        1 => failed(request, FailureKind::Ambiguous),
                        2 => key(request, "another", 1),
                        _ => key(request, &name, 1),
                    });
                }
                Step::Answer { .. } => {}
                Step::Spend { sae, key } => {
                    let bytes = identity(&format!("sae-{sae}"), &format!("k{key}"));
                    let first = spent.insert(key);
                    prop_assert_eq!(acceptor.spent(&bytes) == Completion::First, first);
                }
                Step::Pass(millis) => clock.advance(ms(millis.into())),
            }
            while let Some(request) = acceptor.poll_request() {
                let KmeRequest::Dec { master, key_ids, .. } = &request else { unreachable!() };
                prop_assert!(star || ["sae-0", "sae-1"].contains(&master.as_str()));
                prop_assert_eq!(key_ids.len(), 1);
                asked_at.push((if star { String::new() } else { master.clone() }, clock.now()));
                in_flight.push(request);
            }
            prop_assert!(in_flight.len() <= 8, "no address has authenticated");
        }
        for sae in ["", "sae-0", "sae-1"] {
            let times = asked_at.iter().filter(|(m, _)| m == sae);
            let times: Vec<_> = times.map(|(_, at)| *at).collect();
            for (i, first) in times.iter().enumerate() {
                for (j, last) in times.iter().enumerate().skip(i) {
                    let (calls, passed) = (j - i + 1, *last - *first);
                    let allowed = 10.0 + 5.0 * passed.as_secs_f64() + 1e-6;
                    prop_assert!(calls as f64 <= allowed, "{calls} calls in {passed:?}");
                }
            }
        }
    }
}
