//! The C functions of subscriptions and of the samples that they take.

use std::{ffi::c_void, mem::MaybeUninit, slice};

use axon_shm::Sample;

use super::endpoint::{
    axon_endpoint_options_t, axon_gid_t, describe, end, matched, set_callback, spec,
};
use crate::{
    ffi::{
        callback::axon_callback_t,
        error::{AXON_RET_BAD_ALLOC, CallFailure, axon_ret_t},
        guarded,
        handles::{axon_node_t, axon_sample_t, axon_subscription_t, give, named, revoke},
        memory::{present, present_if_wanted, store, store_if_wanted},
        qos::axon_qos_t,
        wait::duration,
    },
    graph::{Endpoint, EndpointKind},
    qos::Qos,
    session::{MessageInfo, unix_nanos},
};

/// The metadata of a message. Times are nanoseconds since the Unix epoch.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_message_info_t {
    /// The sender: a publisher, the client of a request, or the server of a response.
    pub sender: axon_gid_t,
    /// The publication's number, which starts at 1. A response has the number of its request.
    pub publication_sequence: u64,
    /// The message's number among the messages that this endpoint has taken, which starts at 1.
    pub reception_sequence: u64,
    /// The time of sending, by the sender's clock.
    pub source_timestamp: i64,
    /// The time of taking, by this host's clock.
    pub received_timestamp: i64,
    /// 1 if the sender is an endpoint of the same session, else 0.
    pub own_session: u8,
    /// 0.
    pub reserved: [u8; 7],
}

/// A function that returns memory for a message of `len` bytes, or null if there is none. The taking call
/// runs the function. The function must not take a message of the same endpoint.
pub type axon_room_t = Option<unsafe extern "C" fn(user: *mut c_void, len: usize) -> *mut u8>;

/// Creates a subscription in a node. When the call returns, the subscription is matched with the publishers
/// in the graph, unless that takes longer than 50 ms or many endpoints are created in a row. Content filters do
/// not exist.
///
/// Returns the same codes as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to valid data. `subscription` points to room for a
/// handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    subscription: *mut axon_subscription_t,
) -> axon_ret_t {
    guarded(|| {
        present(subscription, "the place of the subscription")?;
        let node = named(node)?;
        // SAFETY: guaranteed by the caller.
        let (mut spec, request) = unsafe { spec(options) }?;
        let graph = node.session().graph();
        let others = graph.endpoints_of(EndpointKind::Publisher, &spec.topic);
        let others: Vec<Qos> = others.iter().map(|entry| entry.endpoint.qos).collect();
        spec.qos = request.for_subscription(&others);
        let created = node.create_subscription(spec)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, subscription) }
    })
}

/// Destroys a subscription. Samples that were taken in place stay valid until they are released. When the
/// call returns, the subscription's callback has returned and is not called again.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_subscription_destroy(
    subscription: axon_subscription_t,
) -> axon_ret_t {
    guarded(|| end(subscription))
}

/// Stores the subscription's GID and profile. A null pointer skips its value.
///
/// # Safety
/// `gid` and `qos` are null or point to room for their value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_describe(
    subscription: axon_subscription_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { describe(subscription, gid, qos) })
}

/// Counts the publishers on this and other hosts that the subscription receives from.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_matched(
    subscription: axon_subscription_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { matched(subscription, count) })
}

/// Blocks until the subscription receives from at least `count` publishers, for at most `timeout` nanoseconds
/// (negative: without end). AXON_RET_TIMEOUT: it receives from fewer.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_subscription_wait_matched(
    subscription: axon_subscription_t,
    count: usize,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let subscription = named(subscription)?;
        if subscription.wait_matched(count, duration(timeout)) {
            return Ok(());
        }
        let text = format_args!("it receives from fewer than {count} publishers");
        Err(CallFailure::timeout(text).of_endpoint(subscription.endpoint()))
    })
}

/// Copies the oldest sample, by source timestamp among all publishers, to the memory that `room` returns.
/// Stores its metadata at `info`, which may be null. Stores 1 at `taken`, or 0 if there was no sample; then
/// `room` is not called. A publisher's sample may be in memory that this process has not received yet, for
/// instance the first sample of more than 4 KiB. Such a sample does not delay the samples of other
/// publishers.
///
/// AXON_RET_BAD_ALLOC: `room` returned no memory; the sample is lost.
///
/// # Safety
/// `room` returns null, or memory for as many bytes as it is asked for. `info` is null or points to room for
/// the metadata. `taken` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_take(
    subscription: axon_subscription_t,
    room: axon_room_t,
    user: *mut c_void,
    info: *mut axon_message_info_t,
    taken: *mut u8,
) -> axon_ret_t {
    guarded(|| {
        let subscription = named(subscription)?;
        // SAFETY: guaranteed by the caller.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| subscription.take_sample(), subscription.endpoint())
    })
}

/// Takes the oldest sample, by source timestamp among all publishers, in place. The `len` bytes at `data` are
/// valid until `axon_session_sample_release`. If there is no sample, the handle is 0 and nothing else is
/// stored.
///
/// A sample of more than 4 KiB is in the publisher's memory. So is a loan of more than 512 bytes if its
/// publisher expects samples of more than 512 bytes. A subscription can keep five such samples of each
/// publisher; a sixth is copied. A lent sample has the alignment of its loan. A copy has the alignment of the
/// allocator, at least 8; a copy of 0 bytes has any address. Samples of a publisher that violates the
/// protocol may have any alignment.
///
/// No code may write to the bytes, and a forked child may not read them. A publisher in another process that
/// violates the protocol could change the bytes meanwhile. Therefore a parser should read each byte once and
/// check the value that it read. `AXON_SHM_COPY=1` makes the library copy all samples.
///
/// # Safety
/// `sample`, `data` and `len` point to room for one value each. `info` is null or points to room for the
/// metadata.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_take_sample(
    subscription: axon_subscription_t,
    sample: *mut axon_sample_t,
    data: *mut *const u8,
    len: *mut usize,
    info: *mut axon_message_info_t,
) -> axon_ret_t {
    guarded(|| {
        let subscription = named(subscription)?;
        let to = SampleInPlace { sample, data, len, info };
        // SAFETY: guaranteed by the caller.
        unsafe { to.put(|| subscription.take_sample(), subscription.endpoint()) }
    })
}

/// Releases a sample that a subscription, a server or a client took in place. The release may come after the
/// end of that endpoint.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_sample_release(sample: axon_sample_t) -> axon_ret_t {
    guarded(|| revoke(sample).map(drop))
}

/// Stores the number of samples that the subscription lost: samples that were overwritten before they were
/// taken, or lost on the way from another host.
///
/// # Safety
/// `lost` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_lost(
    subscription: axon_subscription_t,
    lost: *mut u64,
) -> axon_ret_t {
    guarded(|| {
        let count = named(subscription)?.lost();
        // SAFETY: guaranteed by the caller.
        unsafe { store(lost, count, "the place of the number") }
    })
}

/// Sets the callback for new samples, which replaces the previous callback. When the call returns, the
/// previous callback has returned and is not called again, unless the call comes from inside that callback.
/// Null removes the callback. The call reports untaken samples at once that no callback was called for. The
/// session's thread reports later samples.
///
/// AXON_RET_ERROR: an event loop of the program already listens to the session.
///
/// # Safety
/// `callback` may be called with `user` from any thread until the callback is replaced or the subscription is
/// destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_set_callback(
    subscription: axon_subscription_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| set_callback(subscription, callback, user))
}

impl axon_message_info_t {
    fn new(info: &MessageInfo, endpoint: &Endpoint) -> Self {
        Self {
            sender: info.publisher.into(),
            publication_sequence: info.sequence,
            reception_sequence: info.reception,
            source_timestamp: unix_nanos(info.source_timestamp),
            received_timestamp: unix_nanos(info.received_timestamp),
            own_session: u8::from(info.publisher.is_of_session_of(&endpoint.gid)),
            reserved: [0; 7],
        }
    }
}

/// The destination of a message that is copied.
pub(super) struct CopyTarget {
    room: unsafe extern "C" fn(user: *mut c_void, len: usize) -> *mut u8,
    user: *mut c_void,
    info: *mut axon_message_info_t,
    taken: *mut u8,
}

impl CopyTarget {
    /// # Safety
    /// As for [`axon_session_subscription_take`], for as long as the value lives.
    pub(super) unsafe fn new(
        room: axon_room_t,
        user: *mut c_void,
        info: *mut axon_message_info_t,
        taken: *mut u8,
    ) -> Result<Self, CallFailure> {
        let room =
            room.ok_or_else(|| CallFailure::argument("the function that makes room is null"))?;
        present(taken, "the place of the answer")?;
        present_if_wanted(info)?;
        Ok(Self { room, user, info, taken })
    }

    /// Takes a message and copies it to the destination.
    pub(super) fn put(
        self,
        take: impl FnOnce() -> Option<(MessageInfo, Sample)>,
        endpoint: &Endpoint,
    ) -> Result<(), CallFailure> {
        let message = take();
        let found = message.is_some();
        if let Some((info, sample)) = message {
            let len = sample.len();
            // SAFETY: the caller of `new` allows this call.
            let at = unsafe { (self.room)(self.user, len) };
            if at.is_null() && len > 0 {
                let text = format_args!("no room for a message of {len} bytes, which is lost");
                return Err(CallFailure::new(AXON_RET_BAD_ALLOC, text).of_endpoint(endpoint));
            }
            if len > 0 {
                let at = at.cast::<MaybeUninit<u8>>();
                // SAFETY: not null, and room for that many bytes, as the caller of `new` guarantees. The old
                // content does not matter.
                sample.write_to(unsafe { slice::from_raw_parts_mut(at, len) });
            }
            // SAFETY: checked in `new`, and guaranteed by its caller.
            unsafe { store_if_wanted(self.info, axon_message_info_t::new(&info, endpoint)) }?;
        }
        // SAFETY: as above.
        unsafe { store(self.taken, u8::from(found), "the place of the answer") }
    }
}

/// The destination of a sample that is taken in place.
pub(super) struct SampleInPlace {
    pub(super) sample: *mut axon_sample_t,
    pub(super) data: *mut *const u8,
    pub(super) len: *mut usize,
    pub(super) info: *mut axon_message_info_t,
}

impl SampleInPlace {
    /// # Safety
    /// The pointers are as [`axon_session_subscription_take_sample`] requires.
    pub(super) unsafe fn put(
        self,
        take: impl FnOnce() -> Option<(MessageInfo, Sample)>,
        endpoint: &Endpoint,
    ) -> Result<(), CallFailure> {
        present(self.sample, "the place of the sample")?;
        present(self.data, "the place of the pointer")?;
        present(self.len, "the place of the length")?;
        present_if_wanted(self.info)?;
        let Some((info, sample)) = take() else {
            // SAFETY: guaranteed by the caller.
            return unsafe { store(self.sample, axon_sample_t { id: 0 }, "the place") };
        };
        let (at, len) = (sample.as_ptr(), sample.len());
        // The bytes stay where they are when the sample moves to its place in the table.
        // SAFETY: guaranteed by the caller.
        unsafe { give(sample, self.sample) }?;
        // SAFETY: guaranteed by the caller.
        unsafe { store(self.data, at, "the place of the pointer") }?;
        // SAFETY: guaranteed by the caller.
        unsafe { store(self.len, len, "the place of the length") }?;
        // SAFETY: guaranteed by the caller.
        unsafe { store_if_wanted(self.info, axon_message_info_t::new(&info, endpoint)) }
    }
}
