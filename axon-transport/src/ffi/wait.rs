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

/// As a timeout: for ever.
pub const AXON_WAIT_FOREVER: i64 = -1;

/// A guard condition of a session. It does not keep the session open: it may be triggered and destroyed
/// when that has ended, but nobody can wait for it any more.
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
        // SAFETY: the caller's word.
        unsafe { give(created, guard) }
    })
}

/// Gives a guard condition's handle up. A wait that waits for it goes on without.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_guard_destroy(guard: axon_guard_t) -> axon_ret_t {
    guarded(|| revoke(guard).map(drop))
}

/// Triggers a guard condition. Async-signal-safe: it takes no lock and no memory, and a signal handler
/// may call it at any time. It leaves errno and the text of the last error alone.
///
/// AXON_RET_INVALID_HANDLE: it names none, or is being destroyed.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_guard_trigger(guard: axon_guard_t) -> axon_ret_t {
    visit(guard, |guard| guard.trigger()).err().unwrap_or(AXON_RET_OK)
}

/// What to wait for: arrays of handles, each of which may be empty, and then null. A handle that is
/// 0 is passed over.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_wait_set_t {
    /// Ready while there is something to take.
    pub subscriptions: *mut axon_subscription_t,
    /// How many they are.
    pub subscription_count: usize,
    /// Ready once it was triggered. The wait that finds it so resets it.
    pub guards: *mut axon_guard_t,
    /// How many they are.
    pub guard_count: usize,
    /// Ready while there is a request to take.
    pub servers: *mut axon_server_t,
    /// How many they are.
    pub server_count: usize,
    /// Ready while there is a response to take.
    pub clients: *mut axon_client_t,
    /// How many they are.
    pub client_count: usize,
    /// Ready while it happened and its status was not taken since.
    pub events: *mut axon_event_t,
    /// How many they are.
    pub event_count: usize,
}

/// Blocks until at least one of what is in `set` is ready, for at most `timeout` nanoseconds: 0 not at
/// all, AXON_WAIT_FOREVER (any negative number) without end, also where the set is empty. Then sets
/// all handles in the arrays to 0 that are not ready.
///
/// AXON_RET_TIMEOUT: none was ready in time; all handles are 0. Every other failure leaves the arrays
/// as they were: AXON_RET_INVALID_HANDLE where one names nothing, AXON_RET_INVALID_ARGUMENT where one is
/// of another session that is closed. What is of another session of this process can be waited for
/// too, and takes a thread more on its way.
///
/// Any number of threads may wait at once, each with arrays of its own. What is destroyed meanwhile is
/// out of the graph at once; the wait goes on.
///
/// # Safety
/// `set` points to a set whose arrays hold as many handles as it says, which nobody else uses during
/// the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_wait(
    session: axon_session_t,
    set: *const axon_wait_set_t,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let session = named(session)?;
        // SAFETY: the caller's word.
        let set = unsafe { value(set, "the pointer to the set") }?;
        // SAFETY: the caller's word.
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
            // It does not keep the objects that it waits for from ending.
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
    /// As [`axon_session_wait`].
    unsafe fn new(set: &axon_wait_set_t) -> Result<Self, CallFailure> {
        // SAFETY: the caller's word, here and below: nobody else uses the arrays.
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

    /// Sets those to 0 that are not ready. The ready ones are counted through all arrays, without
    /// those that are 0.
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

/// What the handles name that are not 0.
fn all<H: FfiHandle>(handles: &[H]) -> Result<Vec<Arc<H::Object>>, CallFailure> {
    handles.iter().filter(|handle| handle.id() != 0).map(|handle| named(*handle)).collect()
}

/// A timeout; `None` is for ever.
fn limit(nanoseconds: i64) -> Option<Duration> {
    u64::try_from(nanoseconds).ok().map(Duration::from_nanos)
}

/// Converts a timeout. A negative one, which means for ever, becomes some hundred years.
pub(super) fn duration(nanoseconds: i64) -> Duration {
    limit(nanoseconds).unwrap_or(Duration::from_nanos(i64::MAX as u64))
}

impl CallFailure {
    pub(super) fn timeout(text: impl std::fmt::Display) -> Self {
        Self::new(AXON_RET_TIMEOUT, text)
    }
}
