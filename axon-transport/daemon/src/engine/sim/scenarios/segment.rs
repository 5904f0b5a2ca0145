//! Many hosts on one segment: a cold start, and more hosts than a daemon has links for.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;

use crate::engine::sim::{
    tests::{all_cases, classic, millis, secs, setting},
    world::World,
};

/// Links of a daemon at a time.
const MAX_LINKS: usize = 160;
/// Budget of a host until the graph is whole, for each other host: bytes and datagrams. It covers two handshakes, since
/// both hosts may dial, and the graph of 20 topics.
const BUDGET: (u64, u64) = (24_000, 40);

/// Creates `topics` topics on each host.
fn with_topics(world: &World, topics: usize) {
    for (host, number) in world.hosts.iter().zip(0..) {
        for topic in 0..topics {
            host.rings.create_publisher(&format!("/{number}/{topic}"), Qos::default());
        }
    }
}

/// Runs until this holds. With many hosts, to look after each event would take longer than the events.
fn within(world: &mut World, most: Duration, holds: impl Fn(&World) -> bool) {
    let end = world.now + most;
    while !holds(world) {
        assert!(world.now < end, "not within {most:?}");
        world.run_for(millis(10));
    }
}

/// Returns the maximum that one host sent: bytes and datagrams.
fn most_sent(world: &World) -> (u64, u64) {
    let counters = (0..world.hosts.len()).map(|host| world.network.counters(host));
    counters.fold((0, 0), |most, c| (most.0.max(c.sent_bytes), most.1.max(c.sent)))
}

#[test]
fn a_segment_is_whole_after_a_cold_start_within_its_budget() {
    // A daemon has MAX_LINKS links, so with one more host each links with all others.
    let hosts = if all_cases() { MAX_LINKS + 1 } else { 20 };
    let hosts = setting("SIMULATE_HOSTS", hosts as u64) as usize;
    let mut world = World::new(8, hosts, classic);
    with_topics(&world, 20);
    within(&mut world, secs(5), World::is_whole);
    let (bytes, datagrams) = most_sent(&world);
    println!(
        "{hosts} hosts are whole after {:?}; at most {bytes} bytes in {datagrams} datagrams sent by one",
        world.now
    );
    let others = hosts as u64 - 1;
    assert!(bytes <= BUDGET.0 * others, "{bytes} bytes, {} for each other", bytes / others);
    assert!(datagrams <= BUDGET.1 * others, "{datagrams}, {} for each other", datagrams / others);
}

#[test]
fn hosts_beyond_the_links_of_a_daemon_are_refused_and_harm_no_link() {
    let beyond = if all_cases() { 40 } else { 3 };
    let hosts = 1 + MAX_LINKS + beyond;
    let mut world = World::apart(50, hosts, classic);
    let first = |world: &World| world.hosts[0].linked();
    for host in 1..=MAX_LINKS {
        world.tell(host, 0);
    }
    within(&mut world, secs(10), |world| world.hosts[0].linked().len() == MAX_LINKS);
    let linked = first(&world);
    for host in MAX_LINKS + 1..hosts {
        world.tell(host, 0);
    }
    world.run_for(secs(if all_cases() { 30 } else { 1 }));
    assert_eq!(first(&world), linked, "no link gave way: each address has one");
    for host in &world.hosts[MAX_LINKS + 1..] {
        assert!(host.linked().is_empty());
        let refused =
            host.refusals.iter().any(|(_, text)| text.contains("as many links as it may"));
        assert!(refused, "{:?}", host.refusals.front());
    }
    let (bytes, datagrams) = most_sent(&world);
    println!("{beyond} hosts too many: at most {bytes} bytes in {datagrams} datagrams sent by one");
    // A link that ends makes room for a link with one of the remaining hosts.
    world.kill(1, true);
    let place = |world: &World| {
        world.hosts[MAX_LINKS + 1..].iter().filter(|host| !host.linked().is_empty()).count()
    };
    world.until(secs(5), |world| place(world) == 1);
}

#[test]
fn many_hosts_with_few_links_each_are_linked() {
    // Links are not forwarded: each host knows its neighbours. All pairs of 1,000 would be half a million links.
    let hosts = if all_cases() { 1000 } else { 40 };
    let (hosts, links) = (setting("SIMULATE_HOSTS", hosts) as usize, 8);
    let mut world = World::apart(51, hosts, classic);
    with_topics(&world, 5);
    for host in 0..hosts {
        for step in 1..=links / 2 {
            let other = (host + step) % hosts;
            world.tell(host, other);
            world.tell(other, host);
        }
    }
    within(&mut world, secs(10), |world| world.hosts.iter().all(|host| host.graph.len() == links));
    let (bytes, datagrams) = most_sent(&world);
    println!(
        "{hosts} hosts with {links} links each after {:?}; at most {bytes} bytes in {datagrams} datagrams sent by one",
        world.now
    );
    assert!(bytes <= BUDGET.0 * links as u64 && datagrams <= BUDGET.1 * links as u64);
}
