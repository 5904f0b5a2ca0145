//! The demo's hosts. Each has a daemon, a runtime directory, an address and an identity of its own.
//! Its processes run this same binary.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use serde_json::Value;
use tokio::{process::Command, time::Instant};

use super::{DemoError, mode::Mode, process::Process};

/// The time in which a daemon has to start.
const START: Duration = Duration::from_secs(20);

/// Returns a domain that ROS 2 users rarely use. It depends on the process id, so that two demos at
/// the same time do not connect.
pub(crate) fn domain() -> u32 {
    181 + std::process::id() % 52
}

/// The properties with which a host is started.
#[derive(Clone, Debug)]
pub(crate) struct HostSpec {
    /// The name in messages, such as `host A`.
    pub(crate) name: &'static str,
    /// The stem of the names of the host's files.
    pub(crate) stem: &'static str,
    /// The loopback address.
    pub(crate) address: &'static str,
    /// The loopback address of the other host.
    pub(crate) peer: &'static str,
    /// The security mode.
    pub(crate) mode: Mode,
    /// The variables `AXON_KME_*` and `AXON_SAE_*`, in qkd.
    pub(crate) identity: Vec<(String, String)>,
    /// The SAE IDs that the host accepts as peers, separated by `;`, in qkd.
    pub(crate) peers: String,
}

impl HostSpec {
    /// Returns the host's settings.
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
    /// Starts the host's daemon. `dir` holds its files, and `logs` holds its log.
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

    /// Returns a command that runs this binary with the host's settings.
    pub(crate) fn command(&self) -> Result<Command, DemoError> {
        axon(&self.settings)
    }

    /// Starts a process of the host.
    pub(crate) fn spawn(&self, role: &str, args: &[OsString]) -> Result<Process, DemoError> {
        let mut command = self.command()?;
        command.args(args);
        Process::start(&format!("the {role} on {}", self.name), command, &self.log)
    }

    /// Returns the status of the host's daemon.
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

    /// Stops the host.
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

/// Returns a command that runs this binary with `settings`. Of the other variables of AXON and ROS
/// it inherits only `AXON_LOG`.
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
