//! The task that supplies [`PeerDiscovery`] with its clock, its sockets and its events.

use std::{
    collections::{BTreeMap, BTreeSet},
    future::pending,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, DiscoveryRange};
use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
    time::{Instant, MissedTickBehavior, interval, sleep_until, timeout},
};
use tracing::{debug, warn};

use super::{
    AddressConfidence, Arrival, Datagrams, DiscoveryAction, DiscoveryNeeds, LocalDaemon,
    PeerDiscovery, PeersOutput, interfaces, socket::SharedSocket,
};

use crate::token_bucket::TokenBucket;

/// Time between two scans of the network interfaces.
const INTERFACES_EVERY: Duration = Duration::from_secs(3);
/// Time between two look-ups of the names of listed peers.
const NAMES_EVERY: Duration = Duration::from_secs(30);
const NAME_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of datagrams that are handled before the resulting actions are carried out.
const TOGETHER: usize = 64;
/// The same limit for the shared port: more than its buffer holds.
const TOGETHER_SHARED: usize = 512;
/// Rate at which single datagrams of the shared port are handled as they come: burst, and number each second. Beyond
/// it, the datagrams of one `REST` are handled together.
const DATAGRAM_BURST: (u32, u32) = (32, 16);
const REST: Duration = Duration::from_millis(20);
/// Maximum number of addresses of one name.
const MOST_OF_A_NAME: usize = 4;

/// A message from the daemon to discovery.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub(crate) enum DiscoveryEvent {
    /// Datagrams came to the QUIC port whose first byte [is discovery's](super::is_discovery).
    Datagrams(Datagrams),
    /// The QUIC port is bound. Discovery sends nothing before.
    QuicPort(u16),
    /// A link stands, from a dial of either side.
    LinkUp {
        /// The id of the peer.
        daemon: DaemonId,
        /// The address of the peer.
        address: SocketAddr,
        /// Whether the peer proved that the id is its own.
        proven: bool,
    },
    /// The last link with a daemon is gone.
    LinkDown {
        /// The id of the peer.
        daemon: DaemonId,
    },
    /// A report whether the path of a link works.
    Path {
        /// The id of the peer.
        daemon: DaemonId,
        /// Whether the path works.
        works: bool,
    },
    /// A [`DiscoveryAction::Dial`] did not lead to a link.
    DialFailed {
        /// The id of the dialled daemon.
        daemon: DaemonId,
        /// The standing, as in the action.
        standing: AddressConfidence,
        /// The address at which an authenticated peer answered that it is another daemon, or that it ends.
        absent_at: Option<SocketAddr>,
    },
    /// The graph has a new digest.
    GraphDigest(u64),
}

/// Discovers within the limits of `wanted` until `events` closes. Then it says goodbye and ends, which closes
/// `actions`.
///
/// Never waits for `actions` to have room: a datagram that finds no room is lost, and a dial counts as failed. No
/// failure of a socket, an interface or a name ends it; the failure is logged, and the rest goes on. Dropping the
/// future is safe, and says no goodbye.
pub(crate) async fn run(
    config: &Config,
    daemon: DaemonId,
    mut wanted: watch::Receiver<DiscoveryNeeds>,
    mut events: mpsc::Receiver<DiscoveryEvent>,
    actions: mpsc::Sender<DiscoveryAction>,
) {
    let mut shell = DiscoveryIo::new(config, daemon, actions);
    let mut look = interval(INTERFACES_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut names = interval(NAMES_EVERY);
    names.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut lookups = JoinSet::new();
    let mut hosts = BTreeSet::new();
    let mut range = DiscoveryRange::Off;
    // While this is set, datagrams wait at the shared port until this time, so that those of a flood are handled
    // together.
    let mut rest: Option<Instant> = None;
    wanted.mark_changed();

    loop {
        let nameless = hosts.is_empty() && shell.names.is_empty();
        let looks = looks_for_somebody(range, &hosts);
        let wakeup = shell.peers.poll_timeout().map(|at| shell.start + at);
        tokio::select! {
            event = events.recv() => match event {
                Some(event) => {
                    shell.event(event);
                    // Events that are already queued are handled together.
                    let more = std::iter::from_fn(|| events.try_recv().ok());
                    more.take(TOGETHER).for_each(|event| shell.event(event));
                }
                None => break,
            },
            datagram = receive(shell.socket.as_ref()), if rest.is_none() => match datagram {
                Ok((from, bytes)) => rest = shell.heard(from, &bytes).then(|| Instant::now() + REST),
                Err(error) => {
                    debug!(%error, "the shared discovery port fails, opening it anew");
                    shell.socket = None;
                }
            },
            () = sleep_until_some(wakeup) => {}
            () = sleep_until_some(rest), if rest.is_some() => rest = None,
            Ok(()) = wanted.changed() => {
                let now = wanted.borrow_and_update().clone();
                range = now.range;
                shell.set_range(range);
                if hosts != now.hosts {
                    hosts = now.hosts;
                    // The next look-up starts after the current one has ended, with the needs of that time.
                    names.reset_immediately();
                }
                if range != DiscoveryRange::Off {
                    shell.look_at_interfaces();
                }
                // A timer that is set fires, even if it is not awaited.
                if looks_for_somebody(range, &hosts) {
                    look.reset();
                }
            }
            _ = look.tick(), if looks => shell.look_at_interfaces(),
            _ = names.tick(), if lookups.is_empty() && !nameless => {
                lookups.spawn(look_up(hosts.clone()));
            }
            Some(found) = lookups.join_next() => if let Ok(found) = found {
                shell.set_found(found);
            },
        }
        let now = shell.start.elapsed();
        shell.peers.handle_timeout(now);
        shell.carry_out();
    }
    shell.peers.say_goodbye();
    shell.carry_out();
}

struct DiscoveryIo {
    start: Instant,
    peers: PeerDiscovery,
    socket: Option<SharedSocket>,
    /// The budget of datagrams of the shared port that may be handled at once.
    at_once: TokenBucket,
    /// Whether the shared port is used at all.
    multicast: bool,
    domain: u32,
    bind: Vec<IpAddr>,
    actions: mpsc::Sender<DiscoveryAction>,
    /// The addresses of static peers. A name keeps its last addresses while its look-up fails.
    names: BTreeMap<String, Vec<IpAddr>>,
    /// Whether the last attempt to open the shared port failed, so that the failure is logged once.
    complained: bool,
}

impl DiscoveryIo {
    fn new(config: &Config, daemon: DaemonId, actions: mpsc::Sender<DiscoveryAction>) -> Self {
        Self {
            start: Instant::now(),
            peers: PeerDiscovery::new(LocalDaemon::of(config, daemon), rand::random()),
            socket: None,
            at_once: TokenBucket::new(DATAGRAM_BURST.0, DATAGRAM_BURST.1),
            multicast: false,
            domain: config.domain,
            bind: config.bind_addrs.clone(),
            actions,
            names: BTreeMap::new(),
            complained: false,
        }
    }

    fn set_range(&mut self, range: DiscoveryRange) {
        self.multicast = range == DiscoveryRange::Subnet;
        if !self.multicast {
            // Leaves the group.
            self.socket = None;
        }
        let now = self.start.elapsed();
        self.peers.set_range(now, range);
    }

    fn set_found(&mut self, found: ResolvedHosts) {
        let now = self.start.elapsed();
        let mut listed = Vec::new();
        let mut names: BTreeMap<String, Vec<IpAddr>> = BTreeMap::new();
        for ((host, port), mut addresses) in found {
            if addresses.is_empty() {
                addresses = self.names.get(&host).cloned().unwrap_or_default();
            }
            listed.extend(addresses.iter().map(|address| (*address, port)));
            names.entry(host).or_default().extend(addresses);
        }
        listed.dedup();
        self.peers.set_listed(now, listed);
        self.names.clone_from(&names);
        // If the channel is full, the message is dropped; the next one replaces it.
        let _ = self.actions.try_send(DiscoveryAction::Named(names));
    }

    /// Handles a datagram of the shared port, together with the datagrams that wait there. Returns whether they were so
    /// many that later ones may wait.
    fn heard(&mut self, from: SocketAddr, bytes: &[u8]) -> bool {
        let now = self.start.elapsed();
        self.peers.handle_datagram(now, from, Arrival::Shared, bytes);
        let mut at_once = self.at_once.take(now);
        for _ in 1..TOGETHER_SHARED {
            let next = self.socket.as_ref().and_then(SharedSocket::try_receive);
            let Some((from, bytes)) = next else { break };
            self.peers.handle_datagram(now, from, Arrival::Shared, &bytes);
            at_once &= self.at_once.take(now);
        }
        !at_once
    }

    fn event(&mut self, event: DiscoveryEvent) {
        let now = self.start.elapsed();
        match event {
            DiscoveryEvent::Datagrams(datagrams) => {
                for (from, bytes) in datagrams.iter() {
                    self.peers.handle_datagram(now, from, Arrival::Quic, bytes);
                }
            }
            DiscoveryEvent::QuicPort(port) => self.peers.set_port(now, port),
            DiscoveryEvent::LinkUp { daemon, address, proven } => {
                self.peers.handle_link_up(now, daemon, address, proven);
            }
            DiscoveryEvent::LinkDown { daemon } => self.peers.handle_link_down(now, daemon),
            DiscoveryEvent::Path { daemon, works } => self.peers.handle_path(now, daemon, works),
            DiscoveryEvent::DialFailed { daemon, standing, absent_at } => {
                if let Some(address) = absent_at {
                    self.peers.handle_absent(daemon, address);
                }
                self.peers.handle_dial_failed(now, daemon, standing);
            }
            DiscoveryEvent::GraphDigest(digest) => self.peers.set_graph(digest),
        }
    }

    fn look_at_interfaces(&mut self) {
        let found = match interfaces() {
            Ok(found) => found,
            Err(error) => return warn!(%error, "cannot list the network interfaces"),
        };
        if self.multicast && self.socket.is_none() {
            match SharedSocket::open(self.domain, &self.bind) {
                Ok(socket) => self.socket = Some(socket),
                Err(error) if !self.complained => {
                    self.complained = true;
                    warn!(%error, "cannot open the shared discovery port; listed peers work");
                }
                Err(_) => {}
            }
        }
        if let Some(socket) = &mut self.socket {
            socket.follow(&found);
        }
        let now = self.start.elapsed();
        self.peers.set_interfaces(now, found);
    }

    fn carry_out(&mut self) {
        while let Some(output) = self.peers.poll_output() {
            match output {
                PeersOutput::Multicast(bytes) => {
                    if let Some(socket) = &mut self.socket {
                        socket.send(&bytes);
                    }
                }
                PeersOutput::Action(action) => {
                    let dial = match &action {
                        DiscoveryAction::Dial { daemon, standing, .. } => {
                            Some((*daemon, *standing))
                        }
                        _ => None,
                    };
                    if let (Err(_), Some((daemon, standing))) =
                        (self.actions.try_send(action), dial)
                    {
                        let now = self.start.elapsed();
                        self.peers.handle_dial_failed(now, daemon, standing);
                    }
                }
            }
        }
    }
}

async fn receive(socket: Option<&SharedSocket>) -> std::io::Result<(SocketAddr, Vec<u8>)> {
    match socket {
        Some(socket) => socket.receive().await,
        None => pending().await,
    }
}

/// Returns whether discovery looks for any peer. Otherwise a change of interfaces is no reason to wake up.
fn looks_for_somebody(range: DiscoveryRange, hosts: &BTreeSet<(String, Option<u16>)>) -> bool {
    match range {
        DiscoveryRange::Off => false,
        DiscoveryRange::Localhost => !hosts.is_empty(),
        DiscoveryRange::Subnet => true,
    }
}

async fn sleep_until_some(at: Option<Instant>) {
    match at {
        Some(at) => sleep_until(at).await,
        None => pending().await,
    }
}

/// Hosts, with a port where one was given, and their addresses.
type ResolvedHosts = Vec<((String, Option<u16>), Vec<IpAddr>)>;

async fn look_up(hosts: BTreeSet<(String, Option<u16>)>) -> ResolvedHosts {
    // The look-ups run in parallel: a name server that does not answer for one host delays no other.
    let mut lookups = JoinSet::new();
    for (host, port) in hosts {
        lookups.spawn(async move {
            let addresses = addresses_of(&host).await;
            ((host, port), addresses)
        });
    }
    let mut found = lookups.join_all().await;
    found.sort_unstable();
    found
}

async fn addresses_of(host: &str) -> Vec<IpAddr> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return vec![address.to_canonical()];
    }
    match timeout(NAME_TIMEOUT, tokio::net::lookup_host((host, 0))).await {
        Ok(Ok(addresses)) => {
            addresses.take(MOST_OF_A_NAME).map(|address| address.ip().to_canonical()).collect()
        }
        Ok(Err(error)) => {
            debug!(host, %error, "static peer has no address");
            Vec::new()
        }
        Err(_) => {
            debug!(host, "static peer: no answer to the look-up of its name");
            Vec::new()
        }
    }
}
