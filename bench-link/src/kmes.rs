//! Two KMEs of this program, for the qkd modes: the simulator over mutual TLS.
//!
//! The KMEs listen on this machine's loopback, where the hosts do not reach them. Each host therefore has a listener at the
//! address of its KME on its own loopback, and this program passes the bytes on. TLS ends at the KME.

use std::{net::TcpListener, path::PathBuf};

use etsi_qkd014::sim;
use tempfile::TempDir;
use tokio::{
    io::copy_bidirectional,
    net::TcpStream,
    runtime::{Builder, Runtime},
};

use crate::{Result, host::Host};

const SAES: [&str; 2] = ["sae-a", "sae-b"];

/// The KMEs of two hosts. They end when this is dropped.
pub(crate) struct Kmes {
    network: sim::Network,
    /// Certificates and keys.
    directory: TempDir,
    runtime: Runtime,
}

impl Kmes {
    pub(crate) fn start() -> Result<Self> {
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let network = sim::Network::builder()
            .strict()
            .kme("kme-a", ([127, 0, 0, 1], 0).into(), [SAES[0]])
            .kme("kme-b", ([127, 0, 0, 2], 0).into(), [SAES[1]]);
        let network = runtime.block_on(network.start())?;
        let directory = tempfile::Builder::new().prefix("axon-link-kme-").tempdir()?;
        network.write_files(directory.path())?;
        Ok(Self { network, directory, runtime })
    }

    /// Settings of the first or the second host.
    pub(crate) fn settings(&self, host: usize) -> Vec<(&'static str, String)> {
        let directory: PathBuf = self.directory.path().into();
        let mut settings =
            self.network.sae(SAES[host]).map(|sae| sae.env(&directory)).unwrap_or_default();
        settings.push(("AXON_QKD_PEERS", SAES[1 - host].to_owned()));
        settings
    }

    /// Makes the KME of the first or the second host reachable there.
    pub(crate) fn connect(&self, host: usize, namespace: &Host) -> Result<()> {
        let address = self.network.kmes()[host].addr();
        let listener = namespace.within(move || TcpListener::bind(address))??;
        listener.set_nonblocking(true)?;
        let _guard = self.runtime.enter();
        let listener = tokio::net::TcpListener::from_std(listener)?;
        self.runtime.spawn(async move {
            while let Ok((mut near, _)) = listener.accept().await {
                tokio::spawn(async move {
                    let mut far = TcpStream::connect(address).await?;
                    near.set_nodelay(true)?;
                    far.set_nodelay(true)?;
                    copy_bidirectional(&mut near, &mut far).await
                });
            }
        });
        Ok(())
    }

    /// Keys that the SAEs which asked first got so far.
    pub(crate) fn keys_drawn(&self) -> u64 {
        self.network.kmes().iter().map(|kme| kme.counters().keys_to_masters).sum()
    }
}
