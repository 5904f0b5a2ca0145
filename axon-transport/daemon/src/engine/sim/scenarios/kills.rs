//! Tests a daemon that is killed at each boundary of a link's life: after each pass of dial, HELLO, proof, election,
//! the hand-over to a successor with its drain, and an orderly end. In a pass one host handles one datagram, answer or
//! timer. A rate on the path separates the datagrams.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::{Config, KeyMode, Security};

use crate::engine::keyring::tests::config as qkd;
use crate::engine::sim::{
    network::{Path, Rate},
    tests::{all_cases, classic, millis, modes, secs},
    world::{Pair, World},
};

/// Between two datagrams on the path, so that each is a pass of its own.
const APART: Duration = Duration::from_micros(500);
/// Divisor of the number of cases in a sample.
const SAMPLE: u64 = 9;

fn start(seed: u64, config: &dyn Fn(usize) -> Config) -> (World, Pair) {
    let mut world = World::new(seed, 2, config);
    let rate = Rate::new((1500.0 / APART.as_secs_f64()) as u64, millis(100));
    world.network.set_default_path(Path { delay: millis(2), rate: Some(rate), ..Path::default() });
    let pair = world.pair(0, 1, "/t", Qos::keep_all());
    (world, pair)
}

/// Kills a host, and one that ends, and starts them again. All has to be as before: the hosts link, and samples arrive
/// in order.
fn recovers(world: &mut World, pair: Pair, (host, ends): (usize, Option<usize>), case: &str) {
    world.kill(host, false);
    world.run_for(millis(300));
    world.restart(host);
    if let Some(ends) = ends.filter(|ends| *ends != host) {
        world.kill(ends, false);
        world.restart(ends);
    }
    let end = world.now + secs(40);
    while !world.is_whole() {
        assert!(world.now < end, "{case}: not whole again: {}", world.describe());
        world.run_for(millis(10));
    }
    world.run_for(secs(1));
    let last = world.received(pair).last().copied();
    let before = world.hosts[pair.publisher.0].rings.published(pair.publisher.1);
    (0..5).for_each(|_| assert!(world.publish(pair, 100), "{case}: {}", world.describe()));
    world.run_for(secs(2));
    let received = world.received(pair);
    let expected: Vec<u64> = (before + 1..=before + 5).collect();
    assert!(received.ends_with(&expected), "{case}, {last:?}: {received:?} {}", world.describe());
    world.check_losses(case);
}

/// Runs to the end, and then again with each host killed after each of its passes. One `ends` in order meanwhile.
fn at_each_pass(
    name: &str,
    ends: Option<usize>,
    make: impl Fn() -> (World, Pair),
    is_over: impl Fn(&World, Duration) -> bool,
) {
    for host in 0..2 {
        let (mut world, _) = make();
        let (began, first) = (world.now, world.passes[host]);
        while !is_over(&world, began) {
            world.run_one();
        }
        let passes = world.passes[host] - first;
        let step = if all_cases() { 1 } else { SAMPLE };
        for kill_after in (0..=passes).step_by(step as usize) {
            let (mut world, pair) = make();
            let began = world.now;
            while world.passes[host] - first < kill_after && !is_over(&world, began) {
                world.run_one();
            }
            let case = format!("{name}, host {host}, pass {kill_after}");
            recovers(&mut world, pair, (host, ends), &case);
        }
        println!("{name}: host {host} is killed after each of {passes} passes, by steps of {step}");
    }
}

#[test]
fn a_daemon_killed_between_dial_and_election_links_again() {
    for (mode, config) in modes() {
        let make = || start(30, &config);
        at_each_pass(mode, None, make, |world, _| world.is_whole());
    }
}

#[test]
fn a_daemon_killed_while_a_successor_takes_over_links_again() {
    for mode in [KeyMode::Session, KeyMode::Messages10] {
        let config = |host: usize| {
            let mut config = qkd(&format!("sae-{host}"), mode);
            if let Security::Qkd(qkd) = &mut config.security {
                // The successor is dialled after 30 s.
                qkd.session_max_age = secs(40);
            }
            config
        };
        let make = || {
            let (mut world, pair) = start(31, &config);
            world.until(secs(10), World::is_whole);
            world.run_until(millis(29_900));
            // Some of it is under way on the old link.
            (0..20).for_each(|_| assert!(world.publish(pair, 3000)));
            world.run_until(millis(29_950));
            (world, pair)
        };
        // The old link closes within 5 s at the latest.
        let name = format!("successor, {mode:?}");
        at_each_pass(&name, None, make, |world, began| world.now > began + secs(2));
    }
}

#[test]
fn a_daemon_killed_while_it_or_its_peer_ends_in_order_links_again() {
    for (mode, config) in modes() {
        for ends in 0..2 {
            let make = || {
                let (mut world, pair) = start(32, &config);
                world.until(secs(10), World::is_whole);
                world.run_for(secs(1));
                (0..20).for_each(|_| assert!(world.publish(pair, 3000)));
                world.run_for(millis(5));
                world.close(ends);
                (world, pair)
            };
            let name = format!("{mode}, host {ends} ends");
            at_each_pass(&name, Some(ends), make, |world, began| world.now > began + millis(100));
        }
    }
}

#[test]
fn keep_all_outlasts_a_killed_daemon_of_the_subscription() {
    for (mode, config) in modes() {
        for (down, samples) in [(millis(200), 300), (secs(3), 100)] {
            let mut world = World::new(90, 2, &config);
            let pair = world.pair(0, 1, "/t", Qos::keep_all());
            world.until(secs(10), World::is_whole);
            world.run_for(secs(1));
            let mut published = 0;
            for number in 0..samples {
                if number == samples / 4 {
                    world.kill(1, false);
                }
                let sent = world.publish(pair, 500);
                published += u64::from(sent);
                world.run_for(down / (samples / 4));
                if number == samples / 2 {
                    world.restart(1);
                }
            }
            world.run_for(secs(15));
            let case = format!("{mode}, {down:?}");
            let received = world.received(pair);
            assert!(received.into_iter().eq(1..=published), "{case}: {}", world.describe());
        }
    }
}

/// Returns the numbers of ordered dials and of calls to the KMEs.
fn costs(world: &World) -> (u64, usize) {
    (world.hosts[0].dials(), world.kmes.asked.len())
}

#[test]
fn daemons_that_had_successors_at_their_address_are_not_dialled_again_and_again() {
    for (mode, config) in modes() {
        let mut world = World::with_beacons(91, 2, &config);
        world.until(secs(10), World::is_linked);
        let (first_dials, first_asked) = costs(&world);
        for succession in 1..=20 {
            world.run_for(secs(2));
            world.kill(1, false);
            world.run_for(millis(100 * (succession % 4)));
            let (dials_before, asked_before) = costs(&world);
            world.restart(1);
            world.until(secs(20), World::is_linked);
            world.run_for(secs(2));
            let (dials, asked) = costs(&world);
            let case = format!("{mode}, {succession}: {dials} dials, {asked} KME calls");
            // One dial of the new daemon, and one of the daemon before it.
            assert!(
                dials <= dials_before + 2,
                "{case}, {dials_before} before: {}",
                world.describe()
            );
            if mode == "session" {
                let most = 3 * (first_asked + 4);
                assert!(asked <= asked_before + most, "{case}, {asked_before} before");
            }
        }
        let before = costs(&world);
        world.run_for(secs(20));
        println!("{mode}: {first_dials} and {first_asked} for the first link, {before:?} in all");
        let after = costs(&world);
        assert_eq!(after.0, before.0, "{mode}: nobody is dialled once all is quiet");
        assert!(mode == "messages10" || after.1 == before.1, "{mode}: {after:?}, {before:?}");
    }
}

#[test]
fn a_host_that_claims_the_id_of_another_one_ends_no_dials_to_that_one() {
    let mut world = World::with_beacons(92, 3, classic);
    let honest = world.hosts[1].daemon;
    world.until(secs(10), World::is_linked);
    // Beacons of the liar name the honest daemon, whose path is cut meanwhile.
    let cuts = [(0, 1), (1, 0)].map(|(from, to)| world.network.cut(&[from], &[to], None));
    world.run_for(secs(150));
    assert!(!world.hosts[0].linked().contains(&honest));
    for _ in 0..40 {
        let liar = world.hosts[2].address;
        world.hosts[0].want(honest, liar, None, world.now);
        world.tell(0, 1);
        world.run_for(secs(1));
    }
    cuts.into_iter().for_each(|cut| world.network.heal(cut));
    world.until(secs(20), World::is_linked);
}
