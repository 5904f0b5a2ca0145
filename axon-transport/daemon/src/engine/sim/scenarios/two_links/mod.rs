//! A peer with two links whose daemon lies: it elects, switches, dials, ends and copies as no honest daemon does. Other
//! hosts are linked with the same host meanwhile, one of them over two paths.

mod acts;
mod copies;
mod named;
mod random;
mod raw;

use std::{net::Ipv4Addr, time::Duration};

use axon_shm::{ids::DaemonId, qos::Qos};

use crate::{
    engine::sim::{
        network::Path,
        tests::{Settings, millis, secs},
        world::{Pair, World},
    },
    keys::{KeyPurpose, KmeRequest},
};

/// The host that the liar attacks, an honest host with two paths, one with a single path, and the liar.
const VICTIM: usize = 0;
const TWO_PATHS: usize = 1;
const ONE_PATH: usize = 2;
const LIAR: usize = 3;
/// Maximum age at which samples of honest hosts arrive. A path takes 2 ms.
const OLDEST: u64 = 8;

/// A link of the liar with its victim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    InUse,
    Standby,
    /// The newest link that is neither.
    Other,
}

/// The links, connections and dials of the victim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct VictimState {
    links: usize,
    standby: usize,
    opening: usize,
    dials: usize,
    connections: usize,
}

/// The hosts, the samples of the honest ones, and those of the liar.
struct Lying {
    world: World,
    case: String,
    /// Between honest hosts: from each to the victim, and back.
    honest: [Pair; 4],
    /// Time between two samples of each publisher, and between two checks, in milliseconds.
    every: u64,
    step: u64,
    next: u64,
    published_at: [Vec<u64>; 4],
    seen: [usize; 4],
    /// From the liar to the victim, and back.
    of_liar: [Pair; 2],
    /// The addresses of the victim, by path.
    addresses: [Ipv4Addr; 2],
    /// The victim's state before the liar came.
    before: VictimState,
    /// The time before which the graph is not checked, since a test changes it.
    graph_from: Duration,
    /// The name of a link of the liar that ended.
    ended: Option<[u8; 16]>,
}

impl Lying {
    /// Links the honest hosts, and then the liar over both paths.
    fn new(seed: u64, mode: &str, config: &Settings) -> Self {
        let mut of = Self::without_liar(seed, mode, config);
        of.let_in();
        of
    }

    /// Links the honest hosts. The liar's daemon runs, and dials nobody.
    fn without_liar(seed: u64, mode: &str, config: &Settings) -> Self {
        let with_paths = |host| {
            let mut config = config(host);
            config.link.paths = 2;
            config
        };
        let mut world = World::apart(seed, 4, with_paths);
        world.hosts[LIAR].lies = true;
        world.network.set_default_path(Path { delay: millis(2), ..Path::default() });
        let second = [VICTIM, TWO_PATHS, LIAR].map(|host| world.add_second_interface(host));
        let honest = [
            world.pair(TWO_PATHS, VICTIM, "/from_1", Qos::keep_all()),
            world.pair(VICTIM, TWO_PATHS, "/to_1", Qos::keep_all()),
            world.pair(ONE_PATH, VICTIM, "/from_2", Qos::keep_all()),
            world.pair(VICTIM, ONE_PATH, "/to_2", Qos::keep_all()),
        ];
        let of_liar = [
            world.pair(LIAR, VICTIM, "/lie", Qos::keep_all()),
            world.pair(VICTIM, LIAR, "/to_liar", Qos::keep_all()),
        ];
        for host in [TWO_PATHS, ONE_PATH] {
            world.tell(host, VICTIM);
            world.tell(VICTIM, host);
        }
        world.hear_all_addresses();
        world.until(secs(20), |world| {
            [TWO_PATHS, ONE_PATH].iter().all(|host| {
                world.hosts[VICTIM].knows(&world.hosts[*host])
                    && world.hosts[*host].knows(&world.hosts[VICTIM])
            })
        });
        world.run_for(secs(8));
        let addresses = [world.hosts[VICTIM].address, second[0]];
        let before = state(&world);
        let graph_from = Duration::ZERO;
        let case = format!("{mode}, seed {seed}");
        let mut of = Self {
            world,
            case,
            honest,
            every: 10,
            step: 1,
            next: 0,
            published_at: Default::default(),
            seen: [0; 4],
            of_liar,
            addresses,
            before,
            graph_from,
            ended: None,
        };
        assert_eq!((before.links, before.standby, before.connections), (3, 1, 3), "{}", of.text());
        of.run(20);
        of
    }

    /// Links the liar with its victim.
    fn let_in(&mut self) {
        self.world.tell(LIAR, VICTIM);
        self.world.tell(VICTIM, LIAR);
        let end = self.world.now + secs(20);
        while self.roles(Role::Standby).is_none() {
            assert!(self.world.now < end, "{}", self.text());
            self.run(20);
        }
    }

    fn text(&self) -> String {
        format!("{}: {}", self.case, self.world.describe())
    }

    /// Returns a link of the liar with its victim, as the liar's daemon knows it.
    fn roles(&self, role: Role) -> Option<u64> {
        let links = self.world.hosts[LIAR].links()?;
        let [in_use, standby, others] = links.with_daemon(self.world.hosts[VICTIM].daemon);
        match role {
            Role::InUse => in_use.last().copied(),
            Role::Standby => standby.last().copied(),
            Role::Other => others.last().copied(),
        }
    }

    /// Runs for so many milliseconds. Honest hosts publish meanwhile, and everything is checked.
    fn run(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds.div_ceil(self.step) {
            let now = self.world.now.as_millis() as u64;
            if now >= self.next {
                self.next = now + self.every;
                for (of, pair) in self.honest.into_iter().enumerate() {
                    assert!(self.world.publish(pair, 200), "held up: {}", self.text());
                    self.published_at[of].push(now);
                }
                // The liar's samples may wait for its links, and its history may be full.
                for pair in self.of_liar {
                    self.world.publish(pair, 200);
                }
                self.check_graph();
            }
            self.world.run_for(millis(self.step));
            self.check_samples();
        }
    }

    /// Checks the samples of honest hosts: none is missing, forged or late.
    fn check_samples(&mut self) {
        let now = self.world.now.as_millis() as u64;
        let mut oldest = 0;
        for (of, pair) in self.honest.into_iter().enumerate() {
            let received = self.world.received(pair);
            for number in &received[self.seen[of]..] {
                self.seen[of] += 1;
                assert_eq!(*number, self.seen[of] as u64, "a gap: {}", self.text());
                let published = self.published_at[of].get(*number as usize - 1);
                let age = published.map(|at| now - at);
                assert!(age.is_some(), "{number} of {pair:?} was forged: {}", self.text());
                oldest = oldest.max(age.unwrap_or_default());
            }
            if let Some(first) = self.published_at[of].get(self.seen[of]) {
                oldest = oldest.max(now.saturating_sub(*first));
            }
        }
        assert!(oldest <= OLDEST.max(self.step), "a sample waits {oldest} ms: {}", self.text());
    }

    /// Checks that honest hosts stay in each other's graph, and that the second link of one stays.
    fn check_graph(&mut self) {
        if self.world.now < self.graph_from {
            return;
        }
        let victim = &self.world.hosts[VICTIM];
        for host in [TWO_PATHS, ONE_PATH] {
            let host = &self.world.hosts[host];
            assert!(victim.knows(host) && host.knows(victim), "the graph flaps: {}", self.text());
        }
        let standby = self.standby_of(TWO_PATHS);
        assert!(standby.is_some(), "an honest second link ended: {}", self.text());
    }

    /// Returns the link with a host that stands by at the victim.
    fn standby_of(&self, host: usize) -> Option<u64> {
        let links = self.world.hosts[VICTIM].links()?;
        links.with_daemon(self.world.hosts[host].daemon)[1].last().copied()
    }

    /// Ends the liar's daemon, and checks that the victim has the state that it had before.
    fn liar_leaves(&mut self) {
        let (daemon, victim) = (self.world.hosts[LIAR].daemon, self.world.hosts[VICTIM].daemon);
        self.world.hosts[VICTIM].unwant(daemon);
        self.world.hosts[LIAR].unwant(victim);
        self.world.kill(LIAR, true);
        // A connection is open for 10 s at most before it is a link, and drained for three probe timeouts. A link whose
        // end did not arrive stands for 120 s.
        for _ in 0..280 {
            self.run(500);
            if state(&self.world) == self.before {
                break;
            }
        }
        assert_eq!(state(&self.world), self.before, "{}", self.text());
        let victim = &self.world.hosts[VICTIM];
        assert!(victim.links().is_some_and(|links| links.is_settled()), "{}", self.text());
        assert!(!victim.graph.contains_key(&daemon), "{}", self.text());
    }

    /// Returns the numbers of connections and of dials that began at the victim.
    fn begun(&self) -> (u64, u64) {
        self.world.hosts[VICTIM].links().map_or((0, 0), |links| links.begun())
    }

    /// Returns the KME keys that were drawn for connections with the liar, and for messages to it.
    fn keys(&self) -> (u64, u64) {
        let sae = self.world.hosts[LIAR].sae();
        let of = |for_messages: bool| {
            let asked = self.world.kmes.asked.iter().filter_map(|request| match request {
                KmeRequest::Enc { slave, number, purpose }
                    if Some(slave) == sae.as_ref()
                        && (*purpose == KeyPurpose::Messages) == for_messages =>
                {
                    Some(u64::from(*number))
                }
                _ => None,
            });
            asked.sum()
        };
        (of(false), of(true))
    }

    /// Returns the link in use with the liar at the victim.
    fn victims_link(&self) -> Option<u64> {
        let links = self.world.hosts[VICTIM].links()?;
        links.with_daemon(self.world.hosts[LIAR].daemon)[0].last().copied()
    }

    fn victim_daemon(&self) -> DaemonId {
        self.world.hosts[VICTIM].daemon
    }
}

fn state(world: &World) -> VictimState {
    let held = world.hosts[VICTIM].links().expect("a daemon that runs").held();
    VictimState {
        links: held.links,
        standby: held.standby,
        opening: held.opening,
        dials: held.dials,
        connections: held.connections,
    }
}
