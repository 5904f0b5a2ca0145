//! Tests access rules between hosts: denied data does not cross, whichever side denies it.

use axon_shm::{
    ids::{DaemonId, Gid},
    qos::{Durability, Qos},
};
use axon_transport::{
    access::AccessRules,
    config::Config,
    internal::wire::session::{CheckedUse, MOST_CHECKED},
    status::{LinkStatus, PeerDecision},
};

use super::super::hostile::{
    LOWEST, dial, elect, greet, of_raw, publishes, samples, say, subscribe,
};
use crate::{
    engine::{
        peer_graph::decisions::looks_at_rules,
        sim::{
            tests::{millis, secs},
            world::{Pair, World},
        },
    },
    link::{AccessDecisions, LinkAccessCheck, LinkMessage, UseDecision},
};

/// Rules that deny nothing.
pub(super) const OPEN: &str = "default = \"allow\"";

fn rules(text: &str) -> AccessRules {
    AccessRules::parse(text, "access.toml").unwrap()
}

/// Creates two hosts, one of which has these rules.
pub(super) fn hosts(with_rules: usize, text: &str) -> World {
    World::new(23, 2, |host| {
        let mut config = Config::default();
        if host == with_rules {
            config.access = rules(text);
        }
        config
    })
}

pub(super) fn link(world: &World, host: usize) -> &LinkStatus {
    world.hosts[host].status.values().next().unwrap()
}

/// Returns the denials that a host's status shows, as one text.
pub(super) fn denied(world: &World, host: usize) -> String {
    format!("{:?}", link(world, host).denied)
}

/// Returns whether a host knows an endpoint of the other one.
fn is_shown(world: &World, host: usize, (_, gid): (usize, Gid)) -> bool {
    world.hosts[host].graph.values().any(|all| all.contains_key(&gid))
}

fn arrives(world: &mut World, pair: Pair) -> bool {
    let before = world.received(pair).len();
    assert!(world.publish(pair, 10));
    world.run_for(millis(900));
    world.received(pair).len() > before
}

fn latched() -> Qos {
    Qos::keep_all().with_durability(Durability::TransientLocal)
}

#[test]
fn a_topic_does_not_cross_where_either_host_denies_it() {
    for (with_rules, text, whose, verb) in [
        (1, "[[deny]]\npeer = \"*\"\npublish = \"/cmd_vel\"", "the peer's", "publish"),
        (1, "[[allow]]\npeer = \"address:*\"\npublish = \"/scan\"", "the peer's", "publish"),
        (0, "[[deny]]\npeer = \"*\"\nsubscribe = \"/cmd_vel\"", "the peer's", "subscribe"),
        (
            0,
            "default = \"deny\"\n[[allow]]\npeer = \"*\"\nsubscribe = \"/sc*\"",
            "the peer's",
            "subscribe",
        ),
    ] {
        let mut world = hosts(with_rules, text);
        let [wrong, right] = ["/cmd_vel", "/scan"].map(|topic| world.pair(0, 1, topic, latched()));
        // Published before they are linked: history is a way in, too.
        assert!(world.publish(wrong, 10) && world.publish(right, 10));
        world.until(secs(20), |world| world.received(right).len() == 1);
        assert!(arrives(&mut world, right), "{text}");
        assert!(!arrives(&mut world, wrong), "{text}");
        assert!(world.received(wrong).is_empty());
        // Neither sees more of the other than it may.
        assert!(is_shown(&world, 1, right.publisher) && is_shown(&world, 0, right.subscription));
        let hidden = if with_rules == 1 { (1, wrong.publisher) } else { (0, wrong.subscription) };
        assert!(!is_shown(&world, hidden.0, hidden.1), "{text}");
        // An endpoint that the peer may neither use nor see is not in its graph either. A [[deny]] alone leaves the
        // endpoint visible.
        let other_end = [wrong.publisher, wrong.subscription][with_rules];
        assert_eq!(is_shown(&world, 1 - with_rules, other_end), !text.contains("allow"), "{text}");
        world.run_for(secs(2));
        let (here, there) = (denied(&world, with_rules), denied(&world, 1 - with_rules));
        assert!(here.contains(&format!("\"{verb} /cmd_vel ({whose})\": \"here: denied")), "{here}");
        assert!(
            there.contains(&format!("\"{verb} /cmd_vel (ours)\": \"by the peer: denied")),
            "{there}"
        );
        assert!(here.contains("access.toml") && there.contains("access.toml"), "{here} {there}");
        assert!(!here.contains("/scan") && !there.contains("/scan"));
    }
}

#[test]
fn a_topic_crosses_beside_a_denial_of_parameters_or_lifecycle() {
    for key in ["parameters", "lifecycle"] {
        for (with_rules, names) in [(0, "true"), (1, "true"), (0, "\"/scan\""), (1, "\"/scan\"")] {
            let text = format!("[[deny]]\npeer = \"*\"\n{key} = {names}");
            let mut world = hosts(with_rules, &text);
            let [scan, events] =
                ["/scan", "/parameter_events"].map(|topic| world.pair(0, 1, topic, latched()));
            world.until(secs(20), World::is_whole);
            assert!(arrives(&mut world, scan) && arrives(&mut world, events), "{text}");
            for pair in [scan, events] {
                assert!(
                    is_shown(&world, 1, pair.publisher) && is_shown(&world, 0, pair.subscription)
                );
            }
            assert!((0..2).all(|host| link(&world, host).denied.is_empty()), "{text}");
        }
    }
}

#[test]
fn an_endpoint_that_may_be_seen_and_not_used_has_no_stand_in() {
    let see = "default = \"deny\"\n[[allow]]\npeer = \"*\"\nsee = \"**\"";
    for closed in ["[[deny]]\npeer = \"*\"\nsubscribe = \"/scan\"", see] {
        let mut world = hosts(0, closed);
        let scan = world.pair(0, 1, "/scan", latched());
        // The check begins before the hosts are linked: the endpoint must never appear, not even for a moment.
        for _ in 0..3000 {
            world.run_for(millis(1));
            assert_eq!(world.hosts[1].shown(), 0, "{closed}");
        }
        assert!(is_shown(&world, 1, scan.publisher), "it may be seen");
        assert!(denied(&world, 1).contains("subscribe /scan (ours)"), "{}", denied(&world, 1));
        assert!(link(&world, 1).routes_refused.is_empty(), "it did not ask");
        for _ in 0..2 {
            world.hosts[0].set_access(OPEN);
            world.run_for(secs(1));
            assert!(arrives(&mut world, scan), "{closed}");
            assert_eq!(world.hosts[1].shown(), 1);
            world.hosts[0].set_access(closed);
            world.run_for(secs(1));
            assert_eq!(world.hosts[1].shown(), 0, "{closed}");
            assert!(!arrives(&mut world, scan), "{closed}");
        }
    }
}

#[test]
fn denying_see_also_denies_topics_without_an_allow_and_reports_the_rule() {
    for hides in ["/scan", "**"] {
        let see = format!("[[deny]]\npeer = \"*\"\nsee = \"{hides}\"");
        let text = format!("{see}\n[[allow]]\npeer = \"*\"\nsubscribe = \"/scan\"");
        let mut world = hosts(0, &text);
        let [scan, odom] = ["/scan", "/odom"].map(|topic| world.pair(0, 1, topic, latched()));
        world.until(secs(20), World::is_linked);
        world.run_for(secs(1));
        assert!(arrives(&mut world, scan), "{text}");
        assert!(is_shown(&world, 1, scan.publisher) && !is_shown(&world, 1, odom.publisher));
        // If no [[allow]] names the peer, hidden endpoints are also denied to it.
        for (with_rules, verb) in [(0, "subscribe"), (1, "publish")] {
            let mut world = hosts(with_rules, &see);
            let scan = world.pair(0, 1, "/scan", latched());
            world.until(secs(20), World::is_linked);
            world.run_for(secs(1));
            assert!(!arrives(&mut world, scan), "{see}");
            world.run_for(secs(2));
            for host in [0, 1] {
                let denied = denied(&world, host);
                assert!(denied.contains(&format!("{verb} /scan (")), "{denied}");
                assert!(denied.contains("denied by line 3 of access.toml"), "{denied}");
            }
        }
    }
}

#[test]
fn rule_changes_stop_and_restart_a_flow_without_gaps_in_allowed_topics() {
    let closed = "[[allow]]\npeer = \"*\"\npublish = \"/other\"\nsubscribe = \"/other\"";
    for host in [0, 1] {
        let mut world = hosts(2, OPEN);
        let [log, other] = ["/log", "/other"].map(|topic| world.pair(0, 1, topic, Qos::keep_all()));
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        assert!(arrives(&mut world, log) && arrives(&mut world, other));
        for _ in 0..3 {
            world.hosts[host].set_access(closed);
            world.run_for(millis(100));
            assert!(!arrives(&mut world, log), "closed at {host}");
            assert!(arrives(&mut world, other));
            world.run_for(secs(2));
            assert!(denied(&world, 1 - host).contains("/log"), "{}", denied(&world, 1 - host));
            world.hosts[host].set_access(OPEN);
            world.run_for(secs(3));
            assert!(arrives(&mut world, log), "open at {host}: {}", world.describe());
            assert!(arrives(&mut world, other));
            assert!(
                link(&world, host).denied.is_empty() && link(&world, 1 - host).denied.is_empty()
            );
        }
        let came = world.received(other);
        assert!(came.windows(2).all(|two| two[1] == two[0] + 1), "{came:?}");
    }
}

#[test]
fn a_hundred_rule_changes_under_load_lose_no_allowed_samples() {
    let mut world = hosts(2, OPEN);
    let pairs = [0, 1].map(|from| {
        ["/log", "/other"].map(|topic| world.pair(from, 1 - from, topic, Qos::keep_all()))
    });
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    for round in 0..100 {
        let text = [OPEN, "[[deny]]\npeer = \"*\"\npublish = \"/log\""][round % 2];
        world.hosts[round / 2 % 2].set_access(text);
        for [log, other] in pairs {
            world.publish(log, 1000);
            assert!(world.publish(other, 1000));
        }
        world.run_for(millis(7));
    }
    world.hosts.iter_mut().for_each(|host| host.set_access(OPEN));
    world.run_for(secs(5));
    for [log, other] in pairs {
        let came = world.received(other);
        assert_eq!(came.len(), 100, "{came:?}");
        assert!(arrives(&mut world, log), "{}", world.describe());
    }
}

#[test]
fn a_peer_that_ignores_rules_receives_and_delivers_nothing() {
    let deny = "[[deny]]\npeer = \"*\"\npublish = \"/in\"\nsubscribe = \"/out\"\n\
                see = [\"/in\", \"/out\"]";
    let mut world = hosts(0, deny);
    world.add_raw(Config::default(), LOWEST);
    let qos = latched();
    let publisher = world.hosts[0].rings.create_publisher("/out", qos);
    let subscription = world.hosts[0].rings.create_subscription("/in", qos, None);
    world.hosts[0].touch_graph();
    world.hosts[0].rings.publish(publisher, 10);
    // The world does not become whole, because host 1 does not see all endpoints.
    world.until(secs(10), World::is_linked);
    let on = dial(&mut world, 0);
    greet(&mut world, on, None);
    say(&mut world, on, &elect(1));
    world.run_for(millis(200));
    let liar = of_raw(7);
    say(&mut world, on, &publishes("/in", liar, qos));
    // It subscribes to a topic that this host has not shown to it.
    say(&mut world, on, &subscribe(3, "/out", qos));
    world.run_for(secs(1));
    // It sends samples that this host did not ask for, and guesses the number of the route.
    for route in 1..5 {
        let bytes = samples(route, "/in", liar, 1..=3);
        world.with_raw(0, |raw, _| raw.links[on].open(bytes.clone()));
    }
    world.hosts[0].rings.publish(publisher, 10);
    world.hosts[0].ring();
    world.run_for(secs(3));
    let heard = &world.raws[0].links[on].messages;
    let refused = heard.iter().find_map(|message| match message {
        LinkMessage::RouteRefused(refused) if refused.route == 3 => Some(&refused.reason),
        _ => None,
    });
    assert_eq!(refused.unwrap(), "denied by line 4 of access.toml");
    let told = heard.iter().find_map(|message| match message {
        LinkMessage::Denied(denied) => Some(denied.denied.clone()),
        _ => None,
    });
    let told = told.unwrap();
    assert_eq!((told.len(), told[0].verb, &*told[0].name), (1, 0, "/in"));
    for message in heard {
        match message {
            LinkMessage::Graph(graph) => {
                let topics: Vec<_> = graph.added.iter().map(|e| e.topic.as_str()).collect();
                assert!(!topics.contains(&"/out") && !topics.contains(&"/in"), "{topics:?}");
            }
            LinkMessage::Subscribe(subscribe) => panic!("asked for {subscribe:?}"),
            LinkMessage::RouteReady(ready) => panic!("served {ready:?}"),
            _ => {}
        }
    }
    assert!(world.raws[0].links[on].opened.is_empty(), "no sample was sent");
    assert!(world.hosts[0].rings.received(subscription, liar).is_empty());
    assert!(!is_shown(&world, 0, (0, liar)));
}

#[test]
fn rules_are_looked_at_for_endpoints_and_never_for_a_sample() {
    const RULES: &str = "[[deny]]\npeer = \"*\"\npublish = \"/denied*\"\n\
        [[limit]]\npeer = \"*\"\ntopic = \"/limited\"\nrate = 100000\n";
    let mut world = hosts(0, RULES);
    let qos = [Qos::keep_all(), Qos::keep_all(), Qos::sensor_data()];
    let topics = ["/log", "/limited", "/scan"];
    let before = looks_at_rules();
    let pairs: Vec<_> = [(0, 1), (1, 0)]
        .iter()
        .flat_map(|(from, to)| {
            topics.iter().zip(qos).map(move |(topic, qos)| (*from, *to, *topic, qos))
        })
        .map(|(from, to, topic, qos)| world.pair(from, to, topic, qos))
        .collect();
    world.until(secs(20), World::is_whole);
    world.run_for(secs(2));
    let matched = looks_at_rules();
    assert!(matched > before, "endpoints are checked");
    for _ in 0..500 {
        pairs.iter().for_each(|pair| assert!(world.publish(*pair, 100)));
        world.run_for(millis(2));
    }
    world.run_for(secs(2));
    assert_eq!(looks_at_rules(), matched, "for {} samples", 500 * pairs.len());
    assert!(pairs.iter().all(|pair| world.received(*pair).len() > 400));
    // One more endpoint beside many, most of them denied, causes only its own check and that of its route.
    for number in 0..100 {
        world.pair(0, 1, &format!("/topic_{number}"), qos[0]);
    }
    // There are more of them than are remembered.
    for number in 0..1_100 {
        world.hosts[1].rings.create_publisher(&format!("/denied_{number}"), qos[0]);
    }
    world.hosts[1].touch_graph();
    world.run_for(secs(5));
    let many = looks_at_rules();
    world.pair(0, 1, "/one_more", qos[0]);
    world.run_for(secs(2));
    let looks = looks_at_rules() - many;
    assert!((1..20).contains(&looks), "{looks} looks for one more endpoint");
    let many = looks_at_rules();
    world.hosts[1].rings.create_publisher("/denied_one_more", qos[0]);
    world.hosts[1].touch_graph();
    world.run_for(secs(2));
    let looks = looks_at_rules() - many;
    assert!((1..20).contains(&looks), "{looks} looks for one more endpoint that is denied");
}

#[test]
fn a_peer_says_which_of_its_rules_decides_and_answers_each_question_once() {
    let mut world = hosts(1, "[[deny]]\npeer = \"*\"\npublish = \"/cmd_vel\"");
    world.until(secs(20), World::is_whole);
    let daemon = world.hosts[1].daemon;
    let uses = |uses: &[(u8, &str)]| {
        let used = |(verb, name): &(u8, &str)| CheckedUse { verb: *verb, name: (*name).to_owned() };
        uses.iter().map(used).collect()
    };
    world.hosts[0].check_access(daemon, 1, uses(&[(0, "/cmd_vel"), (0, "/scan"), (3, "/x")]));
    world.hosts[0].check_access(DaemonId([9; 16]), 2, uses(&[(0, "/scan")]));
    world.run_for(secs(1));
    let said = |decision: &PeerDecision| (decision.allowed, decision.reason.clone());
    let decisions = world.hosts[0].decisions.remove(&1).unwrap().unwrap();
    let open = (true, "allowed: no rule in access.toml denies this".to_owned());
    let denied = (false, "denied by line 3 of access.toml".to_owned());
    assert_eq!(decisions.iter().map(said).collect::<Vec<_>>(), [denied, open.clone(), open]);
    assert_eq!(world.hosts[0].decisions.remove(&2), Some(None), "there is no such peer");
    assert!(world.hosts[0].decisions.is_empty());

    // The host without rules reports that.
    let daemon = world.hosts[0].daemon;
    world.hosts[1].check_access(daemon, 7, uses(&[(4, "/scan")]));
    world.run_for(secs(1));
    let decisions = world.hosts[1].decisions.remove(&7).unwrap().unwrap();
    assert_eq!(said(&decisions[0]), (true, "allowed: there are no access rules".to_owned()));
}

#[test]
fn unrequested_access_answers_and_oversized_access_queries_change_nothing() {
    let mut world = super::super::hostile::world(29, 1, LOWEST);
    let on = dial(&mut world, 0);
    greet(&mut world, on, None);
    say(&mut world, on, &elect(1));
    world.run_for(millis(200));
    let decision = |reason: &str| UseDecision { allowed: true, reason: reason.to_owned() };
    let answer =
        |number, decisions| LinkMessage::AccessDecisions(AccessDecisions { number, decisions });
    say(&mut world, on, &answer(1, vec![decision("unasked")]));
    world.run_for(millis(200));
    assert!(world.hosts[0].decisions.is_empty());

    // An answer about another number of uses is none, and the first one counts.
    let raw = world.raws[0].hello().daemon;
    let used = CheckedUse { verb: 0, name: "/scan".into() };
    world.hosts[0].check_access(raw, 5, vec![used.clone()]);
    world.hosts[0].check_access(raw, 6, vec![used.clone()]);
    world.run_for(millis(200));
    say(&mut world, on, &answer(5, vec![decision("a"), decision("b")]));
    say(&mut world, on, &answer(6, vec![decision("\u{1b}[2Jone")]));
    say(&mut world, on, &answer(6, vec![decision("two")]));
    world.run_for(millis(200));
    let one = Some(vec![PeerDecision::new(true, "[2Jone".into())]);
    assert_eq!(world.hosts[0].decisions, [(6, one)].into());

    const FLOOD: u64 = 2_000;
    // A flood of questions is answered at the rate of control messages, and the link stands.
    for number in 0..FLOOD {
        let uses = vec![used.clone(); MOST_CHECKED];
        say(&mut world, on, &LinkMessage::AccessCheck(LinkAccessCheck { number, uses }));
    }
    world.run_for(secs(1));
    let answers = |world: &World| {
        let heard = &world.raws[0].links[on].messages;
        heard.iter().filter(|message| matches!(message, LinkMessage::AccessDecisions(_))).count()
    };
    let first = answers(&world);
    assert!((1..FLOOD as usize).contains(&first), "{first} at once");
    world.until(secs(120), |world| answers(world) == FLOOD as usize);
    let uses = vec![used; MOST_CHECKED + 1];
    say(&mut world, on, &LinkMessage::AccessCheck(LinkAccessCheck { number: 0, uses }));
    world.run_for(secs(1));
    assert!(world.hosts[0].refusals.iter().any(|(_, why)| why.contains("out of bounds")));
}
