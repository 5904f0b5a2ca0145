//! What a decision of access rules costs, with 0, 10 and 1,000 rules: for one name, for a pair of endpoints on two hosts
//! (the peer's endpoint is permitted, and its view has the other one), and to compile the rules for a peer.
//!
//! Limits are found once for each route; a sample asks for none of this
//! (`rules_are_looked_at_for_endpoints_and_never_for_a_sample`).
//!
//! Rules name topics of three kinds: plain ones, ones below `/**`, and ones with a `*` in a segment. Budget: 2
//! microseconds a pair with 1,000 rules. Patterns with a `*` in the same segment are found by the text around their stars:
//! what 1,000 such rules cost is measured besides.

use std::hint::black_box;

use axon_transport::{
    access::{AccessRules, Principal, Verb},
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    internal::graph::{permits, shows},
};
use criterion::{Criterion, criterion_group, criterion_main};

/// So many rules, the tenth of which has stars.
fn rules(count: usize) -> AccessRules {
    if count == 0 {
        return AccessRules::default();
    }
    let rule = |number: usize| {
        let name = match number % 10 {
            0 => format!("/group_{number}/*_raw"),
            1 => format!("/group_{number}/**"),
            _ => format!("/robot/sensor_{number}/data"),
        };
        format!("[[allow]]\npeer = \"base\"\npublish = \"{name}\"\nsubscribe = \"{name}\"\n")
    };
    AccessRules::parse(&(0..count).map(rule).collect::<String>(), "access.toml").expect("rules")
}

fn decisions(c: &mut Criterion) {
    let endpoint = |kind| Endpoint::new(Gid([1; 16]), kind, "/robot/sensor_7/data", "T");
    let (publisher, subscription) =
        (endpoint(EndpointKind::Publisher), endpoint(EndpointKind::Subscription));
    for count in [0, 10, 1000] {
        let rules = rules(count);
        let peer = rules.permissions(Principal::Name("base"));
        c.bench_function(&format!("one name, {count} rules"), |b| {
            b.iter(|| peer.allows(Verb::Publish, black_box("/robot/sensor_7/data")));
        });
        c.bench_function(&format!("a pair, {count} rules"), |b| {
            b.iter(|| {
                permits(&peer, black_box(&publisher)) && shows(&peer, black_box(&subscription))
            });
        });
        c.bench_function(&format!("compile for a peer, {count} rules"), |b| {
            b.iter(|| rules.permissions(black_box(Principal::Name("base"))));
        });
    }
}

/// All patterns have their stars in the same place, and the name fits none of them.
fn starred(c: &mut Criterion) {
    let rule = |number: usize| {
        let name = format!("/robot/sensor_{number}_*/data");
        format!("[[allow]]\npeer = \"base\"\npublish = \"{name}\"\nsubscribe = \"{name}\"\n")
    };
    let endpoint = |kind| Endpoint::new(Gid([1; 16]), kind, "/robot/sensor_none/data", "T");
    let (publisher, subscription) =
        (endpoint(EndpointKind::Publisher), endpoint(EndpointKind::Subscription));
    for count in [10, 100, 1000] {
        let text: String = (0..count).map(rule).collect();
        let rules = AccessRules::parse(&text, "access.toml").expect("rules");
        let peer = rules.permissions(Principal::Name("base"));
        assert!(!permits(&peer, &publisher) && !shows(&peer, &subscription));
        c.bench_function(&format!("a pair, {count} rules with stars side by side"), |b| {
            b.iter(|| {
                permits(&peer, black_box(&publisher)) || shows(&peer, black_box(&subscription))
            });
        });
    }
}

/// What it costs to find the limits of a topic, once for each route, with so many entries: half of them name the topic by a
/// pattern that fits.
fn limits(c: &mut Criterion) {
    for count in [0, 10, 1000] {
        let entry = |number: usize| {
            let name = match number % 4 {
                0 => "/robot/**".to_owned(),
                1 => "/robot/*/data".to_owned(),
                2 => format!("/robot/sensor_{number}/*_raw"),
                _ => format!("/group_{number}/**"),
            };
            format!("[[limit]]\npeer = \"base\"\ntopic = \"{name}\"\nrate = {}\n", number + 1)
        };
        let text: String = (0..count).map(entry).collect();
        let rules = match count {
            0 => AccessRules::default(),
            _ => AccessRules::parse(&text, "access.toml").expect("limits"),
        };
        let peer = rules.permissions(Principal::Name("base"));
        let found = peer.limits(Verb::Publish, "/robot/sensor_7/data").count();
        assert_eq!(found, count.div_ceil(4) + (count + 2) / 4, "of {count}");
        c.bench_function(&format!("limits of a topic, {count} entries"), |b| {
            b.iter(|| peer.limits(Verb::Publish, black_box("/robot/sensor_7/data")).count());
        });
        c.bench_function(&format!("compile {count} limits for a peer"), |b| {
            b.iter(|| rules.permissions(black_box(Principal::Name("base"))));
        });
    }
}

criterion_group!(benches, decisions, starred, limits);
criterion_main!(benches);
