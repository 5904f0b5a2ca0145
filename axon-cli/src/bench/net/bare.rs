//! The raw limit between two hosts: one stream of bare quinn, under AXON's key exchange and cipher and
//! with its windows, and a length before each message.

use std::{net::Ipv4Addr, sync::Arc};

use axon_tls::{
    Cipher,
    identity::{Auth, SigningKey},
    quic::{ALPN, hybrid_client, hybrid_server},
};
use quinn::{Connection, Endpoint, RecvStream, SendStream, TransportConfig, VarInt};
use tokio::runtime::Runtime;

use crate::bench::harness::{Channel, End, Error, Load, Medium, Result, Side, agree, stamp};

/// As many as a daemon has for its links.
const WORKERS: usize = 2;
const STREAM_WINDOW: u32 = 32 << 20;
const SEND_WINDOW: u64 = 16 << 20;

/// quinn and nothing else.
pub(super) struct BareQuic;

impl Medium for BareQuic {
    fn name(&self) -> &'static str {
        "bare quinn"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(WORKERS)
            .enable_all()
            .build()?;
        let (endpoint, connection, out, into) = match side {
            Side::Near => {
                let key = Auth::None(SigningKey::generate()?);
                let mut config = hybrid_server(&key, Cipher::default(), ALPN)?;
                config.transport_config(transport());
                let _entered = runtime.enter();
                let endpoint = Endpoint::server(config, (Ipv4Addr::LOCALHOST, 0).into())?;
                channel.tell(&endpoint.local_addr()?)?;
                runtime.block_on(async {
                    let incoming = endpoint.accept().await.ok_or("nobody came")?;
                    let connection = incoming.await?;
                    let (out, mut into) = connection.open_bi().await?;
                    let out = greet(out).await?;
                    into.read_exact(&mut [0]).await?;
                    Ok::<_, Error>((endpoint, connection, out, into))
                })?
            }
            Side::Far => {
                let address = channel.hear()?;
                let key = Auth::None(SigningKey::generate()?);
                let mut config = hybrid_client(&key, Cipher::default(), ALPN)?;
                config.transport_config(transport());
                let _entered = runtime.enter();
                let endpoint = Endpoint::client((Ipv4Addr::LOCALHOST, 0).into())?;
                runtime.block_on(async {
                    let connection = endpoint.connect_with(config, address, "axon")?.await?;
                    let (out, mut into) = connection.accept_bi().await?;
                    let out = greet(out).await?;
                    into.read_exact(&mut [0]).await?;
                    Ok::<_, Error>((endpoint, connection, out, into))
                })?
            }
        };
        let bytes = vec![0x5a; load.size];
        Ok(Box::new(BareEnd { out, into, bytes, _connection: connection, endpoint, runtime }))
    }
}

/// A stream that nothing was written to nobody hears of.
async fn greet(mut out: SendStream) -> Result<SendStream> {
    out.write_all(&[0]).await?;
    Ok(out)
}

fn transport() -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    transport
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(256 << 20))
        .send_window(SEND_WINDOW);
    Arc::new(transport)
}

struct BareEnd {
    out: SendStream,
    into: RecvStream,
    bytes: Vec<u8>,
    _connection: Connection,
    endpoint: Endpoint,
    runtime: Runtime,
}

impl End for BareEnd {
    fn send(&mut self, number: u64) -> Result<()> {
        stamp(&mut self.bytes, number);
        let length = u32::try_from(self.bytes.len())?.to_be_bytes();
        Ok(self.runtime.block_on(async {
            self.out.write_all(&length).await?;
            self.out.write_all(&self.bytes).await
        })?)
    }

    fn receive(&mut self) -> Result<u64> {
        let mut length = [0; 4];
        self.runtime.block_on(async {
            self.into.read_exact(&mut length).await?;
            if u32::from_be_bytes(length) as usize != self.bytes.len() {
                return Err("a message of another length".into());
            }
            Ok::<_, Error>(self.into.read_exact(&mut self.bytes).await?)
        })?;
        let [first, last] = [self.bytes.first_chunk(), self.bytes.last_chunk()];
        agree(*first.ok_or("too short")?, *last.ok_or("too short")?)
    }
}

impl Drop for BareEnd {
    fn drop(&mut self) {
        self.endpoint.close(VarInt::from_u32(0), b"");
        self.runtime.block_on(self.endpoint.wait_idle());
    }
}
