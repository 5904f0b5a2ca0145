//! Guard conditions and wait sets.

use std::{sync::Arc, time::Duration};

use super::{
    error::{AXON_RET_OK, AXON_RET_TIMEOUT, CallFailure, axon_ret_t},
    guarded,
    handles::{
        FfiHandle, axon_client_t, axon_event_t, axon_guard_t, axon_server_t, axon_session_t,
        axon_subscription_t, give, named, revoke, visit,
    },
    memory::{elements_mut, present, value},
};
use crate::session::Waitable;

/// A timeout value that means without end.
pub const AXON_WAIT_FOREVER: i64 = -1;

/// Creates a guard condition for a session. It does not keep the session open. After the session has ended,
/// the condition can still be triggered and destroyed, but no wait can include it.
///
/// # Safety
/// `guard` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_guard_create(
    session: axon_session_t,
    guard: *mut axon_guard_t,
) -> axon_ret_t {
    guarded(|| {
        present(guard, "the place of the guard condition")?;
        let created = named(session)?.create_guard_condition();
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, guard) }
    })
}

/// Destroys the handle of a guard condition. A running wait continues without the condition.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_guard_destroy(guard: axon_guard_t) -> axon_ret_t {
    guarded(|| revoke(guard).map(drop))
}

/// Triggers a guard condition. The call is async-signal-safe: it takes no lock and allocates no memory. It
/// changes neither errno nor the text of the last error.
///
/// AXON_RET_INVALID_HANDLE: the handle names no guard condition, or the condition is being destroyed.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_guard_trigger(guard: axon_guard_t) -> axon_ret_t {
    visit(guard, |guard| guard.trigger()).err().unwrap_or(AXON_RET_OK)
}

/// The handles that a wait includes, in one array for each kind. An empty array may be null. A wait skips
/// handles that are 0.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_wait_set_t {
    /// Ready while a sample can be taken.
    pub subscriptions: *mut axon_subscription_t,
    /// The number of subscriptions.
    pub subscription_count: usize,
    /// Ready once triggered. The wait that reports the condition resets it.
    pub guards: *mut axon_guard_t,
    /// The number of guard conditions.
    pub guard_count: usize,
    /// Ready while a request can be taken.
    pub servers: *mut axon_server_t,
    /// The number of servers.
    pub server_count: usize,
    /// Ready while a response can be taken.
    pub clients: *mut axon_client_t,
    /// The number of clients.
    pub client_count: usize,
    /// Ready if the event happened since its status was last taken.
    pub events: *mut axon_event_t,
    /// The number of events.
    pub event_count: usize,
}

/// Blocks until at least one handle in `set` is ready, for at most `timeout` nanoseconds. A timeout of 0 does
/// not block. AXON_WAIT_FOREVER, like any negative number, blocks without end, even if the set is empty. The
/// call then sets all handles in the arrays to 0 that are not ready.
///
/// AXON_RET_TIMEOUT: no handle was ready in time; all handles are 0. Every other failure leaves the arrays
/// unchanged. AXON_RET_INVALID_HANDLE: a handle names no object. AXON_RET_INVALID_ARGUMENT: a handle belongs
/// to another session that is closed. Handles of another open session of this process are permitted; their
/// wake-up takes a detour through one more thread.
///
/// Any number of threads may wait at once, each with arrays of its own. An object that is destroyed during a
/// wait leaves the graph at once. The wait continues.
///
/// # Safety
/// `set` points to a set whose arrays hold as many handles as their counts say. No other code uses the arrays
/// during the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_wait(
    session: axon_session_t,
    set: *const axon_wait_set_t,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let session = named(session)?;
        // SAFETY: guaranteed by the caller.
        let set = unsafe { value(set, "the pointer to the set") }?;
        // SAFETY: guaranteed by the caller.
        let mut arrays = unsafe { Arrays::new(&set) }?;
        let watch = {
            let subscriptions = all(arrays.subscriptions)?;
            let guards = all(arrays.guards)?;
            let servers = all(arrays.servers)?;
            let clients = all(arrays.clients)?;
            let events = all(arrays.events)?;
            let waitables: Vec<Waitable<'_>> = subscriptions
                .iter()
                .map(|one| Waitable::Subscription(one))
                .chain(guards.iter().map(|one| Waitable::GuardCondition(one)))
                .chain(servers.iter().map(|one| Waitable::Server(one)))
                .chain(clients.iter().map(|one| Waitable::Client(one)))
                .chain(events.iter().map(|one| Waitable::Event(one)))
                .collect();
            // The watch does not keep its objects alive.
            session.watch(&waitables)?
        };
        let ready = session.wait_watch(&watch, limit(timeout))?;
        arrays.keep(&ready);
        if ready.is_empty() {
            return Err(CallFailure::timeout("nothing is ready"));
        }
        Ok(())
    })
}

struct Arrays<'a> {
    subscriptions: &'a mut [axon_subscription_t],
    guards: &'a mut [axon_guard_t],
    servers: &'a mut [axon_server_t],
    clients: &'a mut [axon_client_t],
    events: &'a mut [axon_event_t],
}

impl<'a> Arrays<'a> {
    /// # Safety
    /// As for [`axon_session_wait`].
    unsafe fn new(set: &axon_wait_set_t) -> Result<Self, CallFailure> {
        // SAFETY: guaranteed by the caller, here and below: no other code uses the arrays.
        let subscriptions = unsafe {
            elements_mut(set.subscriptions, set.subscription_count, "the subscriptions")
        }?;
        // SAFETY: as above.
        let guards = unsafe { elements_mut(set.guards, set.guard_count, "the guard conditions") }?;
        // SAFETY: as above.
        let servers = unsafe { elements_mut(set.servers, set.server_count, "the servers") }?;
        // SAFETY: as above.
        let clients = unsafe { elements_mut(set.clients, set.client_count, "the clients") }?;
        // SAFETY: as above.
        let events = unsafe { elements_mut(set.events, set.event_count, "the events") }?;
        Ok(Self { subscriptions, guards, servers, clients, events })
    }

    /// Sets the handles to 0 that are not ready. `ready` counts through all arrays and skips handles that are
    /// 0.
    fn keep(&mut self, ready: &[usize]) {
        let (mut number, mut ready) = (0, ready.iter().copied().peekable());
        keep(self.subscriptions, &mut number, &mut ready);
        keep(self.guards, &mut number, &mut ready);
        keep(self.servers, &mut number, &mut ready);
        keep(self.clients, &mut number, &mut ready);
        keep(self.events, &mut number, &mut ready);
    }
}

fn keep<H: FfiHandle>(
    handles: &mut [H],
    number: &mut usize,
    ready: &mut std::iter::Peekable<impl Iterator<Item = usize>>,
) {
    for handle in handles.iter_mut().filter(|handle| handle.id() != 0) {
        if ready.next_if_eq(number).is_none() {
            *handle = H::of(0);
        }
        *number += 1;
    }
}

/// Returns the objects of the handles that are not 0.
fn all<H: FfiHandle>(handles: &[H]) -> Result<Vec<Arc<H::Object>>, CallFailure> {
    handles.iter().filter(|handle| handle.id() != 0).map(|handle| named(*handle)).collect()
}

/// Converts a timeout; `None` is without end.
fn limit(nanoseconds: i64) -> Option<Duration> {
    u64::try_from(nanoseconds).ok().map(Duration::from_nanos)
}

/// Converts a timeout. A negative one, which means without end, becomes about 292 years.
pub(super) fn duration(nanoseconds: i64) -> Duration {
    limit(nanoseconds).unwrap_or(Duration::from_nanos(i64::MAX as u64))
}

impl CallFailure {
    pub(super) fn timeout(text: impl std::fmt::Display) -> Self {
        Self::new(AXON_RET_TIMEOUT, text)
    }
}
