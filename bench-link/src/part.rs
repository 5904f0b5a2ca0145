//! The programs of a measurement: each publishes or takes messages that contain a number and a time.

use std::{
    io::{self, Write, stdin},
    sync::mpsc::{Receiver, RecvTimeoutError, channel},
    thread,
    time::{Duration, Instant},
};

use axon_shm::{
    PublishError,
    qos::{History, Qos, Reliability},
};
use axon_transport::{DaemonCommand, EndpointSpec, Session, SessionOptions, config::Config};
use rand::{Rng, SeedableRng, rngs::StdRng};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use crate::{
    Result, tcp,
    torture::{self, Role},
};

/// For daemons that start, find each other over a path that loses packets, and agree on keys.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// How often a subscriber looks whether it is to end.
const LOOK: Duration = Duration::from_millis(20);
/// Bytes of a message's number and time.
pub(crate) const STAMP: usize = 16;

/// Messages of one size at one rate.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Stream {
    pub(crate) topic: String,
    pub(crate) bytes: usize,
    /// Time between two messages. Zero: as fast as possible.
    pub(crate) every: Duration,
    pub(crate) is_reliable: bool,
    /// KEEP_LAST's depth. `None`: KEEP_ALL.
    pub(crate) depth: Option<u32>,
}

impl Stream {
    fn spec(&self) -> EndpointSpec {
        let mut qos = Qos::default();
        if !self.is_reliable {
            qos.reliability = Reliability::BestEffort;
        }
        match self.depth {
            Some(depth) => qos.depth = depth,
            None => qos.history = History::KeepAll,
        }
        EndpointSpec::new(&self.topic, "bench/Bytes", qos)
    }
}

/// The task of a program.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) enum Part {
    Publish(Stream),
    Subscribe(Stream),
    /// Sends the same messages over a TCP connection to this address.
    Send(Stream, String),
    Receive(String),
    /// One of the processes of a torture; the number decides what it does at random.
    Torture(Role, u64),
}

/// The result of a publisher.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Sent {
    pub(crate) messages: u64,
    /// Number of these messages that were refused, since the publisher's history was full.
    pub(crate) refused: u64,
}

/// A message that arrived. Times are those of the monotonic clock, in nanoseconds.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct Arrival {
    pub(crate) number: u64,
    pub(crate) sent: u64,
    pub(crate) arrived: u64,
}

/// The result of a subscriber.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Taken {
    pub(crate) arrivals: Vec<Arrival>,
    /// Number of messages that the subscription counts as lost.
    pub(crate) lost: u64,
}

impl Part {
    /// Runs this program until its standard input ends. The last line of its output is its result.
    pub(crate) fn run(&self) -> Result<()> {
        if let Self::Torture(role, seed) = self {
            return torture::run(*role, *seed);
        }
        let orders = lines();
        match self {
            Self::Publish(stream) => publish(stream, &orders),
            Self::Subscribe(stream) => subscribe(stream, &orders),
            Self::Send(stream, address) => tcp::send(stream, address, &orders),
            Self::Receive(address) => tcp::receive(address, &orders),
            Self::Torture(..) => Ok(()),
        }
    }
}

/// Prints a value as a line, such as the report that the program is ready for its orders.
pub(crate) fn say<T: Serialize>(value: &T) -> Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{}", serde_json::to_string(value)?)?;
    Ok(out.flush()?)
}

/// Returns the lines of standard input. The receiver is disconnected when the input ends.
fn lines() -> Receiver<()> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        for line in stdin().lines() {
            if line.is_err() || sender.send(()).is_err() {
                return;
            }
        }
    });
    receiver
}

/// Returns the time of the clock that all programs share, in nanoseconds.
pub(crate) fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Writes a message's number and time into its first bytes.
pub(crate) fn stamp(bytes: &mut [u8], number: u64) {
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    bytes[8..STAMP].copy_from_slice(&now_ns().to_le_bytes());
}

/// Returns the arrival of the message in these bytes, at the current time.
pub(crate) fn arrival(bytes: &[u8]) -> Result<Arrival> {
    let word = |at: usize| bytes.get(at..at + 8).and_then(|word| word.try_into().ok());
    let number = word(0).map(u64::from_le_bytes).ok_or("a message without a number")?;
    let sent = word(8).map(u64::from_le_bytes).ok_or("a message without a time")?;
    Ok(Arrival { number, sent, arrived: now_ns() })
}

/// Calls `send` with the number of each message, at the stream's rate, until the orders end. Messages that
/// came too late to be sent in time are sent at once: a timer that fires late changes no rate.
pub(crate) fn paced(
    stream: &Stream,
    orders: &Receiver<()>,
    mut send: impl FnMut(u64) -> Result<()>,
) -> Result<()> {
    let begin = Instant::now();
    for number in 1.. {
        let due = begin + stream.every.mul_f64((number - 1) as f64);
        match orders.recv_timeout(due.saturating_duration_since(Instant::now())) {
            Err(RecvTimeoutError::Timeout) => send(number)?,
            Ok(()) => return Err("an order in the middle of a stream".into()),
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    Ok(())
}

pub(crate) fn session() -> Result<Session> {
    let itself = DaemonCommand::current_executable([""; 0])?;
    let options = SessionOptions::new("bench-link").daemon_command(itself);
    Ok(Session::open(&Config::from_env()?, options)?)
}

/// Returns bytes that no compressor makes shorter, so that the link carries as many bytes as are published.
fn incompressible(length: usize) -> Vec<u8> {
    let mut bytes = vec![0; length];
    StdRng::seed_from_u64(0).fill_bytes(&mut bytes);
    bytes
}

fn publish(stream: &Stream, orders: &Receiver<()>) -> Result<()> {
    let session = session()?;
    let publisher = session.create_publisher(stream.spec())?;
    if !publisher.wait_matched(1, PATIENCE) {
        return Err("the two hosts do not meet".into());
    }
    say(&())?;
    orders.recv()?;
    let mut bytes = incompressible(stream.bytes.max(STAMP));
    let mut sent = Sent::default();
    paced(stream, orders, |number| {
        stamp(&mut bytes, number);
        sent.messages = number;
        match publisher.publish(&bytes) {
            Ok(_) => {}
            Err(PublishError::Blocked { .. }) => sent.refused += 1,
            Err(error) => return Err(error.into()),
        }
        Ok(())
    })?;
    say(&sent)?;
    // The waiting messages are still sent until the measuring process ends this one.
    thread::sleep(PATIENCE);
    Ok(())
}

fn subscribe(stream: &Stream, orders: &Receiver<()>) -> Result<()> {
    let session = session()?;
    let subscription = session.create_subscription(stream.spec())?;
    if !subscription.wait_matched(1, PATIENCE) {
        return Err("the two hosts do not meet".into());
    }
    say(&())?;
    let (mut taken, mut bytes) = (Taken::default(), Vec::new());
    while !matches!(orders.try_recv(), Err(std::sync::mpsc::TryRecvError::Disconnected)) {
        if subscription.recv(&mut bytes, Some(LOOK)).is_ok() {
            taken.arrivals.push(arrival(&bytes)?);
        }
    }
    taken.lost = subscription.lost();
    say(&taken)
}
