//! Runs a script of faults in a world of hosts, and checks the invariants.

use std::{collections::BTreeMap, time::Duration};

use axon_shm::{
    ids::Gid,
    qos::{Durability, Qos},
};
use axon_transport::config::Config;

use super::{
    network::{CutId, Path, Rate},
    rings::COMPRESSIBLE,
    script::{Edge, Fault, Kind, KmeFailure, PathChange, Qos as ScriptQos, Script},
    world::World,
};
use crate::keys::FailureKind;

/// All hosts know each other again within this time after the last fault.
const HEALS: Duration = Duration::from_secs(90);
/// The same limit if a daemon ended after its host got another address. In mode none the address identifies the owner
/// of endpoints, and no process at the old address can answer that the daemon is gone. QUIC gives the link up after 120
/// s.
const HEALS_AFTER_MOVE: Duration = Duration::from_secs(150);
/// Samples that were on their way have arrived, or were counted, within this time after that.
const QUIET: Duration = Duration::from_secs(40);

/// A script that is being run.
struct Run<'a> {
    script: &'a Script,
    world: World,
    /// The faults in progress, with the data to end them.
    cuts: BTreeMap<usize, Vec<CutId>>,
    endpoints: BTreeMap<usize, Gid>,
    /// The number of faults that currently kill, or stop, each host.
    dead: Vec<u32>,
    stopped: Vec<u32>,
    bursts: Vec<Burst>,
}

struct Burst {
    host: usize,
    topic: usize,
    left: u32,
    size: usize,
    every: Duration,
    next: Duration,
}

/// Runs a script.
///
/// # Panics
/// Something does not hold that must.
pub(super) fn run(script: &Script, config: impl Fn(usize) -> Config) {
    let world = World::new(script.seed, script.hosts, config);
    let mut run = Run {
        script,
        world,
        cuts: BTreeMap::new(),
        endpoints: BTreeMap::new(),
        dead: vec![0; script.hosts],
        stopped: vec![0; script.hosts],
        bursts: Vec::new(),
    };
    for step in script.steps() {
        run.run_until(step.at);
        run.apply(step.fault, step.edge);
    }
    run.heal();
    let heals = if moves_and_ends(script) { HEALS_AFTER_MOVE } else { HEALS };
    run.world.until(heals, World::is_whole);
    run.run_until(run.world.now + QUIET);
    run.check();
}

/// Returns whether a daemon ends whose host gets another address.
fn moves_and_ends(script: &Script) -> bool {
    let moved: Vec<_> = script
        .faults
        .iter()
        .filter_map(|fault| match fault.kind {
            Kind::Move { host, .. } => Some(host),
            _ => None,
        })
        .collect();
    script.faults.iter().any(|fault| match fault.kind {
        Kind::Kill { host, .. } => moved.contains(&host),
        _ => false,
    })
}

fn qos(qos: ScriptQos) -> Qos {
    match qos {
        ScriptQos::BestEffort => Qos::sensor_data(),
        ScriptQos::ReliableKeepLast => Qos::default(),
        ScriptQos::ReliableKeepAll => Qos::keep_all(),
        ScriptQos::TransientLocal => Qos::default().with_durability(Durability::TransientLocal),
    }
}

fn path(change: PathChange) -> Path {
    let share = |thousandths: u16| f64::from(thousandths) / 1000.0;
    Path {
        delay: change.delay,
        jitter: change.jitter,
        loss: share(change.loss),
        duplicate: share(change.duplicate),
        reorder: share(change.reorder),
        rate: change.rate.map(|rate| Rate::new(rate, Duration::from_millis(100))),
        ..Path::default()
    }
}

impl Run<'_> {
    fn run_until(&mut self, until: Duration) {
        loop {
            let next = self.bursts.iter().map(|burst| burst.next).min();
            let Some(next) = next.filter(|next| *next <= until) else { break };
            self.world.run_until(next);
            for at in 0..self.bursts.len() {
                if self.bursts[at].next <= next {
                    let Burst { host, topic, size, every, .. } = self.bursts[at];
                    self.world.publish_all(host, topic, size);
                    self.bursts[at].left -= 1;
                    self.bursts[at].next = next + every.max(Duration::from_micros(100));
                }
            }
            self.bursts.retain(|burst| burst.left > 0);
        }
        self.world.run_until(until);
    }

    fn apply(&mut self, number: usize, edge: Edge) {
        let Fault { kind, .. } = &self.script.faults[number];
        let begins = edge == Edge::Begin;
        match kind {
            Kind::Partition { hosts } if begins => {
                let cut = self.world.network.partition(hosts, None);
                self.cuts.entry(number).or_default().push(cut);
            }
            Kind::Cut { from, to } if begins => {
                let cut = self.world.network.cut(&[*from], &[*to], None);
                self.cuts.entry(number).or_default().push(cut);
            }
            Kind::Partition { .. } | Kind::Cut { .. } => {
                for cut in self.cuts.remove(&number).unwrap_or_default() {
                    self.world.network.heal(cut);
                }
            }
            Kind::Kill { host, orderly } => self.kill(*host, *orderly, begins),
            Kind::Pause { host } => {
                let count = &mut self.stopped[*host];
                *count = if begins { *count + 1 } else { count.saturating_sub(1) };
                let stopped = *count > 0;
                self.world.stop(*host, stopped);
            }
            Kind::Path { from, to, change } => {
                let path = begins.then(|| path(*change));
                self.world.network.set_path(*from, *to, path);
            }
            Kind::InterfaceDown { host, .. } => {
                let address = self.world.hosts[*host].address;
                self.world.network.set_interface_up(address, !begins);
            }
            Kind::Move { host, .. } if begins => self.world.move_host(*host),
            Kind::Kme { failure, .. } if begins => {
                let kind = match failure {
                    KmeFailure::Unreachable | KmeFailure::Silent => FailureKind::Unreachable,
                    KmeFailure::Slow | KmeFailure::Error => FailureKind::Unavailable,
                    KmeFailure::Exhausted => FailureKind::Unavailable,
                    KmeFailure::WrongKey => FailureKind::Ambiguous,
                };
                self.world.kmes.failures.extend([kind; 3]);
            }
            Kind::Publisher { host, topic, qos: of } if begins => {
                let gid = self.world.hosts[*host].rings.create_publisher(&name(*topic), qos(*of));
                self.endpoints.insert(number, gid);
                self.world.hosts[*host].touch_graph();
            }
            Kind::Subscription { host, topic, qos: of } if begins => {
                let rings = &self.world.hosts[*host].rings;
                let gid = rings.create_subscription(&name(*topic), qos(*of), None);
                self.endpoints.insert(number, gid);
                self.world.hosts[*host].touch_graph();
            }
            Kind::Publisher { host, .. } | Kind::Subscription { host, .. } => {
                if let Some(gid) = self.endpoints.remove(&number) {
                    self.world.hosts[*host].rings.end(gid);
                    self.world.hosts[*host].touch_graph();
                }
            }
            Kind::Publish { host, topic, count, size, every } if begins => {
                self.bursts.push(Burst {
                    host: *host,
                    topic: *topic,
                    left: *count,
                    size: *size as usize,
                    every: *every,
                    next: self.world.now,
                });
            }
            // Hosts have no NAT here.
            Kind::Move { .. } | Kind::Kme { .. } | Kind::Publish { .. } | Kind::Rebind { .. } => {}
        }
    }

    fn kill(&mut self, host: usize, orderly: bool, begins: bool) {
        let dead = &mut self.dead[host];
        if begins {
            *dead += 1;
            if *dead == 1 {
                self.world.kill(host, orderly);
            }
        } else {
            *dead = dead.saturating_sub(1);
            if *dead == 0 {
                self.world.restart(host);
            }
        }
    }

    /// Ends all faults.
    fn heal(&mut self) {
        self.bursts.clear();
        self.world.network.heal_all();
        self.world.kmes.failures.clear();
        for host in 0..self.script.hosts {
            for other in 0..self.script.hosts {
                self.world.network.set_path(host, other, None);
            }
            let address = self.world.hosts[host].address;
            self.world.network.set_interface_up(address, true);
            if std::mem::take(&mut self.stopped[host]) > 0 {
                self.world.stop(host, false);
            }
            if std::mem::take(&mut self.dead[host]) > 0 {
                self.world.restart(host);
            }
        }
    }

    /// Checks the invariants once all is quiet.
    fn check(&self) {
        for host in &self.world.hosts {
            let (waiting, _) = host.backlog();
            assert_eq!(waiting, 0, "host {} holds samples: {}", host.number, self.world.describe());
        }
        self.world.check_losses("");
    }
}

/// Returns the name of a topic.
pub(super) fn name(topic: usize) -> String {
    let kind = if topic % 2 == 1 { COMPRESSIBLE } else { "/topic" };
    format!("{kind}{topic}")
}
