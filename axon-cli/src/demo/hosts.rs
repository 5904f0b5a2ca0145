//! The demo's hosts: a daemon each, with a runtime directory, an address and an identity of its
//! own, as processes of this same binary.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use serde_json::Value;
use tokio::{process::Command, time::Instant};

use super::{DemoError, mode::Mode, process::Process};

/// Time that a daemon has to be up.
const START: Duration = Duration::from_secs(20);

/// Domains that ROS 2 users hardly use; which one, the process id says, so that two demos at the
/// same time do not meet.
pub(crate) fn domain() -> u32 {
    181 + std::process::id() % 52
}

/// What a host is started with.
#[derive(Clone, Debug)]
pub(crate) struct HostSpec {
    /// Its name in messages, such as `host A`.
    pub(crate) name: &'static str,
    /// File name stem of what it keeps.
    pub(crate) stem: &'static str,
    /// Its loopback address.
    pub(crate) address: &'static str,
    /// The other host's.
    pub(crate) peer: &'static str,
    /// The security mode.
    pub(crate) mode: Mode,
    /// `AXON_KME_*` and `AXON_SAE_*`, in qkd.
    pub(crate) identity: Vec<(String, String)>,
    /// SAE IDs that it takes as peers, `;`-separated, in qkd.
    pub(crate) peers: String,
}

impl HostSpec {
    /// The host's settings.
    pub(crate) fn settings(&self, runtime_dir: &Path) -> Vec<(String, OsString)> {
        let mut settings: Vec<(String, OsString)> = vec![
            ("AXON_RUNTIME_DIR".into(), runtime_dir.into()),
            ("AXON_BIND_ADDRS".into(), self.address.into()),
            ("AXON_DAEMON_PEERS".into(), self.peer.into()),
            ("AXON_DAEMON".into(), "require".into()),
            ("ROS_DOMAIN_ID".into(), domain().to_string().into()),
        ];
        settings.extend(self.mode.settings().map(|(k, v)| (k.into(), v.into())));
        if self.mode.is_qkd() {
            settings.push(("AXON_QKD_PEERS".into(), self.peers.clone().into()));
            settings.extend(self.identity.iter().map(|(k, v)| (k.clone(), v.into())));
        }
        settings
    }
}

/// A running host.
#[derive(Debug)]
pub(crate) struct Host {
    name: &'static str,
    settings: Vec<(String, OsString)>,
    log: PathBuf,
    daemon: Process,
}

impl Host {
    /// Starts the host's daemon; `dir` holds what it keeps, `logs` what it says.
    pub(crate) async fn start(spec: &HostSpec, dir: &Path, logs: &Path) -> Result<Self, DemoError> {
        let runtime_dir = dir.join(format!("{}-{}", spec.mode.stem(), spec.stem));
        private_dir(&runtime_dir)
            .map_err(|source| DemoError::Start { name: spec.name.to_owned(), source })?;
        let log = logs.join(format!("{}-{}.log", spec.mode.stem(), spec.stem));
        let settings = spec.settings(&runtime_dir);
        let mut command = axon(&settings)?;
        command.args(["daemon", "--while-stdin"]);
        let daemon = Process::start(&format!("the daemon of {}", spec.name), command, &log)?;
        let mut host = Self { name: spec.name, settings, log, daemon };
        host.wait_ready().await?;
        Ok(host)
    }

    /// A command of this binary under the host's settings.
    pub(crate) fn command(&self) -> Result<Command, DemoError> {
        axon(&self.settings)
    }

    /// Starts a process of the host.
    pub(crate) fn spawn(&self, role: &str, args: &[OsString]) -> Result<Process, DemoError> {
        let mut command = self.command()?;
        command.args(args);
        Process::start(&format!("the {role} on {}", self.name), command, &self.log)
    }

    /// What the host's daemon says of itself.
    pub(crate) async fn status(&self) -> Result<Value, DemoError> {
        let failed = |reason| DemoError::Status { host: self.name, reason };
        let mut command = self.command()?;
        command.args(["status", "--json"]).stdin(Stdio::null()).kill_on_drop(true);
        let output = command.output().await.map_err(|e| failed(e.to_string()))?;
        if !output.status.success() {
            return Err(failed(String::from_utf8_lossy(&output.stderr).trim().to_owned()));
        }
        serde_json::from_slice(&output.stdout).map_err(|e| failed(e.to_string()))
    }

    /// Ends the host.
    pub(crate) async fn stop(self) {
        self.daemon.stop().await;
    }

    async fn wait_ready(&mut self) -> Result<(), DemoError> {
        let deadline = Instant::now() + START;
        loop {
            self.daemon.check()?;
            match self.status().await {
                Ok(_) => return Ok(()),
                Err(error) if Instant::now() > deadline => return Err(error),
                Err(_) => tokio::time::sleep(Duration::from_millis(50)).await,
            }
        }
    }
}

/// This binary under `settings`, and under no other setting of AXON or ROS but `AXON_LOG`.
pub(crate) fn axon(settings: &[(String, OsString)]) -> Result<Command, DemoError> {
    let binary = std::env::current_exe()
        .map_err(|source| DemoError::Start { name: "axon".to_owned(), source })?;
    let mut command = Command::new(binary);
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text != "AXON_LOG" && (text.starts_with("AXON_") || text.starts_with("ROS_")) {
            command.env_remove(&name);
        }
    }
    command.envs(settings.iter().map(|(k, v)| (k, v)));
    Ok(command)
}

fn private_dir(path: &Path) -> std::io::Result<()> {
    use std::os::unix::fs::DirBuilderExt;
    std::fs::DirBuilder::new().mode(0o700).create(path)
}
