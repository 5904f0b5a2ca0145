//! A host: a network namespace with one device, in which programs are started.

use std::{
    fs,
    io::{self, BufRead, BufReader, Read, Write},
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::{Arc, mpsc},
    thread,
};

use nix::{
    sched::{CloneFlags, unshare},
    unistd::{getgid, getuid},
};
use serde::{Serialize, de::DeserializeOwned};
use tun::Device;

use crate::{Error, Result, part::Part};

/// A program to start, and the channel for the answer.
type Order = (Command, mpsc::Sender<io::Result<Child>>);

/// Gives this process the right to make network namespaces, if it does not have it. To be called before
/// there is a second thread.
pub(crate) fn prepare() -> Result<()> {
    if getuid().is_root() {
        return Ok(());
    }
    let (uid, gid) = (getuid(), getgid());
    unshare(CloneFlags::CLONE_NEWUSER)?;
    fs::write("/proc/self/setgroups", "deny")?;
    fs::write("/proc/self/uid_map", format!("0 {uid} 1"))?;
    fs::write("/proc/self/gid_map", format!("0 {gid} 1"))?;
    Ok(())
}

/// A host. It lasts as long as this process.
pub(crate) struct Host {
    pub(crate) device: Arc<Device>,
    orders: mpsc::Sender<Order>,
    directory: PathBuf,
    address: String,
    peer: String,
}

impl Host {
    /// Starts a host with this address in 10.77.0.0/24. Its programs have a directory of their own in `directory`.
    pub(crate) fn start(directory: &Path, number: u8, congestion: &str) -> Result<Self> {
        let (address, peer) = (format!("10.77.0.{number}"), format!("10.77.0.{}", 3 - number));
        let directory = directory.join(format!("host-{number}"));
        fs::create_dir_all(&directory)?;
        let config = format!("[link]\ngrace_s = 1\ncongestion = {congestion:?}\n");
        fs::write(directory.join("axon.toml"), config)?;
        let (orders, received) = mpsc::channel::<Order>();
        let (made, device) = mpsc::channel();
        let own = address.clone();
        // The namespace is this thread's, and that of the programs which it starts.
        thread::spawn(move || {
            let device = make_device(&own);
            let failed = device.is_err();
            let _ = made.send(device);
            while !failed && let Ok((mut command, answer)) = received.recv() {
                let _ = answer.send(command.spawn());
            }
        });
        let device = Arc::new(device.recv()??);
        Ok(Self { device, orders, directory, address, peer })
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    /// Starts a part of a measurement.
    pub(crate) fn start_part(&self, part: &Part) -> Result<Running> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("part").arg(serde_json::to_string(part)?);
        let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
        for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        command.env("AXON_CONFIG", self.directory.join("axon.toml"));
        command.env("AXON_RUNTIME_DIR", self.directory.join("run"));
        command.env("AXON_DAEMON_PEERS", &self.peer);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        // The program's standard input ends with this process, and the program ends with its standard input.
        command.process_group(0);
        let (answer, child) = mpsc::channel();
        self.orders.send((command, answer)).map_err(|_| "the thread of a host has ended")?;
        Running::new(child.recv()??)
    }
}

fn make_device(address: &str) -> Result<Device> {
    unshare(CloneFlags::CLONE_NEWNET)
        .map_err(|error| format!("a network namespace cannot be made: {error}"))?;
    // The loopback must be up, because a daemon also sends to its own address.
    let up = Command::new("ip").args(["link", "set", "lo", "up"]).status();
    if !up.is_ok_and(|status| status.success()) {
        return Err("`ip link set lo up` fails: is iproute2 installed?".into());
    }
    let mut configuration = tun::Configuration::default();
    configuration.tun_name("path0").address(address).netmask("255.255.255.0").mtu(1500).up();
    tun::create(&configuration)
        .map_err(|error| format!("the device of a host cannot be made: {error}").into())
}

/// A program on a host. It ends when this is dropped.
pub(crate) struct Running {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

impl Running {
    fn new(mut child: Child) -> Result<Self> {
        let input = child.stdin.take();
        let output = BufReader::new(child.stdout.take().ok_or("no standard output")?);
        Ok(Self { child, input, output })
    }

    /// Waits for a line and returns its value.
    pub(crate) fn hear<T: DeserializeOwned>(&mut self) -> Result<T> {
        let mut line = String::new();
        if self.output.read_line(&mut line)? == 0 {
            return Err("a part of the measurement has ended".into());
        }
        Ok(serde_json::from_str(&line)?)
    }

    /// Writes a line.
    pub(crate) fn tell<T: Serialize>(&mut self, word: &T) -> Result<()> {
        let input = self.input.as_mut().ok_or("no standard input")?;
        writeln!(input, "{}", serde_json::to_string(word)?)?;
        Ok(())
    }

    /// Makes the program end.
    pub(crate) fn close(&mut self) {
        self.input = None;
    }

    /// Ends the program, and returns its result.
    pub(crate) fn end<T: DeserializeOwned>(mut self) -> Result<T> {
        self.input = None;
        let mut text = String::new();
        self.output.read_to_string(&mut text)?;
        serde_json::from_str(&text)
            .map_err(|error| -> Error { format!("a part of the measurement: {error}").into() })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.input = None;
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
