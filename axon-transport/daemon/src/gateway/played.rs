//! Two ends of a connection in one process, for tests.

use std::net::{Ipv4Addr, SocketAddr};

use axon_tls::{
    Cipher,
    identity::{Auth, SigningKey},
    quic::{ALPN, hybrid_client, hybrid_server},
};
use quinn::{Connection, Endpoint};

/// A connection, as either end has it.
pub(super) struct Pair {
    pub(super) here: Connection,
    pub(super) there: Connection,
    _ends: [Endpoint; 2],
}

impl Pair {
    pub(super) async fn new() -> Self {
        Self::by_way_of(|to| to).await
    }

    /// One whose dialling end finds the other at the address that this says.
    pub(super) async fn by_way_of(way: impl FnOnce(SocketAddr) -> SocketAddr) -> Self {
        let auth = || Auth::None(SigningKey::generate().unwrap());
        let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let server = hybrid_server(&auth(), Cipher::default(), ALPN).unwrap();
        let client = hybrid_client(&auth(), Cipher::default(), ALPN).unwrap();
        let (one, other) = (Endpoint::client(any).unwrap(), Endpoint::server(server, any).unwrap());
        let dialled = one.connect_with(client, way(other.local_addr().unwrap()), "axon").unwrap();
        let accepted = async { other.accept().await.unwrap().await };
        let (here, there) = tokio::join!(dialled, accepted);
        Self { here: here.unwrap(), there: there.unwrap(), _ends: [one, other] }
    }
}

/// Runs a test on a runtime of its own.
pub(super) fn block_on<T>(test: impl Future<Output = T>) -> T {
    let mut builder = tokio::runtime::Builder::new_current_thread();
    builder.enable_all().build().unwrap().block_on(test)
}
