//! Tests peers that take as many links, and ask for as much, as they get.

#![allow(clippy::print_stdout, reason = "a scenario says what it skips")]

use axon_shm::{ids::DaemonId, qos::Qos};
use axon_transport::config::Config;

use crate::{
    engine::{
        peer::MAX_ROUTES,
        sim::{
            scenarios::{hostile::subscribe, memory::linked_as},
            tests::{all_cases, millis, secs},
            world::World,
        },
    },
    link::{CloseCode, GraphResync, LinkHello, LinkMessage},
};

/// Creates a host and `raws` raw peers.
fn world(seed: u64, raws: u8, config: impl Fn() -> Config) -> World {
    let mut world = World::new(seed, 1, |_| config());
    for raw in 0..raws {
        world.add_raw(Config::default(), DaemonId([0xff - raw; 16]));
    }
    world
}

/// Makes the first peer dial under a daemon id. Returns the connection, on which the peer has sent HELLO and which the
/// host may refuse.
fn greets(world: &mut World, id: u8, replaces: Option<[u8; 16]>) -> usize {
    let to = world.hosts[0].address;
    let number = world.with_raw(0, |raw, now| raw.dial(to, now));
    world.until(secs(5), |world| world.raws[0].links[number].connected);
    world.with_raw(0, |raw, _| {
        let hello = LinkHello { daemon: DaemonId([id; 16]), replaces, ..raw.hello() };
        raw.links[number].say(&LinkMessage::Hello(hello));
    });
    number
}

/// Returns the open connections of the first peer.
fn open(world: &World) -> Vec<usize> {
    let links = world.raws[0].links.iter().enumerate();
    links.filter(|(_, link)| link.closed.is_none()).map(|(number, _)| number).collect()
}

#[test]
fn an_identity_has_at_most_16_links_across_its_daemon_ids() {
    let mut world = world(90, 2, Config::default);
    let links: Vec<_> = (0..16).map(|n| linked_as(&mut world, 0, 0xe0 + n)).collect();
    for id in [0xd0, 0xd1] {
        let number = greets(&mut world, id, None);
        world.until(secs(5), |world| world.raws[0].links[number].closed.is_some());
        let (code, why) = world.raws[0].links[number].closed.as_ref().unwrap();
        assert_eq!(*code, Some(CloseCode::NotAllowed));
        assert!(why.contains("as many connections as it may"), "{why}");
    }
    linked_as(&mut world, 1, 0xf8);
    assert_eq!(world.hosts[0].linked().len(), 17, "{}", world.describe());
    assert_eq!(open(&world), links);
    world.with_raw(0, |raw, now| raw.close(links[0], now));
    world.run_for(secs(1));
    linked_as(&mut world, 0, 0xd2);
}

#[test]
fn of_the_superseded_links_of_an_identity_the_newest_eight_stand() {
    const RENEWED: usize = 12;
    let mut world = world(91, 1, Config::default);
    let mut links = vec![linked_as(&mut world, 0, 0xff)];
    // The peer sends nothing over the new links, so the host waits for frames that may come over the old ones.
    for _ in 0..RENEWED {
        let old = &world.raws[0].links[*links.last().unwrap()];
        let elected = old.messages.iter().find_map(|message| match message {
            LinkMessage::Elected(elected) => Some(elected.link),
            _ => None,
        });
        let number = greets(&mut world, 0xff, elected);
        world.until(secs(5), |world| world.raws[0].links[number].is_elected());
        world.run_for(millis(50));
        links.push(number);
    }
    assert_eq!(open(&world), links[RENEWED - 8..], "{}", world.describe());
    for closed in &links[..RENEWED - 8] {
        let (code, why) = world.raws[0].links[*closed].closed.as_ref().unwrap();
        assert_eq!(*code, Some(CloseCode::Replaced), "{why}");
    }
}

/// Returns a topic whose name does not become much shorter by compression.
fn long_topic(number: u64) -> String {
    let mut random = number.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let name = (0..500).map(|_| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        char::from(b'a' + (random % 26) as u8)
    });
    std::iter::once('/').chain(name).collect()
}

/// Makes a peer that reads nothing ask for the graph of the host over `links` links with different daemon ids, until
/// one is closed. Returns the maximum number of bytes that waited for it.
fn most_unread(seed: u64, links: u8) -> usize {
    let mut world = world(seed, 1, Config::default);
    for number in 0..16_000 {
        world.hosts[0].rings.create_publisher(&long_topic(number), Qos::keep_all());
    }
    world.hosts[0].touch_graph();
    let links: Vec<_> = (0..links).map(|n| linked_as(&mut world, 0, 0xff - n)).collect();
    links.iter().for_each(|link| world.raws[0].links[*link].is_deaf = true);
    let mut most = 0;
    while open(&world) == links {
        assert!(world.now < secs(200), "as much as it likes: {most} bytes");
        for link in &links {
            world.with_raw(0, |raw, _| {
                raw.links[*link].say(&LinkMessage::GraphResync(GraphResync { version: 0 }));
            });
        }
        world.run_for(millis(1_100));
        most = most.max(world.hosts[0].most_unsent());
    }
    let closed = world.raws[0].links.iter().find_map(|link| link.closed.as_ref());
    let (code, why) = closed.unwrap();
    assert_eq!(*code, Some(CloseCode::TooLarge), "{why}");
    assert!(why.contains("not read"), "{why}");
    most
}

#[test]
fn control_messages_that_a_peer_does_not_read_are_bounded_over_its_link() {
    let most = most_unread(92, 1);
    assert!((56 << 20..=72 << 20).contains(&most), "{} MiB", most >> 20);
}

#[test]
fn control_messages_that_a_peer_does_not_read_are_bounded_over_all_its_links() {
    // Three links of 64 MiB would be more.
    let most = most_unread(93, 3);
    assert!((112 << 20..=128 << 20).contains(&most), "{} MiB", most >> 20);
}

#[test]
fn a_daemon_id_is_served_as_many_routes_as_hello_says_and_no_more() {
    const BEYOND: u32 = 5;
    if !all_cases() {
        // It takes a minute without optimization.
        println!("skipped: only among all cases");
        return;
    }
    let mut world = world(94, 1, || {
        let mut config = Config::default();
        // With this size the routes are not refused for their bytes.
        config.link.graph = 64 << 20;
        config
    });
    let number = linked_as(&mut world, 0, 0xf0);
    let most = MAX_ROUTES as u32;
    world.with_raw(0, |raw, _| {
        for route in 0..most + BEYOND {
            raw.links[number].say(&subscribe(route, &format!("/topic_{route}"), Qos::default()));
        }
    });
    let refused = |world: &World| -> Vec<(u32, String)> {
        let messages = world.raws[0].links[number].messages.iter();
        let refused = messages.filter_map(|message| match message {
            LinkMessage::RouteRefused(refused) => Some((refused.route, refused.reason.clone())),
            _ => None,
        });
        refused.collect()
    };
    while refused(&world).len() < BEYOND as usize {
        assert!(world.now < secs(120), "{} are refused", refused(&world).len());
        world.run_for(secs(1));
    }
    let (routes, reasons): (Vec<_>, Vec<_>) = refused(&world).into_iter().unzip();
    assert!(routes.into_iter().eq(most..most + BEYOND));
    assert!(reasons.iter().all(|why| why.contains("32768 routes")), "{reasons:?}");
    assert_eq!(open(&world), [number]);
}

#[test]
fn a_whole_graph_is_sent_once_a_second_however_often_it_is_asked_for() {
    let mut world = world(95, 1, Config::default);
    world.hosts[0].rings.create_publisher("/t", Qos::keep_all());
    world.hosts[0].touch_graph();
    let number = linked_as(&mut world, 0, 0xf0);
    world.run_for(secs(5));
    let whole = |world: &World| {
        let graphs = world.raws[0].links[number].messages.iter();
        graphs.filter(|m| matches!(m, LinkMessage::Graph(graph) if graph.before == 0)).count()
    };
    let before = whole(&world);
    for _ in 0..100 {
        world.with_raw(0, |raw, _| {
            raw.links[number].say(&LinkMessage::GraphResync(GraphResync { version: 0 }));
        });
        world.run_for(millis(50));
    }
    // The host sends a graph at once, after each of five seconds, and for the last request.
    let sent = whole(&world) - before;
    assert!((5..=6).contains(&sent), "{sent} whole graphs in five seconds");
    world.run_for(secs(5));
    assert!(whole(&world) - before <= 7, "nothing more is asked for");
}

#[test]
fn the_backlog_of_ended_publishers_for_a_stalled_peer_is_bounded() {
    let mut world = world(97, 1, || {
        let mut config = Config::default();
        config.reliable_queue = 4 << 20;
        config
    });
    let number = linked_as(&mut world, 0, 0xf0);
    let topics = ["/first", "/second", "/third"];
    let publishers = topics.map(|topic| {
        let host = &mut world.hosts[0];
        let publisher = host.rings.create_publisher(topic, Qos::keep_all());
        host.touch_graph();
        publisher
    });
    for (route, topic) in (1..).zip(topics) {
        let message = subscribe(route, topic, Qos::keep_all());
        world.with_raw(0, |raw, _| raw.links[number].say(&message));
    }
    world.run_for(secs(1));
    let lost = |world: &World| {
        let lost = &world.hosts[0].lost;
        topics.map(|topic| lost.get(&(topic.to_owned(), "publisher_ended")).copied().unwrap_or(0))
    };
    // Each leaves 2 MB.
    for publisher in publishers {
        assert_eq!(lost(&world), [0; 3]);
        for _ in 0..200 {
            assert!(world.hosts[0].rings.publish(publisher, 10_000));
        }
        world.hosts[0].ring();
        world.run_for(millis(100));
        world.hosts[0].rings.end(publisher);
        world.hosts[0].touch_graph();
        world.run_for(millis(300));
    }
    assert_eq!(lost(&world), [200, 0, 0], "{}", world.describe());
    assert_eq!(open(&world), [number]);
}
