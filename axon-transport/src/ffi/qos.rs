//! Quality of service in its C representation.

use std::{mem::MaybeUninit, os::raw::c_char, time::Duration};

use axon_shm::internal::nanoseconds;

use super::{
    error::{CallFailure, axon_ret_t},
    guarded,
    memory::{elements_mut, present, store, store_if_wanted, value},
};
use crate::qos::{
    Choice, Compatibility, Durability, History, Incompatible, Liveliness, Qos, QosRequest,
    Reliability, check,
};

/// Any policy: AXON's default, which is RELIABLE, VOLATILE, KEEP_LAST and AUTOMATIC.
pub const AXON_CHOICE_DEFAULT: u32 = 0;
/// Reliability, durability and liveliness: a level that matches every endpoint of the other side that the graph has
/// for the topic. A subscription gets the highest one that all publishers offer. A publisher is RELIABLE and
/// TRANSIENT_LOCAL, and MANUAL_BY_TOPIC only if a subscription requests that. The level is chosen when the endpoint is
/// created, and not again. Clients and servers get the default.
pub const AXON_CHOICE_BEST_AVAILABLE: u32 = 255;

/// Samples arrive within the bounds of the history.
pub const AXON_RELIABILITY_RELIABLE: u32 = 1;
/// Samples may be lost.
pub const AXON_RELIABILITY_BEST_EFFORT: u32 = 2;

/// A subscription that joins late receives the publisher's history first.
pub const AXON_DURABILITY_TRANSIENT_LOCAL: u32 = 1;
/// A subscription that joins late receives only samples that are published afterwards.
pub const AXON_DURABILITY_VOLATILE: u32 = 2;

/// The newest `depth` samples are kept.
pub const AXON_HISTORY_KEEP_LAST: u32 = 1;
/// All samples are kept, up to the memory budget. Then the publisher waits.
pub const AXON_HISTORY_KEEP_ALL: u32 = 2;

/// The session asserts that a publisher is alive.
pub const AXON_LIVELINESS_AUTOMATIC: u32 = 1;
/// The publisher asserts that it is alive, by publishing or by an explicit call.
pub const AXON_LIVELINESS_MANUAL_BY_TOPIC: u32 = 3;

/// AXON's default: infinite.
pub const AXON_DURATION_DEFAULT: u64 = 0;
/// AXON_CHOICE_BEST_AVAILABLE for a deadline or a lease.
pub const AXON_DURATION_BEST_AVAILABLE: u64 = 0xffff_ffff_ffff_fffe;
/// Infinite.
pub const AXON_DURATION_INFINITE: u64 = 0xffff_ffff_ffff_ffff;

/// The QoS profile that an endpoint offers or requests. All zeros is the default profile: RELIABLE, VOLATILE,
/// KEEP_LAST(10). A profile that AXON returns for an existing endpoint contains neither defaults nor
/// best-available values.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_qos_t {
    /// AXON_RELIABILITY_*, or AXON_CHOICE_*.
    pub reliability: u32,
    /// AXON_DURABILITY_*, or AXON_CHOICE_*.
    pub durability: u32,
    /// AXON_HISTORY_*, or AXON_CHOICE_DEFAULT.
    pub history: u32,
    /// The number of samples that KEEP_LAST keeps; 0 for the default.
    pub depth: u32,
    /// AXON_LIVELINESS_*, or AXON_CHOICE_*.
    pub liveliness: u32,
    /// Must be 0.
    pub reserved: u32,
    /// The longest time between two samples, in nanoseconds, or AXON_DURATION_*.
    pub deadline: u64,
    /// The age from which a sample is not delivered any more, in nanoseconds, or AXON_DURATION_*.
    pub lifespan: u64,
    /// The time without an assertion after which a publisher counts as not alive, in nanoseconds, or
    /// AXON_DURATION_*.
    pub lease: u64,
}

/// The two profiles are compatible.
pub const AXON_QOS_COMPATIBLE: u32 = 0;
/// The result depends on policies that are still open: default or best available.
pub const AXON_QOS_UNKNOWN: u32 = 1;
/// The two profiles are incompatible.
pub const AXON_QOS_INCOMPATIBLE: u32 = 2;

/// No policy is incompatible.
pub const AXON_POLICY_NONE: u32 = 0;
/// The incompatible policy: reliability.
pub const AXON_POLICY_RELIABILITY: u32 = 1;
/// The incompatible policy: durability.
pub const AXON_POLICY_DURABILITY: u32 = 2;
/// The incompatible policy: deadline.
pub const AXON_POLICY_DEADLINE: u32 = 3;
/// The incompatible policy: liveliness.
pub const AXON_POLICY_LIVELINESS: u32 = 4;
/// The incompatible policy: the liveliness lease.
pub const AXON_POLICY_LIVELINESS_LEASE: u32 = 5;

impl axon_qos_t {
    pub(super) fn request(&self) -> Result<QosRequest, CallFailure> {
        let wrong = |policy: &str, value: u32| {
            Err(CallFailure::argument(format_args!("there is no {policy} {value}")))
        };
        let (default, best) = (Choice::SystemDefault, Choice::BestAvailable);
        let reliability = match self.reliability {
            AXON_CHOICE_DEFAULT => default,
            AXON_CHOICE_BEST_AVAILABLE => best,
            AXON_RELIABILITY_RELIABLE => Choice::Exactly(Reliability::Reliable),
            AXON_RELIABILITY_BEST_EFFORT => Choice::Exactly(Reliability::BestEffort),
            other => return wrong("reliability", other),
        };
        let (default, best) = (Choice::SystemDefault, Choice::BestAvailable);
        let durability = match self.durability {
            AXON_CHOICE_DEFAULT => default,
            AXON_CHOICE_BEST_AVAILABLE => best,
            AXON_DURABILITY_TRANSIENT_LOCAL => Choice::Exactly(Durability::TransientLocal),
            AXON_DURABILITY_VOLATILE => Choice::Exactly(Durability::Volatile),
            other => return wrong("durability", other),
        };
        let (default, best) = (Choice::SystemDefault, Choice::BestAvailable);
        let liveliness = match self.liveliness {
            AXON_CHOICE_DEFAULT => default,
            AXON_CHOICE_BEST_AVAILABLE => best,
            AXON_LIVELINESS_AUTOMATIC => Choice::Exactly(Liveliness::Automatic),
            AXON_LIVELINESS_MANUAL_BY_TOPIC => Choice::Exactly(Liveliness::ManualByTopic),
            other => return wrong("liveliness", other),
        };
        let history = match self.history {
            AXON_CHOICE_DEFAULT => None,
            AXON_HISTORY_KEEP_LAST => Some(History::KeepLast),
            AXON_HISTORY_KEEP_ALL => Some(History::KeepAll),
            other => return wrong("history", other),
        };
        let lifespan = match self.lifespan {
            AXON_DURATION_DEFAULT | AXON_DURATION_INFINITE => None,
            AXON_DURATION_BEST_AVAILABLE => {
                return Err(CallFailure::argument("there is no best available lifespan"));
            }
            nanoseconds => Some(Duration::from_nanos(nanoseconds)),
        };
        let period = |period: u64| match period {
            AXON_DURATION_DEFAULT => Choice::SystemDefault,
            AXON_DURATION_BEST_AVAILABLE => Choice::BestAvailable,
            AXON_DURATION_INFINITE => Choice::Exactly(None),
            nanoseconds => Choice::Exactly(Some(Duration::from_nanos(nanoseconds))),
        };
        let (deadline, lease, depth) = (period(self.deadline), period(self.lease), self.depth);
        let mut request = QosRequest::default();
        request.reliability = reliability;
        request.durability = durability;
        request.history = history;
        request.depth = depth;
        request.deadline = deadline;
        request.lifespan = lifespan;
        request.liveliness = liveliness;
        request.lease = lease;
        Ok(request)
    }
}

impl From<&Qos> for axon_qos_t {
    fn from(qos: &Qos) -> Self {
        let period = |period: Option<Duration>| period.map_or(AXON_DURATION_INFINITE, nanoseconds);
        Self {
            reliability: match qos.reliability {
                Reliability::Reliable => AXON_RELIABILITY_RELIABLE,
                Reliability::BestEffort => AXON_RELIABILITY_BEST_EFFORT,
            },
            durability: match qos.durability {
                Durability::TransientLocal => AXON_DURABILITY_TRANSIENT_LOCAL,
                Durability::Volatile => AXON_DURABILITY_VOLATILE,
            },
            history: match qos.history {
                History::KeepLast => AXON_HISTORY_KEEP_LAST,
                History::KeepAll => AXON_HISTORY_KEEP_ALL,
            },
            depth: qos.depth,
            liveliness: match qos.liveliness {
                Liveliness::Automatic => AXON_LIVELINESS_AUTOMATIC,
                Liveliness::ManualByTopic => AXON_LIVELINESS_MANUAL_BY_TOPIC,
            },
            reserved: 0,
            deadline: period(qos.deadline),
            lifespan: period(qos.lifespan),
            lease: period(qos.lease),
        }
    }
}

pub(super) fn policy(incompatible: Option<Incompatible>) -> u32 {
    match incompatible {
        None => AXON_POLICY_NONE,
        Some(Incompatible::Reliability) => AXON_POLICY_RELIABILITY,
        Some(Incompatible::Durability) => AXON_POLICY_DURABILITY,
        Some(Incompatible::Deadline) => AXON_POLICY_DEADLINE,
        Some(Incompatible::Liveliness) => AXON_POLICY_LIVELINESS,
        Some(Incompatible::LivelinessLease) => AXON_POLICY_LIVELINESS_LEASE,
        // The test below fails if another policy is added.
        Some(_) => AXON_POLICY_NONE,
    }
}

/// Checks whether a publisher that offers one profile matches a subscription that requests the other. The
/// result, AXON_QOS_*, is stored at `verdict`. The reason for a result other than AXON_QOS_COMPATIBLE is
/// stored at `reason` as text, cut to `reason_size` bytes with the 0 at its end. Null and 0 mean that no
/// reason is wanted.
///
/// # Safety
/// `offered` and `requested` point to one profile each. `verdict` points to room for a number, and `reason`
/// to room for `reason_size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_qos_check(
    offered: *const axon_qos_t,
    requested: *const axon_qos_t,
    verdict: *mut u32,
    reason: *mut c_char,
    reason_size: usize,
) -> axon_ret_t {
    guarded(|| {
        present(verdict, "the place of the verdict")?;
        // SAFETY: guaranteed by the caller.
        let offered = unsafe { value(offered, "the profile that is offered") }?.request()?;
        // SAFETY: guaranteed by the caller.
        let requested = unsafe { value(requested, "the profile that is requested") }?.request()?;
        // SAFETY: guaranteed by the caller.
        let room = unsafe { elements_mut(reason.cast(), reason_size, "the reason") }?;
        let (found, policies) = match check(&offered, &requested) {
            Compatibility::Compatible => (AXON_QOS_COMPATIBLE, Vec::new()),
            Compatibility::Unknown(policies) => (AXON_QOS_UNKNOWN, policies),
            Compatibility::Incompatible(policies) => (AXON_QOS_INCOMPATIBLE, policies),
        };
        let reasons: Vec<String> = policies
            .iter()
            .map(|policy| {
                let may = if found == AXON_QOS_UNKNOWN { "it may be that " } else { "" };
                format!("{policy}: {may}{}", policy.reason())
            })
            .collect();
        write_text(room, &reasons.join("; "));
        // SAFETY: guaranteed by the caller.
        unsafe { store(verdict, found, "the place of the verdict") }
    })
}

/// Returns the name of a policy as ROS 2 spells it, for instance `RELIABILITY`; null if no policy has that
/// number. The string is static.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_policy_name(policy: u32) -> *const c_char {
    match policy {
        AXON_POLICY_RELIABILITY => c"RELIABILITY".as_ptr(),
        AXON_POLICY_DURABILITY => c"DURABILITY".as_ptr(),
        AXON_POLICY_DEADLINE => c"DEADLINE".as_ptr(),
        AXON_POLICY_LIVELINESS => c"LIVELINESS".as_ptr(),
        AXON_POLICY_LIVELINESS_LEASE => c"LIVELINESS_LEASE_DURATION".as_ptr(),
        _ => std::ptr::null(),
    }
}

/// Stores an endpoint's profile at `out` unless `out` is null.
///
/// # Safety
/// `out` is null or points to room for a profile.
pub(super) unsafe fn store_qos(out: *mut axon_qos_t, qos: &Qos) -> Result<(), CallFailure> {
    // SAFETY: guaranteed by the caller.
    unsafe { store_if_wanted(out, axon_qos_t::from(qos)) }
}

/// Writes `text` with a 0 at its end, cut to fit `room` between two characters.
fn write_text(room: &mut [MaybeUninit<u8>], text: &str) {
    let Some(most) = room.len().checked_sub(1) else { return };
    let mut len = text.len().min(most);
    while !text.is_char_boundary(len) {
        len -= 1;
    }
    for (to, from) in room.iter_mut().zip(text.as_bytes()[..len].iter().chain(&[0])) {
        to.write(*from);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_policy_has_its_number() {
        let numbers = Incompatible::ALL.map(|which| policy(Some(which)));
        assert_eq!(numbers, [1, 2, 3, 4, 5]);
    }
}
