//! Random programs over several processes against a reference model: who is matched with whom, what
//! every process's graph shows, which samples a subscription takes and in which order, and that none
//! is lost. Endpoints come and go, processes are killed, and so is the daemon.
//!
//! A bounded sample of them; more: `PROGRAMS=200 cargo test -p axon-transport --test program`. One that
//! failed says its seed, and `PROGRAM_SEED=...` repeats it alone.

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt::Write as _,
    io::Write as _,
    time::Instant,
};

use axon_transport::{
    config::{Config, OsFiles},
    qos::{Durability, History, Qos, Reliability},
    session::{EndpointSpec, Publisher, Session, SessionOptions, Subscription},
};
use rustix::process::Signal;
use support::{Host, PATIENCE, Player, say, signal, wait_for_the_end};

const PROCESSES: usize = 3;
const STEPS: usize = 50;
/// Programs of an ordinary run.
const FEW: u64 = 3;
const TOPICS: u64 = 2;

/// A profile by its number: reliability, durability, and how much is kept.
fn profile(number: u64) -> Qos {
    let depths = [1, 3, 10, 40];
    let depth = depths.get(usize::try_from(number / 4).unwrap()).copied();
    Qos {
        reliability: [Reliability::Reliable, Reliability::BestEffort][(number % 2) as usize],
        durability: [Durability::Volatile, Durability::TransientLocal][(number / 2 % 2) as usize],
        history: if depth.is_some() { History::KeepLast } else { History::KeepAll },
        depth: depth.unwrap_or(10),
        ..Qos::default()
    }
}

const PROFILES: u64 = 20;

/// Two types of the second topic go by one name and have other hashes.
fn spec(topic: u64, hash: u64, qos: Qos) -> EndpointSpec {
    let type_hash = vec![hash as u8; 4];
    EndpointSpec { type_hash, ..EndpointSpec::new(format!("/t{topic}"), "test/Bytes", qos) }
}

/// What each process does: what its test tells it, line by line.
#[test]
fn child() {
    if std::env::var("PLAY").is_err() {
        return;
    }
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    let session = Session::open(&config, SessionOptions::new("program")).unwrap();
    let mut publishers: HashMap<u64, Publisher> = HashMap::new();
    let mut subscriptions: HashMap<u64, Subscription> = HashMap::new();
    say("ready");
    for line in std::io::stdin().lines() {
        let line = line.unwrap();
        let (what, numbers) = line.split_once(' ').unwrap_or((&line, ""));
        let numbers: Vec<u64> = numbers.split_whitespace().map(|n| n.parse().unwrap()).collect();
        match (what, numbers.as_slice()) {
            ("publisher", &[id, topic, hash, qos]) => {
                let made = session.create_publisher(spec(topic, hash, profile(qos))).unwrap();
                say(made.gid());
                publishers.insert(id, made);
            }
            ("subscription", &[id, topic, hash, qos]) => {
                let made = session.create_subscription(spec(topic, hash, profile(qos))).unwrap();
                say(made.gid());
                subscriptions.insert(id, made);
            }
            ("publish", &[id, stamp, len]) => {
                let payload = vec![stamp as u8; usize::try_from(len).unwrap()];
                let stamp = i64::try_from(stamp).unwrap();
                say(publishers[&id].publish_at(stamp, &payload).unwrap());
            }
            // The samples that must come, and after them none.
            ("take", &[id, count]) => {
                let mut taken = String::new();
                let mut bytes = Vec::new();
                for _ in 0..count {
                    match subscriptions[&id].recv(&mut bytes, Some(PATIENCE)) {
                        Some(info) => {
                            let stamp = info.source_timestamp;
                            assert!(bytes.iter().all(|byte| *byte == stamp as u8));
                            write!(taken, "{stamp}/{} ", bytes.len()).unwrap();
                        }
                        None => taken.push_str("none "),
                    }
                }
                if let Some(more) = subscriptions[&id].take(&mut bytes) {
                    write!(taken, "and {}", more.source_timestamp).unwrap();
                }
                say(format_args!("{} lost: {}", taken.trim(), subscriptions[&id].lost()));
            }
            ("end", &[id]) => {
                publishers.remove(&id);
                subscriptions.remove(&id);
                say("ended");
            }
            ("state", []) => {
                let graph: BTreeSet<String> =
                    session.graph().endpoints.keys().map(ToString::to_string).collect();
                let mut matched = BTreeMap::new();
                let publishers = publishers.iter().map(|(id, p)| (*id, p.matched()));
                let subscriptions = subscriptions.iter().map(|(id, s)| (*id, s.matched()));
                for (id, gids) in publishers.chain(subscriptions) {
                    let gids: BTreeSet<String> = gids.iter().map(ToString::to_string).collect();
                    matched.insert(id, gids);
                }
                say(State { graph, matched });
            }
            _ => unreachable!("{line}"),
        }
    }
    wait_for_the_end();
}

/// What a process sees.
#[derive(Debug, Default, PartialEq)]
struct State {
    graph: BTreeSet<String>,
    /// By the numbers of its endpoints.
    matched: BTreeMap<u64, BTreeSet<String>>,
}

impl std::fmt::Display for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let joined = |set: &BTreeSet<String>| set.iter().cloned().collect::<Vec<_>>().join(",");
        write!(f, "{}", joined(&self.graph))?;
        self.matched.iter().try_for_each(|(id, gids)| write!(f, ";{id}={}", joined(gids)))
    }
}

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

/// An endpoint as the model has it.
struct Modelled {
    gid: String,
    process: usize,
    publishes: bool,
    topic: u64,
    hash: u64,
    qos: Qos,
    /// A publisher's samples, oldest first; what a subscription has to take, by the source's time.
    samples: BTreeMap<u64, u64>,
}

impl Modelled {
    /// ROS 2's rule, as its documentation has it.
    fn goes_with(&self, other: &Self) -> bool {
        let (offered, requested) = if self.publishes { (self, other) } else { (other, self) };
        let reliable = offered.qos.reliability == Reliability::Reliable
            || requested.qos.reliability == Reliability::BestEffort;
        let durable = offered.qos.durability == Durability::TransientLocal
            || requested.qos.durability == Durability::Volatile;
        self.publishes != other.publishes
            && (self.topic, self.hash) == (other.topic, other.hash)
            && reliable
            && durable
    }

    fn depth(&self) -> usize {
        match self.qos.history {
            History::KeepLast => self.qos.depth as usize,
            History::KeepAll => usize::MAX,
        }
    }

    fn keep(&mut self, stamp: u64, len: u64) {
        self.samples.insert(stamp, len);
        while self.samples.len() > self.depth() {
            self.samples.pop_first();
        }
    }
}

/// The processes, and what they must be like.
struct Stage {
    host: Host,
    players: Vec<Player>,
    model: BTreeMap<u64, Modelled>,
    next: u64,
    stamp: u64,
    dice: Dice,
}

impl Stage {
    fn new(seed: u64) -> Self {
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
        let publishes = self.dice.roll(2) == 0;
        let topic = self.dice.roll(TOPICS);
        let hash = if topic == 0 { 7 } else { 7 + self.dice.roll(2) };
        let number = self.dice.roll(PROFILES);
        let what = if publishes { "publisher" } else { "subscription" };
        let gid = self.ask(process, &format!("{what} {id} {topic} {hash} {number}"));
        let samples = BTreeMap::new();
        let qos = profile(number);
        let mut new = Modelled { gid, process, publishes, topic, hash, qos, samples };
        if !publishes && qos.durability == Durability::TransientLocal {
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
        let Some(id) = self.pick(|m| m.publishes) else { return };
        for _ in 0..=self.dice.roll(20) {
            self.stamp += 1;
            let (stamp, len) = (self.stamp, [0, 8, 96, 5000, 70_000][self.dice.roll(5) as usize]);
            let process = self.model[&id].process;
            self.ask(process, &format!("publish {id} {stamp} {len}"));
            let publisher = &self.model[&id];
            let readers: Vec<u64> = self
                .model
                .iter()
                .filter(|(_, other)| !other.publishes && publisher.goes_with(other))
                .map(|(id, _)| *id)
                .collect();
            for reader in readers {
                self.model.get_mut(&reader).unwrap().keep(stamp, len);
            }
            self.model.get_mut(&id).unwrap().keep(stamp, len);
        }
    }

    fn take(&mut self) {
        let Some(id) = self.pick(|m| !m.publishes) else { return };
        let all = self.model[&id].samples.len();
        let process = self.model[&id].process;
        let samples = std::mem::take(&mut self.model.get_mut(&id).unwrap().samples);
        let expected: Vec<String> =
            samples.iter().map(|(stamp, len)| format!("{stamp}/{len}")).collect();
        let taken = self.ask(process, &format!("take {id} {all}"));
        let expected = format!("{} lost: 0", expected.join(" "));
        assert_eq!(taken.trim(), expected.trim(), "subscription {id}");
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

    /// Waits until every process sees what the model says.
    fn settle(&mut self) {
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
                std::thread::sleep(std::time::Duration::from_millis(2));
            }
        }
    }

    fn step(&mut self) -> &'static str {
        match self.dice.roll(100) {
            0..30 => {
                self.create();
                "create"
            }
            30..62 => {
                self.publish();
                "publish"
            }
            62..86 => {
                self.take();
                "take"
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

/// Says which program failed.
struct Running(u64);

impl Drop for Running {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("PROGRAM_SEED={} repeats this", self.0);
        }
    }
}

#[test]
fn processes_see_and_take_what_the_model_says() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let number = |name: &str| std::env::var(name).ok().map(|n| n.parse::<u64>().unwrap());
    let seeds = match number("PROGRAM_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("PROGRAMS").unwrap_or(FEW),
    };
    for seed in seeds {
        let running = Running(seed);
        let mut stage = Stage::new(seed);
        let mut steps = Vec::new();
        for _ in 0..STEPS {
            steps.push(stage.step());
            stage.settle();
        }
        // What is left is taken, too.
        let subscriptions = stage.model.values().filter(|m| !m.publishes).count();
        for _ in 0..4 * subscriptions {
            stage.take();
        }
        for step in ["create", "publish", "take", "end"] {
            assert!(steps.contains(&step), "no program without {step}");
        }
        drop(running);
    }
}
