//! What a publish costs with 1, 4 and 16 subscriptions, each in a session and process of its own.

use std::time::Instant;

use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};

use super::place::{PATIENCE, Settings, session};
use crate::bench::harness::{Channel, Effort, Error, Other, Result, Rounds, qos, spawn};
use axon_transport::session::EndpointSpec;

pub(super) const READERS: [usize; 3] = [1, 4, 16];

/// What a publish of one size took, for each of [`READERS`].
pub(super) struct Cost {
    pub(super) size: usize,
    pub(super) by_readers: Vec<Rounds>,
}

#[derive(Serialize, Deserialize)]
enum Order {
    /// Subscribe there to this.
    Subscribe {
        settings: Settings,
        topic: String,
    },
    Drop,
}

pub(super) struct Crowd(Vec<Other>);

impl Crowd {
    pub(super) fn start(arguments: &[&str]) -> Result<Self> {
        (0..READERS[READERS.len() - 1]).map(|_| spawn(arguments)).collect::<Result<_>>().map(Self)
    }

    /// Nanoseconds of a publish of `size` bytes, with subscriptions that neither take nor sleep.
    pub(super) fn measure(&self, settings: &Settings, size: usize, effort: Effort) -> Result<Cost> {
        let session = session(settings)?;
        let mut publishers = Vec::new();
        for readers in READERS {
            let topic = format!("/bench/{size}/{readers}");
            let spec = EndpointSpec::new(&*topic, "bench/Bytes", qos(1)?);
            let publisher = session.create_publisher(spec)?;
            for reader in &self.0[..readers] {
                let (settings, topic) = (settings.clone(), topic.clone());
                reader.channel().tell(&Order::Subscribe { settings, topic })?;
                reader.channel().hear::<()>()?;
            }
            if !publisher.wait_matched(readers, PATIENCE) {
                return Err("the sessions do not meet".into());
            }
            publishers.push(publisher);
        }
        let bytes = vec![0x5a; size];
        let turn = |which: usize, count: u64| {
            let start = Instant::now();
            for _ in 0..count {
                publishers[which].publish(&bytes)?;
            }
            Ok::<_, Error>(start.elapsed())
        };
        let mut counts = Vec::new();
        for which in 0..READERS.len() {
            let mut count = 4;
            counts.push(loop {
                let elapsed = turn(which, count)?.min(turn(which, count)?);
                if elapsed * 4 >= effort.turn || count >= effort.messages[1] {
                    break effort.count(count, elapsed);
                }
                count *= 4;
            });
        }
        let mut by_readers: Vec<Rounds> = READERS.iter().map(|_| Rounds::default()).collect();
        for round in 0..effort.rounds {
            for next in 0..READERS.len() {
                let which = (round + next) % READERS.len();
                let elapsed = turn(which, counts[which])?;
                by_readers[which].add(vec![elapsed.as_secs_f64() * 1e9 / counts[which] as f64]);
            }
        }
        for reader in &self.0 {
            reader.channel().tell(&Order::Drop)?;
            reader.channel().hear::<()>()?;
        }
        Ok(Cost { size, by_readers })
    }
}

/// Is one of the readers, until the process that measures ends.
pub(super) fn attend() -> Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let mut subscriptions = Vec::new();
    let mut open = None;
    while let Ok(order) = channel.hear::<Order>() {
        match order {
            Order::Subscribe { settings, topic } => {
                let session = match open.take() {
                    Some(session) => session,
                    None => session(&settings)?,
                };
                let spec = EndpointSpec::new(topic, "bench/Bytes", qos(1)?);
                subscriptions.push(session.create_subscription(spec)?);
                open = Some(session);
            }
            Order::Drop => subscriptions.clear(),
        }
        channel.tell(&())?;
    }
    Ok(())
}
