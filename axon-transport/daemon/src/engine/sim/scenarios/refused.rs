//! Tests routes that one host refuses: both hosts report it, with the reason.

use axon_shm::qos::Qos;
use axon_transport::config::Config;

use crate::engine::sim::{
    tests::secs,
    world::{Pair, World},
};

/// Creates two hosts and a topic. Host `fails` can open neither relays nor stand-ins.
fn world(fails: usize) -> (World, Pair) {
    let mut world = World::new(90, 2, |_| Config::default());
    world.hosts[fails].rings.set_fails(true);
    let pair = world.pair(0, 1, "/t", Qos::keep_all());
    world.until(secs(10), World::is_whole);
    world.run_for(secs(5));
    (world, pair)
}

/// Returns the reasons why the topic does not cross, as each host reports them.
fn refused(world: &World) -> [Vec<String>; 2] {
    [0, 1].map(|host| {
        let links = world.hosts[host].status.values();
        links.flat_map(|link| link.routes_refused.values().cloned()).collect()
    })
}

fn flows(world: &mut World, pair: Pair) -> bool {
    assert!(world.publish(pair, 10));
    world.run_for(secs(1));
    !world.received(pair).is_empty()
}

#[test]
fn a_stand_in_that_cannot_be_opened_is_told_to_the_publishers_host() {
    let (mut world, pair) = world(1);
    assert!(!flows(&mut world, pair));
    let [here, there] = refused(&world);
    assert!(there[0].starts_with("not asked for: ") && there[0].contains("stand-in"), "{there:?}");
    assert!(here[0].starts_with("not asked for by the peer: "), "{here:?}");
    // It is tried again when anything changes.
    world.hosts[1].rings.set_fails(false);
    world.hosts[1].touch_graph();
    world.run_for(secs(5));
    assert!(flows(&mut world, pair), "{}", world.describe());
    assert!(refused(&world).iter().all(Vec::is_empty), "{:?}", refused(&world));
}

#[test]
fn unopened_relay_is_reported_to_the_host_of_the_subscriber_which_retries() {
    let (mut world, pair) = world(0);
    assert!(!flows(&mut world, pair));
    let [here, there] = refused(&world);
    let why = "1 of 1 kinds of subscriptions get nothing";
    assert!(there[0].starts_with("refused by the peer: ") && there[0].contains(why), "{there:?}");
    assert!(here[0].starts_with("refused here: ") && here[0].contains(why), "{here:?}");
    world.hosts[0].rings.set_fails(false);
    world.run_for(secs(15));
    assert!(flows(&mut world, pair), "{}", world.describe());
    assert!(refused(&world).iter().all(Vec::is_empty), "{:?}", refused(&world));
}
