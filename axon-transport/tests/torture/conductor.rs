//! Starts the eight, disturbs them, and asks in the end whether all is well.

use std::{
    collections::HashMap,
    env, fmt, fs,
    io::{BufRead as _, BufReader, Write as _},
    os::unix::{fs::MetadataExt as _, process::ExitStatusExt as _},
    path::Path,
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{self, Receiver, RecvTimeoutError},
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process};

use crate::{
    child::ROLE,
    sample::{LONGEST, Random},
};

const PROCESSES: usize = 8;
/// One that is asked and says nothing for so long stands still.
const PATIENCE: Duration = Duration::from_secs(180);
/// `AXON_RING_BUFFER_SIZE_MB` of each.
const BUDGET_MB: u64 = 16;
/// What a process may hold: of each of its two publishers the budget, and what samples that are
/// pinned, lent or being replaced may take beside it; and its session.
const CEILING_MB: u64 = 2 * (2 * BUDGET_MB + 8 * (LONGEST as u64 >> 20)) + 2;

/// How often the memory that they hold is added up, which takes a while.
const LOOK: Duration = Duration::from_millis(200);

/// One of the eight.
struct Player {
    process: Child,
    /// Until it is to end.
    orders: Option<ChildStdin>,
    answers: Receiver<String>,
    stopped: Option<Instant>,
}

impl Drop for Player {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

struct Host {
    dir: tempfile::TempDir,
}

impl Host {
    fn start(&self, seed: u64) -> Player {
        let mut command = Command::new(env::current_exe().expect("its own path"));
        for (name, _) in env::vars().filter(|(name, _)| name.starts_with("AXON_")) {
            command.env_remove(name);
        }
        let mut process = command
            .env(ROLE, seed.to_string())
            .env("AXON_RUNTIME_DIR", self.dir.path().join("run"))
            .env("AXON_DAEMON_PATH", env!("CARGO_BIN_EXE_axon_daemon"))
            .env("AXON_BIND_ADDRS", "127.0.0.1")
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
            .env("AXON_RING_BUFFER_SIZE_MB", BUDGET_MB.to_string())
            .env("AXON_MAX_MESSAGE_MB", (LONGEST >> 20).to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process");
        let orders = process.stdin.take();
        let lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
        let (sender, answers) = mpsc::channel();
        thread::spawn(move || lines.map_while(Result::ok).try_for_each(|line| sender.send(line)));
        Player { process, orders, answers, stopped: None }
    }

    /// The daemon's process, if there is one.
    fn daemon(&self) -> Option<Pid> {
        let run = self.dir.path().join("run");
        let of_this_host = |pid: &u32| {
            let program = fs::read_link(format!("/proc/{pid}/exe")).unwrap_or_default();
            if program != Path::new(env!("CARGO_BIN_EXE_axon_daemon")) {
                return false;
            }
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            let wanted = format!("AXON_RUNTIME_DIR={}", run.display());
            environment.split(|byte| *byte == 0).any(|one| one == wanted.as_bytes())
        };
        let pid = processes().find(of_this_host)?;
        Pid::from_raw(i32::try_from(pid).ok()?)
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        if let Some(daemon) = self.daemon() {
            let _ = kill_process(daemon, Signal::KILL);
        }
    }
}

fn processes() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").expect("procfs").flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

impl Player {
    fn signal(&self, signal: Signal) {
        let pid = i32::try_from(self.process.id()).ok().and_then(Pid::from_raw).expect("a pid");
        kill_process(pid, signal).expect("it is there");
    }

    fn tell(&mut self, order: &str) {
        let orders = self.orders.as_mut().expect("it is not to end yet");
        let told = writeln!(orders, "{order}").and_then(|()| orders.flush());
        if let Err(error) = told {
            panic!("a process cannot be told {order:?} ({error}): {:?}", self.process.wait());
        }
    }

    fn hear(&mut self) -> String {
        match self.answers.recv_timeout(PATIENCE) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Timeout) => {
                panic!("a process stands still:\n{}", threads(self.process.id()))
            }
            Err(RecvTimeoutError::Disconnected) => {
                panic!("a process ended by itself: {:?}", self.process.wait())
            }
        }
    }

    /// Panics if it has ended by itself.
    fn must_live(&mut self) {
        if let Some(status) = self.process.try_wait().expect("a child") {
            panic!("a process ended by itself: {status}, signal {:?}", status.signal());
        }
    }
}

/// What each thread of a process waits for, as far as the system tells.
fn threads(process: u32) -> String {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let describe = |task: fs::DirEntry| {
        let read = |name| fs::read_to_string(task.path().join(name)).unwrap_or_default();
        let [name, wait, call] = ["comm", "wchan", "syscall"].map(read);
        format!("{} {}: {wait} {}\n", task.path().display(), name.trim(), call.trim())
    };
    tasks.map(describe).collect()
}

/// Bytes of shared memory that processes hold descriptors of, each counted once.
fn held(pids: impl Iterator<Item = u32>) -> u64 {
    let mut blocks = HashMap::new();
    for pid in pids {
        let Ok(entries) = fs::read_dir(format!("/proc/{pid}/fd")) else { continue };
        for path in entries.flatten().map(|entry| entry.path()) {
            let memfd = fs::read_link(&path)
                .is_ok_and(|to| to.as_os_str().as_encoded_bytes().starts_with(b"/memfd:axon"));
            if memfd && let Ok(found) = fs::metadata(&path) {
                blocks.insert(found.ino(), found.blocks());
            }
        }
    }
    blocks.values().sum::<u64>() * 512
}

/// What was done to the eight, and what those that lived to the end did meanwhile.
pub(crate) struct Round {
    seed: u64,
    time: Duration,
    kills: u32,
    stops: u32,
    daemons: u32,
    published: u64,
    taken: u64,
    /// Samples of publishers that were killed, in memory that had not reached their subscribers.
    gone: u64,
    /// The most shared memory at a time, in bytes.
    most: u64,
}

impl Round {
    pub(crate) fn heading() -> String {
        let most = format!("MiB of {}", PROCESSES as u64 * CEILING_MB);
        format!(
            "{:>6} {:>8} {:>6} {:>6} {:>8} {:>10} {:>9} {:>14} {most:>12}",
            "seed", "seconds", "kills", "stops", "daemons", "published", "taken", "gone with dead"
        )
    }
}

impl fmt::Display for Round {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { seed, time, kills, stops, daemons, published, taken, gone, most } = self;
        let (seconds, most) = (time.as_secs_f64(), most >> 20);
        write!(
            f,
            "{seed:>6} {seconds:>8.1} {kills:>6} {stops:>6} {daemons:>8} {published:>10} \
             {taken:>9} {gone:>14} {most:>12}"
        )
    }
}

/// Disturbs them for `time`, and then has them come to rest.
pub(crate) fn run(time: Duration, seed: u64) -> Round {
    let host = Host { dir: tempfile::tempdir().expect("a directory") };
    let mut random = Random(seed);
    let mut players: Vec<Player> = (0..PROCESSES).map(|_| host.start(random.next())).collect();
    let (start, mut most) = (Instant::now(), 0);
    let mut looked = start;
    let (mut kills, mut stops, mut daemons) = (0, 0, 0);
    while start.elapsed() < time {
        thread::sleep(Duration::from_millis(20 + random.below(60)));
        let index = usize::try_from(random.below(PROCESSES as u64)).expect("one of eight");
        match random.below(100) {
            0..12 => {
                players[index] = host.start(random.next());
                kills += 1;
            }
            12..40 if players[index].stopped.is_none() => {
                players[index].signal(Signal::STOP);
                players[index].stopped = Some(Instant::now());
                stops += 1;
            }
            40..44 => {
                if let Some(daemon) = host.daemon() {
                    daemons += u32::from(kill_process(daemon, Signal::KILL).is_ok());
                }
            }
            _ => {}
        }
        for player in &mut players {
            player.must_live();
            let pause = Duration::from_millis(random.below(400));
            if player.stopped.is_some_and(|since| since.elapsed() > pause) {
                player.signal(Signal::CONT);
                player.stopped = None;
            }
        }
        if looked.elapsed() < LOOK {
            continue;
        }
        looked = Instant::now();
        let daemon = host.daemon().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
        let now = held(players.iter().map(|player| player.process.id()).chain(daemon));
        most = most.max(now);
        let ceiling = (PROCESSES as u64 * CEILING_MB) << 20;
        assert!(now <= ceiling, "{now} bytes of shared memory, more than {ceiling}");
    }
    assert!(most > 0, "no shared memory was found");
    come_to_rest(&mut players);
    let gone = missed(&mut players);
    let (mut published, mut taken) = (0, 0);
    for player in &mut players {
        player.tell("count");
        let counts = player.hear();
        let mut counts = counts.split(' ').map(|n| n.parse::<u64>().expect("a number"));
        published += counts.next().expect("published");
        taken += counts.next().expect("taken");
    }
    for mut player in players {
        // Its input ends: it should, too.
        player.orders = None;
        assert!(player.process.wait().expect("a child").success());
    }
    Round { seed, time: start.elapsed(), kills, stops, daemons, published, taken, gone, most }
}

/// How many samples KEEP_ALL subscriptions missed of publishers that are dead; of those that live
/// they must not miss any.
fn missed(players: &mut [Player]) -> u64 {
    // A GID begins with that of its session.
    let session = |gid: &str| gid[..24].to_owned();
    let mut ask = |order: &str| -> Vec<String> {
        let answer = |player: &mut Player| {
            player.tell(order);
            player.hear()
        };
        players.iter_mut().map(answer).collect()
    };
    let alive: Vec<String> = ask("who").iter().map(|gid| session(gid)).collect();
    let mut gone = 0;
    for answer in ask("missed") {
        let words: Vec<&str> = answer.split_ascii_whitespace().collect();
        for [publisher, count] in words.as_chunks::<2>().0 {
            let lives = alive.contains(&session(publisher));
            assert!(
                !lives,
                "{count} samples of {publisher}, which lives, are lost to a KEEP_ALL subscription"
            );
            gone += count.parse::<u64>().expect("a number");
        }
    }
    gone
}

/// Every process must come to have the last samples of every other.
fn come_to_rest(players: &mut [Player]) {
    for player in players.iter_mut() {
        if player.stopped.take().is_some() {
            player.signal(Signal::CONT);
        }
        player.tell("quiet");
    }
    let mut subscriptions = String::new();
    for player in players.iter_mut() {
        player.tell("who");
        subscriptions += " ";
        subscriptions += &player.hear();
    }
    let mut lasts = Vec::new();
    for (index, player) in players.iter_mut().enumerate() {
        player.tell(&format!("final{subscriptions}"));
        lasts.push((index, player.hear()));
    }
    for (of, last) in &lasts {
        for (index, player) in players.iter_mut().enumerate() {
            // A publisher does not wait for subscriptions of its own session.
            if index != *of {
                player.tell(&format!("expect {last}"));
                assert_eq!(player.hear(), "there");
            }
        }
    }
}
