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

/// Of a subscription: a publisher became alive or ceased to be.
pub const AXON_EVENT_LIVELINESS_CHANGED: u32 = 0;
/// Of a subscription: no sample came for longer than its deadline.
pub const AXON_EVENT_REQUESTED_DEADLINE_MISSED: u32 = 1;
/// Of a subscription: a publisher offers less than it requests.
pub const AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE: u32 = 2;
/// Of a subscription: samples were lost before they could be taken.
pub const AXON_EVENT_MESSAGE_LOST: u32 = 3;
/// Of a subscription: a publisher of the topic has another type.
pub const AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE: u32 = 4;
/// Of a subscription: a publisher was matched or unmatched.
pub const AXON_EVENT_SUBSCRIPTION_MATCHED: u32 = 5;
/// Of a publisher: it did not assert its liveliness within its lease.
pub const AXON_EVENT_LIVELINESS_LOST: u32 = 6;
/// Of a publisher: it did not publish within its deadline.
pub const AXON_EVENT_OFFERED_DEADLINE_MISSED: u32 = 7;
/// Of a publisher: a subscription requests more than it offers.
pub const AXON_EVENT_OFFERED_QOS_INCOMPATIBLE: u32 = 8;
/// Of a publisher: a subscription of the topic has another type.
pub const AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE: u32 = 9;
/// Of a publisher: a subscription was matched or unmatched.
pub const AXON_EVENT_PUBLICATION_MATCHED: u32 = 10;

/// What is known of an event. Changes are since the status was last taken.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct axon_event_status_t {
    /// AXON_EVENT_*.
    pub kind: u32,
    /// Of incompatible QoS: AXON_POLICY_*, one that kept the last endpoint apart.
    pub last_policy: u32,
    /// How often it happened in all; of `matched`, endpoints matched ever.
    pub total: u64,
    /// How much of that is new.
    pub total_change: u64,
    /// Of `matched`, endpoints matched now; of liveliness changed, publishers that are alive now.
    pub current: u64,
    /// By how many that changed.
    pub current_change: i64,
    /// Of liveliness changed, publishers that are matched and not alive now.
    pub not_alive: u64,
    /// By how many that changed.
    pub not_alive_change: i64,
}

/// One event of a publisher: AXON_RET_INVALID_ARGUMENT where `kind` is not one of its. It may be used
/// after the publisher has ended, and then does not happen again.
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
        // SAFETY: the caller's word.
        unsafe { give_event(found, kind, "publisher", event) }
    })
}

/// One event of a subscription, as `axon_session_publisher_event`.
///
/// # Safety
/// As there.
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
        // SAFETY: the caller's word.
        unsafe { give_event(found, kind, "subscription", event) }
    })
}

/// Gives an event's handle up. Its callback has returned, and is not called any more, when this returns;
/// those of other handles of the same event are.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_event_destroy(event: axon_event_t) -> axon_ret_t {
    guarded(|| {
        // Another call may keep it for a while.
        revoke(event)?.tell_no_more();
        Ok(())
    })
}

/// The status. Its changes are counted anew from here, and the event is not ready any more until it
/// happens again.
///
/// # Safety
/// `status` points to room for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_event_take(
    event: axon_event_t,
    status: *mut axon_event_status_t,
) -> axon_ret_t {
    guarded(|| {
        present(status, "the place of the status")?;
        let event = named(event)?;
        let found = flat(event.kind(), event.take());
        // SAFETY: the caller's word.
        unsafe { store(status, found, "the place of the status") }
    })
}

/// Has `callback` told of the event from now on, in place of the one that this handle had before, which
/// has returned and is not called any more when this returns, unless this is called from within it.
/// Null: nobody is told. What happened since the status was last taken, and nobody was told of by this
/// handle, it is told at once, in this call.
///
/// # Safety
/// `callback` may be called with `user` from any thread until it is replaced or the event is
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
        // One that was destroyed meanwhile has none.
        named(event).map(drop)
    })
}

/// # Safety
/// As [`axon_session_publisher_event`].
unsafe fn give_event(
    event: Option<Event>,
    kind: u32,
    of: &str,
    out: *mut axon_event_t,
) -> Result<(), CallFailure> {
    let none = || CallFailure::argument(format_args!("a {of} has no event {kind}"));
    let event = event.ok_or_else(none)?;
    // SAFETY: the caller's word.
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
