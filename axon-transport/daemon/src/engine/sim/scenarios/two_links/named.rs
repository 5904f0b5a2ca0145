//! Single lies of a daemon with two links, in each mode.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use axon_shm::qos::Qos;

use super::{
    LIAR, Lying, Role, TWO_PATHS, VICTIM,
    acts::{Act, Name, Pose},
};
use crate::engine::sim::{
    tests::{Settings, all_cases, classic, modes, secs},
    world::World,
};

/// The dials that the victim begins in five minutes because of a liar, and the KME keys that it draws for them. Each
/// side has 32 dials at once, and one more each five seconds.
const DIALS: u64 = 32 + 60 + 5;
/// Keys for the messages of five minutes, 1,500 of them, and ten for each new link.
const MESSAGE_KEYS: u64 = 150 + 10 * 2 * DIALS;

/// The mode in which `cargo test` plays most of the lies.
const ONE_MODE: &str = "messages10";

/// Returns all modes, or this one for the sample of `cargo test`.
fn sample(mode: &str) -> Vec<(&'static str, Settings)> {
    let mut all = modes();
    all.retain(|(name, _)| all_cases() || *name == mode);
    all
}

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
    for (mode, config) in sample(ONE_MODE) {
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
fn link_in_use_that_ends_at_each_switch_harms_no_other_peer() {
    for (mode, config) in sample(ONE_MODE) {
        let mut lying = Lying::new(2, mode, &config);
        for round in 0..20 {
            lying.act(&Act::SwitchAndEnd);
            lying.run(200 + 100 * round % 1500);
        }
        lying.liar_leaves();
    }
}

/// Take-overs that a peer may cause in two seconds: eight at once, then one each second.
const TAKE_OVERS: usize = 8 + 2;

/// Makes the liar dial for two seconds as often as it can, and put each link in use at once.
fn flood(seed: u64, (mode, config): &(&str, Settings), beside: bool) {
    let mut lying = Lying::new(seed, mode, config);
    // Take-overs of the beginning count no more.
    lying.run(10_000);
    let elects = lying.world.hosts[LIAR].daemon < lying.victim_daemon();
    lying.case = format!("{mode}, seed {seed}, beside: {beside}, elects: {elects}");
    let (begun, keys) = (lying.begun(), lying.keys());
    let (mut in_use, mut take_overs) = (lying.victims_link(), 0);
    for instant in 0..2000 {
        let own = Name::Own(Role::InUse);
        if beside && lying.roles(Role::Standby).is_some() {
            lying.act(&Act::Switch);
        } else if instant % 4 == 0 {
            let names = if beside { [own, Name::None] } else { [Name::None, own] };
            lying.dial(names, instant / 4 % 2, Pose::Liar);
        }
        lying.run(1);
        // The liar may end its link in use, too.
        let now = lying.victims_link().or(in_use);
        take_overs += usize::from(now != in_use);
        in_use = now;
    }
    let connections = lying.begun().0 - begun.0;
    let dials = lying.begun().1 - begun.1;
    let (sessions, messages) = (lying.keys().0 - keys.0, lying.keys().1 - keys.1);
    println!(
        "{}: {take_overs} take-overs, {connections} connections, {dials} dials of the victim, {sessions} and \
         {messages} keys in 2 s",
        lying.case
    );
    assert!(take_overs <= TAKE_OVERS, "{take_overs} take-overs: {}", lying.text());
    assert!(take_overs > 0, "{take_overs} take-overs: {}", lying.text());
    // The victim dials each lost second link, and no more.
    assert!(
        dials <= 40 && sessions <= dials + connections,
        "{mode}: {dials} dials, {sessions} keys"
    );
    // The links that waited end, or take over one after the other. Then samples arrive again.
    lying.run(15_000);
    let [from_liar, _] = lying.of_liar;
    let before = lying.world.received(from_liar).len();
    lying.run(2000);
    assert!(lying.world.received(from_liar).len() > before, "{}", lying.text());
    lying.liar_leaves();
}

/// Returns a seed with which the liar's daemon elects the links, or the victim's.
fn seed(liar_elects: bool) -> u64 {
    let elects = |seed| {
        let world = World::apart(seed, LIAR + 1, classic);
        world.hosts[LIAR].daemon < world.hosts[VICTIM].daemon
    };
    (3..).find(|seed| elects(*seed) == liar_elects).expect("seeds of either kind")
}

#[test]
fn switch_flood_costs_few_take_overs_and_harms_no_other_peer() {
    for mode in sample("classic") {
        flood(seed(false), &mode, true);
        flood(seed(true), &mode, true);
    }
}

#[test]
fn flood_of_successors_costs_few_take_overs_and_harms_no_other_peer() {
    for mode in sample("classic") {
        flood(seed(false), &mode, false);
        flood(seed(true), &mode, false);
    }
}

#[test]
fn second_links_that_end_again_and_again_cost_the_victim_few_dials_and_keys() {
    for (mode, config) in sample(ONE_MODE) {
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
    for (mode, config) in sample(ONE_MODE) {
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
