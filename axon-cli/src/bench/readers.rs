//! What a publish costs with 1 to 16 reader processes.

use std::{os::fd::AsFd, sync::atomic::Ordering, time::Instant};

use axon_transport::shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions};
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};

use super::harness::{Channel, Effort, Other, Result, Rounds, Shared, qos, spawn};

/// How many readers are compared.
pub(super) const READERS: [usize; 5] = [1, 2, 4, 8, 16];
/// Where the raw limit's bytes begin, apart from its word.
const PAYLOAD: usize = 4096;

/// What a publish of one size took.
pub(super) struct Cost {
    pub(super) size: usize,
    /// One plain copy and a store.
    pub(super) raw: Rounds,
    /// For each of [`READERS`].
    pub(super) by_readers: Vec<Rounds>,
}

#[derive(Serialize, Deserialize)]
enum Order {
    Connect,
    Drop,
}

/// As many processes as the most readers.
pub(super) struct Crowd(Vec<Other>);

impl Crowd {
    pub(super) fn start(arguments: &[&str]) -> Result<Self> {
        (0..READERS[READERS.len() - 1]).map(|_| spawn(arguments)).collect::<Result<_>>().map(Self)
    }

    /// Nanoseconds of a publish of `size` bytes, with readers that neither read nor sleep on the
    /// topic: what is measured is the publisher.
    pub(super) fn measure(&self, size: usize, effort: Effort) -> Result<Cost> {
        let context = Context::new()?;
        let options = PublisherOptions::new(qos(1)?).expected_len(size as u64);
        let mut publishers = Vec::new();
        for readers in READERS {
            let publisher = Publisher::new(&context, options)?;
            for reader in &self.0[..readers] {
                let (ours, theirs) = Channel::pair()?;
                reader.channel().hand_over(&Order::Connect, &[theirs.as_fd()])?;
                publisher.serve(&ours, None)?;
                reader.channel().hear::<()>()?;
            }
            publishers.push(publisher);
        }
        let (memory, _) = Shared::create(PAYLOAD + size)?;
        let bytes = vec![0x5a; size];
        let mut published = 0;
        // The raw limit, then the publishers.
        let mut turn = |which: usize, count: u64| {
            let start = Instant::now();
            for _ in 0..count {
                match which.checked_sub(1) {
                    None => {
                        memory.copy_in(PAYLOAD, &bytes);
                        published += 1;
                        memory.word(0).store(published, Ordering::Release);
                    }
                    Some(index) => drop(publishers[index].publish(&bytes)?),
                }
            }
            Ok::<_, super::harness::Error>(start.elapsed())
        };
        let contestants = 1 + READERS.len();
        let mut counts = Vec::new();
        for which in 0..contestants {
            let mut count = 4;
            counts.push(loop {
                let elapsed = turn(which, count)?.min(turn(which, count)?);
                if elapsed * 4 >= effort.turn || count >= effort.messages[1] {
                    break effort.count(count, elapsed);
                }
                count *= 4;
            });
        }
        let mut rounds: Vec<Rounds> = (0..contestants).map(|_| Rounds::default()).collect();
        for round in 0..effort.rounds {
            for next in 0..contestants {
                let which = (round + next) % contestants;
                let elapsed = turn(which, counts[which])?;
                let each = elapsed.as_secs_f64() * 1e9 / counts[which] as f64;
                rounds[which].add(vec![each]);
            }
        }
        for reader in &self.0 {
            reader.channel().tell(&Order::Drop)?;
            reader.channel().hear::<()>()?;
        }
        let mut rounds = rounds.into_iter();
        let raw = rounds.next().ok_or("nothing was measured")?;
        Ok(Cost { size, raw, by_readers: rounds.collect() })
    }
}

/// Is one of the readers, until the process that measures ends.
pub(super) fn attend() -> Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let context = Context::new()?;
    let mut subscribers = Vec::new();
    while let Ok((order, fds)) = channel.take_over() {
        match order {
            Order::Connect => {
                let [socket] = fds.try_into().map_err(|_| "another number of descriptors")?;
                let options = SubscriberOptions::new(qos(1)?);
                subscribers.push(Subscriber::connect(&context, &socket, options, None)?);
            }
            Order::Drop => subscribers.clear(),
        }
        channel.tell(&())?;
    }
    Ok(())
}
