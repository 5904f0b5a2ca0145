//! Somebody who speaks the link protocol and is no daemon: what a hostile peer would say.

use std::{
    net::{Ipv4Addr, SocketAddr},
    time::Duration,
};

use axon_tls::{
    Cipher,
    identity::Auth,
    quic::{ALPN, hybrid_client},
};
use axon_transport::{
    ids::DaemonId,
    link::{Hello, MAX_FRAME, Message, read_length},
};
use quinn::{Connection, ConnectionError, Endpoint, RecvStream};

use super::super::{pair::Host, process::PATIENCE};

/// Its daemon's id: the highest there is, so that elections are the other side's.
const ID: DaemonId = DaemonId([0xff; 16]);

pub(super) struct Stranger {
    runtime: tokio::runtime::Runtime,
}

/// A link that the daemon elected.
#[derive(Debug)]
pub(super) struct Elected {
    pub(super) connection: Connection,
    _streams: (quinn::SendStream, RecvStream),
}

/// What it says of itself.
pub(super) struct Claim<'a> {
    pub(super) host: &'a str,
    pub(super) daemon: DaemonId,
    /// `AXON_CLASSIC_AUTH` as HELLO has it.
    pub(super) auth: u8,
}

impl<'a> Claim<'a> {
    pub(super) fn pinned(host: &'a str) -> Self {
        Self { host, daemon: ID, auth: 1 }
    }

    pub(super) fn ca(host: &'a str) -> Self {
        Self { host, daemon: ID, auth: 2 }
    }
}

impl Stranger {
    pub(super) fn new() -> Self {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        Self { runtime: builder.worker_threads(1).enable_all().build().unwrap() }
    }

    /// Dials the daemon of `host`; why it was closed on, if it was.
    pub(super) fn dial(
        &self,
        host: &Host,
        auth: &Auth,
        claim: &Claim<'_>,
    ) -> Result<Elected, String> {
        let to = SocketAddr::from((host.address, host.status().port.unwrap()));
        self.dial_at(to, host.domain(), auth, claim)
    }

    pub(super) fn dial_at(
        &self,
        to: SocketAddr,
        domain: u32,
        auth: &Auth,
        claim: &Claim<'_>,
    ) -> Result<Elected, String> {
        let config = hybrid_client(auth, Cipher::default(), ALPN).unwrap();
        let hello = hello(domain, claim);
        self.runtime.block_on(async {
            let endpoint = Endpoint::client((Ipv4Addr::UNSPECIFIED, 0).into()).unwrap();
            let connecting = endpoint.connect_with(config, to, "axon").unwrap();
            let said = |error: ConnectionError| error.to_string();
            let link = async {
                let connection = connecting.await.map_err(said)?;
                let streams = speak(&connection, &hello).await;
                match streams {
                    Some(streams) => Ok(Elected { connection, _streams: streams }),
                    None => Err(said(connection.closed().await)),
                }
            };
            tokio::time::timeout(PATIENCE, link).await.expect("an answer")
        })
    }

    /// Leaves, and waits until the other side knows.
    pub(super) fn leave(&self, link: &Elected) {
        link.connection.close(0_u32.into(), b"");
        self.runtime.block_on(async { tokio::time::sleep(Duration::from_millis(100)).await });
    }
}

fn hello(domain: u32, claim: &Claim<'_>) -> Hello {
    Hello {
        protocol_min: 1,
        protocol_max: 1,
        domain,
        daemon: claim.daemon,
        mode: 0,
        key_mode: 0,
        kex: 0,
        cipher: 0,
        sae: None,
        host: claim.host.to_owned(),
        auth: Some(claim.auth),
        replaces: None,
        expects: None,
        static_peer: false,
    }
}

/// Says HELLO and waits for HELLO and ELECTED; `None` when the other side ends it.
async fn speak(connection: &Connection, hello: &Hello) -> Option<(quinn::SendStream, RecvStream)> {
    let (mut send, mut receive) = connection.open_bi().await.ok()?;
    send.write_all(&Message::Hello(hello.clone()).to_frame().unwrap()).await.ok()?;
    let mut greeted = false;
    loop {
        let mut length = [0; 4];
        receive.read_exact(&mut length).await.ok()?;
        let mut frame = vec![0; read_length(length, MAX_FRAME).unwrap()];
        receive.read_exact(&mut frame).await.ok()?;
        match Message::from_frame(&frame, MAX_FRAME).unwrap() {
            Some(Message::Hello(_)) => greeted = true,
            Some(Message::Elected(_)) => {
                assert!(greeted, "ELECTED before HELLO");
                return Some((send, receive));
            }
            _ => {}
        }
    }
}
