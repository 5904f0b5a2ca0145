//! A world of hosts on one network, with a virtual clock.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt::Write,
    iter,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    time::{Duration, Instant},
};

use axon_shm::{
    ids::{DaemonId, Gid},
    qos::{History, Qos, Reliability},
};
use axon_transport::config::Config;
use bytes::BytesMut;
use quinn_proto::Transmit;

use super::{
    host::{Host, PORT},
    network::Network,
    raw::Raw,
};
use crate::{engine::keyring::tests::Kmes, keys::KmeAnswer};

/// A KME answers after this time.
const KME: Duration = Duration::from_millis(20);

/// The second byte of the addresses of second interfaces.
const SECOND_NETWORK: u8 = 200;

fn is_second(address: IpAddr) -> bool {
    matches!(address.to_canonical(), IpAddr::V4(v4) if v4.octets()[1] == SECOND_NETWORK)
}

/// An endpoint, and its host.
type HostEndpoint = (usize, Gid);

/// Hosts on a network.
pub(super) struct World {
    pub(super) now: Duration,
    pub(super) network: Network,
    pub(super) hosts: Vec<Host>,
    /// Peers without an engine.
    pub(super) raws: Vec<Raw>,
    epoch: Instant,
    pub(super) kmes: Kmes,
    answers: Vec<(Duration, usize, KmeAnswer)>,
    stopped: Vec<bool>,
    /// Passes of each host since the start.
    pub(super) passes: Vec<u64>,
    /// Datagrams in each batch of several that a host sent, for the hosts of the map.
    pub(super) batches: HashMap<usize, Vec<usize>>,
    /// Publishers and subscriptions whose samples are checked.
    pub(super) pairs: Vec<Pair>,
}

/// A publisher and a subscription on two hosts.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    pub(super) publisher: (usize, Gid),
    pub(super) subscription: (usize, Gid),
}

impl World {
    /// Creates `hosts` hosts with these settings. Their daemons are started and link with each other.
    pub(super) fn new(seed: u64, hosts: usize, config: impl Fn(usize) -> Config) -> Self {
        let mut world = Self::apart(seed, hosts, config);
        (0..hosts).for_each(|host| world.introduce(host));
        world
    }

    /// Creates hosts like [`new`](Self::new). They find each other by beacons.
    pub(super) fn with_beacons(seed: u64, hosts: usize, config: impl Fn(usize) -> Config) -> Self {
        let mut world = Self::apart(seed, hosts, config);
        world.hosts.iter_mut().for_each(|host| host.use_beacons(Duration::ZERO));
        (0..hosts).for_each(|host| world.introduce(host));
        world
    }

    /// Creates hosts like [`new`](Self::new), but no host dials.
    pub(super) fn apart(seed: u64, hosts: usize, config: impl Fn(usize) -> Config) -> Self {
        let epoch = Instant::now();
        let mut network = Network::new(seed);
        let mut all = Vec::new();
        for number in 0..hosts {
            let mut host = Host::new(number, config(number), seed, epoch);
            assert_eq!(network.add_host(&[host.address]), number);
            host.start(Duration::ZERO);
            all.push(host);
        }
        Self {
            now: Duration::ZERO,
            network,
            hosts: all,
            raws: Vec::new(),
            epoch,
            kmes: Kmes::default(),
            answers: Vec::new(),
            stopped: vec![false; hosts],
            passes: vec![0; hosts],
            batches: HashMap::new(),
            pairs: Vec::new(),
        }
    }

    /// Makes each other host link with a host's daemon, and the other way round.
    fn introduce(&mut self, of: usize) {
        for other in (0..self.hosts.len()).filter(|other| *other != of) {
            self.tell(other, of);
            self.tell(of, other);
        }
    }

    /// Makes a host link with another one, which it dials.
    pub(super) fn tell(&mut self, host: usize, of: usize) {
        let other = &self.hosts[of];
        let (daemon, address, sae) = (other.daemon, other.address, other.sae());
        self.hosts[host].want(daemon, address, sae, self.now);
    }

    /// Gives a host a second interface, in another network.
    pub(super) fn add_second_interface(&mut self, host: usize) -> Ipv4Addr {
        let [_, _, high, low] = self.hosts[host].address.octets();
        let second = Ipv4Addr::new(10, SECOND_NETWORK, high, low);
        self.network.add_interface(host, second, 1);
        self.hosts[host].second = Some(second);
        second
    }

    /// Gives a raw peer a second interface, in another network.
    pub(super) fn add_second_interface_of_raw(&mut self, raw: usize) {
        let [_, _, high, low] = self.raws[raw].address.octets();
        let second = Ipv4Addr::new(10, SECOND_NETWORK, high, low);
        self.network.add_interface(self.hosts.len() + raw, second, 1);
        self.raws[raw].second = Some(second);
    }

    /// Makes each host hear the beacons of all others, from all their addresses.
    pub(super) fn hear_all_addresses(&mut self) {
        for host in 0..self.hosts.len() {
            for other in (0..self.hosts.len()).filter(|other| *other != host) {
                let peer = &self.hosts[other];
                let (daemon, first) = (peer.daemon, peer.address);
                let addresses: Vec<_> = iter::once(first).chain(peer.second).collect();
                self.hosts[host].hear_addresses(daemon, &addresses);
            }
        }
    }

    /// Adds a raw peer, which a test controls. Returns its number among the raw peers.
    pub(super) fn add_raw(&mut self, config: Config, daemon: DaemonId) -> usize {
        let host = self.hosts.len() + self.raws.len();
        let raw = Raw::new(host, config, daemon, self.epoch);
        assert_eq!(self.network.add_host(&[raw.address]), host);
        self.raws.push(raw);
        self.raws.len() - 1
    }

    /// Calls `act` on a raw peer, and sends the resulting packets.
    pub(super) fn with_raw<T>(
        &mut self,
        number: usize,
        act: impl FnOnce(&mut Raw, Duration) -> T,
    ) -> T {
        let done = act(&mut self.raws[number], self.now);
        self.pass_raw(number);
        done
    }

    fn pass_raw(&mut self, number: usize) {
        let (now, raw) = (self.now, &mut self.raws[number]);
        raw.pass(now);
        let (first, second) = (raw.address, raw.second);
        while let Some((transmit, bytes)) = raw.poll_transmit(now) {
            let Transmit { destination: to, ecn, size, segment_size, .. } = transmit;
            let from = second.filter(|_| is_second(to.ip())).unwrap_or(first);
            let from = SocketAddr::from((from, PORT));
            self.network.send(now, from, to, ecn, &bytes[..size], segment_size);
        }
    }

    /// Ends a host's daemon: at once, or as after SIGTERM.
    pub(super) fn kill(&mut self, host: usize, orderly: bool) {
        if orderly {
            self.close(host);
        }
        self.hosts[host].kill();
    }

    /// Makes a host's daemon end in order, as far as it gets before it is killed.
    pub(super) fn close(&mut self, host: usize) {
        self.hosts[host].close(self.now);
        self.transmit(host);
    }

    /// Stops a host, or lets it go on. Datagrams wait meanwhile.
    pub(super) fn stop(&mut self, host: usize, stopped: bool) {
        self.stopped[host] = stopped;
        if stopped {
            self.network.pause(host);
        } else {
            self.network.resume(self.now, host);
        }
    }

    /// Gives a host another address, which the others learn.
    pub(super) fn move_host(&mut self, host: usize) {
        let [_, subnet, high, low] = self.hosts[host].address.octets();
        let address = Ipv4Addr::new(10, subnet.wrapping_add(1), high, low);
        self.network.move_host(self.hosts[host].address, address);
        self.hosts[host].address = address;
        let daemon = self.hosts[host].daemon;
        self.hosts.iter_mut().for_each(|other| other.moved(daemon, address));
    }

    /// Swaps the addresses of two hosts. All hosts learn the new addresses.
    pub(super) fn swap_hosts(&mut self, one: usize, other: usize) {
        let [first, second] = [one, other].map(|host| self.hosts[host].address);
        self.move_host(one);
        let between = self.hosts[one].address;
        self.network.move_host(second, first);
        self.network.move_host(between, second);
        (self.hosts[one].address, self.hosts[other].address) = (second, first);
        for host in [one, other] {
            let (daemon, address) = (self.hosts[host].daemon, self.hosts[host].address);
            self.hosts.iter_mut().for_each(|other| other.moved(daemon, address));
        }
    }

    /// Makes each publisher of a topic on a host publish a sample.
    pub(super) fn publish_all(&mut self, host: usize, topic: usize, size: usize) {
        let publishers = self.hosts[host].rings.publishers(&super::run::name(topic));
        for publisher in publishers {
            self.hosts[host].rings.publish(publisher, size);
            self.hosts[host].ring();
        }
    }

    /// Returns each RELIABLE and KEEP_ALL pair that transferred a sample: the publisher, the subscription, and the
    /// number of samples that are missing after the first that came. Samples that were published while no relay stood
    /// for the subscription do not count: its host, or the publisher's daemon, was not there.
    fn losses(&self) -> Vec<(HostEndpoint, (HostEndpoint, u64))> {
        let mut losses = Vec::new();
        for there in &self.hosts {
            for (subscription, publisher, mut came) in there.rings.complete() {
                let from = self.hosts.iter().find(|host| {
                    host.rings.publisher(publisher).is_some_and(|qos| {
                        qos.history == History::KeepAll && qos.reliability == Reliability::Reliable
                    })
                });
                let Some(from) = from else { continue };
                let first = came[0];
                came.sort_unstable();
                let promised = from.rings.promised(publisher, subscription).into_iter();
                let missing = promised
                    .filter(|number| *number > first && came.binary_search(number).is_err())
                    .count() as u64;
                losses.push(((from.number, publisher), ((there.number, subscription), missing)));
            }
        }
        losses
    }

    /// Checks, once all is quiet, that no RELIABLE and KEEP_ALL samples are missing except those that were given up.
    pub(super) fn check_losses(&self, case: &str) {
        for (from, to) in self.losses() {
            let (missing, given_up) = (to.1, self.hosts[from.0].rings.given_up(from.1));
            assert!(
                missing <= given_up,
                "{case}: {missing} samples of {from:?} are missing at {:?}, and {given_up} were given up: {}",
                to.0,
                self.describe()
            );
        }
    }

    /// Starts a host's daemon again, under a new id. The others forget the old one.
    pub(super) fn restart(&mut self, host: usize) {
        let old = self.hosts[host].daemon;
        for other in &mut self.hosts {
            other.unwant(old);
        }
        let now = self.now;
        self.hosts[host].start(now);
        self.introduce(host);
    }

    /// Creates a publisher and a subscription of the same topic on two hosts.
    pub(super) fn pair(&mut self, from: usize, to: usize, topic: &str, qos: Qos) -> Pair {
        let publisher = self.hosts[from].rings.create_publisher(topic, qos);
        let subscription = self.hosts[to].rings.create_subscription(topic, qos, None);
        self.hosts[from].touch_graph();
        self.hosts[to].touch_graph();
        let pair = Pair { publisher: (from, publisher), subscription: (to, subscription) };
        self.pairs.push(pair);
        pair
    }

    /// Publishes a sample.
    pub(super) fn publish(&mut self, pair: Pair, length: usize) -> bool {
        let (host, publisher) = pair.publisher;
        let published = self.hosts[host].rings.publish(publisher, length);
        self.hosts[host].ring();
        published
    }

    /// Returns the numbers of the samples that arrived.
    pub(super) fn received(&self, pair: Pair) -> Vec<u64> {
        let (host, subscription) = pair.subscription;
        self.hosts[host].rings.received(subscription, pair.publisher.1)
    }

    fn due(&self, host: usize) -> Option<Duration> {
        if self.stopped[host] { None } else { self.hosts[host].poll_timeout(self.now) }
    }

    /// Returns the time of the next event.
    pub(super) fn next(&mut self) -> Option<Duration> {
        let raws = self.raws.iter_mut().filter_map(Raw::poll_timeout).min();
        let hosts = (0..self.hosts.len()).filter_map(|host| self.due(host)).min();
        let answer = self.answers.iter().map(|(at, ..)| *at).min();
        [hosts, raws, answer, self.network.poll_timeout()].into_iter().flatten().min()
    }

    /// Runs to the next event, and does it.
    pub(super) fn run_one(&mut self) {
        self.now = self.next().expect("a daemon that runs has something to do").max(self.now);
        self.step();
    }

    /// Runs until this time.
    pub(super) fn run_until(&mut self, until: Duration) {
        while self.now < until {
            let next = self.next().unwrap_or(until).max(self.now);
            if next > until {
                self.now = until;
                break;
            }
            self.now = next;
            self.step();
        }
    }

    /// Runs for so long.
    pub(super) fn run_for(&mut self, time: Duration) {
        self.run_until(self.now + time);
    }

    /// Runs until `holds` returns true. Panics with the state of all hosts if that takes `most` or longer.
    pub(super) fn until(&mut self, most: Duration, holds: impl Fn(&Self) -> bool) {
        let end = self.now + most;
        while !holds(self) {
            let next = self.next().unwrap_or(end).max(self.now);
            assert!(next < end, "not within {most:?}:\n{}", self.describe());
            self.now = next;
            self.step();
        }
    }

    /// Handles one event: all that is due now. A host handles all datagrams that came at one time in one pass, as the
    /// reactor does.
    fn step(&mut self) {
        let now = self.now;
        let mut came = BTreeSet::new();
        while let Some(delivery) = self.network.poll_delivery(now) {
            if delivery.at.port() != PORT {
                continue;
            }
            let bytes = BytesMut::from(delivery.bytes);
            match self.hosts.get_mut(delivery.host) {
                Some(host) => {
                    let to = delivery.at.ip();
                    host.handle_datagram(now, delivery.from, to, delivery.ecn, bytes);
                }
                None => {
                    let raw = &mut self.raws[delivery.host - self.hosts.len()];
                    let ends = (delivery.from, delivery.at.ip());
                    raw.handle_datagram(now, ends, delivery.ecn, bytes);
                }
            }
            came.insert(delivery.host);
        }
        for host in came {
            match host.checked_sub(self.hosts.len()) {
                None => self.pass(host),
                Some(raw) => self.pass_raw(raw),
            }
        }
        let due: Vec<_> = self.answers.extract_if(.., |(at, ..)| *at <= now).collect();
        for (_, host, event) in due {
            self.hosts[host].handle_key_event(now, event);
            self.pass(host);
        }
        for host in 0..self.hosts.len() {
            let due = self.due(host);
            if due.is_some_and(|due| due <= now) {
                self.pass(host);
            }
        }
        for raw in 0..self.raws.len() {
            if self.raws[raw].poll_timeout().is_some_and(|due| due <= now) {
                self.pass_raw(raw);
            }
        }
    }

    fn pass(&mut self, number: usize) {
        let now = self.now;
        self.passes[number] += 1;
        self.hosts[number].pass(now);
        self.transmit(number);
        let host = &mut self.hosts[number];
        for (origin, request) in std::mem::take(&mut host.requests) {
            let answer = self.kmes.answer(request);
            self.answers.push((now + KME, number, KmeAnswer { origin, answer }));
        }
        self.check(number);
    }

    fn transmit(&mut self, number: usize) {
        let now = self.now;
        let host = &mut self.hosts[number];
        let (first, second) = (host.address, host.second);
        let mut buffer = Vec::new();
        while let Some(transmit) = host.poll_transmit(&mut buffer, now) {
            let (to, bytes) = (transmit.destination, &buffer[..transmit.size]);
            // The routing table sends to each network through the interface that is in it.
            let from = second.filter(|_| is_second(to.ip())).unwrap_or(first);
            let from = SocketAddr::from((from, PORT));
            if let (Some(each), Some(batches)) =
                (transmit.segment_size, self.batches.get_mut(&number))
            {
                batches.push(transmit.size.div_ceil(each));
            }
            self.network.send(now, from, to, transmit.ecn, bytes, transmit.segment_size);
        }
    }

    /// Checks the invariants after each pass: no sample came twice, out of order or damaged.
    fn check(&mut self, host: usize) {
        self.hosts[host].check_held(self.now);
        let rings = &self.hosts[host].rings;
        assert_eq!(rings.damaged(), 0, "a sample was damaged: {}", self.describe());
        assert_eq!(rings.disordered(), 0, "a sample came twice or late: {}", self.describe());
    }

    /// Returns whether all running daemons are linked with each other.
    pub(super) fn is_linked(&self) -> bool {
        let running = self.hosts.iter().filter(|host| host.is_running());
        running.clone().all(|host| {
            running.clone().all(|o| o.number == host.number || host.linked().contains(&o.daemon))
        })
    }

    /// Returns whether each host knows the endpoints of all others.
    pub(super) fn is_whole(&self) -> bool {
        self.is_linked()
            && self.hosts.iter().filter(|host| host.is_running()).all(|host| {
                let others = self.hosts.iter().filter(|o| o.is_running());
                others.filter(|o| o.number != host.number).all(|o| host.knows(o))
            })
    }

    /// Describes the state of all hosts, for a failure.
    pub(super) fn describe(&self) -> String {
        let mut text = format!("at {:?}\n", self.now);
        for host in &self.hosts {
            let _ = writeln!(
                text,
                "host {} daemon {} linked {:?} lost {:?} waits for room {}",
                host.number,
                host.daemon,
                host.linked().len(),
                host.lost,
                host.rings.waits_for_room()
            );
            let others = self.hosts.iter().filter(|o| o.is_running() && o.number != host.number);
            for o in others.filter(|o| !host.knows(o)) {
                let known = host.graph.get(&o.daemon).map(BTreeMap::len);
                let shown = o.rings.endpoints().len();
                let _ = writeln!(text, "  knows {known:?} of {shown} endpoints of {}", o.number);
            }
            for (at, refusal) in host.refusals.iter().rev().take(8) {
                let _ = writeln!(text, "  {at:?} {refusal}");
            }
        }
        for pair in &self.pairs {
            let (host, publisher) = pair.publisher;
            let received = self.received(*pair);
            let _ = writeln!(
                text,
                "{pair:?}: published {}, received {}, given up {}, last {:?}",
                self.hosts[host].rings.published(publisher),
                received.len(),
                self.hosts[host].rings.given_up(publisher),
                received.last()
            );
        }
        text
    }
}
