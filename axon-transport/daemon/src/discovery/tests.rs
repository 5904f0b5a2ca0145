//! Tests with real sockets on this host's loopback interface.

use std::{net::SocketAddr, time::Duration};

use axon_transport::config::{Config, OsFiles};
use tokio::{
    net::UdpSocket,
    sync::{mpsc, watch},
    time::timeout,
};

use super::{socket::SharedSocket, *};
use crate::wire::beacon::Datagram;

/// Long enough that only a defect reaches it.
const PATIENCE: Duration = Duration::from_secs(30);

fn config(domain: u32, env: &[(&str, &str)]) -> Config {
    let domain = ("ROS_DOMAIN_ID", &*domain.to_string());
    let env = env.iter().copied().chain([domain]).map(|(name, value)| (name.into(), value.into()));
    Config::resolve(env.collect::<Vec<_>>(), None, &OsFiles).unwrap()
}

/// A daemon as discovery sees it: the task, and a UDP socket on a QUIC port.
struct Daemon {
    id: DaemonId,
    address: SocketAddr,
    events: mpsc::Sender<DiscoveryEvent>,
    /// All actions except the datagrams, which [`carry`] carries out.
    actions: mpsc::Receiver<DiscoveryAction>,
}

impl Daemon {
    async fn start(config: Config) -> Self {
        let id = DaemonId::random();
        let mut quic = None;
        for port in quic_ports(config.domain) {
            quic = UdpSocket::bind((config.bind_addrs[0], port)).await.ok();
            if quic.is_some() {
                break;
            }
        }
        let quic = quic.expect("a free QUIC port");
        let address = quic.local_addr().unwrap();
        let (events, of_events) = mpsc::channel(64);
        let (of_actions, actions) = mpsc::channel(1024);
        let (others, of_others) = mpsc::channel(64);
        events.send(DiscoveryEvent::QuicPort(address.port())).await.unwrap();
        tokio::spawn(async move {
            // The sender is kept as long as the daemon exists.
            let wanted = watch::Sender::new(DiscoveryNeeds::of(&config, []));
            run(&config, id, wanted.subscribe(), of_events, of_actions).await;
        });
        tokio::spawn(carry(quic, events.downgrade(), actions, others));
        Self { id, address, events, actions: of_others }
    }

    async fn next(&mut self) -> Option<DiscoveryAction> {
        timeout(PATIENCE, self.actions.recv()).await.expect("something is to happen")
    }
}

/// Carries out discovery's actions as a gateway does, until discovery ends.
async fn carry(
    quic: UdpSocket,
    events: mpsc::WeakSender<DiscoveryEvent>,
    mut actions: mpsc::Receiver<DiscoveryAction>,
    others: mpsc::Sender<DiscoveryAction>,
) {
    let mut buffer = [0; 2048];
    loop {
        tokio::select! {
            action = actions.recv() => match action {
                Some(DiscoveryAction::SendFromQuicPort { to, bytes }) => {
                    let _ = quic.send_to(&bytes, to).await;
                }
                Some(DiscoveryAction::Named(_)) => {}
                Some(other) => drop(others.send(other).await),
                None => return,
            },
            received = quic.recv_from(&mut buffer) => {
                if let (Ok((length, from)), Some(events)) = (received, events.upgrade()) {
                    assert!(is_discovery(buffer[0]));
                    let mut datagrams = Datagrams::default();
                    datagrams.push(from, &buffer[..length]);
                    let _ = events.try_send(DiscoveryEvent::Datagrams(datagrams));
                }
            }
        }
    }
}

#[tokio::test]
async fn two_daemons_find_each_other_by_multicast_and_part_with_a_goodbye() {
    let mut a = Daemon::start(config(211, &[("AXON_BIND_ADDRS", "127.0.0.2")])).await;
    let mut b = Daemon::start(config(211, &[("AXON_BIND_ADDRS", "127.0.0.3")])).await;
    let (of_a, of_b) = (a.next().await.unwrap(), b.next().await.unwrap());
    for (action, peer) in [(of_a, &b), (of_b, &a)] {
        match action {
            DiscoveryAction::Dial { daemon, sae, addrs, listed, .. } => {
                assert_eq!((daemon, sae, listed), (peer.id, None, false));
                assert_eq!(addrs, [peer.address]);
            }
            other => panic!("{other:?}"),
        }
    }
    for (one, other) in [(&a, &b), (&b, &a)] {
        let up = DiscoveryEvent::LinkUp { daemon: other.id, address: other.address, proven: true };
        one.events.send(up).await.unwrap();
    }
    drop(b.events);
    assert_eq!(timeout(PATIENCE, b.actions.recv()).await.unwrap(), None, "it ends");

    a.events.send(DiscoveryEvent::LinkDown { daemon: b.id }).await.unwrap();
    let mut action = a.next().await;
    if let Some(DiscoveryAction::Dial { daemon, standing, .. }) = action {
        // The event overtook the datagram.
        let failed = DiscoveryEvent::DialFailed { daemon, standing, absent_at: None };
        a.events.send(failed).await.unwrap();
        action = a.next().await;
    }
    assert_eq!(action, Some(DiscoveryAction::Gone { daemon: b.id }));
}

#[tokio::test]
async fn listed_daemons_find_each_other_without_multicast_and_say_why_they_do_not_link() {
    // The LOCALHOST range works without multicast.
    let a = config(
        212,
        &[
            ("AXON_BIND_ADDRS", "127.0.0.2"),
            ("ROS_STATIC_PEERS", "127.0.0.3"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ],
    );
    let b = config(
        212,
        &[
            ("AXON_BIND_ADDRS", "127.0.0.3"),
            ("AXON_QUIC_CIPHER", "aes-256-gcm"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ],
    );
    let (mut a, mut b) = (Daemon::start(a).await, Daemon::start(b).await);
    let (of_a, of_b) = (a.next().await.unwrap(), b.next().await.unwrap());
    for (action, peer, theirs) in [(of_a, &b, "aes-256-gcm"), (of_b, &a, "chacha20-poly1305")] {
        let DiscoveryAction::Mismatch(mismatch) = action else { panic!("{action:?}") };
        assert_eq!((mismatch.peer, mismatch.setting), (peer.id, "AXON_QUIC_CIPHER"));
        assert_eq!((mismatch.address, &*mismatch.theirs), (peer.address, theirs));
    }
}

#[tokio::test]
async fn the_shared_port_reaches_all_and_comes_from_the_bound_address() {
    let open = |address: &str| {
        let bind = [address.parse().unwrap()];
        let mut socket = SharedSocket::open(213, &bind).unwrap();
        socket.follow(&interfaces().unwrap());
        // Looking again changes nothing.
        socket.follow(&interfaces().unwrap());
        socket
    };
    let (mut a, b, c) = (open("127.0.0.2"), open("127.0.0.3"), open("127.0.0.4"));
    let sent = Datagram::Goodbye { domain: 213, daemon: DaemonId::random() }.encode();
    a.send(&sent);
    for receiver in [&a, &b, &c] {
        loop {
            let (from, bytes) = timeout(PATIENCE, receiver.receive()).await.unwrap().unwrap();
            if bytes == sent {
                assert_eq!(from.ip(), "127.0.0.2".parse::<IpAddr>().unwrap());
                break;
            }
        }
    }
}

#[tokio::test]
async fn unread_actions_do_not_block_discovery() {
    let (events, of_events) = mpsc::channel(8);
    let (of_actions, actions) = mpsc::channel(1);
    let config =
        config(214, &[("AXON_BIND_ADDRS", "127.0.0.2"), ("AXON_DAEMON_PEERS", "127.0.0.3")]);
    let task = tokio::spawn(async move {
        let wanted = watch::Sender::new(DiscoveryNeeds::of(&config, []));
        run(&config, DaemonId::random(), wanted.subscribe(), of_events, of_actions).await;
    });
    for n in 0..100_u8 {
        events.send(DiscoveryEvent::QuicPort(64_000 + u16::from(n))).await.unwrap();
        let mut noise = Datagrams::default();
        noise.push(([127, 0, 0, 1], 9).into(), &[n; 9]);
        events.send(DiscoveryEvent::Datagrams(noise)).await.unwrap();
    }
    drop(events);
    timeout(PATIENCE, task).await.unwrap().unwrap();
    drop(actions);
}
