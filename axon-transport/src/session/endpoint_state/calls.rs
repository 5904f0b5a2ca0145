//! Requests of tasks that wait for the responses. Each task receives the response to its own request.

use std::{
    collections::{HashMap, HashSet},
    fmt,
    sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError},
    task::Waker,
    time::Instant,
};

use axon_shm::{
    Sample,
    internal::{CarrierState, Writer},
};

use crate::{ids::Gid, session::core::SessionCore};

/// Maximum number of responses that one `collect` handles before the control thread goes on with other work.
const BATCH: usize = 256;

/// The calls of a client that are under way.
#[derive(Default)]
pub(in crate::session) struct Calls {
    by_number: Mutex<HashMap<u64, Call>>,
    /// The ring of the requests.
    ring: OnceLock<Arc<Writer>>,
}

struct Call {
    /// The servers that received the request.
    servers: Vec<Gid>,
    waker: Option<Waker>,
    outcome: Option<Result<Sample, ServerGone>>,
}

/// The error of a call whose servers are all gone without a response.
pub(in crate::session) struct ServerGone;

impl Calls {
    /// Sets the ring of the client's requests.
    pub(in crate::session) fn set_ring(&self, ring: Arc<Writer>) {
        // A client has one ring.
        let _ = self.ring.set(ring);
    }

    /// Returns how a daemon carries, or carried, the requests to a server that is not read. Such a server may still
    /// answer: the ring keeps the requests for the next daemon.
    fn carried(&self, server: &Gid) -> Option<CarrierState> {
        self.ring.get()?.carried(server)
    }

    /// Sends a request, and keeps its response when it comes. Returns the number of the request.
    pub(in crate::session) fn begin<E>(
        &self,
        servers: Vec<Gid>,
        send: impl FnOnce() -> Result<u64, E>,
    ) -> Result<u64, E> {
        // The lock is held while the request is sent: a response whose number is not in the table would be dropped.
        let mut calls = self.lock();
        let number = send()?;
        calls.insert(number, Call { servers, waker: None, outcome: None });
        Ok(number)
    }

    /// Takes the outcome of a call, if there is one. Otherwise `waker` is woken when there is.
    pub(in crate::session) fn outcome(
        &self,
        number: u64,
        waker: &Waker,
    ) -> Option<Result<Sample, ServerGone>> {
        let waker = waker.clone();
        let mut calls = self.lock();
        let call = calls.get_mut(&number)?;
        let outcome = call.outcome.take();
        let before = call.waker.replace(waker);
        drop(calls);
        drop(before);
        outcome
    }

    /// Removes a call whose task does not wait any more.
    pub(in crate::session) fn end(&self, number: u64) {
        let call = self.lock().remove(&number);
        drop(call);
    }

    /// Hands the responses to their calls, and drops responses that no call waits for. Returns whether a call still
    /// waits. `take` takes the next response, with the number of its request. `keep_unread` reduces a set of servers to
    /// the servers that are not read.
    pub(super) fn collect(
        &self,
        core: &SessionCore,
        mut take: impl FnMut() -> Option<(u64, Sample)>,
        mut keep_unread: impl FnMut(&mut HashSet<Gid>),
    ) -> bool {
        // The lock is held from the moment that a response leaves its ring until its call has it. A reader of
        // `calls` therefore finds the response either in the ring or in its call.
        let mut calls = self.lock();
        let (mut woken, mut passed) = (Vec::new(), Vec::new());
        let mut waiting = calls.values().filter(|call| call.outcome.is_none()).count();
        let mut looked = 0;
        while waiting > 0 {
            if looked == BATCH {
                core.wake();
                break;
            }
            let Some((number, sample)) = take() else {
                let (failed, again) =
                    self.fail_those_without_server(&mut calls, &mut keep_unread, &mut woken);
                waiting -= failed;
                if let Some(again) = again {
                    core.look_again(again);
                }
                break;
            };
            looked += 1;
            match calls.get_mut(&number).filter(|call| call.outcome.is_none()) {
                Some(call) => {
                    call.outcome = Some(Ok(sample));
                    woken.extend(call.waker.take());
                    waiting -= 1;
                }
                None => passed.push(sample),
            }
        }
        drop(calls);
        woken.into_iter().for_each(Waker::wake);
        waiting > 0
    }

    /// Fails the calls whose servers are all gone and can send nothing more. The caller has taken all responses before.
    /// Returns the number of failed calls, and when to look again.
    fn fail_those_without_server(
        &self,
        calls: &mut HashMap<u64, Call>,
        keep_unread: impl FnOnce(&mut HashSet<Gid>),
        woken: &mut Vec<Waker>,
    ) -> (usize, Option<Instant>) {
        let mut gone: HashSet<Gid> =
            calls.values().flat_map(|call| &call.servers).copied().collect();
        keep_unread(&mut gone);
        // Called after `keep_unread`: a server that comes back is attached before it is read.
        let mut again = None::<Instant>;
        let lost: HashSet<Gid> = gone
            .into_iter()
            .filter(|server| match self.carried(server) {
                Some(CarrierState::Attached) => false,
                Some(CarrierState::Absent(until)) => {
                    again = Some(again.map_or(until, |before| before.min(until)));
                    false
                }
                None => true,
            })
            .collect();
        let mut failed = 0;
        for call in calls.values_mut().filter(|call| call.outcome.is_none()) {
            if call.servers.iter().all(|server| lost.contains(server)) {
                call.outcome = Some(Err(ServerGone));
                woken.extend(call.waker.take());
                failed += 1;
            }
        }
        (failed, again)
    }

    /// Returns the number of calls under way.
    #[cfg(test)]
    pub(in crate::session) fn count(&self) -> usize {
        self.lock().len()
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<u64, Call>> {
        self.by_number.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Calls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Calls").finish_non_exhaustive()
    }
}
