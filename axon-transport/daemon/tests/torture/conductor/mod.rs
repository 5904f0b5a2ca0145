//! Starts the processes, disturbs them, and asks them at the end whether all is well.

mod host;
mod judge;
mod round;

use std::{
    thread,
    time::{Duration, Instant, SystemTime},
};

use rustix::process::{Signal, kill_process};

pub(crate) use self::{host::Namespaces, round::Round};
use self::{
    host::{Ending, Host, Player, held},
    judge::{Ended, Past, come_to_rest, missed},
    round::{Done, Gone},
};
use crate::sample::{LONGEST, Random};

/// The way in which the processes are disturbed.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Plan {
    /// Eight processes are often stopped for at most some tenths of a second.
    Brief,
    /// Twelve processes are stopped for some seconds, and the daemon is killed meanwhile.
    Stops,
    /// Like `Stops`, but the daemon lives: the samples of a publisher that ended must reach every
    /// reader.
    Ends,
}

impl Plan {
    fn processes(self) -> usize {
        match self {
            Self::Brief => 8,
            Self::Stops | Self::Ends => 12,
        }
    }

    /// Returns the next disturbance, which mostly is none.
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
            (Self::Ends, 0..20) => Disturbance::Kill,
            (Self::Ends, 20..80) => Disturbance::Stop(Duration::from_millis(random.below(400))),
            (Self::Ends, 80..140) => {
                Disturbance::Stop(Duration::from_millis(1000 + random.below(3000)))
            }
            _ => Disturbance::None,
        }
    }
}

/// A disturbance of one process or of the daemon.
enum Disturbance {
    None,
    Kill,
    Stop(Duration),
    /// A process is stopped. The daemon is killed meanwhile, and so are some processes that connect
    /// to the next one.
    StopAround(Duration),
    Daemon,
}

/// A process that does not answer for this long is stuck.
const PATIENCE: Duration = Duration::from_secs(180);
/// The `AXON_RING_BUFFER_SIZE_MB` of each process.
const BUDGET_MB: u64 = 16;
/// Memory that a process may hold: for each of its two publishers the budget, and the samples that
/// are pinned, lent or being replaced; and its session with its calls.
const CEILING_MB: u64 = 2 * (2 * BUDGET_MB + 8 * (LONGEST as u64 >> 20)) + 4;

/// Time after the daemon's death during which processes that connect to the next one are often
/// killed.
const COMING_BACK: Duration = Duration::from_millis(800);
/// Interval of adding up the memory that they hold, which takes a while.
const LOOK: Duration = Duration::from_millis(200);

/// The processes of a round, and the disturbances so far.
struct Game<'a> {
    plan: Plan,
    host: Host<'a>,
    random: Random,
    players: Vec<Player>,
    /// The processes that have ended their publisher and are about to end.
    leaving: Vec<(Player, Instant)>,
    done: Done,
    past: Past,
    kill_daemon_at: Option<Instant>,
    /// The time until which processes are often killed.
    rough_until: Instant,
}

/// Disturbs the processes for `time`, and then lets them come to rest.
pub(crate) fn run(plan: Plan, time: Duration, seed: u64, namespaces: &Namespaces) -> Round {
    let start = Instant::now();
    let mut game = Game {
        plan,
        host: Host::new(namespaces),
        random: Random(seed),
        players: Vec::new(),
        leaving: Vec::new(),
        done: Done::default(),
        past: Past::default(),
        kill_daemon_at: None,
        rough_until: start,
    };
    for _ in 0..plan.processes() {
        let player = game.start();
        game.players.push(player);
    }
    let (mut most, mut looked) = (0, start);
    while start.elapsed() < time {
        thread::sleep(Duration::from_millis(20 + game.random.below(60)));
        game.disturb();
        game.kill_daemon();
        game.resume();
        game.hear_of_ends();
        if looked.elapsed() >= LOOK {
            looked = Instant::now();
            most = most.max(game.held());
        }
    }
    assert!(most > 0, "no shared memory was found");
    let Game { mut players, done, mut past, leaving, host, .. } = game.without_leaving();
    drop(leaving);
    let [unmet, untold] = come_to_rest(&mut players, &mut past);
    let gone = Gone { unmet, untold, ..missed(&mut players, &past) };
    let mut counts = [0; 3];
    for player in &mut players {
        let answer = player.ask("count");
        for (sum, count) in counts.iter_mut().zip(answer.split(' ')) {
            *sum += count.parse::<u64>().expect("a number");
        }
    }
    players.into_iter().for_each(Player::end);
    drop(host);
    let ([published, taken, answers], time) = (counts, start.elapsed());
    Round { plan, seed, time, done, published, taken, answers, gone, most }
}

impl Game<'_> {
    fn start(&mut self) -> Player {
        let player = self.host.start(&mut self.random);
        self.done.namespaced += u32::from(player.is_namespaced());
        player
    }

    fn any(&mut self) -> usize {
        let count = self.players.len() as u64;
        usize::try_from(self.random.below(count)).expect("one of them")
    }

    fn disturb(&mut self) {
        let (index, now) = (self.any(), Instant::now());
        let stopped = self.players[index].stopped.is_some();
        let rough = now < self.rough_until && !stopped && self.random.below(3) == 0;
        match if rough { Disturbance::Kill } else { self.plan.next(&mut self.random) } {
            Disturbance::Kill => {
                if let Some(reader) = self.players[index].known() {
                    self.past.deaths.insert(reader.to_owned(), epoch());
                }
                self.players[index] = self.start();
                self.done.kills += 1;
            }
            Disturbance::Stop(pause) if !stopped => {
                self.done.stops += u32::from(self.players[index].stop(pause));
            }
            Disturbance::StopAround(pause) if !stopped => {
                self.done.stops += u32::from(self.players[index].stop(pause));
                let part = self.random.below(1000) as f64 / 1000.0;
                self.kill_daemon_at = Some(now + pause.mul_f64(part));
            }
            Disturbance::Daemon => self.kill_daemon_at = Some(now),
            Disturbance::Stop(_) | Disturbance::StopAround(_) | Disturbance::None => {}
        }
    }

    fn kill_daemon(&mut self) {
        let now = Instant::now();
        if self.kill_daemon_at.take_if(|at| *at <= now).is_some()
            && let Some(daemon) = self.host.daemon()
        {
            if kill_process(daemon, Signal::KILL).is_ok() {
                self.past.daemons.push(epoch());
                self.done.daemons += 1;
            }
            if matches!(self.plan, Plan::Stops) {
                self.rough_until = now + COMING_BACK;
            }
        }
    }

    /// Continues the processes whose time has come. A publisher then ends, 0.3 to 1 s later.
    fn resume(&mut self) {
        for index in 0..self.players.len() {
            self.players[index].must_live();
            if self.players[index].stopped.is_some_and(|until| until <= Instant::now()) {
                self.players[index].resume();
                let ending = self.any();
                let after = 300 + self.random.below(700);
                let (word, what) = match self.random.below(2) {
                    0 => ("publisher", Ending::Publisher),
                    _ => ("process", Ending::Process),
                };
                let ending = &mut self.players[ending];
                if ending.stopped.is_none() && ending.ending.is_none() && ending.known().is_some() {
                    ending.tell(&format!("end {after} {word}"));
                    ending.ending = Some(what);
                }
            }
        }
    }

    /// Replaces each process that ends by another one.
    fn hear_of_ends(&mut self) {
        for index in 0..self.players.len() {
            let player = &mut self.players[index];
            let Some(ending) = player.ending else { continue };
            let Some(line) = player.heard() else { continue };
            player.ending = None;
            let ended = Ended::parse(&line);
            if ending == Ending::Process {
                self.past.process_ends(ended.gid(), epoch());
            }
            self.past.ended.push(ended);
            self.done.ends += 1;
            if ending == Ending::Process {
                player.resume();
                let next = self.start();
                let player = std::mem::replace(&mut self.players[index], next);
                self.leaving.push((player, Instant::now()));
            }
        }
        self.leaving.retain_mut(|(player, since)| {
            assert!(since.elapsed() < PATIENCE, "a process does not end");
            !player.has_ended()
        });
    }

    /// Waits until all processes that were told to end have.
    fn without_leaving(mut self) -> Self {
        let ends = |player: &Player| player.ending == Some(Ending::Process);
        while !self.leaving.is_empty() || self.players.iter().any(ends) {
            self.players.iter_mut().for_each(Player::resume);
            thread::sleep(Duration::from_millis(10));
            self.hear_of_ends();
        }
        self
    }

    /// Returns the bytes of shared memory that all processes hold.
    fn held(&mut self) -> u64 {
        let daemon = self.host.daemon().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
        let leaving = self.leaving.iter_mut().map(|(player, _)| player);
        let players: Vec<u32> =
            self.players.iter_mut().chain(leaving).filter_map(Player::id).collect();
        let now = held(players.iter().copied().chain(daemon));
        let ceiling = (players.len() as u64 * CEILING_MB) << 20;
        assert!(now <= ceiling, "{now} bytes of shared memory, more than {ceiling}");
        now
    }
}

/// Returns the milliseconds since the epoch.
fn epoch() -> u128 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    now.expect("after the epoch").as_millis()
}
