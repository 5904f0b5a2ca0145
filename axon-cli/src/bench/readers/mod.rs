//! Measures a publish to 1, 4 and 16 reader processes that read every byte.

mod attend;
mod place;

use std::{
    os::fd::AsFd,
    sync::atomic::Ordering,
    thread,
    time::{Duration, Instant},
};

use axon_shm::{Context, Publisher, PublisherOptions};
use rustix::thread::futex;

pub(super) use self::attend::attend;
use self::{
    attend::ReaderCommand,
    place::{READERS_AT_MOST, ReadersMemory},
};
use super::harness::{
    Channel, Effort, Machine, Other, Result, Rounds, cpu, now_ns, qos, spawn, stamp,
};

/// The numbers of readers that are compared.
pub(super) const READERS: [usize; 3] = [1, 4, READERS_AT_MOST];
/// The pause between the time when all have read a message and the next message. It is longer than any reader polls
/// before it sleeps.
const MESSAGE_INTERVAL: Duration = Duration::from_micros(200);
/// The time between two checks whether all have read.
const NAP: Duration = Duration::from_micros(100);

/// How readers wait for a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Until {
    /// Readers sleep on a futex that is not the publisher's. They are woken after the time of the call was taken.
    Told,
    /// Readers sleep, and the publisher wakes them.
    Woken,
}

impl Until {
    pub(super) const ALL: [Self; 2] = [Self::Told, Self::Woken];
}

/// The times of the publishes of one medium.
#[derive(Default)]
pub(super) struct Published {
    /// The call alone. The processor time is that of all processes.
    pub(super) call: Rounds,
    /// The time from the start of the call until the last reader had copied every byte out.
    pub(super) read: Rounds,
}

/// Publishes of one size to one number of readers.
pub(super) struct Cost {
    pub(super) size: usize,
    pub(super) readers: usize,
    pub(super) until: Until,
    /// The raw limit: a plain copy, a store, and one `FUTEX_WAKE` for all readers if they have to be woken.
    pub(super) raw: Published,
    pub(super) axon: Published,
}

/// The reader processes, as many as the largest comparison needs.
pub(super) struct ReaderProcesses<'a> {
    readers: Vec<Other>,
    machine: &'a Machine,
}

impl<'a> ReaderProcesses<'a> {
    /// Starts the processes on all CPUs except that of the process that measures, and pins this thread to that CPU.
    pub(super) fn start(machine: &'a Machine, arguments: &[&str]) -> Result<Self> {
        machine.beside()?;
        let readers = (0..READERS_AT_MOST).map(|_| spawn(arguments)).collect::<Result<_>>()?;
        machine.near()?;
        Ok(Self { readers, machine })
    }

    /// Measures publishes of `size` bytes, for each number of [`READERS`] and each [`Until`]. Raw and AXON take turns.
    pub(super) fn measure(&self, size: usize, effort: Effort) -> Result<Vec<Cost>> {
        let (place, fd) = ReadersMemory::create(size)?;
        for (index, reader) in self.readers.iter().enumerate() {
            reader.channel().hand_over(&ReaderCommand::Share { size, index }, &[fd.as_fd()])?;
            reader.channel().hear::<()>()?;
        }
        let context = Context::new()?;
        let options = PublisherOptions::new(qos(1)?).expected_len(size as u64);
        let mut publishers = Vec::new();
        for readers in READERS {
            let publisher = Publisher::new(&context, options)?;
            for reader in &self.readers[..readers] {
                let (ours, theirs) = Channel::pair()?;
                reader.channel().hand_over(&ReaderCommand::Connect, &[theirs.as_fd()])?;
                publisher.serve(&ours, None)?;
                reader.channel().hear::<()>()?;
            }
            publishers.push(publisher);
        }
        let mut turns = Turns { processes: self, place, bytes: vec![0x5a; size], published: 0 };
        let mut costs = Vec::new();
        for until in Until::ALL {
            let new = |readers| {
                let (raw, axon) = Default::default();
                Cost { size, readers, until, raw, axon }
            };
            costs.extend(READERS.map(new));
        }
        // The first round warms up and does not count.
        for round in 0..=effort.paced_rounds {
            for cost in &mut costs {
                let Cost { readers, until, raw, axon, .. } = cost;
                let at =
                    READERS.iter().position(|n| n == readers).ok_or("no such number of readers")?;
                let sources = [(None, raw), (Some((at, &publishers[at])), axon)];
                for (source, published) in sources {
                    let turn = turns.take(source, *readers, *until, effort.paced_messages)?;
                    if round > 0 {
                        let [call, read] = turn.times;
                        published.call.add(call, turn.cpu);
                        published.read.add(read, turn.cpu);
                    }
                }
            }
        }
        for reader in &self.readers {
            reader.channel().tell(&ReaderCommand::Drop)?;
            reader.channel().hear::<()>()?;
        }
        Ok(costs)
    }
}

/// The times of one turn of one medium.
struct Turn {
    /// Nanoseconds of each call, and nanoseconds until all had read.
    times: [Vec<f64>; 2],
    /// Nanoseconds of processor time per message.
    cpu: f64,
}

struct Turns<'a> {
    processes: &'a ReaderProcesses<'a>,
    place: ReadersMemory,
    bytes: Vec<u8>,
    /// The number of messages published by all media together.
    published: u32,
}

impl Turns<'_> {
    /// Takes a turn of the publisher in `source`, or of the raw limit.
    fn take(
        &mut self,
        source: Option<(usize, &Publisher)>,
        readers: usize,
        until: Until,
        messages: u64,
    ) -> Result<Turn> {
        let readers = &self.processes.readers[..readers];
        for (index, reader) in readers.iter().enumerate() {
            // A reader subscribes only to the publishers that have enough readers to include it.
            let absent = READERS.iter().filter(|count| **count <= index).count();
            reader.channel().tell(&ReaderCommand::Attend {
                source: source.map(|(at, _)| at - absent),
                told: until == Until::Told,
                messages,
                after: self.published,
            })?;
            reader.channel().hear::<()>()?;
        }
        let mut times = [Vec::new(), Vec::new()];
        let before = cpu::own();
        for _ in 0..messages {
            thread::sleep(MESSAGE_INTERVAL);
            self.published += 1;
            let number = self.published;
            stamp(&mut self.bytes, u64::from(number));
            let (begun, start) = (now_ns(), Instant::now());
            match source {
                None => {
                    self.place.copy_in(&self.bytes);
                    self.place.message().store(number, Ordering::Release);
                    if until == Until::Woken {
                        futex::wake(self.place.message(), futex::Flags::empty(), u32::MAX >> 1)?;
                    }
                }
                Some((_, publisher)) => drop(publisher.publish(&self.bytes)?),
            }
            let call = start.elapsed().as_secs_f64() * 1e9 - self.processes.machine.clock_ns;
            times[0].push(call.max(0.0));
            if until == Until::Told {
                self.place.told().store(number, Ordering::Release);
                futex::wake(self.place.told(), futex::Flags::empty(), u32::MAX >> 1)?;
            }
            let mut last = 0;
            for index in 0..readers.len() {
                while self.place.read_by(index).load(Ordering::Acquire) != number {
                    thread::sleep(NAP);
                }
                last = last.max(self.place.read_at(index).load(Ordering::Relaxed));
            }
            times[1].push(last.saturating_sub(begun) as f64);
        }
        let mut seconds = cpu::own() - before;
        for reader in readers {
            seconds += reader.channel().hear::<f64>()?;
        }
        Ok(Turn { times, cpu: seconds * 1e9 / messages as f64 })
    }
}
