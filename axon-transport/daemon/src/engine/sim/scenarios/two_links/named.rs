//! Single lies of a daemon with two links, in each mode.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use axon_shm::qos::Qos;

use super::{
    LIAR, Lying, Role, TWO_PATHS, VICTIM,
    acts::{Act, Name, Pose},
};
use crate::engine::sim::tests::{modes, secs};

/// The dials that the victim begins in five minutes because of a liar, and the KME keys that it draws for them. Each
/// side has 32 dials at once, and one more each five seconds.
const DIALS: u64 = 32 + 60 + 5;
/// Keys for the messages of five minutes, 1,500 of them, and ten for each new link.
const MESSAGE_KEYS: u64 = 150 + 10 * 2 * DIALS;

impl Lying {
    /// Checks that the samples of the liar arrived, too.
    fn liar_is_complete(&mut self) {
        self.run(3000);
        for pair in self.of_liar {
            let (host, publisher) = pair.publisher;
            let published = self.world.hosts[host].rings.published(publisher);
            let received = self.world.received(pair);
            // Those before the link have no reader.
            let is_whole = received.iter().copied().eq(received[0]..=received[received.len() - 1]);
            let is_new = received.last().is_some_and(|last| last + 1 >= published);
            assert!(is_whole && is_new, "{pair:?}: {}", self.text());
        }
    }
}

#[test]
fn switches_at_random_instants_lose_nothing_of_the_liar_either() {
    for (mode, config) in modes() {
        let mut lying = Lying::new(1, mode, &config);
        for round in 0..40 {
            lying.act(&Act::Switch);
            lying.run(50 + 37 * round % 400);
        }
        lying.liar_is_complete();
        lying.liar_leaves();
    }
}

#[test]
fn link_in_use_that_ends_at_each_switch_harms_nobody() {
    for (mode, config) in modes() {
        let mut lying = Lying::new(2, mode, &config);
        for round in 0..20 {
            lying.act(&Act::SwitchAndEnd);
            lying.run(200 + 100 * round % 1500);
        }
        lying.liar_leaves();
    }
}

#[test]
fn switch_flood_harms_nobody() {
    for (mode, config) in modes() {
        for seed in 3..5 {
            let mut lying = Lying::new(seed, mode, &config);
            let (begun, keys) = (lying.begun(), lying.keys());
            // A link stands by as soon as a handshake is complete, and is put in use at once.
            for instant in 0..2000 {
                if lying.roles(Role::Standby).is_some() {
                    lying.act(&Act::Switch);
                } else if instant % 4 == 0 {
                    let path = instant / 4 % 2;
                    lying.dial([Name::Own(Role::InUse), Name::None], path, Pose::Liar);
                }
                lying.run(1);
            }
            let connections = lying.begun().0 - begun.0;
            let dials = lying.begun().1 - begun.1;
            let (sessions, messages) = (lying.keys().0 - keys.0, lying.keys().1 - keys.1);
            println!(
                "{mode}: {connections} connections, {dials} dials of the victim, {sessions} and {messages} keys in 2 s"
            );
            // The victim dials each lost second link, and no more.
            assert!(
                dials <= 40 && sessions <= dials + connections,
                "{mode}: {dials} dials, {sessions} keys"
            );
            lying.liar_leaves();
        }
    }
}

#[test]
fn second_links_that_end_again_and_again_cost_the_victim_few_dials_and_keys() {
    for (mode, config) in modes() {
        for (seed, switches) in [(10, false), (11, true)] {
            let mut lying = Lying::new(seed, mode, &config);
            (lying.every, lying.step) = (200, 50);
            let (begun, keys) = (lying.begun(), lying.keys());
            let start = lying.world.now;
            while lying.world.now < start + secs(300) {
                lying.run(50);
                if lying.roles(Role::Standby).is_some() {
                    // It stands for long enough to count as a success of the victim's dial.
                    lying.run(1050);
                    if switches {
                        lying.act(&Act::Switch);
                    } else {
                        lying.act(&Act::End(Role::Standby));
                    }
                }
            }
            let connections = lying.begun().0 - begun.0;
            let dials = lying.begun().1 - begun.1;
            let (sessions, messages) = (lying.keys().0 - keys.0, lying.keys().1 - keys.1);
            println!(
                "{mode}, {switches}: {connections} connections, {dials} dials of the victim, {sessions} and {messages} \
                 keys in 300 s"
            );
            assert!(connections <= 2 * DIALS, "{mode}, {switches}: {connections} connections");
            assert!(dials <= DIALS, "{mode}, {switches}: {dials} dials");
            assert!(sessions <= 3 * DIALS, "{mode}, {switches}: {sessions} keys");
            assert!(messages <= MESSAGE_KEYS, "{mode}, {switches}: {messages} keys of messages");
            lying.every = 10;
            lying.step = 5;
            lying.liar_leaves();
        }
    }
}

#[test]
fn liar_that_takes_nothing_and_switches_holds_no_publisher_up_for_long() {
    const MANY: u64 = 1000;
    for (mode, config) in modes() {
        let mut lying = Lying::new(20, mode, &config);
        let qos = Qos::keep_all();
        let shared = lying.world.pair(VICTIM, TWO_PATHS, "/shared", qos);
        lying.world.hosts[LIAR].rings.create_subscription("/shared", qos, Some(1));
        lying.world.hosts[LIAR].touch_graph();
        lying.graph_from = lying.world.now + secs(1);
        lying.run(1000);
        let (start, mut published) = (lying.world.now, 0);
        while published < MANY {
            assert!(lying.world.now < start + secs(85), "{published}: {}", lying.text());
            published += u64::from(lying.world.publish(shared, 100));
            lying.run(50);
            if published.is_multiple_of(8) {
                lying.act(&Act::Switch);
            }
        }
        lying.run(5000);
        assert!(lying.world.received(shared).into_iter().eq(1..=MANY), "{}", lying.text());
        lying.liar_leaves();
    }
}
