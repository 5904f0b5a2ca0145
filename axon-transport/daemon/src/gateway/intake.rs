//! Limits the memory of one peer's incoming messages: those that arrive in pieces, or wait for room in a
//! ring.

use std::sync::Arc;

use tokio::sync::{Mutex, OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

/// Up to here a message takes what each stream has.
const SMALL: usize = 32 << 10;
/// What is counted.
const UNIT: usize = 1024;

/// What the messages of one peer share.
#[derive(Debug)]
pub(crate) struct Intake {
    room: Arc<Semaphore>,
    units: u32,
    /// Held for a message that was compressed: how long it really is turns out when it is whole.
    expanding: Arc<Mutex<()>>,
}

/// Room for one message.
#[derive(Default)]
pub(crate) struct Room {
    _whole: Option<OwnedSemaphorePermit>,
    _expanded: Option<OwnedMutexGuard<()>>,
}

impl Intake {
    /// For messages of so many bytes together, or one that is longer.
    pub(crate) fn new(bytes: usize) -> Self {
        let units = u32::try_from(bytes.div_ceil(UNIT)).unwrap_or(u32::MAX);
        let room = Arc::new(Semaphore::new(units as usize));
        Self { room, units, expanding: Arc::default() }
    }

    /// Room for a message of `length` bytes, in the order in which it is asked for.
    pub(crate) async fn room(&self, length: usize) -> Room {
        if length <= SMALL {
            return Room::default();
        }
        let units = u32::try_from(length.div_ceil(UNIT)).unwrap_or(u32::MAX).min(self.units);
        // It is never closed.
        let whole = Arc::clone(&self.room).acquire_many_owned(units).await.ok();
        Room { _whole: whole, _expanded: None }
    }

    /// Room for what a compressed message becomes: for one at a time, so that none waits for another
    /// that waits for it.
    pub(crate) async fn expand(&self, room: &mut Room) {
        room._expanded = Some(Arc::clone(&self.expanding).lock_owned().await);
    }

    /// Gives back what a buffer need not keep until the next message.
    pub(crate) fn shrink(body: &mut Vec<u8>) {
        if body.capacity() > SMALL {
            *body = Vec::new();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        pin::pin,
        task::{Context, Poll, Waker},
    };

    use super::*;

    fn poll<T>(future: std::pin::Pin<&mut impl Future<Output = T>>) -> Poll<T> {
        future.poll(&mut Context::from_waker(Waker::noop()))
    }

    #[test]
    fn messages_that_are_under_way_take_no_more_than_there_is_room_for() {
        const LARGE: usize = 1 << 20;
        const SOME: usize = 4;
        let intake = Intake::new(SOME * LARGE);
        let mut rooms = Vec::new();
        for _ in 0..SOME {
            let Poll::Ready(room) = poll(pin!(intake.room(LARGE))) else { panic!("no room") };
            rooms.push(room);
        }
        let mut next = pin!(intake.room(SMALL + 1));
        assert!(poll(next.as_mut()).is_pending());
        // What is short, and what is longer than all the room together once it is free, passes.
        assert!(poll(pin!(intake.room(SMALL))).is_ready());
        rooms.pop();
        assert!(poll(next.as_mut()).is_ready());
        rooms.clear();
        assert!(poll(pin!(intake.room(100 * LARGE))).is_ready());
    }

    #[test]
    fn one_is_expanded_at_a_time() {
        let intake = Intake::new(1 << 20);
        let (mut one, mut other) = (Room::default(), Room::default());
        assert!(poll(pin!(intake.expand(&mut one))).is_ready());
        assert!(poll(pin!(intake.expand(&mut other))).is_pending());
        drop(one);
        assert!(poll(pin!(intake.expand(&mut other))).is_ready());
    }

    #[test]
    fn a_buffer_keeps_little() {
        let mut body = vec![0; SMALL + 1];
        Intake::shrink(&mut body);
        assert_eq!(body.capacity(), 0);
        let mut body = Vec::with_capacity(SMALL);
        Intake::shrink(&mut body);
        assert_eq!(body.capacity(), SMALL);
    }
}
