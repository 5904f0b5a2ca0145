//! Tests limits between hosts: samples beyond the limit of either side do not cross, and all dropped samples are
//! counted.

use axon_shm::qos::Qos;
use axon_transport::{
    access::{AccessRules, TopicPattern},
    config::{Config, TopicPriority, TopicRule},
    status::LimitStatus,
};

use super::super::radio::{Stream, drive, radio};
use crate::{
    bridge::TrafficRules,
    engine::sim::{
        tests::{millis, secs},
        world::{Pair, World},
    },
};

const TEXT: &str = "[[limit]]\npeer = \"*\"\ntopic = \"/limited\"\nrate = 10\n";

/// Creates two hosts, one of which has these rules.
fn hosts(with_rules: usize, text: &str) -> World {
    World::new(29, 2, |host| {
        let mut config = Config::default();
        if host == with_rules {
            config.access = AccessRules::parse(text, "access.toml").unwrap();
        }
        config
    })
}

/// Publishes a sample every 10 ms for `seconds`.
fn publish(world: &mut World, pairs: &[Pair], seconds: u64) {
    for _ in 0..seconds * 100 {
        for pair in pairs {
            world.publish(*pair, 100);
        }
        world.run_for(millis(10));
    }
}

fn limits(world: &World, host: usize) -> &[LimitStatus] {
    &world.hosts[host].status.values().next().unwrap().limits
}

#[test]
fn samples_beyond_a_limit_of_either_host_do_not_cross() {
    for with_rules in [0, 1] {
        for (over, qos) in [
            ("drop-oldest", Qos::keep_all()),
            ("drop-oldest", Qos::default().with_depth(5)),
            ("drop-oldest", Qos::sensor_data()),
            ("drop-newest", Qos::keep_all()),
            ("drop-newest", Qos::sensor_data()),
        ] {
            let mut world = hosts(with_rules, &format!("{TEXT}over = \"{over}\""));
            let [limited, free] = ["/limited", "/free"].map(|topic| world.pair(0, 1, topic, qos));
            world.until(secs(20), World::is_whole);
            world.run_for(secs(1));
            publish(&mut world, &[limited, free], 10);
            world.run_for(secs(2));
            let came = world.received(limited);
            let text = format!("host {with_rules}, {over}, {qos:?}: {came:?}");
            assert!((95..=103).contains(&came.len()), "{} of 100, {text}", came.len());
            assert!(came.is_sorted_by(|one, next| one < next), "{text}");
            let newest = over == "drop-oldest" && with_rules == 0;
            assert!(!newest || came.contains(&1000), "the newest arrives: {text}");
            assert_eq!(world.received(free).len(), 1000, "{text}");
            let [limit] = limits(&world, with_rules) else { panic!("{text}") };
            let verb = ["subscribe", "publish"][with_rules];
            assert_eq!((&*limit.verb, &*limit.name), (verb, "/limited"));
            assert_eq!(limit.passed, came.len() as u64, "{text}");
            assert_eq!(limit.passed + limit.dropped, 1000, "{text}");
            assert!(limits(&world, 1 - with_rules).is_empty());
            // No flow counts as stalled, and the publisher does not wait.
            assert!(world.publish(limited, 10), "{text}");
        }
    }
}

#[test]
fn a_limit_that_holds_a_keep_all_publisher_back_loses_nothing() {
    for with_rules in [0, 1] {
        let mut world = hosts(with_rules, &format!("{TEXT}over = \"hold\""));
        let pairs = ["/limited", "/free"].map(|topic| world.pair(0, 1, topic, Qos::keep_all()));
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        publish(&mut world, &pairs, 5);
        let early = world.received(pairs[0]).len();
        assert!((45..=55).contains(&early), "{early}");
        world.run_for(secs(60));
        for pair in pairs {
            let published = world.hosts[0].rings.published(pair.publisher.1);
            assert!(published > 300, "{published}");
            assert_eq!(world.received(pair), (1..=published).collect::<Vec<_>>());
        }
    }
}

#[test]
fn limits_that_change_count_at_once_and_lose_nothing_that_they_hold() {
    let hold = format!("{TEXT}over = \"hold\"");
    let open = "default = \"allow\"";
    for host in [0, 1] {
        let mut world = hosts(host, &hold);
        let pair = world.pair(0, 1, "/limited", Qos::keep_all());
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        for round in 0..20 {
            publish(&mut world, &[pair], 1);
            world.hosts[host].set_access([open, &hold][round % 2]);
        }
        world.hosts[host].set_access(open);
        world.run_for(secs(3));
        let published = world.hosts[0].rings.published(pair.publisher.1);
        assert!(published > 1000, "{published}");
        assert_eq!(world.received(pair), (1..=published).collect::<Vec<_>>(), "host {host}");
    }
}

#[test]
fn the_topics_of_a_peer_share_a_joint_limit() {
    let text = "[[limit]]\npeer = \"*\"\nsubscribe = \"/**\"\nbytes = \"2 kB/s\"\ntogether = true";
    let mut world = hosts(0, text);
    let pairs = ["/a", "/b", "/c"].map(|topic| world.pair(0, 1, topic, Qos::sensor_data()));
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    publish(&mut world, &pairs, 10);
    world.run_for(secs(1));
    let came = pairs.map(|pair| world.received(pair).len());
    let sum: usize = came.iter().sum();
    // A sample has 22 bytes more than was asked for.
    assert!((160..=175).contains(&sum), "{came:?}");
    assert!(came.iter().all(|one| *one > 50), "each has its turn: {came:?}");
}

#[test]
fn max_hz_sends_the_newest_samples_of_a_topic_to_each_host() {
    let mut world = World::new(31, 3, |host| {
        let mut config = Config::default();
        if host == 0 {
            let name = TopicPattern::new("/limited").unwrap();
            config.topics.push(TopicRule::new(name, TopicPriority::Normal).max_hz(10.0));
        }
        config
    });
    let qos = Qos::sensor_data();
    let one = world.pair(0, 1, "/limited", qos);
    let subscription = world.hosts[2].rings.create_subscription("/limited", qos, None);
    let pairs = [one, Pair { subscription: (2, subscription), ..one }];
    world.hosts[2].touch_graph();
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    publish(&mut world, &[one], 5);
    world.run_for(secs(1));
    for pair in pairs {
        let came = world.received(pair);
        assert!((45..=55).contains(&came.len()), "{came:?}");
        assert_eq!(came.last(), Some(&500), "the newest arrives");
    }
}

#[test]
fn max_hz_that_changes_counts_for_a_topic_that_is_matched() {
    let entry = |hz: f64| {
        let name = TopicPattern::new("/limited").unwrap();
        TopicRule::new(name, TopicPriority::Normal).max_hz(hz)
    };
    let mut world = World::new(32, 2, |_| Config::default());
    let pair = world.pair(0, 1, "/limited", Qos::sensor_data());
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    // For each of these limits, a hundred samples a second are published for five seconds.
    for (topics, fits) in [
        (vec![], 500..=500),
        (vec![entry(10.0)], 45..=56),
        (vec![entry(40.0)], 190..=211),
        (vec![], 500..=500),
    ] {
        let mut rules = TrafficRules::of(&Config::default());
        rules.topics = topics;
        world.hosts[0].set_rules(rules);
        world.run_for(secs(1));
        let before = world.received(pair).len();
        publish(&mut world, &[pair], 5);
        world.run_for(secs(1));
        let came = world.received(pair).len() - before;
        assert!(fits.contains(&came), "{came} of {fits:?}");
    }
}

#[test]
fn egress_to_a_peer_stays_below_its_limit_and_samples_stay_fresh() {
    let text = "[[limit]]\npeer = \"*\"\negress = \"1 MB/s\"";
    let mut world = hosts(0, text);
    world.network.set_default_path(radio(54, 0.0));
    // Five times the limit, and commands beside it.
    let mut streams = [
        Stream::new(&mut world, "/camera", Qos::sensor_data(), 64 << 10, millis(13)),
        Stream::new(&mut world, "/cmd_vel", Qos::default(), 64, millis(20)),
    ];
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(2));
    let (from, before) = (world.now, world.network.counters(0).clone());
    drive(&mut world, &mut streams, secs(10));
    let after = world.network.counters(0);
    let bytes = after.sent_bytes - before.sent_bytes + 28 * (after.sent - before.sent);
    assert!((9_500_000..10_100_000).contains(&bytes), "{bytes} in ten seconds");
    let median = |stream: &Stream| {
        let ages = stream.ages(from);
        (ages.len(), ages[ages.len() / 2])
    };
    let (cameras, camera) = median(&streams[0]);
    let (commands, command) = median(&streams[1]);
    assert!(cameras > 130 && camera < millis(220), "{cameras} images, {camera:?} old");
    assert!(commands > 490 && command < millis(30), "{commands} commands, {command:?} old");
    let limit = &limits(&world, 0)[0];
    assert_eq!(
        (&*limit.verb, &*limit.limit, &*limit.place),
        ("egress", "1 MB/s", "line 1 of access.toml")
    );
    // The limit is gone: the link has all of its rate.
    world.hosts[0].set_access("default = \"allow\"");
    world.run_for(secs(1));
    let before = world.network.counters(0).sent_bytes;
    drive(&mut world, &mut streams, secs(5));
    let free = world.network.counters(0).sent_bytes - before;
    assert!(free > 20_000_000, "{free} in five seconds");
}

#[test]
fn short_samples_beyond_the_egress_do_not_grow_old() {
    let mut world = hosts(0, "[[limit]]\npeer = \"*\"\negress = \"100 kB/s\"");
    world.network.set_default_path(radio(54, 0.0));
    let mut streams = [Stream::new(&mut world, "/short", Qos::sensor_data(), 1000, millis(4))];
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(5));
    let from = world.now;
    drive(&mut world, &mut streams, secs(10));
    let ages = streams[0].ages(from);
    let oldest = ages.iter().max().unwrap();
    assert!(ages.len() > 700 && *oldest < millis(600), "{} samples, {oldest:?} old", ages.len());
}

#[test]
fn all_peers_together_have_the_egress_of_an_interface_in_equal_parts() {
    // The ids of two daemons decide which of them dials. With three hosts each limit is tried on a client and on a server.
    for limited in 0..3 {
        let text = "[[limit]]\ninterface = \"w*0\"\negress = \"1 MB/s\"";
        let mut world = World::new(37, 3, |host| {
            let mut config = Config::default();
            if host == limited {
                config.access = AccessRules::parse(text, "access.toml").unwrap();
            }
            config
        });
        world.network.set_default_path(radio(54, 0.0));
        let peers: Vec<usize> = (0..3).filter(|host| *host != limited).collect();
        let pairs: Vec<_> = ["/a", "/b"]
            .into_iter()
            .zip(&peers)
            .map(|(topic, peer)| world.pair(limited, *peer, topic, Qos::sensor_data()))
            .collect();
        world.until(secs(20), World::is_whole);
        let measure = |world: &mut World| {
            world.run_for(secs(1));
            let before: Vec<_> = pairs.iter().map(|pair| world.received(*pair).len()).collect();
            let sent = world.network.counters(limited).clone();
            for _ in 0..500 {
                // Each alone has more than the limit.
                pairs.iter().for_each(|pair| assert!(world.publish(*pair, 30_000)));
                world.run_for(millis(20));
            }
            let now = world.network.counters(limited);
            let bytes = now.sent_bytes - sent.sent_bytes + 28 * (now.sent - sent.sent);
            let came = pairs.iter().zip(before);
            let came: Vec<_> =
                came.map(|(pair, before)| world.received(*pair).len() - before).collect();
            (bytes, came)
        };
        let (bytes, came) = measure(&mut world);
        assert!((9_300_000..10_100_000).contains(&bytes), "host {limited}: {bytes} in ten seconds");
        assert!(came.iter().all(|one| (140..=170).contains(one)), "host {limited}: {came:?}");
        let all = world.hosts[limited].status.values().flat_map(|link| &link.limits);
        let all: Vec<_> = all.map(|limit| (&*limit.name, &*limit.place)).collect();
        assert_eq!(all, [("(all packets by wlan0)", "line 1 of access.toml"); 2]);
        // The interface has another address.
        world.move_host(limited);
        world.until(secs(30), World::is_whole);
        let (bytes, _) = measure(&mut world);
        // QUIC begins anew with a small window.
        assert!((7_000_000..10_100_000).contains(&bytes), "host {limited}: {bytes} after it moved");
        world.hosts[limited].set_access("default = \"allow\"");
        let (bytes, _) = measure(&mut world);
        assert!(bytes > 20_000_000, "host {limited}: {bytes} without the limit");
    }
}

#[test]
fn best_effort_samples_that_wait_when_their_publisher_ends_arrive_or_are_counted() {
    const SAMPLES: u64 = 5;
    // One in fifty seconds is none while anybody waits.
    for (rate, over, arrive) in
        [("1", "hold", 5), ("1", "drop-oldest", 2), ("0.02", "hold", 1), ("0.02", "drop-oldest", 1)]
    {
        let text = format!(
            "[[limit]]\npeer = \"*\"\ntopic = \"/limited\"\nrate = {rate}\nburst = 1\nover = \"{over}\""
        );
        let mut world = hosts(0, &text);
        let pair = world.pair(0, 1, "/limited", Qos::sensor_data());
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        for _ in 0..SAMPLES {
            world.publish(pair, 100);
        }
        world.run_for(millis(300));
        world.hosts[0].rings.end(pair.publisher.1);
        world.hosts[0].touch_graph();
        world.run_for(secs(30));
        let came = world.received(pair);
        let text = format!("{rate} a second, {over}: {came:?}, {:?}", world.hosts[0].lost);
        assert_eq!(came.len(), arrive, "{text}");
        assert_eq!(
            came.len() as u64 + world.hosts[0].lost.values().sum::<u64>(),
            SAMPLES,
            "{text}"
        );
        assert!(world.hosts[1].lost.is_empty(), "{text}: {:?}", world.hosts[1].lost);
        let is_shown = world.hosts[1].graph.values().any(|all| all.contains_key(&pair.publisher.1));
        assert!(!is_shown, "it is over, {text}");
    }
}
