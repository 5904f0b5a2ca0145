//! Two hosts that list each other as peers, on addresses and in a domain of their own.

use std::{
    collections::BTreeSet,
    ffi::OsString,
    fs,
    net::Ipv4Addr,
    os::unix::{fs::PermissionsExt, process::CommandExt},
    path::Path,
    process::{Command, Stdio},
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
};

use axon_tests::Sizes;
use axon_transport::{
    Session, SessionOptions,
    config::{Config, OsFiles},
    daemon_status,
    status::{LinkStatus, Status},
};
use rustix::process::{Pid, Signal, kill_process};

use super::{
    excerpt::excerpt,
    mode::Settings,
    process::{Kept, Node, until},
    wire::Wire,
};

/// The topic of all these tests.
pub(crate) const TOPIC: &str = "/numbers";

/// The plan for the start of two hosts.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    /// The settings of host A and host B.
    pub(crate) settings: [Settings; 2],
    /// Seconds that a daemon outlives its last session.
    pub(crate) grace_s: u32,
    /// Seconds after which a peer that reads nothing is disconnected from a topic.
    pub(crate) stalled_s: u32,
    /// MiB that the graph of a peer may take, and its routes four times as much; the default if `None`.
    pub(crate) graph_mb: Option<u32>,
    /// Whether host B is in another domain.
    pub(crate) other_domain: bool,
    /// Whether only a simulated wire connects the hosts: [`Host::wire`].
    pub(crate) wired: bool,
    /// The number of wires between the hosts, if they are `wired`.
    pub(crate) paths: usize,
    /// Whether the hosts list each other; if not, they find each other by multicast on the loopback.
    pub(crate) listed: bool,
}

impl Plan {
    pub(crate) fn new(settings: [Settings; 2]) -> Self {
        Self {
            settings,
            grace_s: 300,
            stalled_s: 300,
            graph_mb: None,
            other_domain: false,
            wired: false,
            paths: 1,
            listed: true,
        }
    }

    /// Starts both hosts.
    pub(crate) fn start(self) -> [Host; 2] {
        let mut hosts = self.prepare();
        hosts.iter_mut().for_each(Host::start);
        hosts
    }

    /// Prepares both hosts without a daemon: a process of theirs starts it.
    pub(crate) fn prepare(self) -> [Host; 2] {
        static PAIRS: AtomicU32 = AtomicU32::new(0);
        let (pair, pid) = (PAIRS.fetch_add(1, Ordering::Relaxed), std::process::id());
        // A network that hardly anybody uses; another run of the tests at the same time has its own.
        let net = [(16 + pair % 200) as u8, (1 + pid % 250) as u8];
        let lease = Arc::new(DomainLease::next(pid.wrapping_mul(31) + 2 * pair));
        let domain = lease.0;
        let [addresses, ends, second_ends] = [[1, 2], [4, 3], [6, 5]]
            .map(|of| of.map(|host| Ipv4Addr::new(127, net[0], net[1], host)));
        let ends = [0, 1].map(|host| match self.paths {
            1 => ends[host].to_string(),
            _ => format!("{},{}", ends[host], second_ends[host]),
        });
        [0, 1].map(|host| {
            let lists = self.listed && !self.wired;
            let peers = if lists { addresses[1 - host].to_string() } else { String::new() };
            let mut more = vec![
                ("AXON_BIND_ADDRS", addresses[host].to_string()),
                ("AXON_DAEMON_PEERS", peers),
                ("ROS_DOMAIN_ID", (domain + u32::from(self.other_domain && host == 1)).to_string()),
            ];
            if self.wired {
                more.push(("AXON_ADVERTISE_ADDRS", ends[host].clone()));
                more.push(("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST".to_owned()));
                if host == 0 {
                    more.push(("ROS_STATIC_PEERS", ends[1].replace(',', ";")));
                }
            }
            let settings = self.settings[host].iter().cloned().chain(more);
            let graph = self.graph_mb.map_or_else(String::new, |mib| format!("graph_mb = {mib}\n"));
            let [grace_s, stalled_s] = [self.grace_s, self.stalled_s];
            let link = format!("[link]\ngrace_s = {grace_s}\nstalled_s = {stalled_s}\n{graph}");
            let lease = Arc::clone(&lease);
            Host::new(["A", "B"][host], addresses[host], settings, &link, lease)
        })
    }
}

/// A host with its daemon.
#[derive(Debug)]
pub(crate) struct Host {
    name: &'static str,
    pub(crate) address: Ipv4Addr,
    pub(crate) dir: tempfile::TempDir,
    env: Vec<(String, String)>,
    pub(crate) daemon: Option<Kept>,
    /// The lease lasts until no process of the host runs any more.
    _lease: Arc<DomainLease>,
}

/// Two domains that no other test has meanwhile: hosts of one domain find each other by multicast.
#[derive(Debug)]
struct DomainLease(u32);

static DOMAINS_IN_USE: Mutex<BTreeSet<u32>> = Mutex::new(BTreeSet::new());

impl DomainLease {
    /// Reserves the first pair of free domains from this one on.
    fn next(from: u32) -> Self {
        let mut in_use = DOMAINS_IN_USE.lock().unwrap();
        // Below 100: the tool's tests, whose daemons may still be in their grace time, are above.
        let all = (0..49).map(|later| 1 + (from / 2 + later) % 49 * 2);
        let free = all.into_iter().find(|domain| !in_use.contains(domain));
        let domain = free.expect("fewer than 50 pairs of hosts at a time");
        in_use.insert(domain);
        Self(domain)
    }
}

impl Drop for DomainLease {
    fn drop(&mut self) {
        if let Ok(mut in_use) = DOMAINS_IN_USE.lock() {
            in_use.remove(&self.0);
        }
    }
}

impl Host {
    fn new(
        name: &'static str,
        address: Ipv4Addr,
        settings: impl IntoIterator<Item = (&'static str, String)>,
        toml: &str,
        lease: Arc<DomainLease>,
    ) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
        fs::write(path("axon.toml"), toml).unwrap();
        let mut env = vec![
            ("AXON_RUNTIME_DIR".to_owned(), path("run")),
            ("AXON_CONFIG".to_owned(), path("axon.toml")),
            ("AXON_DAEMON_PATH".to_owned(), env!("CARGO_BIN_EXE_axon-test-daemon").to_owned()),
            (
                "AXON_LOG".to_owned(),
                "info,axon_daemon=debug,axon_shm=debug,axon_transport=debug".to_owned(),
            ),
            ("RUST_BACKTRACE".to_owned(), "1".to_owned()),
        ];
        env.extend(settings.into_iter().map(|(name, value)| (name.to_owned(), value)));
        Self { name, address, dir, env, daemon: None, _lease: lease }
    }

    /// Starts its daemon, which has none.
    pub(crate) fn start(&mut self) {
        let mut command = self.command(env!("CARGO_BIN_EXE_axon-test-daemon"));
        command.arg("--while-stdin");
        self.start_as(command);
    }

    /// Starts the daemon after a command of the shell, and without the right to exceed the limits that the command
    /// sets.
    pub(crate) fn start_by(&mut self, shell: &str) {
        let script = format!("{shell} && exec \"$0\" --while-stdin");
        let mut command = match rustix::process::geteuid().is_root() {
            true => {
                let mut command = self.command("setpriv");
                command.args(["--bounding-set=-ipc_lock", "--inh-caps=-ipc_lock", "sh"]);
                command
            }
            false => self.command("sh"),
        };
        command.args(["-c", &script, env!("CARGO_BIN_EXE_axon-test-daemon")]);
        self.start_as(command);
    }

    fn start_as(&mut self, mut command: Command) {
        command.stdin(Stdio::piped()).stdout(Stdio::null());
        self.daemon = Some(Kept(command.spawn().unwrap()));
        // An application that lost its daemon may have started one first: then this one ends at once.
        until("the daemon stands", || {
            self.try_status().is_some_and(|status| status.port.is_some())
        });
    }

    /// Returns the wire to this host, which runs already, of a plan that is `wired`.
    pub(crate) fn wire(&self) -> Wire {
        self.wire_at([3, 4])
    }

    /// Returns the second wire of a plan with two paths.
    pub(crate) fn second_wire(&self) -> Wire {
        self.wire_at([5, 6])
    }

    fn wire_at(&self, [near, far]: [u8; 2]) -> Wire {
        let at = |host| {
            let [a, b, c, _] = self.address.octets();
            Ipv4Addr::new(a, b, c, host)
        };
        let port = self.status().port.unwrap();
        Wire::between((at(near), port).into(), (at(far), 0).into(), (self.address, port).into())
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        let ours = |name: &str| ["AXON_", "ROS_", "XDG_"].iter().any(|p| name.starts_with(p));
        for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        let log = fs::OpenOptions::new().create(true).append(true).open(self.log()).unwrap();
        command.envs(self.env.iter().map(|(n, v)| (n, v))).stderr(log);
        command
    }

    fn log(&self) -> std::path::PathBuf {
        self.dir.path().join("host.txt")
    }

    /// Stops its daemon, until the end of a scope.
    pub(crate) fn stop_daemon(&self) -> Stopped {
        let pid = self.status().pid;
        signal(pid, Signal::STOP);
        Stopped(pid)
    }

    /// Gives a variable another value for the processes that are started from now on.
    pub(crate) fn set(&mut self, name: &str, value: &str) {
        self.env.retain(|(n, _)| n != name);
        self.env.push((name.to_owned(), value.to_owned()));
    }

    /// Leaves a variable to `axon.toml`, for the processes that are started from now on.
    pub(crate) fn unset(&mut self, name: &str) {
        self.env.retain(|(n, _)| n != name);
    }

    pub(crate) fn domain(&self) -> u32 {
        self.variable("ROS_DOMAIN_ID").parse().unwrap()
    }

    fn variable(&self, name: &str) -> &str {
        &self.env.iter().find(|(n, _)| n == name).unwrap().1
    }

    /// Returns the configuration of the host's processes, for this process.
    pub(crate) fn config(&self) -> Config {
        let env = self.env.iter().map(|(n, v)| (OsString::from(n), OsString::from(v)));
        Config::resolve(env.filter(|(n, _)| n != "RUST_BACKTRACE"), None, &OsFiles).unwrap()
    }

    /// Returns the bytes in this line of `/proc/PID/status` of the host's daemon.
    pub(crate) fn memory(&self, line: &str) -> usize {
        let pid = self.daemon.as_ref().unwrap().0.id();
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let line = status.lines().find_map(|l| l.strip_prefix(line)).unwrap();
        let kib: usize = line.split_whitespace().nth(1).unwrap().parse().unwrap();
        kib << 10
    }

    pub(crate) fn try_status(&self) -> Option<Status> {
        let json = daemon_status(&self.config()).ok()?;
        Some(serde_json::from_str(&json).unwrap())
    }

    /// Returns the daemon's status, once there is a daemon.
    #[track_caller]
    pub(crate) fn status(&self) -> Status {
        let mut status = None;
        until("a daemon answers", || {
            status = self.try_status();
            status.is_some()
        });
        status.unwrap()
    }

    /// Waits for the link to the one peer, and returns its status.
    #[track_caller]
    pub(crate) fn link(&self) -> LinkStatus {
        let mut links = Vec::new();
        until("a link stands", || {
            links = self.status().links;
            links.iter().any(|link| link.state == "connected")
        });
        assert_eq!(links.len(), 1, "one peer, one link: {links:?}");
        links.remove(0)
    }

    /// Waits for a refusal that `fits`.
    #[track_caller]
    pub(crate) fn wait_refusal(&self, what: &str, fits: impl Fn(&str) -> bool) {
        until(what, || {
            let refusals = self.status().refusals;
            refusals.iter().any(|r| fits(&format!("{} {} {}", r.peer, r.what, r.reason)))
        });
    }

    /// Waits for a line of its daemon's log that has all of this.
    #[track_caller]
    pub(crate) fn wait_log(&self, parts: &[&str]) {
        until(&format!("{parts:?} in the log"), || {
            let log = self.all_logs();
            log.lines().any(|line| parts.iter().all(|part| line.contains(part)))
        });
    }

    /// Returns the number of bytes in the daemon's log.
    pub(crate) fn log_bytes(&self) -> usize {
        self.all_logs().len()
    }

    /// Lines of its daemon's log that have all of this.
    pub(crate) fn log_lines(&self, parts: &[&str]) -> usize {
        let log = self.all_logs();
        log.lines().filter(|line| parts.iter().all(|part| line.contains(part))).count()
    }

    /// Returns whether the host's daemon is the process with which it was started.
    pub(crate) fn is_first_daemon(&self) -> bool {
        self.daemon.as_ref().is_some_and(|daemon| daemon.0.id() == self.status().pid)
    }

    /// Starts a publisher that waits for `readers` readers; without a count it publishes a stream.
    pub(crate) fn publish(&self, sizes: Sizes, readers: usize, count: Option<u64>) -> Node {
        let count = count.map_or_else(|| "stream".to_owned(), |count| count.to_string());
        let readers = readers.to_string();
        self.node(&["publish", TOPIC, sizes.name(), &readers, &count])
    }

    /// Starts a publisher that waits for `readers` readers and then publishes as fast as they permit.
    pub(crate) fn flood(&self, sizes: Sizes, readers: usize) -> Node {
        self.node(&["publish", TOPIC, sizes.name(), &readers.to_string(), "flood"])
    }

    /// Starts a subscriber, and waits until it is ready.
    pub(crate) fn subscribe(&self, sizes: Sizes) -> Node {
        let mut node = self.node(&["subscribe", TOPIC, sizes.name()]);
        node.wait_ready();
        node
    }

    /// Opens a session of this process on this host.
    pub(crate) fn session(&self, name: &str) -> Session {
        Session::open(&self.config(), SessionOptions::new(name)).unwrap()
    }

    /// Opens the same session without memory that it shares with the daemon.
    pub(crate) fn relayed_session(&self, name: &str) -> Session {
        let mut config = self.config();
        config.shm = false;
        Session::open(&config, SessionOptions::new(name)).unwrap()
    }

    pub(crate) fn node(&self, arguments: &[&str]) -> Node {
        self.node_with(&[], arguments)
    }

    /// Starts a process with settings of its own beside the host's.
    pub(crate) fn node_with(&self, settings: &[(&str, &str)], arguments: &[&str]) -> Node {
        let mut command = self.command(env!("CARGO_BIN_EXE_axon-test-node"));
        command.args(arguments).envs(settings.iter().copied());
        Node::start(command)
    }

    /// Starts a process of another user, which runs a program that it can read.
    pub(crate) fn node_of(&self, program: &Path, uid: u32, arguments: &[&str]) -> Node {
        let mut command = self.command(program.to_str().unwrap());
        command.args(arguments).uid(uid).gid(uid);
        Node::start(command)
    }

    pub(crate) fn all_logs(&self) -> String {
        let spawned = self.dir.path().join(format!("run/axon-{}.log", self.domain()));
        let text = |log| String::from_utf8_lossy(&fs::read(log).unwrap_or_default()).into_owned();
        [self.log(), spawned].map(text).concat()
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        if let Some(status) = self.try_status() {
            if std::thread::panicking() {
                let (links, refusals, keys) = (status.links, status.refusals, status.keys);
                let text = format!("{links:#?}\n{refusals:#?}\n{keys}");
                eprintln!("{}", excerpt(&format!("the status of host {}", self.name), &text));
            }
            // A daemon that a session started is not a child of this process.
            kill(status.pid);
        }
        if std::thread::panicking() {
            eprintln!("{}", excerpt(&format!("the log of host {}", self.name), &self.all_logs()));
        }
    }
}

/// A daemon that is stopped until the end of the scope, however that ends.
pub(crate) struct Stopped(u32);

impl Drop for Stopped {
    fn drop(&mut self) {
        signal(self.0, Signal::CONT);
    }
}

/// Writes a private key that only its owner can read.
pub(crate) fn write_key(path: &Path, pem: &str) {
    fs::write(path, pem).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o600)).unwrap();
}

pub(crate) fn kill(pid: u32) {
    signal(pid, Signal::KILL);
}

pub(crate) fn signal(pid: u32, signal: Signal) {
    let pid = Pid::from_raw(i32::try_from(pid).unwrap()).unwrap();
    // It may have ended by itself meanwhile.
    let _ = kill_process(pid, signal);
}
