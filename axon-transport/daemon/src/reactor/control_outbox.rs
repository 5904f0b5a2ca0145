//! Messages to the control plane, in order.

use std::collections::VecDeque;

use tokio::sync::mpsc::{Sender, error::TrySendError};

use crate::bridge::{CHANNEL, ToControl};

/// Messages to the control plane, including those that found the channel full.
pub(super) struct ControlOutbox {
    control: Sender<ToControl>,
    waiting: VecDeque<ToControl>,
}

impl ControlOutbox {
    /// Creates an empty outbox.
    pub(super) fn new(control: Sender<ToControl>) -> Self {
        Self { control, waiting: VecDeque::new() }
    }

    /// Sends a message, or queues it. Status, refusals and datagrams are dropped if the channel is full.
    pub(super) fn tell(&mut self, what: ToControl) {
        let droppable = matches!(
            what,
            ToControl::Link(..)
                | ToControl::Keys(_)
                | ToControl::Refusal { .. }
                | ToControl::Datagrams(_)
        );
        if !self.waiting.is_empty() {
            self.waiting.extend((!droppable).then_some(what));
        } else if let Err(TrySendError::Full(what)) = self.control.try_send(what) {
            self.waiting.extend((!droppable).then_some(what));
        }
    }

    /// Returns whether so many messages wait that the reactor should stop reading from the network.
    pub(super) fn is_behind(&self) -> bool {
        self.waiting.len() >= CHANNEL
    }

    /// Sends the next message that waits. Without one, or once the control plane is gone, it never returns. Cancel
    /// safe.
    pub(super) async fn send_next(&mut self) {
        if !self.waiting.is_empty()
            && let Ok(permit) = self.control.reserve().await
            && let Some(next) = self.waiting.pop_front()
        {
            return permit.send(next);
        }
        std::future::pending().await
    }

    /// Sends all messages that wait.
    pub(super) async fn flush(&mut self) {
        while let Some(next) = self.waiting.pop_front() {
            if self.control.send(next).await.is_err() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::mpsc;

    #[tokio::test]
    async fn messages_stay_in_order_and_status_is_dropped_when_the_channel_is_full() {
        let (sender, mut control) = mpsc::channel(1);
        let mut told = ControlOutbox::new(sender);
        for draining in [true, false, true] {
            told.tell(ToControl::Draining(draining));
            told.tell(ToControl::Keys(serde_json::Value::Null));
        }
        let mut seen = Vec::new();
        for _ in 0..3 {
            seen.push(control.recv().await);
            if seen.len() < 3 {
                told.send_next().await;
            }
        }
        assert!(
            matches!(
                seen[..],
                [
                    Some(ToControl::Draining(true)),
                    Some(ToControl::Draining(false)),
                    Some(ToControl::Draining(true)),
                ]
            ),
            "{seen:?}"
        );
        assert!(control.try_recv().is_err());
    }
}
