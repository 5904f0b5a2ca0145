//! Events of publishers and subscriptions.

use std::ffi::c_void;

use super::{
    callback::{axon_callback_t, told},
    error::{CallFailure, axon_ret_t},
    guarded,
    handles::{axon_event_t, axon_publisher_t, axon_subscription_t, give, named, revoke},
    memory::{present, store},
    qos::policy,
};
use crate::{
    events::{EventKind, EventStatus},
    session::Event,
};

/// Subscription event: a publisher became alive or stopped being alive.
pub const AXON_EVENT_LIVELINESS_CHANGED: u32 = 0;
/// Subscription event: no sample arrived within the requested deadline.
pub const AXON_EVENT_REQUESTED_DEADLINE_MISSED: u32 = 1;
/// Subscription event: a publisher offers less than the subscription requests.
pub const AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE: u32 = 2;
/// Subscription event: samples were lost before the subscription could take them.
pub const AXON_EVENT_MESSAGE_LOST: u32 = 3;
/// Subscription event: a publisher of the topic has another type.
pub const AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE: u32 = 4;
/// Subscription event: a publisher was matched or unmatched.
pub const AXON_EVENT_SUBSCRIPTION_MATCHED: u32 = 5;
/// Publisher event: the publisher did not assert its liveliness within its lease.
pub const AXON_EVENT_LIVELINESS_LOST: u32 = 6;
/// Publisher event: the publisher did not publish within its deadline.
pub const AXON_EVENT_OFFERED_DEADLINE_MISSED: u32 = 7;
/// Publisher event: a subscription requests more than the publisher offers.
pub const AXON_EVENT_OFFERED_QOS_INCOMPATIBLE: u32 = 8;
/// Publisher event: a subscription of the topic has another type.
pub const AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE: u32 = 9;
/// Publisher event: a subscription was matched or unmatched.
pub const AXON_EVENT_PUBLICATION_MATCHED: u32 = 10;

/// The status of an event. Each change is counted since the status was last taken.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct axon_event_status_t {
    /// AXON_EVENT_*.
    pub kind: u32,
    /// Incompatible QoS: AXON_POLICY_* of a policy that kept the last endpoint from matching.
    pub last_policy: u32,
    /// How often the event happened. For `matched`: the endpoints that were ever matched.
    pub total: u64,
    /// The change of `total`.
    pub total_change: u64,
    /// For `matched`: the endpoints that are matched now. For liveliness changed: the publishers that are
    /// alive now.
    pub current: u64,
    /// The change of `current`.
    pub current_change: i64,
    /// For liveliness changed: the publishers that are matched and not alive now.
    pub not_alive: u64,
    /// The change of `not_alive`.
    pub not_alive_change: i64,
}

/// Creates a handle for one event of a publisher. AXON_RET_INVALID_ARGUMENT: a publisher has no event of this
/// `kind`. The handle stays valid after the publisher ends. The event does not happen again then.
///
/// # Safety
/// `event` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_event(
    publisher: axon_publisher_t,
    kind: u32,
    event: *mut axon_event_t,
) -> axon_ret_t {
    guarded(|| {
        present(event, "the place of the event")?;
        let publisher = named(publisher)?;
        let found = of_number(kind).and_then(|kind| publisher.event(kind));
        // SAFETY: guaranteed by the caller.
        unsafe { give_event(found, kind, "publisher", event) }
    })
}

/// Creates a handle for one event of a subscription, as `axon_session_publisher_event` does.
///
/// # Safety
/// As for `axon_session_publisher_event`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_event(
    subscription: axon_subscription_t,
    kind: u32,
    event: *mut axon_event_t,
) -> axon_ret_t {
    guarded(|| {
        present(event, "the place of the event")?;
        let subscription = named(subscription)?;
        let found = of_number(kind).and_then(|kind| subscription.event(kind));
        // SAFETY: guaranteed by the caller.
        unsafe { give_event(found, kind, "subscription", event) }
    })
}

/// Destroys the handle of an event. When the call returns, the callback of this handle has returned and is
/// not called again. The callbacks of other handles of the same event stay set.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_event_destroy(event: axon_event_t) -> axon_ret_t {
    guarded(|| {
        // A concurrent call may keep the object for a while.
        revoke(event)?.tell_no_more();
        Ok(())
    })
}

/// Takes the status of an event. The changes are counted from 0 again. The event is not ready until it
/// happens again.
///
/// # Safety
/// `status` points to room for one status.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_event_take(
    event: axon_event_t,
    status: *mut axon_event_status_t,
) -> axon_ret_t {
    guarded(|| {
        present(status, "the place of the status")?;
        let event = named(event)?;
        let found = flat(event.kind(), event.take());
        // SAFETY: guaranteed by the caller.
        unsafe { store(status, found, "the place of the status") }
    })
}

/// Sets the callback of this handle, which replaces the handle's previous callback. When the call returns,
/// the previous callback has returned and is not called again, unless the call comes from inside that
/// callback. Null removes the callback.
///
/// The call reports the earlier occurrences at once: those since the status was last taken that this handle
/// has not reported yet.
///
/// # Safety
/// `callback` may be called with `user` from any thread until the callback is replaced or the event is
/// destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_event_set_callback(
    event: axon_event_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| {
        let object = named(event)?;
        object.set_callback(told(callback, user));
        // An object that was destroyed meanwhile has no callback.
        named(event).map(drop)
    })
}

/// # Safety
/// As for [`axon_session_publisher_event`].
unsafe fn give_event(
    event: Option<Event>,
    kind: u32,
    of: &str,
    out: *mut axon_event_t,
) -> Result<(), CallFailure> {
    let none = || CallFailure::argument(format_args!("a {of} has no event {kind}"));
    let event = event.ok_or_else(none)?;
    // SAFETY: guaranteed by the caller.
    unsafe { give(event, out) }
}

fn of_number(kind: u32) -> Option<EventKind> {
    EventKind::ALL.get(usize::try_from(kind).ok()?).copied()
}

fn flat(kind: EventKind, status: EventStatus) -> axon_event_status_t {
    let kind = EventKind::ALL.iter().position(|one| *one == kind).unwrap_or_default() as u32;
    let nothing = axon_event_status_t { kind, ..axon_event_status_t::default() };
    match status {
        EventStatus::Counted(counted) => {
            axon_event_status_t { total: counted.total, total_change: counted.change, ..nothing }
        }
        EventStatus::Matched(matched) => axon_event_status_t {
            total: matched.total,
            total_change: matched.total_change,
            current: matched.current,
            current_change: matched.current_change,
            ..nothing
        },
        EventStatus::IncompatibleQos(status) => axon_event_status_t {
            total: status.count.total,
            total_change: status.count.change,
            last_policy: policy(status.last_policy),
            ..nothing
        },
        EventStatus::LivelinessChanged(changed) => axon_event_status_t {
            current: changed.alive,
            current_change: changed.alive_change,
            not_alive: changed.not_alive,
            not_alive_change: changed.not_alive_change,
            ..nothing
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_have_the_numbers_that_the_header_gives_them() {
        let numbers = [
            (AXON_EVENT_LIVELINESS_CHANGED, EventKind::LivelinessChanged),
            (AXON_EVENT_REQUESTED_DEADLINE_MISSED, EventKind::RequestedDeadlineMissed),
            (AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE, EventKind::RequestedQosIncompatible),
            (AXON_EVENT_MESSAGE_LOST, EventKind::MessageLost),
            (AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE, EventKind::SubscriptionIncompatibleType),
            (AXON_EVENT_SUBSCRIPTION_MATCHED, EventKind::SubscriptionMatched),
            (AXON_EVENT_LIVELINESS_LOST, EventKind::LivelinessLost),
            (AXON_EVENT_OFFERED_DEADLINE_MISSED, EventKind::OfferedDeadlineMissed),
            (AXON_EVENT_OFFERED_QOS_INCOMPATIBLE, EventKind::OfferedQosIncompatible),
            (AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE, EventKind::PublisherIncompatibleType),
            (AXON_EVENT_PUBLICATION_MATCHED, EventKind::PublicationMatched),
        ];
        assert_eq!(numbers.len(), EventKind::ALL.len());
        for (number, kind) in numbers {
            assert_eq!(of_number(number), Some(kind));
        }
        assert_eq!(of_number(11), None);
    }
}
