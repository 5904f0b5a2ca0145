//! The C functions of publishers.

use super::endpoint::{axon_endpoint_options_t, axon_gid_t, describe, matched, spec};
use crate::{
    ffi::{
        error::{CallFailure, axon_ret_t},
        guarded,
        handles::{axon_node_t, axon_publisher_t, give, named, revoke},
        memory::{elements, present, present_if_wanted, store, store_if_wanted},
        qos::axon_qos_t,
        wait::duration,
    },
    graph::EndpointKind,
    qos::Qos,
    session::from_unix_nanos,
};

/// A source timestamp that means the time of the call.
pub const AXON_TIME_NOW: i64 = i64::MIN;

/// Converts a source timestamp of the caller; `None` is now.
pub(super) fn time(timestamp: i64) -> Option<i64> {
    (timestamp != AXON_TIME_NOW).then_some(timestamp)
}

/// Creates a publisher in a node. When the call returns, the publisher is matched with the subscriptions in
/// the graph, unless that takes longer than 50 ms, or new endpoints of the session waited for 100 ms lately: from
/// then on they wait for a tenth of the time.
///
/// AXON_RET_INVALID_ARGUMENT: a name, the hash or a policy is out of bounds. AXON_RET_BAD_ALLOC: shared
/// memory is short. AXON_RET_DENIED: the session's permissions do not allow the endpoint.
///
/// # Safety
/// `options` points to options whose pointers point to valid data. `publisher` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    publisher: *mut axon_publisher_t,
) -> axon_ret_t {
    guarded(|| {
        present(publisher, "the place of the publisher")?;
        let node = named(node)?;
        // SAFETY: guaranteed by the caller.
        let (mut spec, request) = unsafe { spec(options) }?;
        let graph = node.session().graph();
        let others = graph.endpoints_of(EndpointKind::Subscription, &spec.topic);
        let others: Vec<Qos> = others.iter().map(|entry| entry.endpoint.qos).collect();
        spec.qos = request.for_publisher(&others);
        let created = node.create_publisher(spec)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, publisher) }
    })
}

/// Destroys a publisher. Subscriptions can still take its remaining samples. Its loans can then only be
/// abandoned.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_publisher_destroy(publisher: axon_publisher_t) -> axon_ret_t {
    guarded(|| revoke(publisher).map(drop))
}

/// Stores the publisher's GID and profile. A null pointer skips its value.
///
/// # Safety
/// `gid` and `qos` are null or point to room for their value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_describe(
    publisher: axon_publisher_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { describe(publisher, gid, qos) })
}

/// Publishes a sample. Copies the `len` bytes at `data`. `source_timestamp` is in nanoseconds since the Unix
/// epoch, or AXON_TIME_NOW. Stores the sample's sequence number, which starts at 1, at `sequence`, which may
/// be null.
///
/// The call may block for up to 100 ms if the publisher and a subscription are both RELIABLE and KEEP_ALL and
/// the subscription has no room. It never blocks otherwise. AXON_RET_TIMEOUT: the subscription's history
/// stayed full. AXON_RET_BAD_ALLOC: memory is short, or loans and subscriptions hold all memory of the
/// publisher. AXON_RET_INVALID_ARGUMENT: the sample is longer than `AXON_MAX_MESSAGE_MB` allows. A refused
/// sample gets no sequence number, so no subscription counts it as lost.
///
/// # Safety
/// `data` points to `len` bytes, or is null and `len` 0; `sequence` is null or points to room for a
/// number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_publish(
    publisher: axon_publisher_t,
    data: *const u8,
    len: usize,
    source_timestamp: i64,
    sequence: *mut u64,
) -> axon_ret_t {
    guarded(|| {
        present_if_wanted(sequence)?;
        let publisher = named(publisher)?;
        // SAFETY: guaranteed by the caller.
        let payload = unsafe { elements(data, len, "the sample") }?;
        let published = match time(source_timestamp) {
            Some(time) => publisher.publish_at(from_unix_nanos(time), payload),
            None => publisher.publish(payload),
        };
        let number =
            published.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))?;
        // SAFETY: guaranteed by the caller.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// Skips a sample that no subscription would read, now or later: uses up the next sequence number and stores
/// it at `sequence`. Stores 0 if a subscription would read the sample. Publishing without readers has the
/// same effect, but this call saves the caller the work of serializing first.
///
/// # Safety
/// `sequence` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_skip_unread(
    publisher: axon_publisher_t,
    sequence: *mut u64,
) -> axon_ret_t {
    guarded(|| {
        present(sequence, "the place of the number")?;
        let publisher = named(publisher)?;
        let skipped = publisher.skip_unread();
        let skipped =
            skipped.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))?;
        // SAFETY: guaranteed by the caller.
        unsafe { store(sequence, skipped.unwrap_or(0), "the place of the number") }
    })
}

/// Counts the subscriptions on this and other hosts that receive from the publisher.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_matched(
    publisher: axon_publisher_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { matched(publisher, count) })
}

/// Blocks until at least `count` subscriptions receive from the publisher, for at most `timeout` nanoseconds
/// (negative: without end). AXON_RET_TIMEOUT: fewer subscriptions do.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_publisher_wait_matched(
    publisher: axon_publisher_t,
    count: usize,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let publisher = named(publisher)?;
        if publisher.wait_matched(count, duration(timeout)) {
            return Ok(());
        }
        let text = format_args!("fewer than {count} subscriptions receive from it");
        Err(CallFailure::timeout(text).of_endpoint(publisher.endpoint()))
    })
}

/// Blocks until every sample published so far is acknowledged, for at most `timeout` nanoseconds (negative:
/// without end). AXON_RET_TIMEOUT: a sample is not acknowledged.
///
/// A sample is acknowledged at once between processes of this host that share memory. If they share none
/// (AXON_SHM), this host's daemon carries the sample. If both the publisher and the subscription are RELIABLE
/// and KEEP_ALL, it is acknowledged when the other process has it. Otherwise it is acknowledged when the
/// daemon has it.
///
/// The meaning for another host depends on the QoS of publisher and subscription:
///
/// - Both RELIABLE and KEEP_ALL: that host has the sample.
/// - Both RELIABLE, one of them KEEP_LAST: that host has the newest samples, as many as the smaller depth, or
///   newer ones. Older samples may be missing.
/// - One of them BEST_EFFORT: the sample was sent or dropped.
///
/// AXON_RET_TIMEOUT comes at once, and once, if samples were given up since the last call: because a link or
/// this host's daemon failed, a host stopped reading, or a limit dropped them.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_publisher_wait_acknowledged(
    publisher: axon_publisher_t,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let publisher = named(publisher)?;
        if publisher.wait_acknowledged(duration(timeout)) {
            return Ok(());
        }
        Err(CallFailure::timeout("a sample is not acknowledged").of_endpoint(publisher.endpoint()))
    })
}

/// Asserts that the publisher is alive. With MANUAL_BY_TOPIC liveliness, every publication asserts it, too.
/// With AUTOMATIC liveliness, the session asserts it.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_publisher_assert_liveliness(
    publisher: axon_publisher_t,
) -> axon_ret_t {
    guarded(|| {
        let publisher = named(publisher)?;
        let asserted = publisher.assert_liveliness();
        asserted.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))
    })
}
