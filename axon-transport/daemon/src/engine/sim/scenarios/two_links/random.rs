//! Acts by chance, in each mode.

use axon_envelope::Kind;
use axon_shm::ids::Gid;
use rand::RngExt;

use super::{
    Lying, Role,
    acts::{Act, Name, Pose},
    copies::CopyStream,
};
use crate::engine::sim::{
    rng::{SimRng, Stream, stream},
    tests::{all_cases, modes, setting},
};

/// Acts of one run.
const ACTS: usize = 25;

/// Chooses acts.
struct Chance {
    rng: SimRng,
    /// GIDs of the liar and of honest hosts.
    gids: Vec<Gid>,
}

impl Chance {
    fn one<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.rng.random_range(0..of.len())]
    }

    fn role(&mut self) -> Role {
        self.one(&[Role::InUse, Role::Standby, Role::Standby, Role::Other])
    }

    fn name(&mut self) -> Name {
        let own = Name::Own(self.role());
        self.one(&[own, own, Name::OfOther, Name::Never, Name::Ended, Name::None])
    }

    fn copy(&mut self) -> CopyStream {
        let topic = self.one(&["/lie", "/lie", "/from_1", "/from_2", "/to_1"]);
        let of = self.one(&self.gids.clone());
        let number = self.one(&[0, 1, 2, 50, 100, 120, 10_000, 1 << 40, u64::MAX]);
        let mut copy = CopyStream::new(topic, self.rng.random_range(0..6), of, number);
        if self.rng.random_bool(0.5) {
            copy.after = self.one(&[0, 1, number, number.wrapping_add(1), 1 << 40, u64::MAX]);
        }
        if self.rng.random_bool(0.2) {
            copy.writer = self.one(&self.gids.clone());
        }
        copy.kind =
            self.one(&[Kind::Topic, Kind::Topic, Kind::Topic, Kind::Request, Kind::Response]);
        copy.length = self.one(&[0, 10, 10, 10, 1000, 4096 - 24]);
        if self.rng.random_bool(0.05) {
            copy.length = self.one(&[4096, 5000, 100_000]);
        }
        copy.is_copy = self.rng.random_bool(0.9);
        if self.rng.random_bool(0.3) {
            copy.cut = Some(self.rng.random_range(0..150));
        }
        copy
    }

    fn act(&mut self) -> Act {
        let on = self.role();
        match self.rng.random_range(0..16) {
            0 | 1 => Act::Switch,
            2 => Act::SwitchAndEnd,
            3 => Act::AskForSwitch { on, times: self.one(&[1, 2, 1000]) },
            4 => Act::Elect {
                on,
                name: self.name(),
                election: self.one(&[0, 1, u64::from(u32::MAX), u64::from(u32::MAX), u64::MAX]),
                standby: self.one(&[None, None, Some(true), Some(false)]),
                times: self.one(&[1, 1, 2, 50]),
            },
            5..=8 => Act::Dial {
                beside: if self.rng.random_bool(0.5) {
                    Name::Own(Role::InUse)
                } else {
                    self.name()
                },
                replaces: if self.rng.random_bool(0.7) { Name::None } else { self.name() },
                path: self.rng.random_range(0..2),
                pose: self.one(&[Pose::Liar, Pose::Liar, Pose::Liar, Pose::Honest, Pose::Nobody]),
            },
            9 => Act::Renew,
            10 => Act::End(on),
            11 => Act::Silence {
                path: self.rng.random_range(0..2),
                from_liar: self.rng.random_bool(0.6),
                to_liar: self.rng.random_bool(0.6),
                milliseconds: self.rng.random_range(50..700),
            },
            12 => {
                let copy = self.copy();
                let count = self.one(&[20, 200, 1000]);
                let numbers = copy.number..copy.number.saturating_add(count);
                let of = |number| CopyStream { number, ..copy.clone() };
                Act::Copies { on, copies: numbers.map(of).collect(), ends: true }
            }
            _ => {
                let count = self.rng.random_range(1..6);
                let copies = (0..count).map(|_| self.copy()).collect();
                Act::Copies { on, copies, ends: self.rng.random_bool(0.8) }
            }
        }
    }
}

/// Plays acts by chance. Panics if an honest host suffers.
fn play(seed: u64, mode: &str, lying: &mut Lying) {
    let mut gids = vec![lying.of_liar[0].publisher.1, lying.of_liar[0].publisher.1, Gid::default()];
    gids.extend(lying.honest.iter().flat_map(|pair| [pair.publisher.1, pair.subscription.1]));
    let mut chance = Chance { rng: stream(seed, Stream::Script), gids };
    for _ in 0..ACTS {
        lying.remember();
        let act = chance.act();
        lying.case = format!("{mode}, seed {seed}, {act:.0?}");
        lying.case.truncate(300);
        lying.act(&act);
        lying.run(chance.one(&[1, 1, 5, 20, 100, 400]));
    }
    lying.case = format!("{mode}, seed {seed}, the end");
}

/// Plays some seeds in a mode.
fn play_seeds(mode: &str) {
    let seeds = if all_cases() { 200 } else { 1 };
    let (first, seeds) = (setting("SIMULATE_FIRST", 1), setting("SIMULATE_SEEDS", seeds));
    let config = modes().into_iter().find(|(name, _)| *name == mode).expect("a mode").1;
    for seed in first..first + seeds {
        let mut lying = Lying::new(seed, mode, &config);
        play(seed, mode, &mut lying);
        lying.liar_leaves();
    }
}

#[test]
fn acts_by_chance_harm_no_other_peer_in_classic() {
    play_seeds("classic");
}

#[test]
fn acts_by_chance_harm_no_other_peer_in_session() {
    play_seeds("session");
}

#[test]
fn acts_by_chance_harm_no_other_peer_in_messages10() {
    play_seeds("messages10");
}
