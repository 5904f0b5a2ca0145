//! Tests address changes under a link: a NAT rebinds, or a host gets another address.
//!
//! quinn-proto 0.11.19 has a debug assertion that fails when the loss timer of a server expires after the client's
//! address changed: the new path has nothing in flight, and the timer is the old path's. Without debug assertions it
//! sends one probe. So these tests run only in release: `cargo xtask simulate --scenarios`.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::{Config, KeyMode, Security};

use crate::engine::{
    keyring::tests::config as qkd,
    sim::{
        network::{Filtering, Path},
        tests::{millis, modes, secs},
        world::{Pair, World},
    },
};

/// Two linked hosts with samples in both directions; the first is behind a NAT, if so.
struct Moving {
    world: World,
    pairs: [Pair; 2],
    nat: Option<crate::engine::sim::network::NatId>,
    published: [u64; 2],
}

impl Moving {
    fn new(seed: u64, config: &dyn Fn(usize) -> Config, nat: Option<Filtering>) -> Self {
        let mut world = World::new(seed, 2, config);
        world.network.set_default_path(Path { delay: millis(5), ..Path::default() });
        let nat = nat.map(|filtering| {
            let outer = [203, 0, 113, 1].into();
            let nat = world.network.add_nat(outer, filtering, Some(secs(30)));
            let inner = world.hosts[0].address;
            world.network.put_behind(inner, nat);
            nat
        });
        let pairs =
            [world.pair(0, 1, "/out", Qos::keep_all()), world.pair(1, 0, "/in", Qos::keep_all())];
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        Self { world, pairs, nat, published: [0; 2] }
    }

    /// Publishes in both directions for so long.
    fn publish(&mut self, time: Duration) {
        let end = self.world.now + time;
        while self.world.now < end {
            self.publish_one();
            self.world.run_for(millis(20));
        }
    }

    /// Publishes one sample in each direction.
    fn publish_one(&mut self) {
        for (pair, published) in self.pairs.iter().zip(&mut self.published) {
            *published += u64::from(self.world.publish(*pair, 500));
        }
    }

    /// Publishes a sample in each direction every millisecond, for `milliseconds`.
    fn publish_each(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds {
            self.publish_one();
            self.world.run_for(millis(1));
        }
    }

    fn downs(&self) -> usize {
        let refusals = self.world.hosts.iter().flat_map(|host| &host.refusals);
        refusals.filter(|(_, text)| text.starts_with("down")).count()
    }

    /// Checks that all published samples arrive, in order and once.
    fn is_complete(&mut self, case: &str) {
        self.world.run_for(secs(10));
        for (pair, published) in self.pairs.iter().zip(self.published) {
            let expected: Vec<u64> = (1..=published).collect();
            let received = self.world.received(*pair);
            assert_eq!(received, expected, "{case}: {}", self.world.describe());
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn a_nat_that_rebinds_loses_no_sample_and_no_link() {
    for (mode, config) in modes() {
        for filtering in [Filtering::EndpointIndependent, Filtering::AddressAndPortDependent] {
            let mut moving = Moving::new(40, &config, Some(filtering));
            let nat = moving.nat.unwrap();
            for (number, outer) in [None, Some(2), None, None, Some(3)].into_iter().enumerate() {
                let outer = outer.map(|last| [203, 0, 113, last].into());
                moving.world.network.rebind(nat, outer);
                // At once, after the loss timer, and after the link was probed for silence.
                moving.publish(millis(40 * 8u64.pow(number as u32 % 3)));
            }
            let case = format!("{mode}, {filtering:?}");
            moving.is_complete(&case);
            assert_eq!(moving.downs(), 0, "{case}: {}", moving.world.describe());
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn a_nat_whose_mapping_ends_while_nothing_is_published_keeps_the_link() {
    let mut moving =
        Moving::new(41, &crate::engine::sim::tests::classic, Some(Filtering::EndpointIndependent));
    let nat = moving.nat.unwrap();
    for _ in 0..4 {
        moving.world.run_for(secs(45));
        moving.publish(millis(200));
        moving.world.network.rebind(nat, None);
    }
    moving.is_complete("quiet");
    assert_eq!(moving.downs(), 0, "{}", moving.world.describe());
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn a_host_that_gets_another_address_is_linked_again() {
    for (mode, config) in modes() {
        for host in 0..2 {
            let mut moving = Moving::new(42, &config, None);
            for _ in 0..3 {
                moving.world.move_host(host);
                moving.publish(secs(2));
            }
            moving.world.run_for(secs(40));
            let case = format!("{mode}, host {host}");
            assert!(moving.world.is_whole(), "{case}: {}", moving.world.describe());
            let before = moving.published;
            moving.publish(secs(1));
            moving.world.run_for(secs(2));
            moving.world.check_losses(&case);
            for ((pair, before), published) in moving.pairs.iter().zip(before).zip(moving.published)
            {
                let expected: Vec<u64> = (before + 1..=published).collect();
                let received = moving.world.received(*pair);
                assert!(received.ends_with(&expected), "{case}: {}", moving.world.describe());
            }
            println!("{case} moves three times: {} links ended", moving.downs());
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn two_hosts_that_get_other_addresses_at_once_flow_again_soon_and_lose_nothing() {
    for (mode, config) in modes() {
        let mut moving = Moving::new(43, &config, None);
        for _ in 0..3 {
            (0..2).for_each(|host| moving.world.move_host(host));
            // Neither host knows where to probe until the other's beacons give the new address.
            moving.publish(secs(10));
        }
        moving.is_complete(mode);
        assert_eq!(moving.downs(), 0, "{mode}: {}", moving.world.describe());
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn an_endpoint_that_ends_while_its_daemons_predecessor_is_not_given_up_leaves_nothing() {
    let mut world = World::new(44, 2, crate::engine::sim::tests::classic);
    let pair = world.pair(0, 1, "/out", Qos::keep_all());
    world.until(secs(20), World::is_whole);
    // No process at the old address can answer that the daemon is gone, and in `none` the address identifies the owner
    // of endpoints.
    world.move_host(1);
    world.kill(1, false);
    world.restart(1);
    world.until(secs(5), World::is_linked);
    world.run_for(secs(1));
    world.hosts[1].rings.end(pair.subscription.1);
    world.hosts[1].touch_graph();
    world.until(secs(5), World::is_whole);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn two_hosts_that_swap_addresses_resume_with_a_third_without_loss() {
    for (mode, config) in modes() {
        let mut world = World::new(45, 3, &config);
        let pairs = [(0, 1, "/a"), (2, 0, "/b"), (1, 2, "/c")]
            .map(|(from, to, topic)| world.pair(from, to, topic, Qos::keep_all()));
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        // Each of the two answers the probes that are sent to the old address of the other.
        world.swap_hosts(1, 2);
        for _ in 0..100 {
            pairs.iter().for_each(|pair| assert!(world.publish(*pair, 500), "the history is full"));
            world.run_for(millis(100));
        }
        world.run_for(secs(10));
        for pair in pairs {
            let expected: Vec<u64> = (1..=100).collect();
            assert_eq!(world.received(pair), expected, "{mode}: {}", world.describe());
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a debug assertion of quinn-proto fails")]
fn superseded_link_on_a_cut_path_holds_nothing_up_for_long() {
    for mode in [KeyMode::Session, KeyMode::Messages10] {
        let config = |host: usize| {
            let mut config = qkd(&format!("sae-{host}"), mode);
            if let Security::Qkd(qkd) = &mut config.security {
                // The successor is dialled after 900 s.
                qkd.session_max_age = secs(1000);
            }
            config
        };
        for after in 0..16 {
            let mut moving = Moving::new(46, &config, None);
            moving.world.run_until(millis(899_500));
            // Samples are under way on the old link when the successor takes over, and when both hosts move.
            while moving.world.hosts[0].leaving() == 0 && moving.world.hosts[1].leaving() == 0 {
                moving.publish_each(1);
                assert!(moving.world.now < secs(920), "no successor: {}", moving.world.describe());
            }
            moving.publish_each(after);
            (0..2).for_each(|host| moving.world.move_host(host));
            moving.publish(secs(3));
            moving.world.run_for(secs(25));
            for (pair, published) in moving.pairs.iter().zip(moving.published) {
                let expected: Vec<u64> = (1..=published).collect();
                let received = moving.world.received(*pair);
                assert_eq!(received, expected, "{mode:?}, {after} ms: {}", moving.world.describe());
            }
        }
    }
}
