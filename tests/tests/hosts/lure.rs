//! A daemon that dials an address without a peer, to which forged beacons lead it.

use std::{
    net::{Ipv4Addr, SocketAddr, UdpSocket},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use axon_daemon::internal::wire::{
    SecurityTerms,
    beacon::{Beacon, Datagram},
};
use axon_transport::ids::DaemonId;
use quinn::{Connection, Endpoint, ServerConfig};

use super::{pair::Host, process::PATIENCE};

/// Time between two beacons.
const EVERY: Duration = Duration::from_millis(200);

/// Beacons to one daemon, until this is dropped.
struct Lure(Arc<AtomicBool>);

impl Lure {
    /// Sends beacons that a daemon with these terms is at `at`, which the daemon of `host` lists.
    fn new(host: &Host, at: SocketAddr, terms: SecurityTerms, sae: Option<&str>) -> Self {
        let beacon = Datagram::Beacon(Beacon {
            protocols: (1, 1),
            domain: host.domain(),
            // The highest, so that the other one dials.
            daemon: DaemonId([0xff; 16]),
            terms,
            sae: sae.map(str::to_owned),
            port: at.port(),
            addresses: vec![at.ip()],
            graph: 1,
            answer_wanted: false,
            localhost: false,
        });
        let to = SocketAddr::from((host.address, 61_300 + 16 * host.domain() as u16));
        let socket = UdpSocket::bind((at.ip(), 0)).unwrap();
        let over = Arc::<AtomicBool>::default();
        let until = Arc::clone(&over);
        thread::spawn(move || {
            // Relaxed: the flag orders nothing else.
            while !until.load(Ordering::Relaxed) {
                // An error: the daemon has ended.
                let _ = socket.send_to(&beacon.encode(), to);
                thread::sleep(EVERY);
            }
        });
        Self(over)
    }
}

impl Drop for Lure {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Creates a server on this host's loopback address, which accepts no connection yet.
pub(crate) fn server(config: ServerConfig, address: Ipv4Addr) -> Endpoint {
    Endpoint::server(config, (address, 0).into()).unwrap()
}

/// Accepts the one connection that the daemon of `host` dials to `at`, and then no other. `at` leads to `server`. The
/// daemon needs a session: without one it looks for no peer.
pub(crate) async fn accept_dial(
    server: &Endpoint,
    host: &Host,
    at: SocketAddr,
    terms: SecurityTerms,
    sae: Option<&str>,
) -> Connection {
    let lure = Lure::new(host, at, terms, sae);
    let accepted = async { server.accept().await.unwrap().await.unwrap() };
    let connection = tokio::time::timeout(PATIENCE, accepted).await.expect("the daemon dials");
    drop(lure);
    // Otherwise a second dial, which may be under way, would go on until it is answered.
    let server = server.clone();
    tokio::spawn(async move {
        while let Some(another) = server.accept().await {
            another.refuse();
        }
    });
    connection
}
