//! The two processes, and how one has the other answer.

use std::{
    env,
    os::fd::AsFd,
    process::{Command, Stdio, exit},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Instant,
};

use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};

use super::{
    Channel, Effort, End, Error, Load, Machine, Medium, Result, Rounds, Side, Wake, machine,
    raw::Shared,
};

use crate::say::say;

/// Turns of the wait for credit before the CPU is offered to others: a medium's own threads may
/// need it.
const SPINS: u32 = 200_000;
const CREDIT: usize = 8;

/// What the process that measures has the other one do.
#[derive(Serialize, Deserialize)]
enum Order {
    Open(Load),
    /// Send each of so many messages back.
    Answer {
        medium: usize,
        count: u64,
    },
    /// Take so many messages and say by the credit word how many they are in all.
    Take {
        medium: usize,
        count: u64,
    },
    /// Go to this CPU until the next is opened.
    Move(usize),
    Close,
}

#[derive(Serialize, Deserialize)]
struct Hello {
    cpu: usize,
    cpus: Vec<usize>,
}

/// A process that was started to be on the other side.
pub(crate) struct Other {
    channel: Option<Channel>,
    over: Arc<AtomicBool>,
    watch: Option<JoinHandle<()>>,
}

/// Starts this program again with `arguments`, which must lead it to the other side. It ends when
/// what is returned is dropped. If it ends before, so does this process: it may be in the middle of
/// a loop that nobody else ends.
pub(crate) fn spawn(arguments: &[&str]) -> Result<Other> {
    let (channel, theirs) = Channel::pair()?;
    let mut child =
        Command::new(env::current_exe()?).args(arguments).stdin(Stdio::from(theirs)).spawn()?;
    let over = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&over);
    let watch = thread::spawn(move || {
        let status = child.wait();
        if !seen.load(Ordering::Relaxed) {
            say(format_args!("the other process of the measurement ended early: {status:?}"));
            exit(1);
        }
    });
    Ok(Other { channel: Some(channel), over, watch: Some(watch) })
}

impl Other {
    /// The socket to it.
    pub(crate) fn channel(&self) -> &Channel {
        self.channel.as_ref().expect("open until it is dropped")
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        self.channel = None;
        if let Some(watch) = self.watch.take() {
            let _ = watch.join();
        }
    }
}

/// The process that measures, with the other one at its service.
pub(crate) struct Pair<'a> {
    media: &'a [&'a dyn Medium],
    effort: Effort,
    clock: f64,
    cpu: usize,
    cpus: Vec<usize>,
    credit: Shared,
    other: Other,
}

impl<'a> Pair<'a> {
    /// Starts the other process, in which `arguments` must lead to [`serve`] with the same media.
    pub(crate) fn start(
        media: &'a [&'a dyn Medium],
        effort: Effort,
        machine: &Machine,
        arguments: &[&str],
    ) -> Result<Self> {
        let other = spawn(arguments)?;
        let [near, far] = machine.pinned;
        let (credit, fd) = Shared::create(CREDIT)?;
        let cpus = machine.allowed.clone();
        other.channel().hand_over(&Hello { cpu: far, cpus: cpus.clone() }, &[fd.as_fd()])?;
        Ok(Self { media, effort, clock: machine.clock_ns, cpu: near, cpus, credit, other })
    }

    /// Nanoseconds of half a round trip, for each medium that carries this.
    pub(crate) fn latency(&self, load: &Load) -> Result<Vec<Rounds>> {
        self.by_turns(load, |end, medium, sent, count| {
            let cold = count / 16 + 1;
            self.other.channel().tell(&Order::Answer { medium, count: cold + count })?;
            let mut times = Vec::with_capacity(usize::try_from(count)?);
            for _ in 0..cold {
                ping(end, sent)?;
            }
            let mut before = Instant::now();
            for _ in 0..count {
                ping(end, sent)?;
                let now = Instant::now();
                times.push(((now - before).as_secs_f64() * 1e9 - self.clock) / 2.0);
                before = now;
            }
            Ok(times)
        })
    }

    /// Nanoseconds from message to message in a stream that the receiver keeps up with.
    pub(crate) fn stream(&self, load: &Load) -> Result<Vec<Rounds>> {
        self.by_turns(load, |end, medium, sent, count| {
            let credit = self.credit.word(0);
            let window = load.window as u64;
            // All that was sent before has been taken: the other one said that it is done.
            let taken_before = credit.load(Ordering::Acquire);
            self.other.channel().tell(&Order::Take { medium, count })?;
            // From here on the other one is awake.
            self.other.channel().hear::<()>()?;
            let start = Instant::now();
            for index in 0..count {
                await_credit(credit, (taken_before + index + 1).saturating_sub(window));
                *sent += 1;
                end.send(*sent)?;
            }
            await_credit(credit, taken_before + count);
            Ok(vec![start.elapsed().as_secs_f64() * 1e9 / count as f64])
        })
    }

    /// All media that carry a load, a turn each per round, beginning with another one each time.
    fn by_turns(
        &self,
        load: &Load,
        turn: impl Fn(&mut dyn End, usize, &mut u64, u64) -> Result<Vec<f64>>,
    ) -> Result<Vec<Rounds>> {
        let channel = self.other.channel();
        let media = carrying(self.media, load);
        machine::unpin(&self.cpus)?;
        channel.tell(&Order::Open(*load))?;
        let mut ends = Vec::new();
        for medium in &media {
            let end = medium.open(load, Side::Near, channel);
            ends.push((end.map_err(|error| named(*medium, error))?, 0));
            channel.hear::<()>()?;
        }
        machine::pin(self.cpu)?;
        if load.wake == Wake::EventOneCpu {
            channel.tell(&Order::Move(self.cpu))?;
            channel.hear::<()>()?;
        }
        let mut turn = |medium: usize, count: u64| {
            let (end, sent) = &mut ends[medium];
            let start = Instant::now();
            let times = turn(&mut **end, medium, sent, count);
            let times = times.map_err(|error| named(media[medium], error))?;
            channel.hear::<()>()?;
            Ok::<_, Error>((times, start.elapsed()))
        };
        // The second time all is warm, and the least of the three was disturbed least.
        let mut counts = Vec::new();
        for medium in 0..media.len() {
            let mut count = 4;
            counts.push(loop {
                let mut least = turn(medium, count)?.1;
                for _ in 0..2 {
                    least = least.min(turn(medium, count)?.1);
                }
                if least * 4 >= self.effort.turn || count >= self.effort.messages[1] {
                    break self.effort.count(count, least);
                }
                count *= 4;
            });
        }
        let mut rounds: Vec<Rounds> = media.iter().map(|_| Rounds::default()).collect();
        for round in 0..self.effort.rounds {
            for next in 0..media.len() {
                let medium = (round + next) % media.len();
                let (times, _) = turn(medium, counts[medium])?;
                rounds[medium].add(times);
            }
        }
        channel.tell(&Order::Close)?;
        drop(ends);
        channel.hear::<()>()?;
        Ok(rounds)
    }
}

/// Is the other process, until the one that measures ends.
pub(crate) fn serve(all: &[&dyn Medium]) -> Result<()> {
    // In the middle of a loop nobody else would end this process.
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let (Hello { cpu, cpus }, fds) = channel.take_over()?;
    let [fd] = fds.try_into().map_err(|_| "another number of descriptors")?;
    let credit = Shared::map(&fd, CREDIT)?;
    // Each with the number of the last message.
    let mut ends: Vec<(Box<dyn End>, u64)> = Vec::new();
    let mut media = Vec::new();
    let mut window = 1;
    while let Ok(order) = channel.hear() {
        match order {
            Order::Open(load) => {
                window = load.window as u64;
                machine::unpin(&cpus)?;
                media = carrying(all, &load);
                for medium in &media {
                    let end = medium.open(&load, Side::Far, &channel);
                    ends.push((end.map_err(|error| named(*medium, error))?, 0));
                    channel.tell(&())?;
                }
                machine::pin(cpu)?;
            }
            Order::Answer { medium, count } => {
                let (end, last) = &mut ends[medium];
                for _ in 0..count {
                    let number = next(&mut **end, last).map_err(|e| named(media[medium], e))?;
                    end.send(number).map_err(|error| named(media[medium], error))?;
                }
                channel.tell(&())?;
            }
            Order::Take { medium, count } => {
                let (end, last) = &mut ends[medium];
                let word = credit.word(0);
                let before = word.load(Ordering::Relaxed);
                channel.tell(&())?;
                for index in 1..=count {
                    next(&mut **end, last).map_err(|error| named(media[medium], error))?;
                    if index == count || index.is_multiple_of(window / 4) {
                        // Pairs with the load of the one that waits for it.
                        word.store(before + index, Ordering::Release);
                    }
                }
                channel.tell(&())?;
            }
            Order::Move(cpu) => {
                machine::pin(cpu)?;
                channel.tell(&())?;
            }
            Order::Close => {
                ends.clear();
                channel.tell(&())?;
            }
        }
    }
    Ok(())
}

/// Those that have a part under `load`, the same on both sides.
fn carrying<'a>(media: &[&'a dyn Medium], load: &Load) -> Vec<&'a dyn Medium> {
    media.iter().copied().filter(|medium| medium.carries(load)).collect()
}

/// Receives the message after `last`.
fn next(end: &mut dyn End, last: &mut u64) -> Result<u64> {
    let number = end.receive()?;
    if number != *last + 1 {
        return Err(format!("message {number} came after message {last}").into());
    }
    *last = number;
    Ok(number)
}

fn ping(end: &mut dyn End, sent: &mut u64) -> Result<()> {
    *sent += 1;
    end.send(*sent)?;
    let received = end.receive()?;
    if received != *sent {
        return Err(format!("sent message {sent}, got message {received} back").into());
    }
    Ok(())
}

fn await_credit(credit: &std::sync::atomic::AtomicU64, wanted: u64) {
    let mut spins = 0;
    while credit.load(Ordering::Acquire) < wanted {
        spins += 1;
        if spins > SPINS {
            thread::yield_now();
        }
    }
}

fn named(medium: &dyn Medium, error: Error) -> Error {
    format!("{}: {error}", medium.name()).into()
}
