//! Measures AXON's shared memory, used as its documentation recommends.

use std::{
    os::fd::{AsFd, OwnedFd},
    time::Duration,
};

use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions};
use axon_transport::qos::Qos;

use super::{Channel, End, Load, Medium, Motion, Result, Side, agree, stamp};

/// Any machine connects within this time.
const CONNECT_TIMEOUT: Option<Duration> = Some(Duration::from_secs(60));
/// The longest sleep of `Subscriber::recv`.
const LONGEST_SLEEP: Option<Duration> = Some(Duration::from_secs(1));
/// The library copies a published message of up to this size in any case, so `take_into` is faster.
const COPIED: usize = 4096;
/// The library also copies a loan of up to this size, so `publish` is faster.
const LOANS_COPIED: usize = 512;

/// `axon_shm` without a daemon, RELIABLE and KEEP_LAST.
pub(crate) struct Axon;

impl Medium for Axon {
    fn name(&self) -> &'static str {
        "AXON"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        let context = Context::new()?;
        let qos = qos(load.window)?;
        // The budget must hold all messages in transit; otherwise the oldest are lost. Samples
        // occupy whole cache lines.
        let budget = (load.window * load.size * 5 / 4).max(64 << 20) as u64;
        let options = PublisherOptions::new(qos).budget(budget).expected_len(load.size as u64);
        let publisher = Publisher::new(&context, options)?;
        let connect = |socket: &OwnedFd| {
            Subscriber::connect(&context, socket, SubscriberOptions::new(qos), CONNECT_TIMEOUT)
        };
        // Each direction has its own socket.
        let subscriber = match side {
            Side::Near => {
                let [(there, first), (back, second)] = [Channel::pair()?, Channel::pair()?];
                channel.hand_over(&(), &[first.as_fd(), second.as_fd()])?;
                publisher.serve(&there, CONNECT_TIMEOUT)?;
                connect(&back.into())?
            }
            Side::Far => {
                let ((), fds) = channel.take_over()?;
                let [there, back] = fds.try_into().map_err(|_| "another number of descriptors")?;
                let subscriber = connect(&there)?;
                publisher.serve(&back, CONNECT_TIMEOUT)?;
                subscriber
            }
        };
        let loans = load.motion == Motion::Touch && load.size > LOANS_COPIED;
        let in_place = loans || load.size > COPIED;
        Ok(Box::new(AxonEnd {
            publisher,
            subscriber,
            context,
            size: load.size,
            sleeps: load.wake.sleeps(),
            loans,
            copies: !in_place || load.motion == Motion::Copy,
            bytes: vec![0x5a; load.size],
        }))
    }
}

/// Returns the default profile with a history of at least `window` samples.
pub(crate) fn qos(window: usize) -> Result<Qos> {
    let qos = Qos::default();
    Ok(qos.with_depth(qos.depth.max(u32::try_from(window)?)))
}

struct AxonEnd {
    publisher: Publisher,
    subscriber: Subscriber,
    context: Context,
    size: usize,
    sleeps: bool,
    loans: bool,
    copies: bool,
    /// The buffer for messages sent and received. The raw limit and other media have one buffer as
    /// well.
    bytes: Vec<u8>,
}

impl End for AxonEnd {
    fn send(&mut self, number: u64) -> Result<()> {
        if self.loans {
            let mut loan = self.publisher.loan(self.size)?;
            stamp(&mut loan, number);
            loan.publish_now()?;
        } else {
            stamp(&mut self.bytes, number);
            self.publisher.publish(&self.bytes)?;
        }
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        loop {
            if self.sleeps {
                self.context.wait(|| self.subscriber.has_data(), LONGEST_SLEEP);
            }
            if self.copies {
                if self.subscriber.take_into(&mut self.bytes)?.is_some() {
                    let [first, last] = [self.bytes.first_chunk(), self.bytes.last_chunk()];
                    return agree(*first.ok_or("too short")?, *last.ok_or("too short")?);
                }
            } else if let Some(sample) = self.subscriber.take()? {
                let [mut first, mut last] = [[0; 8]; 2];
                sample.read_at(0, &mut first);
                sample.read_at(self.size - 8, &mut last);
                return agree(first, last);
            }
        }
    }
}
