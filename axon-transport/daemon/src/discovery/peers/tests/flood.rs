//! Tests with forged beacons: an honest host is still found and dialled, and no forged record remains.

use super::*;
use crate::wire::beacon::{Beacon, Datagram};

/// The start of the honest host, in milliseconds; the forger began before it.
const STARTS: u64 = 1_000;
/// The first beacons of a daemon, in milliseconds from its start.
const BURST: [u64; 5] = [0, 180, 450, 900, 1_700];
/// The most time until the dial, in milliseconds.
const LIMIT: u64 = 3_000;
/// The time that an answer of the honest host takes, in milliseconds.
const ROUND_TRIP: u64 = 20;

/// A forger: returns its datagrams of a millisecond, each with its source.
type Forger = fn(u64) -> Vec<(SocketAddr, Arrival, Datagram)>;

/// An honest host at its address, and a forger.
struct Scene {
    peers: PeerDiscovery,
    honest: DaemonId,
    address: SocketAddr,
    arrival: Arrival,
    forger: Forger,
    /// The start of the honest host, in milliseconds.
    starts: u64,
    now: u64,
    /// Answers of the honest host that are in flight, each with the time of its arrival.
    echoes: VecDeque<(u64, Vec<u8>)>,
    /// The number of probes that the honest host received.
    probes: usize,
}

impl Scene {
    fn new(honest: DaemonId, forger: Forger) -> Self {
        let (peers, address) = (settled(local()), from("10.0.0.2:61300"));
        Self {
            peers,
            honest,
            address,
            arrival: Arrival::Shared,
            forger,
            starts: STARTS,
            now: 10_000,
            echoes: VecDeque::new(),
            probes: 0,
        }
    }

    /// Creates a scene in which this host and the honest host list each other.
    fn listed(honest: DaemonId, forger: Forger) -> Self {
        let mut scene = Self::new(honest, forger);
        scene.peers.set_listed(secs(3.0), vec![(scene.address.ip(), None)]);
        scene.arrival = Arrival::Quic;
        scene
    }

    /// Creates a scene in which the two hosts had a link, which is lost when the forger begins.
    fn met(honest: DaemonId, forger: Forger) -> Self {
        let mut scene = Self::new(honest, forger);
        scene.honest_speaks();
        let (at, address) = (scene.time(), scene.address);
        scene.peers.handle_link_up(at, honest, address, true);
        scene
    }

    fn time(&self) -> Duration {
        Duration::from_millis(self.now)
    }

    fn honest_speaks(&mut self) {
        let port = self.address.port();
        let bytes = Datagram::Beacon(Beacon { port, ..beacon(self.honest) }).encode();
        let source = match self.arrival {
            Arrival::Quic => self.address,
            Arrival::Shared => SocketAddr::new(self.address.ip(), 40_000),
        };
        self.peers.handle_datagram(self.time(), source, self.arrival, &bytes);
    }

    /// Returns the milliseconds from the honest host's start until this host dials its true address.
    fn play(&mut self) -> Option<u64> {
        let begin = self.now;
        for passed in 0..self.starts + 2 * LIMIT {
            self.now = begin + passed;
            for (source, arrival, datagram) in (self.forger)(passed) {
                self.peers.handle_datagram(self.time(), source, arrival, &datagram.encode());
            }
            let speaks =
                passed.checked_sub(self.starts).is_some_and(|since| BURST.contains(&since));
            if speaks {
                self.honest_speaks();
            }
            self.peers.handle_timeout(self.time());
            if self.is_dialled() && passed >= self.starts {
                return Some(passed - self.starts);
            }
        }
        None
    }

    /// Performs the outputs of the state machine; only the honest host answers. Returns whether the honest host was
    /// dialled.
    fn is_dialled(&mut self) -> bool {
        let mut dialled = false;
        while self.echoes.front().is_some_and(|(at, _)| *at <= self.now) {
            let (_, echo) = self.echoes.pop_front().unwrap();
            self.peers.handle_datagram(self.time(), self.address, Arrival::Quic, &echo);
        }
        while let Some(output) = self.peers.poll_output() {
            match output {
                PeersOutput::Action(DiscoveryAction::Dial { daemon, addrs, .. }) => {
                    // An address that does not answer takes 5 s, so only the first address counts.
                    dialled |= daemon == self.honest && addrs[0] == self.address;
                }
                PeersOutput::Action(DiscoveryAction::SendFromQuicPort { to, bytes })
                    if to == self.address =>
                {
                    if let Ok(Datagram::Probe { nonce, .. }) = Datagram::decode(&bytes) {
                        self.probes += 1;
                        let echo = Datagram::Echo { daemon: self.honest, nonce }.encode();
                        self.echoes.push_back((self.now + ROUND_TRIP, echo));
                    }
                }
                PeersOutput::Action(_) | PeersOutput::Multicast(_) => {}
            }
        }
        dialled
    }

    #[track_caller]
    fn links(&mut self, what: &str) {
        let after = self.play().unwrap_or_else(|| panic!("{what}: never dialled"));
        eprintln!("{what}: dialled after {after} ms");
        assert!(after <= LIMIT, "{what}: dialled after {after} ms");
        self.bounded();
        self.ends();
    }

    fn bounded(&self) {
        // One of the records was linked.
        assert!(self.peers.records.len() <= MOST_UNAUTHENTICATED + 1);
        assert!(self.peers.in_flight() <= MOST_IN_FLIGHT);
    }

    /// Ends the flood, and checks that nothing of it stays.
    fn ends(&mut self) {
        for second in 1..=300 {
            self.now += 1_000;
            // The honest host continues.
            if second % 10 == 0 {
                self.honest_speaks();
            }
            self.peers.handle_timeout(self.time());
            self.is_dialled();
        }
        assert_eq!(self.peers.records.len(), 1, "the honest host alone is known");
    }
}

fn made_up(number: u64) -> DaemonId {
    // The ids are above and below this host's own.
    let mut id = [if number.is_multiple_of(2) { 0x11 } else { 0xee }; 16];
    id[1..9].copy_from_slice(&number.to_be_bytes());
    DaemonId(id)
}

/// Returns an unused address of this subnet.
fn forged(number: u64) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 10 + (number % 240) as u8], 10_000 + (number / 7 % 50_000) as u16))
}

fn said(source: SocketAddr, daemon: DaemonId) -> (SocketAddr, Arrival, Datagram) {
    let beacon = Beacon { port: source.port(), answer_wanted: true, ..beacon(daemon) };
    (source, Arrival::Quic, Datagram::Beacon(beacon))
}

/// Forges 300 beacons a second, each of another daemon at another address.
fn from_everywhere(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let numbers = (ms * 3 / 10)..((ms + 1) * 3 / 10);
    numbers.map(|number| said(forged(number), made_up(number))).collect()
}

/// Forges 300 beacons a second, each of another daemon, from one address.
fn from_one_address(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let numbers = (ms * 3 / 10)..((ms + 1) * 3 / 10);
    let at = |number| SocketAddr::from(([10, 0, 0, 66], 10_000 + (number % 50_000) as u16));
    numbers.map(|number| said(at(number), made_up(number))).collect()
}

/// Forges 300 beacons a second, each of another daemon, from the honest host's address.
fn from_the_honest_address(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let numbers = (ms * 3 / 10)..((ms + 1) * 3 / 10);
    let at = |number| SocketAddr::from(([10, 0, 0, 2], 10_000 + (number % 50_000) as u16));
    numbers.map(|number| said(at(number), made_up(number))).collect()
}

/// Forges the same beacons from all ports that a daemon at the honest host's address would have.
fn from_the_expected_ports(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let mut all = from_the_honest_address(ms);
    for (number, (source, _, datagram)) in all.iter_mut().enumerate() {
        source.set_port(61_300 + (ms + number as u64) as u16 % 16);
        if let Datagram::Beacon(beacon) = datagram {
            beacon.port = source.port();
        }
    }
    all
}

/// Forges 20 beacons a second under the ids of the hosts that these tests know.
fn under_the_id(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let number = ms / 50;
    let ids = if ms.is_multiple_of(50) { &[LOWER, HIGHER][..] } else { &[] };
    ids.iter().map(|id| said(forged(number), *id)).collect()
}

/// Forges the same beacons at the honest host's address, with wrong ports.
fn under_the_id_with_wrong_ports(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let mut all = under_the_id(ms);
    for (source, ..) in &mut all {
        *source = SocketAddr::from(([10, 0, 0, 2], 20_000 + (ms / 50) as u16));
    }
    all
}

/// Forges 20 goodbyes a second in the names of the hosts that these tests know, from the honest host's address.
fn goodbyes(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let ids = if ms.is_multiple_of(50) { &[LOWER, HIGHER][..] } else { &[] };
    let goodbye = |daemon: &DaemonId| Datagram::Goodbye { domain: 0, daemon: *daemon };
    let at = SocketAddr::from(([10, 0, 0, 2], 40_000));
    ids.iter().map(|id| (at, Arrival::Shared, goodbye(id))).collect()
}

/// Forges goodbyes, and beacons under the same ids from other addresses.
fn goodbyes_and_beacons(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let mut all = goodbyes(ms);
    all.extend(under_the_id(ms + 17));
    all
}

/// Forges the datagrams of all three floods, and goodbyes under the same ids from the forged addresses.
fn everything(ms: u64) -> Vec<(SocketAddr, Arrival, Datagram)> {
    let mut all = from_everywhere(ms);
    all.extend(from_one_address(ms));
    all.extend(under_the_id(ms));
    if ms % 50 == 25 {
        for daemon in [LOWER, HIGHER] {
            let goodbye = Datagram::Goodbye { domain: 0, daemon };
            all.push((forged(ms / 50), Arrival::Quic, goodbye));
        }
    }
    all
}

#[test]
fn a_listed_host_is_dialled_through_any_flood() {
    for honest in [LOWER, HIGHER] {
        Scene::listed(honest, from_everywhere).links("listed, 300/s from everywhere");
        Scene::listed(honest, from_one_address).links("listed, 300/s from one address");
        Scene::listed(honest, from_the_honest_address).links("listed, 300/s from its address");
        Scene::listed(honest, from_the_expected_ports).links("listed, 300/s from its ports");
        Scene::listed(honest, under_the_id).links("listed, 20/s under its id");
        Scene::listed(honest, under_the_id_with_wrong_ports).links("listed, wrong ports");
        Scene::listed(honest, goodbyes).links("listed, goodbyes from its address");
        Scene::listed(honest, goodbyes_and_beacons).links("listed, goodbyes and beacons");
        Scene::listed(honest, everything).links("listed, everything");
    }
}

#[test]
fn a_host_that_was_linked_is_dialled_again_through_any_flood() {
    for honest in [LOWER, HIGHER] {
        for (forger, what) in [
            (from_everywhere as Forger, "met, 300/s from everywhere"),
            (from_one_address, "met, 300/s from one address"),
            (from_the_expected_ports, "met, 300/s from its ports"),
            (under_the_id, "met, 20/s under its id"),
            (under_the_id_with_wrong_ports, "met, wrong ports"),
            (goodbyes, "met, goodbyes from its address"),
            (goodbyes_and_beacons, "met, goodbyes and beacons"),
            (everything, "met, everything"),
        ] {
            let mut scene = Scene::met(honest, forger);
            // While the host was linked, beacons contradicted it.
            for ms in 0..1_000 {
                scene.now += 1;
                for (source, arrival, datagram) in forger(ms) {
                    scene.peers.handle_datagram(scene.time(), source, arrival, &datagram.encode());
                }
            }
            scene.peers.handle_link_down(scene.time(), honest);
            scene.starts = 0;
            scene.links(what);
        }
    }
}

#[test]
fn an_unknown_host_is_dialled_through_any_flood_once_it_answers() {
    for honest in [LOWER, HIGHER] {
        Scene::new(honest, from_everywhere).links("unknown, 300/s from everywhere");
        Scene::new(honest, from_one_address).links("unknown, 300/s from one address");
        Scene::new(honest, under_the_id).links("unknown, 20/s under its id");
        Scene::new(honest, goodbyes).links("unknown, goodbyes from its address");
        Scene::new(honest, goodbyes_and_beacons).links("unknown, goodbyes and beacons");
        Scene::new(honest, everything).links("unknown, everything");
    }
}

#[test]
fn an_answer_is_asked_of_no_flood() {
    // A listed host that asks for an answer gets it while other hosts ask without end.
    let mut scene = Scene::listed(HIGHER, from_everywhere);
    for ms in 0..5_000 {
        scene.now += 1;
        for (source, arrival, datagram) in from_everywhere(ms) {
            scene.peers.handle_datagram(scene.time(), source, arrival, &datagram.encode());
        }
        scene.is_dialled();
    }
    let ask = Beacon { port: 61300, answer_wanted: true, ..beacon(HIGHER) };
    let bytes = Datagram::Beacon(ask).encode();
    scene.peers.handle_datagram(scene.time(), scene.address, Arrival::Quic, &bytes);
    let answered = std::iter::from_fn(|| scene.peers.poll_output()).any(|output| match output {
        PeersOutput::Action(DiscoveryAction::SendFromQuicPort { to, bytes }) => {
            let said = Datagram::decode(&bytes);
            to == scene.address && matches!(said, Ok(Datagram::Beacon(b)) if b.daemon == OWN)
        }
        _ => false,
    });
    assert!(answered);
    // This daemon's own beacons are sent as often as without the flood.
    assert!(scene.peers.interval() <= secs(20.0), "{:?}", scene.peers.interval());
}

/// Returns the number of probes since the last call, by host.
fn probed(peers: &mut PeerDiscovery) -> BTreeMap<IpAddr, usize> {
    let mut hosts = BTreeMap::new();
    while let Some(output) = peers.poll_output() {
        if let PeersOutput::Action(DiscoveryAction::SendFromQuicPort { to, bytes }) = output
            && matches!(Datagram::decode(&bytes), Ok(Datagram::Probe { .. }))
        {
            *hosts.entry(to.ip()).or_default() += 1;
        }
    }
    hosts
}

/// Returns the most probes that one host receives within ten seconds of the forger's datagrams, at four times its rate.
fn most_probed(mut scene: Scene) -> usize {
    for ms in 0..10_000 {
        scene.now += 1;
        for number in 4 * ms..4 * ms + 4 {
            for (source, arrival, datagram) in (scene.forger)(number) {
                scene.peers.handle_datagram(scene.time(), source, arrival, &datagram.encode());
            }
        }
        scene.peers.handle_timeout(scene.time());
    }
    probed(&mut scene.peers).into_values().max().unwrap_or(0)
}

#[test]
fn a_host_in_whose_name_beacons_are_forged_hears_few_probes() {
    // At most 32 in each of the four periods for answers.
    const OTHERS: usize = 4 * 32;
    let most = most_probed(Scene::new(HIGHER, from_one_address));
    assert!((1..=OTHERS).contains(&most), "{most}");
    let most = most_probed(Scene::listed(HIGHER, from_the_honest_address));
    assert!((1..=OTHERS).contains(&most), "{most}");
    // At a known host each of the sixteen ports is probed four times a second.
    let most = most_probed(Scene::listed(HIGHER, from_the_expected_ports));
    assert!((1..=OTHERS + 16 * 41).contains(&most), "{most}");
    // A port with a daemon that answers is probed as often.
    let mut scene = Scene::listed(HIGHER, from_the_expected_ports);
    for ms in 0..10_000 {
        scene.now += 1;
        for number in 4 * ms..4 * ms + 4 {
            for (source, arrival, datagram) in from_the_expected_ports(number) {
                scene.peers.handle_datagram(scene.time(), source, arrival, &datagram.encode());
            }
        }
        scene.peers.handle_timeout(scene.time());
        scene.is_dialled();
    }
    assert!((1..=41).contains(&scene.probes), "{}", scene.probes);
}

#[test]
fn probes_of_strangers_keep_no_answer_from_a_host_that_is_known() {
    let mut scene = Scene::listed(HIGHER, from_everywhere);
    let (now, address) = (scene.time(), scene.address);
    let probe = |nonce: u64| Datagram::Probe { daemon: HIGHER, nonce: nonce.to_be_bytes() };
    for number in 0..5_000 {
        scene.peers.handle_datagram(now, forged(number), Arrival::Quic, &probe(number).encode());
    }
    let echoes = std::iter::from_fn(|| scene.peers.poll_output()).count();
    assert!(echoes <= 1_024, "{echoes}");
    scene.peers.handle_datagram(now, address, Arrival::Quic, &probe(7).encode());
    assert!(scene.peers.poll_output().is_some());
}

#[test]
fn no_more_beacons_of_strangers_are_looked_at_than_a_second_has_time_for() {
    let mut scene = Scene::listed(HIGHER, from_everywhere);
    let now = scene.time();
    let all = |number| said(forged(number), made_up(number));
    for (source, arrival, datagram) in (0..20_000).map(all) {
        scene.peers.handle_datagram(now, source, arrival, &datagram.encode());
    }
    let outputs = std::iter::from_fn(|| scene.peers.poll_output());
    let gone =
        outputs.filter(|o| matches!(o, PeersOutput::Action(DiscoveryAction::Gone { .. }))).count();
    let heard = gone + scene.peers.records.len();
    assert!((500..=1_024).contains(&heard), "{heard}");
    scene.honest_speaks();
    assert!(scene.peers.records.contains_key(&HIGHER), "one that is listed is always heard");
}

#[test]
fn a_flood_pushes_out_no_host_that_answered() {
    let mut scene = Scene::new(HIGHER, from_the_honest_address);
    // Dials to the host fail, so that only its answer shows that it is there.
    scene.honest_speaks();
    let source = scene.address;
    let record = scene.peers.records.get_mut(&HIGHER).unwrap();
    record.sources.iter_mut().for_each(|source| source.answered = true);
    record.done();
    for ms in 0..10_000 {
        scene.now += 1;
        for (source, arrival, datagram) in from_the_honest_address(ms) {
            scene.peers.handle_datagram(scene.time(), source, arrival, &datagram.encode());
        }
        while scene.peers.poll_output().is_some() {}
    }
    let record = &scene.peers.records[&HIGHER];
    assert!(record.sources.iter().any(|s| s.answered && s.address == source));
}

#[test]
fn an_address_that_answers_under_many_names_counts_once() {
    let mut scene = Scene::new(HIGHER, from_one_address);
    for number in 0..100 {
        let (_, arrival, datagram) = said(forged(number), made_up(number));
        let one = SocketAddr::from(([10, 0, 0, 66], 61_300));
        scene.peers.handle_datagram(scene.time(), one, arrival, &datagram.encode());
    }
    for record in scene.peers.records.values_mut() {
        record.sources.iter_mut().for_each(|source| source.answered = true);
    }
    assert!(scene.peers.records.len() >= 100);
    assert_eq!(scene.peers.interval(), secs(10.0));
}
