//! The processes: each publishes, takes, calls or answers, and reports all of it, until its standard input ends.

mod publisher;
mod service;
mod subscriber;

use std::{
    io::stdin,
    sync::mpsc::{Receiver, channel},
    thread,
    time::{Duration, Instant},
};

use axon_shm::PublishError;
use axon_transport::{Session, ids::Gid};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::words::{Order, Report, Role};
use crate::{
    Result,
    part::{PATIENCE, say, session},
};

/// How often a process looks whether it has orders.
const LOOK: Duration = Duration::from_millis(20);

/// Is the process of this role.
pub(crate) fn run(role: Role, seed: u64) -> Result<()> {
    let orders = orders();
    let mut random = StdRng::seed_from_u64(seed);
    let session = open()?;
    match role {
        Role::Publisher(topic) => publisher::run(&session, topic, &orders, &mut random),
        Role::Subscriber(topic) => subscriber::run(&session, topic, &orders),
        Role::Client(host) => service::call(&session, host, &orders, &mut random),
        Role::Server(host) => service::answer(&session, host, &orders),
    }
}

/// Daemons are killed while they start, too.
fn open() -> Result<Session> {
    let begin = Instant::now();
    loop {
        match session() {
            Ok(session) => return Ok(session),
            Err(error) if begin.elapsed() > 2 * PATIENCE => return Err(error),
            Err(_) => thread::sleep(LOOK),
        }
    }
}

fn orders() -> Receiver<Order> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        for line in stdin().lines().map_while(|line| line.ok()) {
            let Ok(order) = serde_json::from_str(&line) else { return };
            if sender.send(order).is_err() {
                return;
            }
        }
    });
    receiver
}

fn broken(what: String) -> Result<()> {
    say(&Report::Broken { what })
}

/// What the pattern of messages knows of their writer.
fn key(gid: Gid) -> u64 {
    let (low, high) = gid.0.split_at(8);
    let word = |half: &[u8]| half.iter().fold(0, |word, byte| word << 8 | u64::from(*byte));
    word(low) ^ word(high)
}

/// A length between these, each power of two as often as the next.
fn length(random: &mut StdRng, (shortest, longest): (usize, usize)) -> usize {
    let (low, high) = ((shortest as f64).ln(), (longest as f64).ln());
    (random.random_range(low..high).exp() as usize).clamp(shortest, longest)
}

/// Whether a peer is slow or the history full: it may work the next time.
fn is_for_now(error: &PublishError) -> bool {
    matches!(
        error,
        PublishError::Blocked { .. } | PublishError::Pinned { .. } | PublishError::NoMemory { .. }
    )
}
