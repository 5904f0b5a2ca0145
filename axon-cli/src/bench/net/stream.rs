//! Measures streams: a publisher at full speed, and a reader in another process.

use std::time::{Duration, Instant};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, qos::Qos};
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};

use super::{
    bare::{BareEnd, Threads},
    hosts::Hosts,
};
use crate::bench::{
    harness::{
        Channel, End as _, Load, Motion, Other, Result, Side, Wake, agree, cpu, spawn, stamp,
    },
    session::place::{MATCH_TIMEOUT, Settings, session},
};

/// The number of a stream's last message.
const LAST: u64 = u64::MAX;

/// The behaviour of a publisher that is faster than its reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Flow {
    /// The publisher waits: RELIABLE and KEEP_ALL.
    Waits,
    /// The publisher does not wait, and the oldest messages are lost: RELIABLE and KEEP_LAST(10),
    /// the default of ROS 2.
    Overtakes,
}

/// The result of a stream.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Streamed {
    pub(super) sent: u64,
    pub(super) taken: u64,
    /// The seconds from the first message taken to the last.
    pub(super) seconds: f64,
    /// The processor time in seconds of all processes that took part.
    pub(super) cpu_seconds: f64,
}

impl Streamed {
    pub(super) fn per_second(&self) -> f64 {
        self.taken as f64 / self.seconds.max(1e-9)
    }

    pub(super) fn cpu_us_a_message(&self) -> f64 {
        self.cpu_seconds * 1e6 / self.taken.max(1) as f64
    }
}

#[derive(Serialize, Deserialize)]
enum StreamCommand {
    Bare { size: usize, threads: Threads },
    Read { settings: Settings, topic: String, flow: Flow },
}

/// The reader's result: messages, seconds, and seconds of processor time.
type Found = (u64, f64, f64);

/// The process that reads.
pub(super) struct Reader(Other);

impl Reader {
    pub(super) fn start(arguments: &[&str]) -> Result<Self> {
        Ok(Self(spawn(arguments)?))
    }

    /// Measures a stream over bare quinn.
    pub(super) fn bare(&self, size: usize, threads: Threads, length: Duration) -> Result<Streamed> {
        let channel = self.0.channel();
        channel.tell(&StreamCommand::Bare { size, threads })?;
        let mut end = BareEnd::open(&load(size), Side::Near, channel, threads)?;
        channel.hear::<()>()?;
        let before = cpu::own();
        let sent = until_over(length, |number| match number {
            LAST => end.send(number),
            _ => end.queue(number),
        })?;
        end.idle(channel)?;
        self.found(sent, || cpu::own() - before)
    }

    /// Measures a stream from a publisher on the first host to a subscription on the other.
    pub(super) fn axon(
        &self,
        hosts: &Hosts<'_>,
        size: usize,
        flow: Flow,
        length: Duration,
    ) -> Result<Streamed> {
        let [near, far] = &hosts.settings;
        let channel = self.0.channel();
        let topic = format!("/stream/{size}/{flow:?}");
        channel.tell(&StreamCommand::Read { settings: far.clone(), topic: topic.clone(), flow })?;
        let session = session(near)?;
        let publisher = session.create_publisher(spec(&topic, flow))?;
        if !publisher.wait_matched(1, MATCH_TIMEOUT) {
            return Err("the two hosts do not meet".into());
        }
        channel.hear::<()>()?;
        let pids = hosts.pids()?;
        let cpu = || pids.iter().copied().map(cpu::of).sum::<f64>() + cpu::own();
        let before = cpu();
        let mut bytes = vec![0x5a; size];
        let sent = until_over(length, |number| {
            stamp(&mut bytes, number);
            loop {
                match publisher.publish(&bytes) {
                    Ok(_) => return Ok(()),
                    // The reader is slower, so a KEEP_ALL publisher waits.
                    Err(PublishError::Blocked { .. }) => {}
                    Err(error) => return Err(error.into()),
                }
            }
        })?;
        self.found(sent, || cpu() - before)
    }

    fn found(&self, sent: u64, cpu: impl Fn() -> f64) -> Result<Streamed> {
        let (taken, seconds, theirs) = self.0.channel().hear::<Found>()?;
        Ok(Streamed { sent, taken, seconds, cpu_seconds: theirs + cpu() })
    }
}

/// Runs as the process that reads, until the process that measures ends.
pub(super) fn attend() -> Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    while let Ok(order) = channel.hear::<StreamCommand>() {
        let found = match order {
            StreamCommand::Bare { size, threads } => {
                let mut end = BareEnd::open(&load(size), Side::Far, &channel, threads)?;
                channel.tell(&())?;
                count(|| end.receive())?
            }
            StreamCommand::Read { settings, topic, flow } => {
                read(&channel, &settings, &topic, flow)?
            }
        };
        channel.tell(&found)?;
    }
    Ok(())
}

fn read(channel: &Channel, settings: &Settings, topic: &str, flow: Flow) -> Result<Found> {
    let session = session(settings)?;
    let subscription = session.create_subscription(spec(topic, flow))?;
    if !subscription.wait_matched(1, MATCH_TIMEOUT) {
        return Err("the two hosts do not meet".into());
    }
    channel.tell(&())?;
    let mut bytes = Vec::new();
    count(|| {
        subscription
            .recv(&mut bytes, Some(MATCH_TIMEOUT))
            .map_err(|_| "the stream does not end")?;
        let [first, last] = [bytes.first_chunk(), bytes.last_chunk()];
        agree(*first.ok_or("too short")?, *last.ok_or("too short")?)
    })
}

/// Receives messages until the last one, and checks their order.
fn count(mut receive: impl FnMut() -> Result<u64>) -> Result<Found> {
    let mut before = receive()?;
    let (start, cpu) = (Instant::now(), cpu::own());
    let mut taken = 1;
    while before != LAST {
        let number = receive()?;
        if number <= before {
            return Err(format!("message {number} came after message {before}").into());
        }
        before = number;
        taken += 1;
    }
    Ok((taken, start.elapsed().as_secs_f64(), cpu::own() - cpu))
}

/// Sends for `length`, then sends the last message. Returns the number of messages sent.
fn until_over(length: Duration, mut send: impl FnMut(u64) -> Result<()>) -> Result<u64> {
    let start = Instant::now();
    let mut sent = 0;
    while start.elapsed() < length {
        sent += 1;
        send(sent)?;
    }
    send(LAST)?;
    Ok(sent + 1)
}

fn load(size: usize) -> Load {
    Load::stream(size, Wake::Poll, Motion::Copy)
}

fn spec(topic: &str, flow: Flow) -> EndpointSpec {
    let qos = match flow {
        Flow::Waits => Qos::keep_all(),
        Flow::Overtakes => Qos::default(),
    };
    EndpointSpec::new(topic, "bench/Bytes", qos)
}
