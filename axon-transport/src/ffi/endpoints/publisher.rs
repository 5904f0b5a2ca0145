//! Publishers.

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

/// The time at which the call is made, as a sample's source timestamp.
pub const AXON_TIME_NOW: i64 = i64::MIN;

/// A point in time of the caller's; `None` is now.
pub(super) fn time(timestamp: i64) -> Option<i64> {
    (timestamp != AXON_TIME_NOW).then_some(timestamp)
}

/// A publisher of a node. When it returns, the publisher is matched with those subscriptions that the
/// graph shows, unless they take longer than 50 ms.
///
/// AXON_RET_INVALID_ARGUMENT: a name, the hash or a policy is out of bounds. AXON_RET_BAD_ALLOC: shared
/// memory is short. AXON_RET_DENIED: the session's permissions do not allow it.
///
/// # Safety
/// `options` points to options whose pointers point to what they say; `publisher` points to room for
/// a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    publisher: *mut axon_publisher_t,
) -> axon_ret_t {
    guarded(|| {
        present(publisher, "the place of the publisher")?;
        let node = named(node)?;
        // SAFETY: the caller's word.
        let (mut spec, request) = unsafe { spec(options) }?;
        let graph = node.session().graph();
        let others = graph.endpoints_of(EndpointKind::Subscription, &spec.topic);
        let others: Vec<Qos> = others.iter().map(|entry| entry.endpoint.qos).collect();
        spec.qos = request.for_publisher(&others);
        let created = node.create_publisher(spec)?;
        // SAFETY: the caller's word.
        unsafe { give(created, publisher) }
    })
}

/// Ends a publisher. Subscriptions still take what it left. What it lent can only be abandoned then.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_publisher_destroy(publisher: axon_publisher_t) -> axon_ret_t {
    guarded(|| revoke(publisher).map(drop))
}

/// What the publisher is: its GID, and the profile that it has. Null where one is not wanted.
///
/// # Safety
/// `gid` and `qos` are null or point to room for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_describe(
    publisher: axon_publisher_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { describe(publisher, gid, qos) })
}

/// Publishes a sample of `len` bytes at `data`, which are copied. `source_timestamp` is in
/// nanoseconds since the Unix epoch, or AXON_TIME_NOW. Its sequence number, from 1, is stored at
/// `sequence`, which may be null.
///
/// Where the publisher and a subscription are both RELIABLE and KEEP_ALL, it may block for 100 ms until
/// the subscription makes room: AXON_RET_TIMEOUT where its history stayed full, AXON_RET_BAD_ALLOC where
/// memory stayed short. Never else. AXON_RET_BAD_ALLOC: memory is short, or what loans and subscriptions
/// hold fills that of the publisher. AXON_RET_INVALID_ARGUMENT: the sample is longer than
/// `AXON_MAX_MESSAGE_MB` allows. A sample that was refused has no number: nobody counts it lost.
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
        // SAFETY: the caller's word.
        let payload = unsafe { elements(data, len, "the sample") }?;
        let published = match time(source_timestamp) {
            Some(time) => publisher.publish_at(from_unix_nanos(time), payload),
            None => publisher.publish(payload),
        };
        let number =
            published.map_err(|e| CallFailure::from(e).of_endpoint(publisher.endpoint()))?;
        // SAFETY: the caller's word.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// If a sample would be read by nobody, now or later, uses up the next sequence number and stores it
/// at `sequence`; stores 0 where somebody would. Publishing does the same where nobody reads, but
/// a caller that has to serialize first can save the work.
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
        // SAFETY: the caller's word.
        unsafe { store(sequence, skipped.unwrap_or(0), "the place of the number") }
    })
}

/// How many subscriptions receive from the publisher, on this host and on others.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_publisher_matched(
    publisher: axon_publisher_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { matched(publisher, count) })
}

/// Blocks until at least `count` subscriptions receive from the publisher, for at most `timeout`
/// nanoseconds (negative: for ever): AXON_RET_TIMEOUT where they do not.
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

/// Blocks until every sample published so far is acknowledged, for at most `timeout` nanoseconds
/// (negative: for ever): AXON_RET_TIMEOUT where one is not. Between processes of this host that share
/// memory a sample is acknowledged at once. Where they share none (AXON_SHM), this host's daemon carries it:
/// a sample of a RELIABLE and KEEP_ALL publisher for a subscription like it is acknowledged when the other
/// process has it, any other when the daemon has it. For another host it depends on the QoS of publisher and
/// subscription. Both RELIABLE and KEEP_ALL: that host has the sample. Both RELIABLE, one of them KEEP_LAST:
/// that host has the newest samples, as many as the depth (the smaller one), or newer ones; older ones may be
/// missing. One of them BEST_EFFORT: the sample was sent or dropped. AXON_RET_TIMEOUT comes at once, and
/// once, when samples were given up since the last call: with a link, or with this host's daemon, for a host
/// that read nothing, or by a limit.
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

/// Says that the publisher is alive. Where its liveliness is MANUAL_BY_TOPIC, so does every
/// publication; where it is AUTOMATIC, its session says so.
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
