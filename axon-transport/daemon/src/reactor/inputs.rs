//! The inputs of the reactor besides datagrams: an input that woke the loop is kept here until the next pass takes it
//! in.

use std::{
    io,
    os::fd::AsFd,
    task::{Context, Poll},
};

use axon_shm::internal::descriptors::PassedFd;
use tokio::{
    io::unix::AsyncFd,
    sync::mpsc::{self, error::TryRecvError},
};

use super::rings::ShmRings;
use crate::{
    async_fd::watch,
    bridge::ToGateway,
    discovery::Interface,
    engine::compression::CompressionAnswer,
    keys::{Events, KmeAnswer, Statistics, UsedStatistics},
};

/// Inputs of one kind that one pass takes.
const BATCH: usize = 256;

/// A result from another thread.
pub(super) enum TaskResult {
    /// The ledger of used keys recorded the key of a connection; true if it was new.
    Recorded(u64, bool),
    /// Counters for the status of the keys.
    Keys(Box<(Statistics, UsedStatistics)>),
    /// The files of the identity changed.
    Identity,
    /// This host's network interfaces.
    Interfaces(Vec<Interface>),
    /// A sample was compressed, or does not become shorter.
    Compressed(CompressionAnswer),
}

/// An input.
pub(super) enum ReactorInput {
    /// An order of the control plane.
    Order(ToGateway),
    /// The KME answered.
    Key(KmeAnswer),
    /// Another thread did something.
    Done(TaskResult),
}

/// Channels and the doorbell.
pub(super) struct Inputs {
    orders: mpsc::Receiver<ToGateway>,
    key_events: Option<Events>,
    done: mpsc::UnboundedReceiver<TaskResult>,
    doorbell: AsyncFd<PassedFd>,
    rang: bool,
    /// Inputs that woke the loop.
    taken: Vec<ReactorInput>,
}

impl Inputs {
    /// Watches the channels and the doorbell of `rings`. Needs a tokio runtime.
    ///
    /// # Errors
    /// The doorbell cannot be watched.
    pub(super) fn new(
        orders: mpsc::Receiver<ToGateway>,
        key_events: Option<Events>,
        done: mpsc::UnboundedReceiver<TaskResult>,
        rings: &ShmRings,
    ) -> io::Result<Self> {
        let doorbell = watch(rings.doorbell().as_fd().try_clone_to_owned()?)?;
        // The rings are looked at in the first pass, which arms the doorbell.
        Ok(Self { orders, key_events, done, doorbell, rang: true, taken: Vec::new() })
    }

    /// Returns whether the doorbell rang since the last call.
    pub(super) fn take_ring(&mut self) -> bool {
        std::mem::take(&mut self.rang)
    }

    /// Takes the waiting inputs, up to a bound.
    pub(super) fn take(&mut self) -> Vec<ReactorInput> {
        let mut inputs = std::mem::take(&mut self.taken);
        for _ in 0..BATCH {
            match self.orders.try_recv() {
                Ok(order) => inputs.push(ReactorInput::Order(order)),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    inputs.push(ReactorInput::Order(ToGateway::Shutdown));
                    break;
                }
            }
        }
        for _ in 0..BATCH {
            let Some(event) = self.key_events.as_mut().and_then(Events::try_recv) else { break };
            inputs.push(ReactorInput::Key(event));
        }
        while let Ok(done) = self.done.try_recv() {
            inputs.push(ReactorInput::Done(done));
        }
        inputs
    }

    /// Polls for an input: ready once there is one.
    pub(super) fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        if let Poll::Ready(ready) = self.doorbell.poll_read_ready(cx) {
            self.rang = true;
            if let Ok(mut ready) = ready {
                ready.clear_ready();
            }
        }
        if let Poll::Ready(order) = self.orders.poll_recv(cx) {
            self.taken.push(ReactorInput::Order(order.unwrap_or(ToGateway::Shutdown)));
        }
        if let Some(events) = &mut self.key_events {
            match events.poll_recv(cx) {
                Poll::Ready(Some(event)) => self.taken.push(ReactorInput::Key(event)),
                // The KME client ended. Its last answers were taken.
                Poll::Ready(None) => self.key_events = None,
                Poll::Pending => {}
            }
        }
        if let Poll::Ready(Some(done)) = self.done.poll_recv(cx) {
            self.taken.push(ReactorInput::Done(done));
        }
        if self.rang || !self.taken.is_empty() { Poll::Ready(()) } else { Poll::Pending }
    }
}
