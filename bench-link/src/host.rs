//! A host: a network namespace with one device, in which programs are started.

use std::{
    ffi::OsString,
    fs,
    io::{BufRead, BufReader, Read, Write},
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::{Arc, mpsc},
    thread,
};

use axon_transport::{
    config::{Config, OsFiles},
    daemon_status,
};
use nix::{
    sched::{CloneFlags, unshare},
    unistd::{getgid, getuid},
};
use rustix::process::{Pid, Signal, kill_process};
use serde::{Serialize, de::DeserializeOwned};
use serde_json::Value;
use tun::Device;

use crate::{Error, Result, part::Part};

/// What a host's thread does in the host's namespace.
type Order = Box<dyn FnOnce() + Send>;

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
    /// One for each path.
    pub(crate) devices: Vec<Arc<Device>>,
    orders: mpsc::Sender<Order>,
    directory: PathBuf,
    number: u8,
    settings: Vec<(&'static str, String)>,
}

impl Host {
    /// A host with an address in the network of each path. Its programs find it in a directory of its own in `directory`;
    /// `link` is the `[link]` section of their file.
    pub(crate) fn start(directory: &Path, number: u8, paths: u8, link: &str) -> Result<Self> {
        let directory = directory.join(format!("host-{number}"));
        fs::create_dir_all(&directory)?;
        fs::write(directory.join("axon.toml"), format!("[link]\n{link}"))?;
        let (orders, received) = mpsc::channel::<Order>();
        let (made, devices) = mpsc::channel();
        // The namespace is this thread's, and that of the programs which it starts.
        thread::spawn(move || {
            let devices = make_devices(number, paths);
            let failed = devices.is_err();
            let _ = made.send(devices);
            while !failed && let Ok(order) = received.recv() {
                order();
            }
        });
        let devices = devices.recv()??;
        let peers = (0..paths).map(|path| address(path, 3 - number)).collect::<Vec<_>>().join(";");
        let settings = vec![("AXON_DAEMON_PEERS", peers)];
        Ok(Self { devices, orders, directory, number, settings })
    }

    /// Gives a variable this value for the programs that are started from now on.
    pub(crate) fn set(&mut self, settings: impl IntoIterator<Item = (&'static str, String)>) {
        self.settings.extend(settings);
    }

    /// Its address on the first path.
    pub(crate) fn address(&self) -> String {
        address(0, self.number)
    }

    /// Returns the file of its network namespace, for `nsenter`.
    pub(crate) fn namespace(&self) -> Result<PathBuf> {
        let thread = self.within(|| fs::read_link("/proc/thread-self"))??;
        Ok(Path::new("/proc").join(thread).join("ns/net"))
    }

    /// Does something in the host's namespace.
    pub(crate) fn within<T: Send + 'static>(
        &self,
        order: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T> {
        let (answer, answered) = mpsc::channel();
        let order = move || drop(answer.send(order()));
        self.orders.send(Box::new(order)).map_err(|_| "the thread of a host has ended")?;
        Ok(answered.recv()?)
    }

    /// The process of its daemon, if it has one.
    pub(crate) fn daemon(&self) -> Option<Pid> {
        Pid::from_raw(self.status()?["pid"].as_i64()?.try_into().ok()?)
    }

    /// The status of its daemon, if it has one.
    pub(crate) fn status(&self) -> Option<Value> {
        let variables = self.variables().into_iter();
        let variables = variables.map(|(name, value)| (OsString::from(name), value));
        let config = Config::resolve(variables, None, &OsFiles).ok()?;
        serde_json::from_str(&daemon_status(&config).ok()?).ok()
    }

    /// How many lines of its daemon's log have this text.
    pub(crate) fn log_lines(&self, text: &str) -> usize {
        let log = fs::read(self.directory.join("run/axon-0.log")).unwrap_or_default();
        String::from_utf8_lossy(&log).lines().filter(|line| line.contains(text)).count()
    }

    /// What its programs have in their environment.
    fn variables(&self) -> Vec<(&'static str, OsString)> {
        let mut variables = vec![
            ("AXON_CONFIG", self.directory.join("axon.toml").into()),
            ("AXON_RUNTIME_DIR", self.directory.join("run").into()),
        ];
        variables.extend(self.settings.iter().map(|(name, value)| (*name, value.into())));
        variables
    }

    /// Starts a part of a measurement.
    pub(crate) fn start_part(&self, part: &Part) -> Result<Running> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("part").arg(serde_json::to_string(part)?);
        let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
        for (name, _) in std::env::vars().filter(|(name, _)| ours(name) && name != "AXON_LOG") {
            command.env_remove(name);
        }
        command.envs(self.variables());
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        // The program's standard input ends with this process, and the program ends with its standard input.
        command.process_group(0);
        Running::new(self.within(move || command.spawn())??)
    }
}

/// The address of a host in the network of a path.
fn address(path: u8, host: u8) -> String {
    format!("10.{}.0.{host}", 77 + path)
}

/// Kills a process. Returns whether it was there.
pub(crate) fn kill(pid: Pid) -> bool {
    kill_process(pid, Signal::KILL).is_ok()
}

fn make_devices(number: u8, paths: u8) -> Result<Vec<Arc<Device>>> {
    unshare(CloneFlags::CLONE_NEWNET)
        .map_err(|error| format!("a network namespace cannot be made: {error}"))?;
    // The loopback must be up, because a daemon also sends to its own address.
    let up = Command::new("ip").args(["link", "set", "lo", "up"]).status();
    if !up.is_ok_and(|status| status.success()) {
        return Err("`ip link set lo up` fails: is iproute2 installed?".into());
    }
    (0..paths).map(|path| make_device(path, number).map(Arc::new)).collect()
}

fn make_device(path: u8, number: u8) -> Result<Device> {
    let mut configuration = tun::Configuration::default();
    configuration.tun_name(format!("path{path}")).address(address(path, number));
    configuration.netmask("255.255.255.0").mtu(1500).up();
    tun::create(&configuration)
        .map_err(|error| format!("the device of a host cannot be made: {error}").into())
}

const NO_OUTPUT: &str = "no standard output";

/// A program on a host. It ends when this is dropped.
pub(crate) struct Running {
    child: Child,
    input: Option<ChildStdin>,
    output: Option<BufReader<ChildStdout>>,
}

impl Running {
    fn new(mut child: Child) -> Result<Self> {
        let input = child.stdin.take();
        let output = child.stdout.take().map(BufReader::new);
        Ok(Self { child, input, output })
    }

    /// Waits for a line and returns its value.
    pub(crate) fn hear<T: DeserializeOwned>(&mut self) -> Result<T> {
        let mut line = String::new();
        let output = self.output.as_mut().ok_or(NO_OUTPUT)?;
        if output.read_line(&mut line)? == 0 {
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

    /// Its output, which can be taken once.
    pub(crate) fn take_output(&mut self) -> Result<BufReader<ChildStdout>> {
        Ok(self.output.take().ok_or(NO_OUTPUT)?)
    }

    /// Has it end.
    pub(crate) fn close(&mut self) {
        self.input = None;
    }

    /// Ends the program, and returns its result.
    pub(crate) fn end<T: DeserializeOwned>(mut self) -> Result<T> {
        self.input = None;
        let mut text = String::new();
        self.take_output()?.read_to_string(&mut text)?;
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
