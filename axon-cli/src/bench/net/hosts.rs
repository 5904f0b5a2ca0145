//! Starts two hosts for the measurement, on this machine's loopback.

use std::path::Path;

use tokio::runtime::Runtime;

use crate::{
    bench::{
        harness::Result,
        session::place::{Settings, daemon_pid},
    },
    demo::{
        hosts::{Host, HostSpec},
        kmes::{Kmes, Role},
        mode::Mode,
    },
};

/// A daemon on each host.
pub(super) struct Hosts<'a> {
    runtime: &'a Runtime,
    daemons: Option<[Host; 2]>,
    /// The settings of the processes on each host.
    pub(super) settings: [Settings; 2],
}

impl<'a> Hosts<'a> {
    /// Starts the daemons. `dir` holds their files.
    pub(super) fn start(runtime: &'a Runtime, mode: Mode, kmes: &Kmes, dir: &Path) -> Result<Self> {
        let spec = |name, stem, [address, peer]: [&'static str; 2], role, peers| HostSpec {
            name,
            stem,
            address,
            peer,
            mode,
            identity: kmes.identity(role),
            peers,
        };
        let (one, other) = ("127.0.0.1", "127.0.0.2");
        let specs = [
            spec("host A", "a", [one, other], Role::A, kmes.sae(Role::B).to_owned()),
            spec("host B", "b", [other, one], Role::B, kmes.sae(Role::A).to_owned()),
        ];
        let [a, b] = &specs;
        let daemons = runtime.block_on(async {
            let (a, b) = (Host::start(a, dir, dir).await?, Host::start(b, dir, dir).await?);
            Ok::<_, crate::demo::DemoError>([a, b])
        })?;
        let settings = specs.map(|spec| {
            let directory = dir.join(format!("{}-{}", mode.stem(), spec.stem));
            let settings = spec.settings(&directory).into_iter();
            settings.map(|(name, value)| (name, value.to_string_lossy().into_owned())).collect()
        });
        Ok(Self { runtime, daemons: Some(daemons), settings })
    }

    /// Returns the process ids of the daemons.
    pub(super) fn pids(&self) -> Result<[u32; 2]> {
        let [near, far] = &self.settings;
        Ok([daemon_pid(near)?, daemon_pid(far)?])
    }
}

impl Drop for Hosts<'_> {
    fn drop(&mut self) {
        if let Some([a, b]) = self.daemons.take() {
            self.runtime.block_on(async {
                a.stop().await;
                b.stop().await;
            });
        }
    }
}
