//! A host whose daemon claims the id of another host's.

use axon_shm::qos::Qos;

use crate::engine::sim::{
    tests::{Settings, modes, secs},
    world::World,
};

/// Creates a world in which host 2 claims the id of host 1 towards host 0. No host has dialled yet.
fn world(seed: u64, config: &Settings) -> World {
    let mut world = World::apart(seed, 3, config);
    world.kill(2, false);
    world.hosts[2].poses_as = Some(world.hosts[1].daemon);
    let now = world.now;
    world.hosts[2].start(now);
    world
}

fn is_linked(world: &World, host: usize, with: usize) -> bool {
    world.hosts[host].linked().contains(&world.hosts[with].daemon)
}

/// Checks that samples cross from host 1 to host 0 for half a minute, and that host 0 reports the claim.
fn goes_on(mut world: World, case: &str) {
    let pair = world.pair(1, 0, "/t", Qos::keep_all());
    world.run_for(secs(5));
    for _ in 0..30 {
        assert!(world.publish(pair, 100), "{case}");
        world.run_for(secs(1));
    }
    let all: Vec<_> = (1..=30).collect();
    assert_eq!(world.received(pair), all, "{case}: {}", world.describe());
    let told =
        |text: &String| text.contains("claims daemon id") && text.contains("which proved it");
    let refusals: Vec<_> = world.hosts[0].refusals.iter().map(|(_, text)| text).collect();
    assert!(refusals.iter().any(|text| told(text)), "{case}: {refusals:?}");
    let flaps = world.hosts[1].refusals.iter().filter(|(_, text)| text.starts_with("down"));
    assert_eq!(flaps.count(), 0, "{case}: {}", world.describe());
}

#[test]
fn a_claim_that_comes_first_does_not_keep_the_owner_out() {
    for (mode, config) in modes() {
        for seed in 130..134 {
            let case = format!("{mode}, seed {seed}");
            let mut world = world(seed, &config);
            world.tell(2, 0);
            world.until(secs(5), |world| is_linked(world, 2, 0) && is_linked(world, 0, 1));
            world.run_for(secs(2));
            world.tell(1, 0);
            world.until(secs(5), |world| is_linked(world, 1, 0));
            goes_on(world, &case);
        }
    }
}

#[test]
fn a_claim_that_comes_later_takes_nothing_away() {
    for (mode, config) in modes() {
        for seed in 140..144 {
            let case = format!("{mode}, seed {seed}");
            let mut world = world(seed, &config);
            world.tell(1, 0);
            world.until(secs(5), |world| is_linked(world, 1, 0) && is_linked(world, 0, 1));
            world.tell(2, 0);
            goes_on(world, &case);
        }
    }
}

#[test]
fn a_claim_made_at_the_same_time_takes_nothing_away() {
    for (mode, config) in modes() {
        for seed in 150..158 {
            let case = format!("{mode}, seed {seed}");
            let mut world = world(seed, &config);
            // With even seeds the owner of the id sends its first packet before the impostor, with odd ones after it.
            for host in if seed % 2 == 0 { [1, 2] } else { [2, 1] } {
                world.tell(host, 0);
            }
            goes_on(world, &case);
        }
    }
}

#[test]
fn a_claim_made_while_the_owner_is_cut_off_ends_when_it_is_back() {
    for (mode, config) in modes() {
        let mut world = world(160, &config);
        world.tell(1, 0);
        world.until(secs(5), |world| is_linked(world, 1, 0) && is_linked(world, 0, 1));
        let cut = world.network.partition(&[1], None);
        world.tell(2, 0);
        // The owner's link ends after 120 s, and the other one's begins.
        world.run_for(secs(140));
        assert!(!is_linked(&world, 1, 0), "{mode}: {}", world.describe());
        assert!(is_linked(&world, 2, 0) && is_linked(&world, 0, 1), "{mode}");
        world.network.heal(cut);
        world.until(secs(20), |world| is_linked(world, 1, 0));
        world.hosts[1].refusals.clear();
        goes_on(world, mode);
    }
}
