use super::*;

pub(super) fn new(peers: QkdPeers) -> (Acceptor, Clock) {
    let clock = Clock::default();
    (Acceptor::new("sae-b", peers, Cipher::default(), clock.clone()), clock)
}

pub(super) fn identity(sae: &str, key_id: &str) -> Vec<u8> {
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
fn the_kme_is_not_asked_about_unlisted_or_malformed_identities() {
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
    let KmeRequest::Dec { master, key_ids, .. } = &request else { panic!() };
    assert_eq!((master.as_str(), &key_ids[..]), ("sae-a", &[id("k1")][..]));
    acceptor.handle_answer(key(request, "k1", 9));

    let resolver = acceptor.resolver(ip("10.0.0.1"));
    let found = resolver.resolve(&bytes).expect("cached");
    let clients = qkd::derive_psk(&[9; 32], "k1", "sae-a", "sae-b", Cipher::default()).unwrap();
    assert_eq!(found.identity(), clients.identity());
    assert_eq!(resolver.identity().unwrap().client_sae(), "sae-a");
}

/// A client may offer several identities: the daemon asks its KME for none of them if it has one.
#[test]
fn a_look_up_among_several_identities_fetches_nothing() {
    let (acceptor, _) = new(listed(&["sae-a"]));
    let (missing, cached) = (identity("sae-a", "k0"), identity("sae-a", "k1"));
    look_up(&acceptor, "10.0.0.1", &cached);
    acceptor.handle_answer(key(acceptor.poll_request().unwrap(), "k1", 9));

    let resolver = acceptor.resolver(ip("10.0.0.1"));
    assert!(resolver.resolve_known(&missing).is_none());
    assert_eq!(resolver.outcome(), None);
    assert!(acceptor.poll_request().is_none(), "nothing is fetched");
    assert!(resolver.resolve_known(&cached).is_some());
    assert_eq!(resolver.outcome(), Some(Lookup::Found));
    assert_eq!(resolver.identity().unwrap().key_id(), "k1");
    assert_eq!(acceptor.spent(&cached), Completion::First);
    assert!(resolver.resolve_known(&cached).is_none(), "a spent key is not at hand");
}

#[test]
fn only_a_completed_handshake_spends_a_key_and_only_once() {
    let (acceptor, clock) = new(listed(&["sae-a"]));
    let bytes = identity("sae-a", "k1");
    look_up(&acceptor, "10.0.0.1", &bytes);
    acceptor.handle_answer(key(acceptor.poll_request().unwrap(), "k1", 9));
    for _ in 0..1000 {
        // Copied ClientHellos with wrong binders.
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
    acceptor.handle_answer(key(request, "k1", 9));
    assert_eq!(acceptor.cached(), 0);
    assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Spent);
}

#[test]
fn a_key_unknown_twice_is_not_asked_for_again_for_thirty_seconds() {
    let (acceptor, clock) = new(listed(&["sae-a"]));
    let bytes = identity("sae-a", "k1");
    look_up(&acceptor, "10.0.0.1", &bytes);
    acceptor.handle_answer(failed(acceptor.poll_request().unwrap(), FailureKind::Refused));
    assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::UnknownKeyId);
    assert!(acceptor.poll_request().is_none());
    clock.advance(s(1));
    assert_eq!(look_up(&acceptor, "10.0.0.1", &bytes), Lookup::Fetching, "relayed late");
    acceptor.handle_answer(failed(acceptor.poll_request().unwrap(), FailureKind::Refused));
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
    acceptor.handle_answer(failed(acceptor.poll_request().unwrap(), FailureKind::Unreachable));
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
        acceptor.handle_answer(key(acceptor.poll_request().unwrap(), &name(i), 9));
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
fn one_address_has_two_calls_in_flight_for_an_sae() {
    let (acceptor, _) = new(listed(&["sae-a", "sae-c"]));
    let look_up = |source, sae, key_id| look_up(&acceptor, source, &identity(sae, key_id));
    assert_eq!(look_up("10.0.0.1", "sae-a", "k1"), Lookup::Fetching);
    assert_eq!(look_up("10.0.0.1", "sae-a", "k2"), Lookup::Fetching);
    assert!(matches!(look_up("10.0.0.1", "sae-a", "k3"), Lookup::Limited(_)));
    assert_eq!(look_up("10.0.0.2", "sae-a", "k3"), Lookup::Fetching);
    assert_eq!(look_up("10.0.0.1", "sae-c", "k3"), Lookup::Fetching);
    acceptor.handle_answer(key(acceptor.poll_request().unwrap(), "k1", 9));
    assert_eq!(look_up("10.0.0.1", "sae-a", "k4"), Lookup::Fetching);
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

#[test]
fn strangers_do_not_empty_the_bucket_of_an_address_that_authenticated() {
    let (acceptor, _) = new(listed(&["sae-a"]));
    acceptor.authenticated(ip("10.9.9.9"), "sae-a");
    for i in 0..100 {
        acceptor.prefetch(ip("10.0.0.1"), &identity("sae-a", &format!("made-up-{i}")));
        while let Some(request) = acceptor.poll_request() {
            acceptor.handle_answer(failed(request, FailureKind::Refused));
        }
    }
    let stranger = look_up(&acceptor, "10.0.0.2", &identity("sae-a", "k"));
    assert!(matches!(stranger, Lookup::Limited(_)));
    assert_eq!(look_up(&acceptor, "10.9.9.9", &identity("sae-a", "k")), Lookup::Fetching);
}

/// Handshakes in flight keep the PSK that they looked up, so a release by the acceptor alone would erase nothing.
#[test]
fn an_expired_displaced_or_spent_psk_is_erased_in_handshakes_under_way() {
    type End = fn(&Acceptor, &Clock);
    let ends: [(&str, End); 3] = [
        ("expired", |acceptor, clock| {
            clock.advance(s(60));
            acceptor.expire();
        }),
        ("displaced", |acceptor, clock| {
            for number in 0..8 {
                clock.advance(s(1));
                let name = format!("later-{number}");
                look_up(acceptor, "10.0.0.1", &identity("sae-a", &name));
                acceptor.handle_answer(key(acceptor.poll_request().unwrap(), &name, 1));
            }
        }),
        ("spent", |acceptor, _| {
            assert_eq!(acceptor.spent(&identity("sae-a", "k1")), Completion::First);
        }),
    ];
    for (name, end) in ends {
        let (acceptor, clock) = new(listed(&["sae-a"]));
        let bytes = identity("sae-a", "k1");
        look_up(&acceptor, "10.0.0.1", &bytes);
        acceptor.handle_answer(key(acceptor.poll_request().unwrap(), "k1", 9));
        let psk = acceptor.resolver(ip("10.0.0.1")).resolve(&bytes).unwrap();
        assert!(!psk.is_erased(), "{name}");
        end(&acceptor, &clock);
        assert!(psk.is_erased(), "{name}");
    }
}
