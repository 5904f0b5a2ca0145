//! Starts the processes, disturbs them, and asks in the end whether all is well.

use std::{
    collections::HashMap,
    env, fmt, fs,
    io::{BufRead as _, BufReader, Write as _},
    os::unix::{fs::MetadataExt as _, process::ExitStatusExt as _},
    path::Path,
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{self, Receiver, RecvTimeoutError},
    thread,
    time::{Duration, Instant, SystemTime},
};

use rustix::process::{Pid, Signal, kill_process};

use crate::{
    child::ROLE,
    sample::{LONGEST, Random},
};

/// How the processes are disturbed.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Plan {
    /// Eight of them are stopped for some tenths of a second at most, often.
    Brief,
    /// Twelve are stopped for some seconds, and the daemon is killed meanwhile.
    Stops,
}

impl Plan {
    fn processes(self) -> usize {
        match self {
            Self::Brief => 8,
            Self::Stops => 12,
        }
    }

    /// What happens next, mostly nothing.
    fn next(self, random: &mut Random) -> Disturbance {
        match (self, random.below(1000)) {
            (Self::Brief, 0..120) => Disturbance::Kill,
            (Self::Brief, 120..400) => Disturbance::Stop(Duration::from_millis(random.below(400))),
            (Self::Brief, 400..440) => Disturbance::Daemon,
            (Self::Stops, 0..60) => Disturbance::Kill,
            (Self::Stops, 60..120) => Disturbance::Stop(Duration::from_millis(random.below(400))),
            (Self::Stops, 120..160) => {
                Disturbance::StopAround(Duration::from_millis(1000 + random.below(3000)))
            }
            (Self::Stops, 160..180) => Disturbance::Daemon,
            _ => Disturbance::None,
        }
    }
}

/// What happens to one process or to the daemon.
enum Disturbance {
    None,
    Kill,
    Stop(Duration),
    /// The daemon is killed while it is stopped, and some that come back to the next one.
    StopAround(Duration),
    Daemon,
}

/// One that is asked and says nothing for so long stands still.
const PATIENCE: Duration = Duration::from_secs(180);
/// `AXON_RING_BUFFER_SIZE_MB` of each.
const BUDGET_MB: u64 = 16;
/// What a process may hold: of each of its two publishers the budget, and what samples that are
/// pinned, lent or being replaced may take beside it; and its session.
const CEILING_MB: u64 = 2 * (2 * BUDGET_MB + 8 * (LONGEST as u64 >> 20)) + 2;

/// For how long after the daemon's death those that come back to the next one are killed often.
const COMING_BACK: Duration = Duration::from_millis(800);
/// How often the memory that they hold is added up, which takes a while.
const LOOK: Duration = Duration::from_millis(200);

/// One of the processes.
struct Player {
    process: Child,
    /// Until it is to end.
    orders: Option<ChildStdin>,
    answers: Receiver<String>,
    /// Its KEEP_ALL subscription, once it has said so.
    reader: Option<String>,
    /// Until when it is stopped.
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
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
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
        Player { process, orders, answers, reader: None, stopped: None }
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
        self.reader();
        self.line()
    }

    /// Its KEEP_ALL subscription.
    fn reader(&mut self) -> String {
        if self.reader.is_none() {
            self.reader = Some(self.line());
        }
        self.reader.clone().expect("just said")
    }

    /// The same, if it has said so.
    fn known(&mut self) -> Option<&str> {
        if self.reader.is_none() {
            self.reader = self.answers.try_recv().ok();
        }
        self.reader.as_deref()
    }

    fn ask(&mut self, order: &str) -> String {
        self.tell(order);
        self.hear()
    }

    fn line(&mut self) -> String {
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

/// What was done to the processes, and what those that lived to the end did meanwhile.
pub(crate) struct Round {
    plan: Plan,
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
        format!(
            "{:>6} {:>6} {:>8} {:>6} {:>6} {:>8} {:>10} {:>9} {:>14} {:>6} {:>6}",
            "plan",
            "seed",
            "seconds",
            "kills",
            "stops",
            "daemons",
            "published",
            "taken",
            "gone with dead",
            "MiB",
            "most"
        )
    }
}

impl fmt::Display for Round {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plan, seed, time, kills, stops, daemons, published, taken, gone, most } = self;
        let (seconds, most) = (time.as_secs_f64(), most >> 20);
        let (plan, limit) = (format!("{plan:?}"), plan.processes() as u64 * CEILING_MB);
        write!(
            f,
            "{plan:>6} {seed:>6} {seconds:>8.1} {kills:>6} {stops:>6} {daemons:>8} \
             {published:>10} {taken:>9} {gone:>14} {most:>6} {limit:>6}"
        )
    }
}

/// Disturbs them for `time`, and then has them come to rest.
pub(crate) fn run(plan: Plan, time: Duration, seed: u64) -> Round {
    let host = Host { dir: tempfile::tempdir().expect("a directory") };
    let mut random = Random(seed);
    let count = plan.processes();
    let mut players: Vec<Player> = (0..count).map(|_| host.start(random.next())).collect();
    let (start, mut most) = (Instant::now(), 0);
    let mut looked = start;
    let (mut kills, mut stops, mut daemons) = (0, 0, 0);
    // When the process of each reader was killed.
    let mut deaths: HashMap<String, u128> = HashMap::new();
    let mut kill_daemon_at: Option<Instant> = None;
    let mut rough_until = start;
    while start.elapsed() < time {
        thread::sleep(Duration::from_millis(20 + random.below(60)));
        let index = usize::try_from(random.below(count as u64)).expect("one of them");
        let player = &mut players[index];
        let now = Instant::now();
        let mut stop = |player: &mut Player, pause| {
            player.signal(Signal::STOP);
            player.stopped = Some(now + pause);
            stops += 1;
        };
        let rough = now < rough_until && player.stopped.is_none() && random.below(3) == 0;
        match if rough { Disturbance::Kill } else { plan.next(&mut random) } {
            Disturbance::Kill => {
                if let Some(reader) = player.known() {
                    deaths.insert(reader.to_owned(), epoch());
                }
                *player = host.start(random.next());
                kills += 1;
            }
            Disturbance::Stop(pause) if player.stopped.is_none() => stop(player, pause),
            Disturbance::StopAround(pause) if player.stopped.is_none() => {
                stop(player, pause);
                kill_daemon_at = Some(now + pause.mul_f64(random.below(1000) as f64 / 1000.0));
            }
            Disturbance::Daemon => kill_daemon_at = Some(now),
            Disturbance::Stop(_) | Disturbance::StopAround(_) | Disturbance::None => {}
        }
        if kill_daemon_at.take_if(|at| *at <= now).is_some()
            && let Some(daemon) = host.daemon()
        {
            daemons += u32::from(kill_process(daemon, Signal::KILL).is_ok());
            if matches!(plan, Plan::Stops) {
                rough_until = now + COMING_BACK;
            }
        }
        for player in &mut players {
            player.must_live();
            if player.stopped.take_if(|until| *until <= Instant::now()).is_some() {
                player.signal(Signal::CONT);
            }
        }
        if looked.elapsed() < LOOK {
            continue;
        }
        looked = Instant::now();
        let daemon = host.daemon().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
        let now = held(players.iter().map(|player| player.process.id()).chain(daemon));
        most = most.max(now);
        let ceiling = (count as u64 * CEILING_MB) << 20;
        assert!(now <= ceiling, "{now} bytes of shared memory, more than {ceiling}");
    }
    assert!(most > 0, "no shared memory was found");
    come_to_rest(&mut players);
    let gone = missed(&mut players, &deaths);
    let (mut published, mut taken) = (0, 0);
    for player in &mut players {
        let counts = player.ask("count");
        let mut counts = counts.split(' ').map(|n| n.parse::<u64>().expect("a number"));
        published += counts.next().expect("published");
        taken += counts.next().expect("taken");
    }
    for mut player in players {
        // Its input ends: it should, too.
        player.orders = None;
        assert!(player.process.wait().expect("a child").success());
    }
    let time = start.elapsed();
    Round { plan, seed, time, kills, stops, daemons, published, taken, gone, most }
}

/// Milliseconds since the epoch.
fn epoch() -> u128 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    now.expect("after the epoch").as_millis()
}

/// How many samples KEEP_ALL subscriptions missed of publishers that were dead by then; of those that
/// lived they must not miss any, and must count the others.
fn missed(players: &mut [Player], deaths: &HashMap<String, u128>) -> u64 {
    // A GID begins with that of its session.
    let session = |gid: &str| gid[..24].to_owned();
    let deaths: HashMap<String, u128> =
        deaths.iter().map(|(reader, at)| (session(reader), *at)).collect();
    let (mut gone, mut wrong) = (0, Vec::new());
    for (index, player) in players.iter_mut().enumerate() {
        let answer = player.ask("missed");
        let words: Vec<&str> = answer.split_ascii_whitespace().collect();
        for [publisher, samples, at, counted] in words.as_chunks::<4>().0 {
            let at: u128 = at.parse().expect("a time");
            if deaths.get(&session(publisher)).is_some_and(|death| *death <= at)
                && *counted == "true"
            {
                gone += samples.parse::<u64>().expect("a number");
            } else {
                let reader = player.reader();
                wrong.push((index, reader, format!("{samples} of {publisher} ({counted})")));
            }
        }
    }
    for (index, reader, what) in &wrong {
        let publisher = what.split(' ').nth(2).expect("its GID").to_owned();
        players[*index].ask(&format!("pair_log {publisher}"));
        for player in players.iter_mut() {
            if session(&player.reader()) == session(&publisher) {
                player.ask(&format!("pair_log {reader}"));
            }
        }
    }
    let wrong: Vec<String> =
        wrong.into_iter().map(|(_, reader, what)| format!("{reader} missed {what}")).collect();
    assert!(
        wrong.is_empty(),
        "samples of publishers that live, or that nobody counts, are missing:\n{}",
        wrong.join("\n")
    );
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
        subscriptions += " ";
        subscriptions += &player.reader();
    }
    let mut lasts = Vec::new();
    for (index, player) in players.iter_mut().enumerate() {
        lasts.push((index, player.ask(&format!("final{subscriptions}"))));
    }
    for (of, last) in &lasts {
        for (index, player) in players.iter_mut().enumerate() {
            // A publisher does not wait for subscriptions of its own session.
            if index != *of {
                assert_eq!(player.ask(&format!("expect {last}")), "there");
            }
        }
    }
}
