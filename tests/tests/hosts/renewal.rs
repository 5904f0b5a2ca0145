//! Links that are made anew under a new key while samples flow.

use axon_tests::{Sizes, Tally};

use super::{mode::Kmes, pair::Plan, process::until};

fn renew(key_mode: &str) {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", key_mode), ("AXON_QKD_SESSION_MAX_AGE", "1")];
    let [a, b] = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let (mut renewals, mut since) = (0, b.link().since_unix_ms);
    let before = kmes.keys();
    until("the link is renewed three times", || {
        // Between two links there may be none to be seen.
        let now = b.status().links.first().map_or(since, |link| link.since_unix_ms);
        renewals += u32::from(now != since);
        since = now;
        renewals >= 3
    });
    let after = kmes.keys();
    assert!(after.0 >= before.0 + 3 && after.1 >= before.1 + 3, "{before:?}, {after:?}");
    let now = publisher.published();
    there.wait_taken(now + 100);
    let sent = publisher.stop();
    there.wait_taken(sent);
    assert_eq!(there.tally(), Tally { taken: sent, first: 1, last: sent, ..Tally::default() });
    for node in [publisher, there] {
        node.finish();
    }
}

#[test]
fn in_session_nothing_is_lost() {
    renew("session");
}

#[test]
fn in_messages10_nothing_is_lost() {
    renew("messages10");
}
