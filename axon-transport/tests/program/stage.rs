//! The processes of a program, and the steps that it takes.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::Write as _,
    time::{Duration, Instant},
};

use axon_transport::qos::Durability;
use rustix::process::Signal;

use super::{
    model::{Kind, Modelled, PROFILES, State, joined, profile},
    support::{self, Host, PATIENCE, Player, signal},
};

const PROCESSES: usize = 3;
const TOPICS: u64 = 2;

/// Its own: a test whose seed is all that need be known.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, sides: u64) -> u64 {
        // SplitMix64.
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % sides
    }
}

/// As the processes say it.
fn said_by(calls: &BTreeSet<(String, u64)>) -> String {
    joined(&calls.iter().map(|(who, stamp)| format!("{who}/{stamp}")).collect())
}

/// The processes, and what they must be like.
pub(super) struct Stage {
    host: Host,
    players: Vec<Player>,
    model: BTreeMap<u64, Modelled>,
    next: u64,
    stamp: u64,
    dice: Dice,
}

impl Stage {
    pub(super) fn new(seed: u64) -> Self {
        let host = Host::new().with("AXON_LOG", "error");
        let players = (0..PROCESSES).map(|_| Self::player(&host)).collect();
        let model = BTreeMap::new();
        Self { host, players, model, next: 0, stamp: 0, dice: Dice(seed) }
    }

    fn player(host: &Host) -> Player {
        let mut player = host.play("program");
        assert_eq!(player.hear(), "ready");
        player
    }

    fn ask(&mut self, process: usize, line: &str) -> String {
        let player = &mut self.players[process];
        let mut input = player.child.0.stdin.as_ref().unwrap();
        writeln!(input, "{line}").unwrap();
        player.hear()
    }

    fn create(&mut self) {
        let (id, process) = (self.next, self.dice.roll(PROCESSES as u64) as usize);
        self.next += 1;
        let kind = match self.dice.roll(20) {
            0..7 => Kind::Publisher,
            7..14 => Kind::Subscription,
            14..17 => Kind::Server,
            _ => Kind::Client,
        };
        let topic = self.dice.roll(TOPICS);
        let hash = if topic == 0 { 7 } else { 7 + self.dice.roll(2) };
        let number = self.dice.roll(PROFILES);
        let gid = self.ask(process, &format!("{} {id} {topic} {hash} {number}", kind.name()));
        let (samples, calls) = (BTreeMap::new(), BTreeSet::new());
        let qos = profile(number);
        let mut new = Modelled { gid, process, kind, topic, hash, qos, samples, calls };
        if kind == Kind::Subscription && qos.durability == Durability::TransientLocal {
            let others = self.model.values().filter(|other| other.goes_with(&new));
            let late = others.flat_map(|other| {
                let stands = new.depth().min(other.depth());
                other.samples.iter().rev().take(stands).map(|(stamp, len)| (*stamp, *len))
            });
            let late: Vec<_> = late.collect();
            new.samples.extend(late);
            while new.samples.len() > new.depth() {
                new.samples.pop_first();
            }
        }
        self.model.insert(id, new);
    }

    fn pick(&mut self, which: impl Fn(&Modelled) -> bool) -> Option<u64> {
        let ids: Vec<u64> =
            self.model.iter().filter(|(_, m)| which(m)).map(|(id, _)| *id).collect();
        let at = self.dice.roll(ids.len().max(1) as u64) as usize;
        ids.get(at).copied()
    }

    fn publish(&mut self) {
        let Some(id) = self.pick(|m| m.kind == Kind::Publisher) else { return };
        for _ in 0..=self.dice.roll(20) {
            self.stamp += 1;
            let (stamp, len) = (self.stamp, [0, 8, 96, 5000, 70_000][self.dice.roll(5) as usize]);
            let process = self.model[&id].process;
            self.ask(process, &format!("publish {id} {stamp} {len}"));
            let publisher = &self.model[&id];
            let readers: Vec<u64> = self
                .model
                .iter()
                .filter(|(_, other)| publisher.goes_with(other))
                .map(|(id, _)| *id)
                .collect();
            for reader in readers {
                self.model.get_mut(&reader).unwrap().keep(stamp, len);
            }
            self.model.get_mut(&id).unwrap().keep(stamp, len);
        }
    }

    pub(super) fn take(&mut self) {
        let Some(id) = self.pick(|m| m.kind == Kind::Subscription) else { return };
        let all = self.model[&id].samples.len();
        let process = self.model[&id].process;
        let samples = std::mem::take(&mut self.model.get_mut(&id).unwrap().samples);
        let expected: Vec<String> =
            samples.iter().map(|(stamp, len)| format!("{stamp}/{len}")).collect();
        let taken = self.ask(process, &format!("take {id} {all}"));
        let expected = format!("{} lost: 0", expected.join(" "));
        assert_eq!(taken.trim(), expected.trim(), "subscription {id}");
    }

    /// A client asks all servers that there are.
    fn request(&mut self) {
        let Some(id) = self.pick(|m| m.kind == Kind::Client) else { return };
        let client = self.model.remove(&id).unwrap();
        for _ in 0..=self.dice.roll(4) {
            self.stamp += 1;
            let (stamp, len) = (self.stamp, [0, 60, 5000, 70_000][self.dice.roll(4) as usize]);
            self.ask(client.process, &format!("ask {id} {stamp} {len}"));
            for server in self.model.values_mut().filter(|other| client.goes_with(other)) {
                server.keep_call(&client.gid, stamp);
            }
        }
        self.model.insert(id, client);
    }

    /// A server answers all that it was asked.
    fn answer(&mut self) {
        let Some(id) = self.pick(|m| m.kind == Kind::Server) else { return };
        let server = self.model.get_mut(&id).unwrap();
        let (process, gid) = (server.process, server.gid.clone());
        let requests = std::mem::take(&mut server.calls);
        let answered = self.ask(process, &format!("answer {id} {}", requests.len()));
        assert_eq!(answered, said_by(&requests), "server {id}");
        // A client that is gone gets nothing.
        for (client, stamp) in requests {
            if let Some(client) = self.model.values_mut().find(|other| other.gid == client) {
                client.keep_call(&gid, stamp);
            }
        }
    }

    fn hear(&mut self) {
        let Some(id) = self.pick(|m| m.kind == Kind::Client) else { return };
        let client = self.model.get_mut(&id).unwrap();
        let process = client.process;
        let responses = std::mem::take(&mut client.calls);
        let heard = self.ask(process, &format!("hear {id} {}", responses.len()));
        assert_eq!(heard, said_by(&responses), "client {id}");
    }

    /// A process waits for all that it has.
    pub(super) fn wait(&mut self) {
        let process = self.dice.roll(PROCESSES as u64) as usize;
        let ready = self.model.iter().filter(|(_, m)| m.process == process && m.is_ready());
        let ready: BTreeSet<String> = ready.map(|(id, _)| id.to_string()).collect();
        let found = self.ask(process, &format!("wait {}", ready.len()));
        assert_eq!(found, joined(&ready), "process {process}");
    }

    fn end(&mut self) {
        let Some(id) = self.pick(|_| true) else { return };
        let process = self.model[&id].process;
        self.ask(process, &format!("end {id}"));
        self.model.remove(&id);
    }

    fn kill(&mut self) {
        let process = self.dice.roll(PROCESSES as u64) as usize;
        signal(self.players[process].pid(), Signal::KILL);
        self.players[process] = Self::player(&self.host);
        self.model.retain(|_, m| m.process != process);
    }

    fn kill_daemon(&mut self) {
        let before = self.host.status().unwrap();
        signal(before.pid, Signal::KILL);
        support::until("there is another daemon", || {
            self.host.status().is_ok_and(|now| now.daemon != before.daemon)
        });
    }

    /// How many subscriptions there are.
    pub(super) fn subscriptions(&self) -> usize {
        self.model.values().filter(|m| m.kind == Kind::Subscription).count()
    }

    /// Waits until every process sees what the model says.
    pub(super) fn settle(&mut self) {
        let graph: BTreeSet<String> = self.model.values().map(|m| m.gid.clone()).collect();
        let expected: Vec<String> = (0..PROCESSES)
            .map(|process| {
                let own = self.model.iter().filter(|(_, m)| m.process == process);
                let matched = own.map(|(id, m)| {
                    let others = self.model.values().filter(|other| m.goes_with(other));
                    (*id, others.map(|other| other.gid.clone()).collect())
                });
                State { graph: graph.clone(), matched: matched.collect() }.to_string()
            })
            .collect();
        let deadline = Instant::now() + PATIENCE;
        for (process, expected) in expected.iter().enumerate() {
            loop {
                let seen = self.ask(process, "state");
                if seen == *expected {
                    break;
                }
                assert!(Instant::now() < deadline, "{process} sees\n{seen}, not\n{expected}");
                std::thread::sleep(Duration::from_millis(2));
            }
        }
    }

    pub(super) fn step(&mut self) -> &'static str {
        match self.dice.roll(100) {
            0..26 => {
                self.create();
                "create"
            }
            26..46 => {
                self.publish();
                "publish"
            }
            46..60 => {
                self.take();
                "take"
            }
            60..68 => {
                self.request();
                "request"
            }
            68..75 => {
                self.answer();
                "answer"
            }
            75..80 => {
                self.hear();
                "hear"
            }
            80..86 => {
                self.wait();
                "wait"
            }
            86..96 => {
                self.end();
                "end"
            }
            96..99 => {
                self.kill();
                "kill"
            }
            _ => {
                self.kill_daemon();
                "kill the daemon"
            }
        }
    }
}
