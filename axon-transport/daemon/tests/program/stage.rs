//! The processes of a program, and the checks of their state after each step.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::Write as _,
    time::{Instant, SystemTime},
};

use serde::de::DeserializeOwned;

use super::{
    model::{Modelled, RING},
    orders::{Described, Kind, Order, Own, State},
    support::{Host, PATIENCE, Player, excerpt::excerpt},
};

pub(super) const PROCESSES: usize = 3;
/// Nanoseconds by which slow clocks are slow.
pub(super) const SLOW: i64 = 2 * 3600 * 1_000_000_000;

/// A random number generator of this test, so that a seed determines a program.
pub(super) struct Dice(u64);

impl Dice {
    pub(super) fn roll(&mut self, sides: u64) -> u64 {
        // SplitMix64.
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % sides
    }

    pub(super) fn one_of<T: Clone>(&mut self, of: &[T]) -> T {
        of[self.roll(of.len() as u64) as usize].clone()
    }

    pub(super) fn process(&mut self) -> usize {
        self.roll(PROCESSES as u64) as usize
    }
}

/// The processes, and the model of their state.
pub(super) struct Stage {
    pub(super) host: Host,
    pub(super) players: Vec<Player>,
    pub(super) model: BTreeMap<u64, Modelled>,
    /// Bytes that each publisher published, including publishers that are gone.
    pub(super) published: BTreeMap<String, u64>,
    next: u64,
    /// The last source time by a correct clock.
    pub(super) clock: i64,
    pub(super) calls: u64,
    pub(super) dice: Dice,
    /// The situations that occurred, with their counts.
    pub(super) sights: BTreeMap<String, u64>,
    orders: Vec<String>,
}

impl Stage {
    pub(super) fn new(seed: u64) -> Self {
        let ring = (RING >> 20).to_string();
        let host = Host::new().with("AXON_LOG", "error").with("AXON_RING_BUFFER_SIZE_MB", &ring);
        let players = (0..PROCESSES).map(|_| Self::player(&host)).collect();
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
        let clock = i64::try_from(now.as_nanos()).unwrap();
        let (model, published, sights) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        let (next, calls, dice, orders) = (0, 0, Dice(seed), Vec::new());
        Self { host, players, model, published, next, clock, calls, dice, sights, orders }
    }

    pub(super) fn player(host: &Host) -> Player {
        let mut player = host.play("program");
        assert_eq!(player.hear(), "ready");
        player
    }

    pub(super) fn saw(&mut self, what: impl Into<String>) {
        *self.sights.entry(what.into()).or_default() += 1;
    }

    /// Sends an order to a process, and returns the answer.
    pub(super) fn ask<T: DeserializeOwned>(&mut self, process: usize, order: &Order) -> T {
        let line = serde_json::to_string(order).unwrap();
        if !matches!(order, Order::State) {
            self.orders.push(format!("{process}: {line}"));
        }
        let player = &mut self.players[process];
        let mut input = player.child.0.stdin.as_ref().unwrap();
        writeln!(input, "{line}").unwrap();
        serde_json::from_str(&player.hear()).unwrap()
    }

    pub(super) fn pick(&mut self, which: impl Fn(&Modelled) -> bool) -> Option<u64> {
        let which = self.model.iter().filter(|(_, m)| which(m));
        let ids: Vec<u64> = which.map(|(id, _)| *id).collect();
        (!ids.is_empty()).then(|| self.dice.one_of(&ids))
    }

    /// Picks one that is `best`, or else any.
    pub(super) fn pick_best(
        &mut self,
        which: impl Fn(&Modelled) -> bool,
        best: impl Fn(&Modelled) -> bool,
    ) -> Option<u64> {
        self.pick(|m| which(m) && best(m)).or_else(|| self.pick(which))
    }

    /// Creates a node or an endpoint, and records its relations to all existing ones.
    pub(super) fn make(
        &mut self,
        process: usize,
        by: Option<u64>,
        what: Described,
        slow: bool,
    ) -> u64 {
        let id = self.next;
        self.next += 1;
        let order = Order::Create { id, by, what: Box::new(what.clone()) };
        let gid: String = self.ask(process, &order);
        self.published.insert(gid.clone(), 0);
        let mut new = Modelled::new(gid, process, what, slow);
        let mut sights = BTreeSet::new();
        for other in self.model.values_mut() {
            let relation = new.relation(other);
            sights.extend(relation.sights());
            new.meet(&relation, true);
            other.meet(&relation, false);
            if new.is(Kind::Subscription) && new.matches(other) {
                new.join(other);
            }
        }
        if !new.owed.is_empty() {
            sights.insert("late joiner with history".to_owned());
        }
        sights.into_iter().for_each(|sight| self.saw(sight));
        self.model.insert(id, new);
        id
    }

    /// Waits until every process sees the state of the model.
    pub(super) fn settle(&mut self) {
        let graph = self.model.values().map(|m| (m.gid.clone(), m.what.clone()));
        let graph: BTreeMap<String, Described> = graph.collect();
        let deadline = Instant::now() + PATIENCE;
        for process in 0..PROCESSES {
            let ours = self.model.iter().filter(|(_, m)| m.process == process);
            let own: BTreeMap<u64, Own> = ours
                .filter(|(_, m)| !m.is(Kind::Node))
                .map(|(id, m)| {
                    let partners = self.model.values().filter(|other| m.matches(other));
                    (*id, m.sees(partners.map(|other| other.gid.clone()).collect()))
                })
                .collect();
            let expected = State { graph: graph.clone(), own };
            loop {
                let mut seen: State = self.ask(process, &Order::State);
                let named = seen.own.iter_mut().all(|(id, own)| {
                    let policy = own.reported.as_mut().and_then(|all| all.policy.take());
                    self.model.get(id).is_some_and(|m| m.may_name(policy.as_ref()))
                });
                if seen == expected && named {
                    break;
                }
                assert!(
                    Instant::now() < deadline,
                    "{process} sees\n{seen:#?}\n(policies: {named}), not\n{expected:#?}"
                );
                std::thread::sleep(std::time::Duration::from_millis(2));
            }
        }
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let told = excerpt("what the processes were told", &self.orders.join("\n"));
            eprintln!("{told}");
        }
    }
}
