//! The steps that a program takes.

use std::collections::{BTreeMap, BTreeSet};

use rustix::process::Signal;

use super::{
    model::{Modelled, Owed, Relation},
    orders::{Call, Described, Kind, Losses, Order, Published, Sample, Taken},
    rules::{POLICIES, Profile},
    stage::{PROCESSES, SLOW, Stage},
    support::{signal, until},
};

const HOUR: u64 = 3600;
/// Number and length of the samples of a flood: more than twice what a ring keeps.
const FLOOD: (u64, u64) = (1000, 20_000);

/// The situations that a run of programs must come across, besides the policies.
pub(super) const SIGHTS: [&str; 21] = [
    "create",
    "publish",
    "flood",
    "take",
    "ask",
    "answer",
    "hear",
    "wait",
    "end",
    "kill",
    "kill the daemon",
    "match",
    "another type",
    "late joiner with history",
    "sample taken from the dead",
    "sample lost",
    "sample too old",
    "publisher held back",
    "call between processes",
    "wait that finds something",
    "wait that finds nothing",
];

impl Relation {
    pub(super) fn sights(&self) -> BTreeSet<String> {
        match self {
            Self::None => BTreeSet::new(),
            Self::Match => ["match".to_owned()].into(),
            Self::Type => ["another type".to_owned()].into(),
            // If several policies mismatch, it is not specified which one is named.
            Self::Qos(policies) if policies.len() == 1 => policies.clone(),
            Self::Qos(_) => BTreeSet::new(),
        }
    }
}

/// Returns the situations and policies that a run has not come across.
pub(super) fn not_seen(sights: &BTreeMap<String, u64>) -> Vec<&'static str> {
    SIGHTS.into_iter().chain(POLICIES).filter(|sight| !sights.contains_key(*sight)).collect()
}

impl Stage {
    pub(super) fn step(&mut self) {
        let (name, done) = match self.dice.roll(100) {
            0..26 => ("create", self.create()),
            26..45 => ("publish", self.publish()),
            45..49 => ("flood", self.flood()),
            49..60 => ("take", self.take()),
            60..67 => ("ask", self.request()),
            67..74 => ("answer", self.answer()),
            74..80 => ("hear", self.hear()),
            80..87 => ("wait", self.wait()),
            87..96 => ("end", self.end()),
            96..98 => ("kill", self.kill()),
            _ => ("kill the daemon", self.kill_daemon()),
        };
        if done {
            self.saw(name);
        }
    }

    /// Takes the remaining samples.
    pub(super) fn drain(&mut self) {
        while self.model.values().any(|m| !m.owed.is_empty()) {
            self.take();
        }
        self.wait();
    }

    fn create(&mut self) -> bool {
        let process = self.dice.process();
        let kind = match self.dice.roll(20) {
            0..3 => Kind::Node,
            3..8 => Kind::Publisher,
            8..14 => Kind::Subscription,
            14..17 => Kind::Server,
            _ => Kind::Client,
        };
        let node = self.pick(|m| m.process == process && m.is(Kind::Node));
        let by = node.filter(|_| kind != Kind::Node && self.dice.roll(3) > 0);
        let mut what = self.describe(kind);
        self.suit_somebody(&mut what);
        if let Some(by) = by {
            let Described { node, namespace, .. } = &self.model[&by].what;
            (what.node, what.namespace) = (node.clone(), namespace.clone());
        }
        let slow = kind == Kind::Publisher && self.dice.roll(4) == 0;
        self.make(process, by, what, slow);
        true
    }

    /// Makes half of the new endpoints compatible with an existing one. Few random pairs are.
    fn suit_somebody(&mut self, what: &mut Described) {
        let other = match what.kind {
            Kind::Publisher => Kind::Subscription,
            Kind::Subscription => Kind::Publisher,
            Kind::Node | Kind::Server | Kind::Client => return,
        };
        if let (0, Some(other)) = (self.dice.roll(2), self.pick(|m| m.is(other))) {
            let Profile { depth, lifespan, .. } = what.profile;
            let there = &self.model[&other].what;
            let profile = Profile { depth, lifespan, ..there.profile };
            (what.topic, what.type_name) = (there.topic.clone(), there.type_name.clone());
            (what.hash, what.profile) = (there.hash.clone(), profile);
        }
    }

    fn describe(&mut self, kind: Kind) -> Described {
        let dice = &mut self.dice;
        let (number, profile) = (dice.roll(2), profile(dice));
        let text = String::new;
        let nothing = Described {
            kind,
            topic: text(),
            type_name: text(),
            hash: Vec::new(),
            profile: Profile::default(),
            node: text(),
            namespace: text(),
            enclave: text(),
        };
        match kind {
            Kind::Node => Described {
                // Several nodes may have the same name.
                node: dice.one_of(&["left", "right"]).to_owned(),
                namespace: dice.one_of(&["/", "/front", "/front/low"]).to_owned(),
                enclave: dice.one_of(&["/", "/robot"]).to_owned(),
                ..nothing
            },
            // They differ only in how much they keep, so all are compatible.
            Kind::Server | Kind::Client => Described {
                topic: format!("/s{number}"),
                type_name: "test/Echo".to_owned(),
                profile: Profile { depth: profile.depth, ..Profile::default() },
                ..nothing
            },
            // On the second topic, not all endpoints have the same type, and not all know its hash.
            Kind::Publisher | Kind::Subscription => {
                let other = number == 1 && dice.roll(5) == 0;
                let hashes = [vec![7; 32], vec![7; 32], vec![8; 32], vec![]];
                let hash = dice.one_of(&hashes);
                Described {
                    topic: format!("/t{number}"),
                    type_name: if other { "test/Other" } else { "test/Bytes" }.to_owned(),
                    hash: if number == 0 { vec![7; 32] } else { hash },
                    profile,
                    ..nothing
                }
            }
        }
    }

    fn publish(&mut self) -> bool {
        let heard = self.heard();
        let which = |m: &Modelled| m.is(Kind::Publisher);
        let Some(id) = self.pick_best(which, |m| heard.contains(&m.gid)) else { return false };
        for _ in 0..=self.dice.roll(20) {
            let len = self.dice.one_of(&[0, 8, 96, 5000, 70_000]);
            if self.publish_of(id, 1, len).blocked {
                self.saw("publisher held back");
                break;
            }
        }
        true
    }

    /// Returns the endpoints that are matched with an endpoint for which `like` holds.
    fn matched(&self, like: impl Fn(&Modelled, &Modelled) -> bool) -> BTreeSet<String> {
        let mut matched = self.model.values().collect::<Vec<_>>();
        matched.retain(|m| self.model.values().any(|other| m.matches(other) && like(m, other)));
        matched.into_iter().map(|m| m.gid.clone()).collect()
    }

    fn heard(&self) -> BTreeSet<String> {
        self.matched(|_, _| true)
    }

    /// Returns the publishers that readers may hold back.
    fn held(&self) -> BTreeSet<String> {
        self.matched(Modelled::waits_for)
    }

    fn publish_of(&mut self, id: u64, count: u64, len: u64) -> Published {
        let publisher = &self.model[&id];
        let (process, slow_by) = (publisher.process, if publisher.slow { SLOW } else { 0 });
        let stamp = self.clock + 1 - slow_by;
        self.clock += i64::try_from(count).unwrap();
        let published: Published = self.ask(process, &Order::Publish { id, stamp, count, len });
        let mut publisher = self.model.remove(&id).unwrap();
        let next = publisher.sequence + 1;
        assert_eq!(published.first, (published.count > 0).then_some(next), "numbers go up by one");
        let lifespan = publisher.what.profile.lifespan;
        // Expiry goes by age, whatever the publisher's clock says.
        let expired = lifespan == Some(0);
        for done in 0..published.count {
            let sample = Sample {
                publisher: publisher.gid.clone(),
                sequence: next + done,
                stamp: stamp + i64::try_from(done).unwrap(),
                len,
            };
            let behind = publisher.bytes;
            let sample = Owed { sample, process, behind, expired, held: false };
            publisher.bytes += len;
            publisher.sequence += 1;
            publisher.keep_history(&sample);
            for reader in self.model.values_mut().filter(|other| publisher.matches(other)) {
                reader.owe(&sample, publisher.waits_for(reader));
            }
        }
        self.published.insert(publisher.gid.clone(), publisher.bytes);
        if published.blocked {
            let holds = self.model.values().any(|other| other.may_hold(&publisher));
            assert!(holds, "{} waits for nobody", publisher.gid);
        } else {
            assert_eq!(published.count, count);
        }
        self.model.insert(id, publisher);
        published
    }

    /// Publishes more than a ring keeps, while nobody takes.
    fn flood(&mut self) -> bool {
        // The model cannot tell samples that late joiners get, or that expire, from lost ones.
        let which = |m: &Modelled| {
            let Profile { transient_local, lifespan, .. } = m.what.profile;
            m.is(Kind::Publisher) && !transient_local && lifespan != Some(0)
        };
        let held = self.held();
        let best = |m: &Modelled| held.contains(&m.gid);
        let waits = self.dice.roll(3) == 0;
        let picked = if waits { self.pick_best(which, best) } else { self.pick(which) };
        let Some(id) = picked else { return false };
        let publisher = &self.model[&id];
        let keeps_all = |m: &Modelled| publisher.matches(m) && m.what.profile.depth.is_none();
        if !self.model.values().any(keeps_all) {
            let profile = Profile { reliable: false, depth: None, ..Profile::default() };
            let what = Described {
                kind: Kind::Subscription,
                profile,
                node: String::new(),
                namespace: String::new(),
                ..publisher.what.clone()
            };
            let process = self.dice.process();
            self.make(process, None, what, false);
        }
        self.settle();
        let (count, len) = FLOOD;
        let blocked = self.publish_of(id, count, len).blocked;
        let publisher = &self.model[&id];
        let readers = || self.model.iter().filter(|(_, other)| publisher.matches(other));
        let waits = readers().any(|(_, reader)| publisher.waits_for(reader));
        assert_eq!(blocked, waits, "it waits for readers that lose nothing, and for no others");
        if blocked {
            self.saw("publisher held back");
            return true;
        }
        // A reader that loses samples is told before anything is taken.
        let losers = readers().filter(|(_, reader)| reader.what.profile.depth.is_none());
        let losers: Vec<(u64, usize)> = losers.map(|(id, reader)| (*id, reader.process)).collect();
        for (id, process) in losers {
            let losses: Losses = self.ask(process, &Order::AwaitLoss { id });
            self.model.get_mut(&id).unwrap().hear_of(losses);
        }
        true
    }

    fn take(&mut self) -> bool {
        let which = |m: &Modelled| m.is(Kind::Subscription);
        let Some(id) = self.pick_best(which, |m| !m.owed.is_empty()) else { return false };
        let (process, owed) = (self.model[&id].process, self.model[&id].owed.len() as u64);
        let living: BTreeSet<&String> = self.model.values().map(|m| &m.gid).collect();
        let of_dead = self.model[&id]
            .owed
            .values()
            .any(|owed| !owed.expired && !living.contains(&owed.sample.publisher));
        let too_old = self.model[&id].owed.values().any(|owed| owed.expired);
        let taken: Taken = self.ask(process, &Order::Take { id, owed });
        let subscription = self.model.get_mut(&id).unwrap();
        let lost = subscription.take(&taken, &self.published);
        for (sight, there) in [
            ("sample taken from the dead", of_dead),
            ("sample too old", too_old),
            ("sample lost", lost > 0),
        ] {
            if there {
                self.saw(sight);
            }
        }
        true
    }

    /// Lets a client send requests to all servers.
    fn request(&mut self) -> bool {
        let heard = self.heard();
        let which = |m: &Modelled| m.is(Kind::Client);
        let Some(id) = self.pick_best(which, |m| heard.contains(&m.gid)) else { return false };
        let client = self.model.remove(&id).unwrap();
        let mut between = false;
        for _ in 0..=self.dice.roll(4) {
            self.calls += 1;
            let (stamp, len) = (self.calls, self.dice.one_of(&[0, 60, 5000, 70_000]));
            let _: u64 = self.ask(client.process, &Order::Ask { id, stamp, len });
            for server in self.model.values_mut().filter(|other| client.matches(other)) {
                between |= server.process != client.process;
                server.keep_call(&client.gid, stamp);
            }
        }
        self.model.insert(id, client);
        if between {
            self.saw("call between processes");
        }
        true
    }

    /// Lets a server answer all its requests.
    fn answer(&mut self) -> bool {
        let which = |m: &Modelled| m.is(Kind::Server);
        let Some(id) = self.pick_best(which, |m| !m.calls.is_empty()) else { return false };
        let server = self.model.get_mut(&id).unwrap();
        let (process, gid) = (server.process, server.gid.clone());
        let requests = std::mem::take(&mut server.calls);
        let count = requests.len() as u64;
        let answered: BTreeSet<Call> = self.ask(process, &Order::Answer { id, count });
        assert_eq!(answered, requests, "server {id}");
        // A client that is gone gets no response.
        for (client, stamp) in requests {
            if let Some(client) = self.model.values_mut().find(|other| other.gid == client) {
                client.keep_call(&gid, stamp);
            }
        }
        count > 0
    }

    fn hear(&mut self) -> bool {
        let which = |m: &Modelled| m.is(Kind::Client);
        let Some(id) = self.pick_best(which, |m| !m.calls.is_empty()) else { return false };
        let client = self.model.get_mut(&id).unwrap();
        let process = client.process;
        let responses = std::mem::take(&mut client.calls);
        let count = responses.len() as u64;
        let heard: BTreeSet<Call> = self.ask(process, &Order::Hear { id, count });
        assert_eq!(heard, responses, "client {id}");
        count > 0
    }

    /// Lets a process wait for all its endpoints.
    fn wait(&mut self) -> bool {
        let which = if self.dice.roll(2) > 0 { self.pick(Modelled::is_ready) } else { None };
        let process = which.map_or_else(|| self.dice.process(), |id| self.model[&id].process);
        let ready = self.model.iter().filter(|(_, m)| m.process == process && m.is_ready());
        let ready: BTreeSet<u64> = ready.map(|(id, _)| *id).collect();
        let some = !ready.is_empty();
        let found: BTreeSet<u64> = self.ask(process, &Order::Wait { some });
        assert_eq!(found, ready, "process {process}");
        self.saw(if some { "wait that finds something" } else { "wait that finds nothing" });
        true
    }

    fn end(&mut self) -> bool {
        let Some(id) = self.pick(|_| true) else { return false };
        let process = self.model[&id].process;
        self.ask::<()>(process, &Order::End { id });
        self.model.remove(&id);
        true
    }

    fn kill(&mut self) -> bool {
        let process = self.dice.roll(PROCESSES as u64) as usize;
        signal(self.players[process].pid(), Signal::KILL);
        self.players[process] = Self::player(&self.host);
        self.model.retain(|_, m| m.process != process);
        true
    }

    fn kill_daemon(&mut self) -> bool {
        let mut before = None;
        until("a daemon answers", || {
            before = self.host.status().ok();
            before.is_some()
        });
        let before = before.unwrap();
        signal(before.pid, Signal::KILL);
        until("there is another daemon", || {
            self.host.status().is_ok_and(|now| now.daemon != before.daemon)
        });
        true
    }
}

/// Returns a profile. Most pairs of them are compatible, so that samples are received.
fn profile(dice: &mut super::stage::Dice) -> Profile {
    let period = |roll: u64| [HOUR, 2 * HOUR].get(roll as usize).copied();
    Profile {
        reliable: dice.roll(3) > 0,
        transient_local: dice.roll(2) > 0,
        depth: dice.one_of(&[Some(1), Some(3), Some(10), Some(40), None, None]),
        deadline: period(dice.roll(9)),
        manual: dice.roll(3) == 0,
        lease: period(dice.roll(9)),
        lifespan: dice.one_of(&[None, None, Some(0), Some(HOUR)]),
    }
}
