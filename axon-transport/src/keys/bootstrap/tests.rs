use std::{net::IpAddr, sync::Arc, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_tls::{
    Cipher,
    qkd::{self, PskIdentity, PskResolver},
};
use proptest::prelude::*;

use super::{Acceptor, Completion, Dial, DialRefusal, Dialler, Lookup};
use crate::{
    config::QkdPeers,
    keys::{
        Clock,
        request::{Answer, Failure, FailureKind, Fetched, Request},
    },
};

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn s(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

fn ip(text: &str) -> IpAddr {
    text.parse().unwrap()
}

fn listed(saes: &[&str]) -> QkdPeers {
    QkdPeers::Listed(saes.iter().map(|s| s.to_string()).collect())
}

fn failed(request: Request, kind: FailureKind) -> Answer {
    let outcome = Err(Failure { kind, text: "as the test says".to_owned() });
    Answer { request, took: ms(5), outcome }
}

fn key(request: Request, name: &str, byte: u8) -> Answer {
    let keys = vec![(id(name), KmeKey::from_slice(&[byte; 32]).unwrap())];
    Answer { request, took: ms(5), outcome: Ok(Fetched::Keys(keys)) }
}

mod dialler {
    use super::*;

    fn new() -> Dialler {
        Dialler::new("sae-a", listed(&["sae-b", "sae-c"]), Cipher::default())
    }

    /// A dialler that holds key `name` for sae-b since `now`.
    fn holding(now: Duration, name: &str) -> Dialler {
        let mut dialler = new();
        give(&mut dialler, now, name);
        dialler
    }

    fn give(dialler: &mut Dialler, now: Duration, name: &str) {
        assert!(matches!(dialler.dial(now, "sae-b"), Dial::Wait { until: None, .. }));
        let request = dialler.poll_request(now).expect("asks for a key");
        dialler.on_answer(now, key(request, name, 1));
    }

    fn attempt(dialler: &mut Dialler, now: Duration) -> Option<KeyId> {
        match dialler.dial(now, "sae-b") {
            Dial::Attempt(attempt) => Some(attempt.key_id),
            _ => None,
        }
    }

    #[test]
    fn no_kme_call_for_who_is_no_peer() {
        let mut dialler = new();
        for sae in ["sae-a", "sae-x", "", "SAE-B", "sae-b ", "*"] {
            assert!(matches!(dialler.dial(s(1), sae), Dial::Refused(_)), "{sae}");
        }
        assert!(dialler.poll_request(s(1)).is_none());
        // Not even under `*`.
        let mut dialler = Dialler::new("sae-a", QkdPeers::Any, Cipher::default());
        let dial = dialler.dial(s(1), "sae-a");
        assert!(matches!(dial, Dial::Refused(DialRefusal::OwnSaeId(_))));
        assert!(dialler.poll_request(s(1)).is_none());
    }

    #[test]
    fn one_key_serves_every_address_and_attempt_until_it_is_spent() {
        let mut dialler = holding(s(0), "k1");
        for t in 0..100 {
            assert_eq!(attempt(&mut dialler, s(t)), Some(id("k1")));
            assert!(dialler.poll_request(s(t)).is_none());
            dialler.silent(s(t), "sae-b", &id("k1"));
        }
        assert_eq!(dialler.succeeded(s(100), "sae-b", &id("other")), Completion::Reused);
        assert_eq!(dialler.succeeded(s(100), "sae-b", &id("k1")), Completion::First);
        assert_eq!(dialler.succeeded(s(100), "sae-b", &id("k1")), Completion::Reused);
        assert_eq!(attempt(&mut dialler, s(100)), None, "spent");
        assert!(dialler.poll_request(s(100)).is_some(), "the next dial has a key of its own");
    }

    #[test]
    fn a_key_is_tried_again_with_growing_pauses_and_given_up_after_ten_seconds() {
        let mut dialler = holding(s(0), "k1");
        let (mut now, mut pauses) = (s(0), Vec::new());
        while attempt(&mut dialler, now).is_some() {
            dialler.refused(now, "sae-b", &id("k1"));
            match dialler.dial(now, "sae-b") {
                Dial::Wait { until: Some(until), .. } => {
                    pauses.push((until - now).as_millis());
                    assert!(attempt(&mut dialler, until - ms(1)).is_none());
                    now = until;
                    if pauses.last() == Some(&1000) {
                        break;
                    }
                }
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(pauses[..8], [50, 100, 200, 400, 800, 1600, 1600, 1600]);
        assert_eq!(pauses.pop(), Some(1000), "given up: back-off before the KME is asked again");
        let tried: u128 = pauses.iter().sum();
        assert!((10_000..=11_600).contains(&tried), "{tried}");
        assert!(matches!(dialler.dial(now, "sae-b"), Dial::Wait { until: None, .. }));
        assert!(dialler.poll_request(now).is_some());
    }

    #[test]
    fn silence_does_not_count_against_a_key() {
        let mut dialler = holding(s(0), "k1");
        let mut now = s(0);
        for _ in 0..100 {
            dialler.refused(now, "sae-b", &id("k1"));
            now += s(2);
            dialler.silent(now, "sae-b", &id("k1"));
            now += s(2);
        }
        assert_eq!(attempt(&mut dialler, now), Some(id("k1")));
    }

    #[test]
    fn a_key_ends_after_ten_minutes() {
        let mut dialler = holding(s(7), "k1");
        assert_eq!(dialler.poll_timeout(), Some(s(607)));
        assert!(attempt(&mut dialler, s(606)).is_some());
        assert!(attempt(&mut dialler, s(607)).is_none());
        assert_eq!(dialler.succeeded(s(607), "sae-b", &id("k1")), Completion::Reused);
    }

    #[test]
    fn failed_calls_are_spaced_out_up_to_a_minute() {
        let mut dialler = new();
        let (mut now, mut pauses) = (s(0), Vec::new());
        for _ in 0..9 {
            assert!(matches!(dialler.dial(now, "sae-b"), Dial::Wait { until: None, .. }));
            let request = dialler.poll_request(now).unwrap();
            assert!(dialler.poll_request(now).is_none(), "never two calls for one peer");
            dialler.on_answer(now, failed(request, FailureKind::Ambiguous));
            let Dial::Wait { until: Some(until), why } = dialler.dial(now, "sae-b") else {
                panic!()
            };
            assert!(why.contains("as the test says"), "{why}");
            pauses.push((until - now).as_secs());
            now = until;
        }
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
        give(&mut dialler, now, "k1");
        assert_eq!(dialler.succeeded(now, "sae-b", &id("k1")), Completion::First);
        give(&mut dialler, now, "k2");
    }

    #[test]
    fn made_up_names_under_a_star_are_bounded() {
        let mut dialler = Dialler::new("sae-a", QkdPeers::Any, Cipher::default());
        let mut asked = 0;
        for i in 0..2000 {
            dialler.dial(s(0), &format!("made-up-{i}"));
            asked += usize::from(dialler.poll_request(s(0)).is_some());
        }
        assert_eq!(asked, 8, "in flight");
        let dial = dialler.dial(s(0), "one-more");
        assert!(matches!(dial, Dial::Refused(DialRefusal::TooMany)));
    }

    #[test]
    fn answers_nobody_waits_for_are_dropped() {
        let mut dialler = holding(s(0), "k1");
        let request = Request::Status { slave: "sae-b".to_owned() };
        dialler.on_answer(s(1), failed(request, FailureKind::Refused));
        let mut other = new();
        other.dial(s(1), "sae-b");
        let request = other.poll_request(s(1)).unwrap();
        dialler.on_answer(s(1), key(request, "k2", 2));
        assert_eq!(attempt(&mut dialler, s(1)), Some(id("k1")));
    }
}

mod acceptor {
    use super::*;

    fn new(peers: QkdPeers) -> (Acceptor, Clock) {
        let clock = Clock::manual();
        (Acceptor::new("sae-b", peers, Cipher::default(), clock.clone()), clock)
    }

    fn identity(sae: &str, key_id: &str) -> Vec<u8> {
        PskIdentity::new(sae, key_id).unwrap().to_bytes()
    }

    fn look_up(acceptor: &Acceptor, source: &str, identity: &[u8]) -> Lookup {
        let resolver = acceptor.resolver(ip(source));
        let psk = resolver.resolve(identity);
        let outcome = resolver.outcome().expect("was asked");
        assert_eq!(psk.is_some(), outcome == Lookup::Found);
        outcome
    }

    #[test]
    fn the_kme_is_not_asked_for_who_is_no_peer() {
        let (acceptor, _) = new(listed(&["sae-a"]));
        for (bytes, expected) in [
            (identity("sae-x", "k"), Lookup::NotAPeer),
            (identity("sae-b", "k"), Lookup::OwnSaeId),
            (b"axon-qkd-v1:sae-%61:k".to_vec(), Lookup::Malformed),
            (b"".to_vec(), Lookup::Malformed),
            (vec![0xff; 200], Lookup::Malformed),
        ] {
            assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), expected);
        }
        assert!(acceptor.poll_request().is_none());
    }

    #[test]
    fn a_miss_asks_once_and_the_next_look_up_finds_the_clients_psk() {
        let (acceptor, _) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Fetching);
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Fetching);
        let request = acceptor.poll_request().unwrap();
        assert!(acceptor.poll_request().is_none(), "one call for one key");
        let Request::Dec { master, key_ids, .. } = &request else { panic!() };
        assert_eq!((master.as_str(), &key_ids[..]), ("sae-a", &[id("k1")][..]));
        acceptor.on_answer(key(request, "k1", 9));

        let resolver = acceptor.resolver(ip("10.0.0.1"));
        let found = resolver.resolve(&bytes).expect("cached");
        let clients = qkd::derive_psk(&[9; 32], "k1", "sae-a", "sae-b", Cipher::default()).unwrap();
        assert_eq!(found.identity(), clients.identity());
        assert_eq!(resolver.identity().unwrap().client_sae(), "sae-a");
    }

    #[test]
    fn only_a_completed_handshake_spends_a_key_and_only_once() {
        let (acceptor, clock) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        look_up(&acceptor, "10.0.0.1", &bytes);
        acceptor.on_answer(key(acceptor.poll_request().unwrap(), "k1", 9));
        for _ in 0..1000 {
            // Copied ClientHellos, wrong binders.
            assert_eq!(look_up(&acceptor, "10.0.0.66", &bytes), Lookup::Found);
        }
        assert_eq!(acceptor.spent(&bytes), Completion::First);
        assert_eq!(acceptor.spent(&bytes), Completion::Reused);
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Spent);
        clock.advance(s(3600));
        acceptor.expire();
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Spent);
        assert_eq!(acceptor.spent(b"not an identity"), Completion::Reused);
        assert!(acceptor.poll_request().is_none());
    }

    #[test]
    fn a_key_that_arrives_after_it_was_spent_is_not_kept() {
        let (acceptor, _) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        look_up(&acceptor, "10.0.0.1", &bytes);
        let request = acceptor.poll_request().unwrap();
        assert_eq!(acceptor.spent(&bytes), Completion::First);
        acceptor.on_answer(key(request, "k1", 9));
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Spent);
    }

    #[test]
    fn unknown_keys_are_not_asked_for_again_for_thirty_seconds() {
        let (acceptor, clock) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        look_up(&acceptor, "10.0.0.1", &bytes);
        acceptor.on_answer(failed(acceptor.poll_request().unwrap(), FailureKind::Refused));
        clock.advance(s(29));
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::UnknownKeyId);
        assert!(acceptor.poll_request().is_none());
        clock.advance(s(2));
        assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Fetching);
    }

    #[test]
    fn a_kme_that_is_down_is_named_and_asked_again() {
        let (acceptor, _) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        look_up(&acceptor, "10.0.0.1", &bytes);
        acceptor.on_answer(failed(acceptor.poll_request().unwrap(), FailureKind::Unreachable));
        let again = look_up(&acceptor, "10.0.0.1", &bytes);
        assert_eq!(again, Lookup::KmeFailed("as the test says".to_owned()));
        assert!(acceptor.poll_request().is_some());
    }

    #[test]
    fn unspent_keys_are_kept_a_minute_and_eight_for_each_sae() {
        let (acceptor, clock) = new(listed(&["sae-a"]));
        let name = |i: u32| format!("k{i}");
        for i in 0..9 {
            look_up(&acceptor, "10.0.0.1", &identity("sae-a", &name(i)));
            acceptor.on_answer(key(acceptor.poll_request().unwrap(), &name(i), 9));
            clock.advance(s(1));
        }
        for i in 1..9 {
            let found = look_up(&acceptor, "10.0.0.1", &identity("sae-a", &name(i)));
            assert_eq!(found, Lookup::Found, "{i}");
        }
        assert_ne!(look_up(&acceptor, "10.0.0.1", &identity("sae-a", "k0")), Lookup::Found);
        clock.advance(s(60));
        assert_ne!(look_up(&acceptor, "10.0.0.1", &identity("sae-a", "k8")), Lookup::Found);
    }

    #[test]
    fn an_address_that_authenticated_before_gets_through_a_flood() {
        let (acceptor, _) = new(listed(&["sae-a", "sae-c"]));
        acceptor.authenticated(ip("10.9.9.9"), "sae-c");
        for i in 0..2000 {
            let source = format!("10.{}.{}.1", i / 250, i % 250);
            acceptor.prefetch(ip(&source), &identity("sae-a", &format!("made-up-{i}")));
            acceptor.prefetch(ip(&source), &identity("sae-c", &format!("made-up-{i}")));
        }
        let stranger = look_up(&acceptor, "10.8.8.8", &identity("sae-a", "k"));
        assert!(matches!(stranger, Lookup::Limited(_)));
        assert_eq!(look_up(&acceptor, "10.9.9.9", &identity("sae-c", "k")), Lookup::Fetching);
    }

    #[tokio::test]
    async fn a_waiting_caller_is_woken_by_a_look_up() {
        let (acceptor, _) = new(listed(&["sae-a"]));
        let other = acceptor.clone();
        let waiting = tokio::spawn(async move { other.next_request().await });
        tokio::task::yield_now().await;
        let resolver = acceptor.resolver(ip("10.0.0.1"));
        std::thread::spawn(move || Arc::clone(&resolver).resolve(&identity("sae-a", "k1")))
            .join()
            .map(|psk| assert!(psk.is_none()))
            .unwrap();
        assert!(matches!(waiting.await.unwrap(), Request::Dec { .. }));
    }

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
        /// Whatever made-up identities come from wherever, calls to the KME stay within bounds.
        #[test]
        fn calls_stay_within_bounds(steps in steps(), star: bool) {
            let peers = if star { QkdPeers::Any } else { listed(&["sae-0", "sae-1"]) };
            let (acceptor, clock) = new(peers);
            let (mut in_flight, mut asked_at) = (Vec::<Request>::new(), Vec::<(String, Duration)>::new());
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
                        let Request::Dec { key_ids, .. } = &request else { unreachable!() };
                        let name = key_ids[0].to_string();
                        acceptor.on_answer(match kind {
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
                    let Request::Dec { master, key_ids, .. } = &request else { unreachable!() };
                    prop_assert!(star || ["sae-0", "sae-1"].contains(&master.as_str()));
                    prop_assert_eq!(key_ids.len(), 1);
                    asked_at.push((if star { String::new() } else { master.clone() }, clock.now()));
                    in_flight.push(request);
                }
                prop_assert!(in_flight.len() <= 8, "none of these addresses authenticated");
            }
            for sae in ["", "sae-0", "sae-1"] {
                let times: Vec<_> = asked_at.iter().filter(|(m, _)| m == sae).map(|(_, t)| *t).collect();
                for (i, first) in times.iter().enumerate() {
                    for (j, last) in times.iter().enumerate().skip(i) {
                        let allowed = 10.0 + 5.0 * (*last - *first).as_secs_f64() + 1e-6;
                        prop_assert!((j - i + 1) as f64 <= allowed, "{} calls in {:?}", j - i + 1, *last - *first);
                    }
                }
            }
        }
    }
}
