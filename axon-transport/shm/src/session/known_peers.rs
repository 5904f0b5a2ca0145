//! Descriptors of sessions that another part of this process holds already.

use std::{
    collections::HashMap,
    sync::{Mutex, MutexGuard, PoisonError},
};

use super::peer::PeerDescriptors;
use crate::{ids::SessionId, os::descriptors::PassedFd};

/// The doorbells and pidfds that this process holds, by session. A part of the process that receives a session's
/// descriptors uses these in place of its own copies, so the process has them once.
#[derive(Debug, Default)]
pub struct KnownPeers(Mutex<HashMap<SessionId, (PassedFd, PassedFd)>>);

impl KnownPeers {
    /// Adds the descriptors of a session, in place of earlier ones.
    pub fn insert(&self, id: SessionId, doorbell: &PassedFd, pidfd: &PassedFd) {
        let replaced = self.lock().insert(id, (doorbell.share(), pidfd.share()));
        drop(replaced);
    }

    /// Forgets a session. Its descriptors are closed when nothing else uses them.
    pub fn remove(&self, id: &SessionId) {
        let removed = self.lock().remove(id);
        drop(removed);
    }

    /// Replaces received copies of the doorbell and the pidfd of a session that is known.
    pub fn replace(&self, id: &SessionId, descriptors: &mut PeerDescriptors) {
        let known = self.lock().get(id).map(|(doorbell, pidfd)| (doorbell.share(), pidfd.share()));
        if let Some((doorbell, pidfd)) = known {
            let received = std::mem::replace(&mut descriptors.doorbell, doorbell);
            received.close_copy_of(&descriptors.doorbell);
            descriptors.pidfd = pidfd;
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<SessionId, (PassedFd, PassedFd)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd;

    use super::*;
    use crate::session::segment::SessionSegment;

    fn numbers(descriptors: &PeerDescriptors) -> [i32; 3] {
        let PeerDescriptors { segment, doorbell, pidfd } = descriptors;
        [segment, doorbell, pidfd].map(AsRawFd::as_raw_fd)
    }

    #[test]
    fn received_copies_of_known_descriptors_are_replaced() {
        let id = SessionId([1; 16]);
        let held = SessionSegment::create(id).unwrap().descriptors().unwrap();
        let known = KnownPeers::default();
        known.insert(id, &held.doorbell, &held.pidfd);
        let mut received = held.try_clone().unwrap();
        let [segment, ..] = numbers(&received);
        known.replace(&id, &mut received);
        let [_, doorbell, pidfd] = numbers(&held);
        assert_eq!(
            numbers(&received),
            [segment, doorbell, pidfd],
            "the segment's stays: it is closed once mapped"
        );

        // Of other sessions, and of one that is forgotten, the received ones stay.
        for id in [SessionId([2; 16]), id] {
            known.remove(&SessionId([1; 16]));
            let mut received = held.try_clone().unwrap();
            let before = numbers(&received);
            known.replace(&id, &mut received);
            assert_eq!(numbers(&received), before);
        }
    }
}
