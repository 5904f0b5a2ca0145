use super::*;

fn new() -> BootstrapDialler {
    BootstrapDialler::new("sae-a", listed(&["sae-b", "sae-c"]), Cipher::default(), s(3))
}

/// Returns a dialler that holds key `name` for sae-b since `now`.
fn holding(now: Duration, name: &str) -> BootstrapDialler {
    let mut dialler = new();
    give(&mut dialler, now, name);
    dialler
}

fn give(dialler: &mut BootstrapDialler, now: Duration, name: &str) {
    assert!(matches!(dialler.dial(now, "sae-b"), DialDecision::Wait { until: None, .. }));
    let request = dialler.poll_request(now).expect("asks for a key");
    dialler.handle_answer(now, key(request, name, 1));
}

fn attempt(dialler: &mut BootstrapDialler, now: Duration) -> Option<KeyId> {
    match dialler.dial(now, "sae-b") {
        DialDecision::Attempt(attempt) => Some(attempt.key_id),
        _ => None,
    }
}

#[test]
fn no_kme_call_is_made_for_an_unlisted_sae() {
    let mut dialler = new();
    for sae in ["sae-a", "sae-x", "", "SAE-B", "sae-b ", "*"] {
        assert!(matches!(dialler.dial(s(1), sae), DialDecision::Refused(_)), "{sae}");
    }
    assert!(dialler.poll_request(s(1)).is_none());
    // The own SAE ID is refused even with `*`.
    let mut dialler = BootstrapDialler::new("sae-a", QkdPeers::Any, Cipher::default(), s(3));
    let dial = dialler.dial(s(1), "sae-a");
    assert!(matches!(dial, DialDecision::Refused(DialRefusal::OwnSaeId(_))));
    assert!(dialler.poll_request(s(1)).is_none());
}

#[test]
fn one_key_serves_every_address_and_attempt_until_it_is_spent() {
    let mut dialler = holding(s(0), "k1");
    for t in 0..100 {
        assert_eq!(attempt(&mut dialler, s(t)), Some(id("k1")));
        assert!(dialler.poll_request(s(t)).is_none());
        dialler.handle_silence(s(t), "sae-b", &id("k1"));
    }
    assert_eq!(dialler.handle_success(s(100), "sae-b", &id("other")), Completion::Reused);
    assert_eq!(dialler.handle_success(s(100), "sae-b", &id("k1")), Completion::First);
    assert_eq!(dialler.handle_success(s(100), "sae-b", &id("k1")), Completion::Reused);
    assert_eq!(attempt(&mut dialler, s(100)), None, "spent");
    assert!(dialler.poll_request(s(100)).is_some(), "the next dial has a key of its own");
}

#[test]
fn a_key_is_tried_again_with_growing_pauses_and_given_up_after_ten_seconds() {
    let mut dialler = holding(s(0), "k1");
    let (mut now, mut pauses) = (s(0), Vec::new());
    while attempt(&mut dialler, now).is_some() {
        dialler.handle_refusal(now, "sae-b", &id("k1"));
        match dialler.dial(now, "sae-b") {
            DialDecision::Wait { until: Some(until), .. } => {
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
    assert!(matches!(dialler.dial(now, "sae-b"), DialDecision::Wait { until: None, .. }));
    assert!(dialler.poll_request(now).is_some());
}

#[test]
fn mismatched_key_is_given_up_at_the_fourth_report() {
    let mut dialler = holding(s(0), "k1");
    let mut now = s(0);
    for said in 1..=4 {
        assert_eq!(attempt(&mut dialler, now), Some(id("k1")), "{said}");
        assert!(!dialler.handle_mismatch(now, "sae-b", &id("k0")), "not the key in question");
        assert_eq!(dialler.handle_mismatch(now, "sae-b", &id("k1")), said == 4);
        now += s(2);
    }
    assert!(!dialler.handle_mismatch(now, "sae-b", &id("k1")), "it is gone");
    give(&mut dialler, now, "k2");
    assert_eq!(attempt(&mut dialler, now), Some(id("k2")));
}

#[test]
fn kmes_that_disagree_about_every_key_are_asked_ever_more_seldom() {
    let (mut dialler, mut asked) = (new(), 0);
    for tenth in 0..6_000 {
        let now = ms(100 * tenth);
        if let Some(key_id) = attempt(&mut dialler, now) {
            dialler.handle_mismatch(now, "sae-b", &key_id);
        }
        if let Some(request) = dialler.poll_request(now) {
            asked += 1;
            dialler.handle_answer(now, key(request, &format!("k{asked}"), 1));
        }
    }
    // Calls that are 1, 2, 4 … 60 s apart.
    assert!((10..=16).contains(&asked), "{asked} in ten minutes");
}

#[test]
fn silence_does_not_count_against_a_key() {
    let mut dialler = holding(s(0), "k1");
    let mut now = s(0);
    for _ in 0..100 {
        dialler.handle_refusal(now, "sae-b", &id("k1"));
        now += s(2);
        dialler.handle_silence(now, "sae-b", &id("k1"));
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
    assert_eq!(dialler.handle_success(s(607), "sae-b", &id("k1")), Completion::Reused);
}

#[test]
fn failed_calls_are_spaced_out_up_to_a_minute() {
    let mut dialler = new();
    let (mut now, mut pauses) = (s(0), Vec::new());
    for _ in 0..9 {
        assert!(matches!(dialler.dial(now, "sae-b"), DialDecision::Wait { until: None, .. }));
        let request = dialler.poll_request(now).unwrap();
        assert!(dialler.poll_request(now).is_none(), "never two calls for one peer");
        dialler.handle_answer(now, failed(request, FailureKind::Ambiguous));
        let DialDecision::Wait { until: Some(until), why } = dialler.dial(now, "sae-b") else {
            panic!()
        };
        assert!(why.contains("as the test says"), "{why}");
        pauses.push((until - now).as_secs());
        now = until;
    }
    assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
    give(&mut dialler, now, "k1");
    assert_eq!(dialler.handle_success(now, "sae-b", &id("k1")), Completion::First);
    give(&mut dialler, now, "k2");
}

#[test]
fn made_up_names_under_a_star_are_bounded() {
    let mut dialler = BootstrapDialler::new("sae-a", QkdPeers::Any, Cipher::default(), s(3));
    let mut asked = 0;
    for i in 0..2000 {
        dialler.dial(s(0), &format!("made-up-{i}"));
        asked += usize::from(dialler.poll_request(s(0)).is_some());
    }
    assert_eq!(asked, 8, "in flight");
    let dial = dialler.dial(s(0), "one-more");
    assert!(matches!(dial, DialDecision::Refused(DialRefusal::TooMany)));
}

#[test]
fn unexpected_kme_answers_are_dropped() {
    let mut dialler = holding(s(0), "k1");
    let request = KmeRequest::Status { slave: "sae-b".to_owned() };
    dialler.handle_answer(s(1), failed(request, FailureKind::Refused));
    let mut other = new();
    other.dial(s(1), "sae-b");
    let request = other.poll_request(s(1)).unwrap();
    dialler.handle_answer(s(1), key(request, "k2", 2));
    assert_eq!(attempt(&mut dialler, s(1)), Some(id("k1")));
}

/// Attempts and their connections keep the PSK, so a release by the dialler alone would erase nothing.
#[test]
fn an_expired_refused_mismatched_or_spent_psk_is_erased_in_attempts_under_way() {
    let psk = |dialler: &mut BootstrapDialler| match dialler.dial(s(0), "sae-b") {
        DialDecision::Attempt(attempt) => attempt.psk,
        other => panic!("{other:?}"),
    };
    type End = fn(&mut BootstrapDialler);
    let ends: [(&str, End); 5] = [
        ("expired", |dialler| {
            dialler.dial(s(600), "sae-c");
        }),
        ("refused", |dialler| {
            (0..20).for_each(|at| dialler.handle_refusal(s(at), "sae-b", &id("k1")));
        }),
        ("mismatched", |dialler| {
            for _ in 0..4 {
                dialler.handle_mismatch(s(0), "sae-b", &id("k1"));
            }
        }),
        ("spent", |dialler| {
            assert_eq!(dialler.handle_success(s(0), "sae-b", &id("k1")), Completion::First);
        }),
        ("dialler dropped", |dialler| *dialler = new()),
    ];
    for (name, end) in ends {
        let mut dialler = holding(s(0), "k1");
        let psk = psk(&mut dialler);
        assert!(!psk.is_erased(), "{name}");
        end(&mut dialler);
        assert!(psk.is_erased(), "{name}");
    }
}
