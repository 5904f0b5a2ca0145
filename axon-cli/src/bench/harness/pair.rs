//! The process that measures, and its control of the process that answers.

use std::{
    os::fd::AsFd,
    sync::atomic::{AtomicU64, Ordering},
    thread,
    time::{Duration, Instant},
};

use super::{
    Channel, Effort, End, Error, Load, Machine, Medium, Other, Result, Rounds, Side, Wake, cpu,
    machine,
    raw::SharedPages,
    serve::{BOARD, BenchCommand, Hello, MOST_PACED, carrying, named, noted, now_ns},
    spawn,
};

/// The number of polls for credit before this thread yields the CPU, which a medium's own threads may need.
const SPINS: u32 = 200_000;

/// The process that measures, with its connection to the process that answers.
pub(crate) struct Pair<'a> {
    media: &'a [&'a dyn Medium],
    effort: Effort,
    clock: f64,
    cpu: usize,
    cpus: Vec<usize>,
    board: SharedPages,
    other: Other,
}

/// An open end of a medium, while its turns are taken.
struct Contestant<'a> {
    index: usize,
    medium: &'a dyn Medium,
    end: Box<dyn End>,
    sent: u64,
    daemons: Vec<u32>,
}

/// The result of a turn, and the number of messages sent one way during it.
type Turn<T> = (T, u64);

impl<'a> Pair<'a> {
    /// Starts the other process. `arguments` must make it call [`serve`](super::serve()) with the same media.
    pub(crate) fn start(
        media: &'a [&'a dyn Medium],
        effort: Effort,
        machine: &Machine,
        arguments: &[&str],
    ) -> Result<Self> {
        let other = spawn(arguments)?;
        let [near, far] = machine.pinned;
        let (board, fd) = SharedPages::create(BOARD)?;
        let cpus = machine.allowed.clone();
        other.channel().hand_over(&Hello { cpu: far, cpus: cpus.clone() }, &[fd.as_fd()])?;
        Ok(Self { media, effort, clock: machine.clock_ns, cpu: near, cpus, board, other })
    }

    /// Measures half a round trip in nanoseconds, for each medium that carries `load`.
    pub(crate) fn latency(&self, load: &Load) -> Result<Vec<Rounds>> {
        self.by_turns(load, |of, count| {
            let cold = count / 16 + 1;
            self.channel().tell(&BenchCommand::Answer { medium: of.index, count: cold + count })?;
            let mut times = Vec::with_capacity(usize::try_from(count)?);
            for _ in 0..cold {
                of.ping()?;
            }
            let mut before = Instant::now();
            for _ in 0..count {
                of.ping()?;
                let now = Instant::now();
                times.push(((now - before).as_secs_f64() * 1e9 - self.clock) / 2.0);
                before = now;
            }
            Ok((times, 2 * (cold + count)))
        })
    }

    /// Measures the nanoseconds from message to message in a stream whose receiver keeps up.
    pub(crate) fn stream(&self, load: &Load) -> Result<Vec<Rounds>> {
        self.by_turns(load, |of, count| {
            let credit = self.board.word(0);
            let window = load.window as u64;
            // The other process has taken all messages of earlier turns, because it reported the end of each turn.
            let taken_before = credit.load(Ordering::Acquire);
            self.channel().tell(&BenchCommand::Take { medium: of.index, count })?;
            // After this packet the other process is awake.
            self.channel().hear::<()>()?;
            let start = Instant::now();
            for index in 0..count {
                await_credit(credit, (taken_before + index + 1).saturating_sub(window));
                of.send()?;
            }
            await_credit(credit, taken_before + count);
            Ok((vec![start.elapsed().as_secs_f64() * 1e9 / count as f64], count))
        })
    }

    /// Measures the nanoseconds from just before a message is sent until it is taken. One message is sent every
    /// `load.pace`, and both processes sleep in between.
    pub(crate) fn paced(&self, load: &Load) -> Result<Vec<Rounds>> {
        let pace = load.pace.ok_or("a load without a pace")?;
        let channel = self.channel();
        self.open(load, |mut all| {
            let mut rounds: Vec<Rounds> = all.iter().map(|_| Rounds::default()).collect();
            for round in 0..self.effort.paced_rounds {
                for next in 0..all.len() {
                    let which = (round + next) % all.len();
                    let (sent_at, spent) = self.spent(&mut all[which], |of| {
                        let count = self.effort.paced_messages.min(MOST_PACED);
                        let credit = self.board.word(0);
                        let taken_before = credit.load(Ordering::Acquire);
                        channel.tell(&BenchCommand::Note { medium: of.index, count })?;
                        channel.hear::<()>()?;
                        let mut sent_at = Vec::new();
                        let mut due = Instant::now();
                        for index in 0..count {
                            due += pace;
                            thread::sleep(due.saturating_duration_since(Instant::now()));
                            let window = load.window as u64;
                            await_credit(credit, (taken_before + index + 1).saturating_sub(window));
                            sent_at.push(now_ns());
                            of.send()?;
                        }
                        Ok((sent_at, count))
                    })?;
                    let taken = |index| self.board.word(noted(index)).load(Ordering::Relaxed);
                    let times = (0..).zip(sent_at).map(|(index, at)| (taken(index) - at) as f64);
                    rounds[which].add(times.collect(), spent);
                }
            }
            Ok(rounds)
        })
    }

    /// Measures all media that carry a load. Each has one turn per round, and each round begins with another medium.
    fn by_turns(
        &self,
        load: &Load,
        turn: impl Fn(&mut Contestant<'_>, u64) -> Result<Turn<Vec<f64>>>,
    ) -> Result<Vec<Rounds>> {
        self.open(load, |mut all| {
            // After the first of three turns all caches are warm. The shortest of the three was disturbed least.
            let mut counts = Vec::new();
            for of in &mut all {
                let mut count = 4;
                counts.push(loop {
                    let mut least = Duration::MAX;
                    for _ in 0..3 {
                        let start = Instant::now();
                        self.spent(of, |of| turn(of, count))?;
                        least = least.min(start.elapsed());
                    }
                    if least * 4 >= self.effort.turn || count >= self.effort.messages[1] {
                        break self.effort.count(count, least);
                    }
                    count *= 4;
                });
            }
            let mut rounds: Vec<Rounds> = all.iter().map(|_| Rounds::default()).collect();
            for round in 0..self.effort.rounds {
                for next in 0..all.len() {
                    let which = (round + next) % all.len();
                    let (times, spent) =
                        self.spent(&mut all[which], |of| turn(of, counts[which]))?;
                    rounds[which].add(times, spent);
                }
            }
            Ok(rounds)
        })
    }

    /// Makes both processes open their ends for a load, and close them after `measure`.
    fn open(
        &self,
        load: &Load,
        measure: impl FnOnce(Vec<Contestant<'a>>) -> Result<Vec<Rounds>>,
    ) -> Result<Vec<Rounds>> {
        let channel = self.channel();
        machine::unpin(&self.cpus)?;
        channel.tell(&BenchCommand::Open(*load))?;
        let mut all = Vec::new();
        for (index, medium) in carrying(self.media, load).into_iter().enumerate() {
            let end = medium.open(load, Side::Near, channel);
            let end = end.map_err(|error| named(medium, error))?;
            all.push(Contestant { index, medium, end, sent: 0, daemons: medium.daemons()? });
            channel.hear::<()>()?;
        }
        machine::pin(self.cpu)?;
        if load.wake == Wake::EventOneCpu {
            channel.tell(&BenchCommand::Move(self.cpu))?;
            channel.hear::<()>()?;
        }
        let rounds = measure(all)?;
        channel.tell(&BenchCommand::Close)?;
        channel.hear::<()>()?;
        Ok(rounds)
    }

    /// Takes a turn. Returns its result and the processor time of a message in all processes together, in nanoseconds.
    fn spent<T>(
        &self,
        of: &mut Contestant<'_>,
        turn: impl FnOnce(&mut Contestant<'_>) -> Result<Turn<T>>,
    ) -> Result<(T, f64)> {
        let daemons = of.daemons.clone();
        let cpu = || cpu::own() + daemons.iter().copied().map(cpu::of).sum::<f64>();
        let before = cpu();
        let medium = of.medium;
        let (given, messages) = turn(of).map_err(|error| named(medium, error))?;
        of.end.idle(self.channel())?;
        let theirs = self.channel().hear::<f64>()?;
        let seconds = cpu() - before + theirs;
        Ok((given, seconds * 1e9 / messages as f64))
    }

    fn channel(&self) -> &Channel {
        self.other.channel()
    }
}

impl Contestant<'_> {
    fn send(&mut self) -> Result<()> {
        self.sent += 1;
        self.end.send(self.sent)
    }

    fn ping(&mut self) -> Result<()> {
        self.send()?;
        let received = self.end.receive()?;
        if received != self.sent {
            let sent = self.sent;
            return Err(Error::from(format!("sent message {sent}, got message {received} back")));
        }
        Ok(())
    }
}

fn await_credit(credit: &AtomicU64, wanted: u64) {
    let mut spins = 0;
    while credit.load(Ordering::Acquire) < wanted {
        spins += 1;
        if spins > SPINS {
            thread::yield_now();
        }
    }
}
