//! Simulates a whole subnet in one thread: seeded loss, delay, reordering and duplication, and a clock that jumps.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::{IpAddr, Ipv4Addr, SocketAddr},
    time::Duration,
};

use axon_transport::config::QkdPeers;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::*;
use crate::{discovery::quic_ports, wire::SecurityTerms};

const CLASSIC: SecurityTerms =
    SecurityTerms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(0) };
const CLASSIC_AES: SecurityTerms = SecurityTerms { cipher: 1, ..CLASSIC };
const SESSION: SecurityTerms =
    SecurityTerms { mode: 1, key_mode: 1, kex: 1, cipher: 0, auth: None };
const MESSAGES10: SecurityTerms = SecurityTerms { key_mode: 2, ..SESSION };

struct Host {
    peers: PeerDiscovery,
    terms: SecurityTerms,
    address: SocketAddr,
    links: BTreeSet<usize>,
    dials: BTreeMap<usize, Duration>,
    in_flight: BTreeSet<usize>,
    mismatches: Vec<(DaemonId, &'static str)>,
    gone: Vec<DaemonId>,
}

enum What {
    Datagram { to: usize, from: SocketAddr, arrival: Arrival, bytes: Vec<u8> },
    DialEnds { from: usize, to: usize, standing: AddressConfidence },
}

struct Subnet {
    now: Duration,
    hosts: Vec<Host>,
    /// The time at which each host wants to be woken.
    wakeups: Vec<Option<Duration>>,
    /// The coming events, by time, then by a running number.
    coming: BTreeMap<(Duration, u64), What>,
    number: u64,
    random: StdRng,
    loss: f64,
}

fn id(host: usize) -> DaemonId {
    DaemonId([host as u8 + 1; 16])
}

impl Subnet {
    fn new(seed: u64, terms: &[SecurityTerms], loss: f64) -> Self {
        let hosts = terms.iter().enumerate().map(|(host, terms)| {
            let ip = IpAddr::from(Ipv4Addr::new(10, 0, 0, host as u8 + 1));
            let sae = |host: usize| format!("sae-{host:02}");
            let all = (0..100).map(sae).filter(|s| *s != sae(host)).collect();
            let local = LocalDaemon {
                daemon: id(host),
                domain: 3,
                terms: *terms,
                sae: (terms.mode == SecurityTerms::QKD).then(|| (sae(host), QkdPeers::Listed(all))),
                range: DiscoveryRange::Subnet,
                bind: vec![ip],
                advertise: Vec::new(),
                has_two_paths: false,
            };
            Host {
                peers: PeerDiscovery::new(local, seed ^ host as u64),
                terms: *terms,
                address: SocketAddr::new(ip, *quic_ports(3).start()),
                links: BTreeSet::new(),
                dials: BTreeMap::new(),
                in_flight: BTreeSet::new(),
                mismatches: Vec::new(),
                gone: Vec::new(),
            }
        });
        let hosts: Vec<Host> = hosts.collect();
        let mut subnet = Self {
            now: Duration::ZERO,
            wakeups: vec![None; hosts.len()],
            hosts,
            coming: BTreeMap::new(),
            number: 0,
            random: StdRng::seed_from_u64(seed),
            loss,
        };
        for host in 0..subnet.hosts.len() {
            subnet.start(host);
        }
        subnet
    }

    fn start(&mut self, host: usize) {
        let Host { peers, address, .. } = &mut self.hosts[host];
        let interface = Interface {
            name: "eth0".to_owned(),
            index: 2,
            address: address.ip(),
            prefix: 24,
            broadcast: None,
            loopback: false,
        };
        peers.set_interfaces(self.now, vec![interface]);
        peers.set_port(self.now, address.port());
        self.settle(host);
    }

    fn later(&mut self, wait: Duration, what: What) {
        self.number += 1;
        self.coming.insert((self.now + wait, self.number), what);
    }

    /// Simulates the network: it loses, delays, reorders, and at times duplicates a datagram.
    fn transmit(&mut self, from: usize, to: usize, arrival: Arrival, bytes: &[u8]) {
        let copies = if self.random.random_bool(0.05) { 2 } else { 1 };
        for _ in 0..copies {
            if self.random.random_bool(self.loss) {
                continue;
            }
            let wait = Duration::from_micros(self.random.random_range(100..80_000));
            let from = match arrival {
                Arrival::Quic => self.hosts[from].address,
                Arrival::Shared => SocketAddr::new(self.hosts[from].address.ip(), 40_000),
            };
            self.later(wait, What::Datagram { to, from, arrival, bytes: bytes.to_vec() });
        }
    }

    /// Performs all outputs of a host at this moment.
    fn settle(&mut self, host: usize) {
        self.hosts[host].peers.handle_timeout(self.now);
        while let Some(output) = self.hosts[host].peers.poll_output() {
            match output {
                PeersOutput::Multicast(bytes) => {
                    for to in (0..self.hosts.len()).filter(|to| *to != host) {
                        self.transmit(host, to, Arrival::Shared, &bytes);
                    }
                }
                PeersOutput::Action(DiscoveryAction::SendFromQuicPort { to, bytes }) => {
                    let to = self.hosts.iter().position(|h| h.address == to);
                    self.transmit(host, to.expect("a host's address"), Arrival::Quic, &bytes);
                }
                PeersOutput::Action(DiscoveryAction::Dial {
                    daemon,
                    addrs,
                    sae,
                    listed,
                    standing,
                }) => {
                    let to = self.hosts.iter().position(|h| h.address == addrs[0]).unwrap();
                    assert_eq!((id(to), listed), (daemon, false));
                    assert_eq!(self.hosts[host].terms, self.hosts[to].terms, "dialled a mismatch");
                    assert_eq!(sae.is_some(), self.hosts[to].terms.mode == SecurityTerms::QKD);
                    let last = self.hosts[host].dials.insert(to, self.now);
                    let spaced = last.is_none_or(|last| last + Duration::from_secs(1) <= self.now);
                    assert!(spaced, "{host} dialled {to} at {last:?} and again at {:?}", self.now);
                    assert!(self.hosts[host].in_flight.insert(to), "dialled twice at once");
                    // A dial to a peer whose own dial made the link no longer counts.
                    let Host { in_flight, links, .. } = &self.hosts[host];
                    assert!(in_flight.difference(links).count() <= MOST_IN_FLIGHT);
                    let wait = Duration::from_millis(self.random.random_range(5..200));
                    self.later(wait, What::DialEnds { from: host, to, standing });
                }
                PeersOutput::Action(DiscoveryAction::Mismatch(mismatch)) => {
                    self.hosts[host].mismatches.push((mismatch.peer, mismatch.setting));
                }
                PeersOutput::Action(DiscoveryAction::Named(names)) => {
                    panic!("it looks no names up: {names:?}")
                }
                PeersOutput::Action(DiscoveryAction::Addresses { .. }) => {
                    panic!("links have one path")
                }
                // Many consecutive beacons were lost, so the peer seemed gone; its mismatch is reported again.
                PeersOutput::Action(DiscoveryAction::Gone { daemon }) => {
                    let gone = self.hosts.iter().position(|h| h.peers.local.daemon == daemon);
                    assert!(!self.hosts[host].links.contains(&gone.unwrap()), "it is linked");
                    self.hosts[host].gone.push(daemon);
                }
            }
        }
        self.wakeups[host] = self.hosts[host].peers.poll_timeout();
    }

    fn run_until(&mut self, end: Duration) {
        loop {
            let coming = self.coming.keys().next().map(|(at, _)| *at);
            let next = self.wakeups.iter().flatten().copied().chain(coming).min().unwrap();
            if next > end {
                self.now = end;
                return;
            }
            self.now = self.now.max(next);
            if coming == Some(next) {
                match self.coming.pop_first().unwrap().1 {
                    What::Datagram { to, from, arrival, bytes } => {
                        self.hosts[to].peers.handle_datagram(self.now, from, arrival, &bytes);
                        self.settle(to);
                    }
                    What::DialEnds { from, to, standing } => self.dial_ends(from, to, standing),
                }
            }
            for host in 0..self.hosts.len() {
                if self.wakeups[host].is_some_and(|at| at <= self.now) {
                    self.settle(host);
                }
            }
        }
    }

    fn dial_ends(&mut self, from: usize, to: usize, standing: AddressConfidence) {
        let now = self.now;
        self.hosts[from].in_flight.remove(&to);
        if self.random.random_bool(self.loss) {
            self.hosts[from].peers.handle_dial_failed(now, id(to), standing);
            return self.settle(from);
        }
        for (a, b) in [(from, to), (to, from)] {
            let address = self.hosts[b].address;
            self.hosts[a].links.insert(b);
            self.hosts[a].peers.handle_link_up(now, id(b), address, true);
            self.settle(a);
        }
    }

    fn break_link(&mut self, a: usize, b: usize) {
        let now = self.now;
        for (a, b) in [(a, b), (b, a)] {
            if self.hosts[a].links.remove(&b) {
                self.hosts[a].peers.handle_link_down(now, id(b));
                self.settle(a);
            }
        }
    }

    /// Checks that hosts with the same terms are linked, and that the others know the reason why they are not.
    fn assert_whole(&self) {
        for (a, host) in self.hosts.iter().enumerate() {
            let differ = |b: &usize| self.hosts[*b].terms != host.terms;
            let others = (0..self.hosts.len()).filter(|b| *b != a);
            let (strangers, friends): (BTreeSet<_>, BTreeSet<_>) = others.partition(differ);
            assert_eq!(host.links, friends, "links of host {a} at {:?}", self.now);
            let told: BTreeSet<_> = host.mismatches.iter().map(|(peer, _)| *peer).collect();
            assert_eq!(told, strangers.into_iter().map(id).collect(), "and knows why not");
            assert!(host.mismatches.len() <= told.len() + host.gone.len(), "once for each");
        }
    }
}

fn four_kinds() -> Vec<SecurityTerms> {
    [(CLASSIC, 10), (SESSION, 10), (MESSAGES10, 5), (CLASSIC_AES, 5)]
        .into_iter()
        .flat_map(|(terms, count)| std::iter::repeat_n(terms, count))
        .collect()
}

#[test]
fn thirty_hosts_find_each_other_through_a_bad_network() {
    for seed in 0..20 {
        let mut subnet = Subnet::new(seed, &four_kinds(), 0.3);
        subnet.run_until(Duration::from_secs(60));
        subnet.assert_whole();
        let settings: BTreeSet<_> = subnet.hosts[0].mismatches.iter().map(|(_, s)| *s).collect();
        let expected = BTreeSet::from(["AXON_SECURITY_MODE", "AXON_QUIC_CIPHER"]);
        assert_eq!(settings, expected);
        assert!(subnet.hosts[10].mismatches.contains(&(id(20), "AXON_QKD_KEY_MODE")));
    }
}

#[test]
fn a_host_that_comes_late_is_found_within_the_first_beacons() {
    let mut subnet = Subnet::new(1, &[CLASSIC; 8], 0.0);
    subnet.run_until(Duration::from_secs(30));
    subnet.assert_whole();
    let late = subnet.hosts.len();
    let mut fresh = Subnet::new(1, &[CLASSIC; 9], 0.0);
    subnet.hosts.push(fresh.hosts.pop().unwrap());
    subnet.wakeups.push(None);
    while subnet.hosts[late].peers.poll_output().is_some() {}
    subnet.start(late);
    subnet.run_until(Duration::from_secs(33));
    subnet.assert_whole();
}

#[test]
fn broken_links_come_back() {
    for seed in 0..5 {
        let mut subnet = Subnet::new(seed, &[SESSION; 10], 0.2);
        subnet.run_until(Duration::from_secs(60));
        for a in 0..10 {
            for b in a + 1..10 {
                subnet.break_link(a, b);
            }
        }
        subnet.run_until(Duration::from_secs(120));
        subnet.assert_whole();
    }
}

#[test]
fn the_same_seed_is_the_same_run() {
    let run = || {
        let mut subnet = Subnet::new(9, &four_kinds(), 0.3);
        subnet.run_until(Duration::from_secs(20));
        let dials = subnet.hosts.iter().map(|host| host.dials.clone()).collect::<Vec<_>>();
        (subnet.number, dials)
    };
    assert_eq!(run(), run());
}
