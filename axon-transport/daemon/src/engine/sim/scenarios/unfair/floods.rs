//! A peer that announces more than fits, while another host streams.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::{ids::DaemonId, qos::Qos};
use axon_transport::{
    config::Config,
    graph::{Endpoint, EndpointKind},
};

use crate::{
    engine::sim::{
        network::{Path, Rate},
        scenarios::memory::{gid, linked_as},
        tests::{millis, secs},
        world::World,
    },
    link::{GraphUpdate, LinkMessage},
};

/// Endpoints that the peer announces, each with four names of 500 bytes: 24 MB.
const MANY: u32 = 12_000;
/// In one message: it is 4 MiB at most before it is compressed.
const PART: u32 = 1_800;
/// Maximum charge of one message while it is handled.
const ONE: usize = 28 << 20;
/// Time between two samples of the other host.
const EVERY: Duration = Duration::from_millis(10);

fn long(number: u32) -> Endpoint {
    let name = |kind: &str| format!("{:0<500}", format!("/{kind}_{number}_{}", "n".repeat(480)));
    Endpoint::new(gid(0xf0, number), EndpointKind::Publisher, name("topic"), name("type"))
        .with_node(name("node"), name("space"))
}

#[test]
fn stream_of_another_host_continues_during_12_000_announcements() {
    let mut world = World::new(96, 2, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    let rate = Rate::new(1_000_000_000, millis(20));
    let path = Path { delay: millis(1), rate: Some(rate), ..Path::default() };
    world.network.set_default_path(path);
    let pair = world.pair(1, 0, "/stream", Qos::keep_all());
    world.until(secs(5), World::is_whole);
    let number = linked_as(&mut world, 0, 0xf0);
    assert!(world.publish(pair, 100));
    world.until(secs(5), |world| !world.received(pair).is_empty());

    // All parts are there at once, as far as QUIC takes them.
    for from in (0..MANY).step_by(PART as usize) {
        let to = MANY.min(from + PART);
        let graph = GraphUpdate {
            version: to.into(),
            before: from.into(),
            added: (from..to).map(long).collect(),
            more: to < MANY,
            ..GraphUpdate::default()
        };
        world.with_raw(0, |raw, _| raw.links[number].say(&LinkMessage::Graph(graph)));
    }
    let heard = |world: &World| world.hosts[0].heard_endpoints();
    let (before, start) = (world.hosts[0].handled(), world.now);
    let (mut due, mut last, mut longest) = (start, start, Duration::ZERO);
    let mut most = 0;
    while heard(&world) < u64::from(MANY) || world.now < start + secs(1) {
        assert!(world.now < start + secs(30), "{} came: {}", heard(&world), world.describe());
        if world.now >= due {
            due += EVERY;
            assert!(world.publish(pair, 100));
        }
        let (samples, passes, handled) =
            (world.received(pair).len(), world.passes[0], world.hosts[0].handled());
        match world.next() {
            Some(at) if at <= due => world.run_one(),
            _ => world.run_until(due),
        }
        let passes = (world.passes[0] - passes).max(1);
        let handled = world.hosts[0].handled() - handled;
        most = most.max(handled / passes as usize);
        if world.received(pair).len() > samples {
            longest = longest.max(world.now - last);
            last = world.now;
        }
    }
    longest = longest.max(world.now - last);
    let samples = world.received(pair).len();
    let all = world.hosts[0].handled() - before;
    println!(
        "{} MB handled, {} in one pass; {samples} samples, each within {longest:?}",
        all / 1_000_000,
        most / 1_000_000
    );
    assert!(all > 5 * ONE, "it was handled as long messages are");
    assert!(most <= ONE, "one message in a pass: others have their turn");
    assert!(longest <= 3 * EVERY, "{longest:?} without a sample");
    assert!(world.raws[0].links[number].closed.is_none(), "{}", world.describe());
}
