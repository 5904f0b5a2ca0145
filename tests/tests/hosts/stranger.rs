//! A peer that speaks the link protocol and is not a daemon: it sends what a hostile peer could send.

use std::{
    net::{Ipv4Addr, SocketAddr},
    sync::{Arc, Mutex},
    time::Duration,
};

use axon_daemon::internal::{
    link::{Elected, LinkHello, LinkMessage, MAX_FRAME, Owners, read_length},
    owner::{EXPORTER, prove},
};
use axon_tls::{
    Cipher,
    identity::Auth,
    quic::{ALPN, hybrid_client},
};
use axon_transport::{ids::DaemonId, internal::SessionKey};
use quinn::{Connection, Endpoint, RecvStream, SendStream, TransportConfig};

use super::{pair::Host, process::PATIENCE};

/// The peer's daemon id: the highest possible, so that the other side decides elections.
const ID: DaemonId = DaemonId([0xff; 16]);

/// Returns a daemon id that is higher than a host's own, so that the host elects the stranger's links.
pub(crate) fn high_id(number: u8) -> DaemonId {
    let mut id = [0xff; 16];
    id[15] = number;
    DaemonId(id)
}

pub(crate) struct Stranger {
    runtime: tokio::runtime::Runtime,
}

/// A connection on which the stranger sent HELLO and got an answer.
#[derive(Debug)]
pub(crate) struct Met {
    pub(crate) connection: Connection,
    send: SendStream,
    receive: RecvStream,
}

/// The stranger's description of itself.
pub(crate) struct Claim<'a> {
    pub(crate) host: &'a str,
    pub(crate) daemon: DaemonId,
    /// `AXON_CLASSIC_AUTH` as HELLO has it.
    pub(crate) auth: u8,
}

impl<'a> Claim<'a> {
    pub(crate) fn pinned(host: &'a str) -> Self {
        Self { host, daemon: ID, auth: 1 }
    }

    pub(crate) fn ca(host: &'a str) -> Self {
        Self { host, daemon: ID, auth: 2 }
    }
}

impl Stranger {
    pub(crate) fn new() -> Self {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        Self { runtime: builder.worker_threads(1).enable_all().build().unwrap() }
    }

    /// Dials the daemon of `host` and waits to be elected; why it was closed on, if it was.
    pub(crate) fn dial(&self, host: &Host, auth: &Auth, claim: &Claim<'_>) -> Result<Met, String> {
        let to = SocketAddr::from((host.address, host.status().port.unwrap()));
        self.dial_at(to, host.domain(), auth, claim)
    }

    pub(crate) fn dial_at(
        &self,
        to: SocketAddr,
        domain: u32,
        auth: &Auth,
        claim: &Claim<'_>,
    ) -> Result<Met, String> {
        let mut met = self.meet(to, domain, auth, claim)?;
        self.hear(&mut met, |message| matches!(message, LinkMessage::Elected(_)))?;
        Ok(met)
    }

    /// Dials like [`dial`](Self::dial), under any daemon id: the daemon with the lower id elects.
    pub(crate) fn dial_as(
        &self,
        host: &Host,
        auth: &Auth,
        claim: &Claim<'_>,
    ) -> Result<Met, String> {
        let status = host.status();
        let to = SocketAddr::from((host.address, status.port.unwrap()));
        let mut met = self.meet(to, host.domain(), auth, claim)?;
        if claim.daemon.to_string() < status.daemon {
            self.say(
                &mut met,
                &LinkMessage::Elected(Elected { link: [7; 16], election: 1, standby: None }),
            );
            self.hear(&mut met, |message| !matches!(message, LinkMessage::Elected(_)))?;
        } else {
            self.hear(&mut met, |message| matches!(message, LinkMessage::Elected(_)))?;
        }
        Ok(met)
    }

    /// Dials and exchanges HELLOs.
    pub(crate) fn meet(
        &self,
        to: SocketAddr,
        domain: u32,
        auth: &Auth,
        claim: &Claim<'_>,
    ) -> Result<Met, String> {
        let mut config = hybrid_client(auth, Cipher::default(), ALPN).unwrap();
        // A message is a packet. A receiver that was away for a moment loses some, and QUIC closes a connection whose
        // stream has 1,024 gaps.
        let mut transport = TransportConfig::default();
        transport.send_window(16 << 10);
        config.transport_config(Arc::new(transport));
        let mut met = self.limited(async {
            let endpoint = Endpoint::client((Ipv4Addr::UNSPECIFIED, 0).into()).unwrap();
            let connection = endpoint.connect_with(config, to, "axon").unwrap().await;
            let connection = connection.map_err(|error| error.to_string())?;
            match connection.open_bi().await {
                Ok((send, receive)) => Ok(Met { connection, send, receive }),
                Err(error) => Err(error.to_string()),
            }
        })?;
        self.say(&mut met, &LinkMessage::Hello(hello(domain, claim)));
        self.hear(&mut met, |message| matches!(message, LinkMessage::Hello(_)))?;
        Ok(met)
    }

    /// Proves that these sessions are its own, as the daemon that it claims to be.
    pub(crate) fn prove(&self, met: &mut Met, daemon: DaemonId, sessions: &[&SessionKey]) {
        let mut binding = [0; 32];
        met.connection.export_keying_material(&mut binding, EXPORTER, b"").unwrap();
        let proofs = sessions.iter().map(|key| prove(key, &binding, daemon).unwrap()).collect();
        self.say(met, &LinkMessage::Owners(Owners { proofs }));
    }

    /// Sends a message. The caller must check by other means whether it arrives.
    pub(crate) fn say(&self, met: &mut Met, message: &LinkMessage) {
        let frame = message.to_frame().unwrap();
        let _ = self.limited(met.send.write_all(&frame));
    }

    /// Reads until the message is the one waited for; why the other side closed, if it did.
    pub(crate) fn hear(
        &self,
        met: &mut Met,
        awaited: impl Fn(&LinkMessage) -> bool,
    ) -> Result<LinkMessage, String> {
        self.limited(async {
            loop {
                match next(&mut met.receive).await {
                    Some(message) if awaited(&message) => return Ok(message),
                    Some(_) => {}
                    None => return Err(met.connection.closed().await.to_string()),
                }
            }
        })
    }

    /// Waits until the other side sends nothing more, which it may do without closing.
    pub(crate) fn hear_out(&self, met: &mut Met) {
        self.limited(async { while next(&mut met.receive).await.is_some() {} });
    }

    /// Ends the control stream: nothing more will be sent.
    pub(crate) fn end(&self, met: &mut Met) {
        let _ = met.send.finish();
    }

    /// Opens a stream for samples, once the other side lets it.
    pub(crate) fn open(&self, met: &Met) -> Result<SendStream, String> {
        self.limited(met.connection.open_uni()).map_err(|error| error.to_string())
    }

    /// Writes for `time`, as far as the other side permits. Returns whether all bytes were written.
    pub(crate) fn write_for(&self, stream: &mut SendStream, bytes: &[u8], time: Duration) -> bool {
        let write = async { tokio::time::timeout(time, stream.write_all(bytes)).await };
        // An error: the other side takes no more in that time, or stopped the stream.
        self.runtime.block_on(write).is_ok_and(|written| written.is_ok())
    }

    /// Reads all streams of samples from now on. The returned buffer grows with the data that arrive.
    pub(crate) fn read_streams(&self, met: &Met) -> Arc<Mutex<Vec<u8>>> {
        let came = Arc::default();
        let (connection, all) = (met.connection.clone(), Arc::clone(&came));
        self.runtime.spawn(async move {
            while let Ok(mut stream) = connection.accept_uni().await {
                let all: Arc<Mutex<Vec<u8>>> = Arc::clone(&all);
                tokio::spawn(async move {
                    while let Ok(Some(chunk)) = stream.read_chunk(usize::MAX, true).await {
                        all.lock().unwrap().extend_from_slice(&chunk.bytes);
                    }
                });
            }
        });
        came
    }

    /// Waits until the other side closes the connection, and returns its reason.
    pub(crate) fn closed(&self, met: &Met) -> String {
        self.limited(met.connection.closed()).to_string()
    }

    /// Leaves, and waits until the other side knows.
    pub(crate) fn leave(&self, met: &Met) {
        met.connection.close(0_u32.into(), b"");
        self.runtime.block_on(async { tokio::time::sleep(Duration::from_millis(100)).await });
    }

    fn limited<T>(&self, future: impl Future<Output = T>) -> T {
        let limited = async { tokio::time::timeout(PATIENCE, future).await };
        self.runtime.block_on(limited).expect("an answer")
    }
}

fn hello(domain: u32, claim: &Claim<'_>) -> LinkHello {
    LinkHello {
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
        routes: None,
        proof: None,
        paths: None,
        beside: None,
    }
}

/// Reads the next message of a known type, `None` at the end of the stream.
async fn next(receive: &mut RecvStream) -> Option<LinkMessage> {
    loop {
        let mut length = [0; 4];
        receive.read_exact(&mut length).await.ok()?;
        let mut frame = vec![0; read_length(length, MAX_FRAME).unwrap()];
        receive.read_exact(&mut frame).await.ok()?;
        if let Some(message) = LinkMessage::from_frame(&frame, MAX_FRAME).unwrap() {
            return Some(message);
        }
    }
}
