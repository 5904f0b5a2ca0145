//! Subscriptions, and the samples that they take.

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

/// What is known of a message besides its bytes. Times are nanoseconds since the Unix epoch.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_message_info_t {
    /// Who sent it: a publisher, a client of a request, or a server of a response.
    pub sender: axon_gid_t,
    /// The publication's number, from 1; of a response, that of the request that it answers.
    pub publication_sequence: u64,
    /// Its number among the messages that this endpoint has taken, from 1.
    pub reception_sequence: u64,
    /// When it was sent, by the sender's clock.
    pub source_timestamp: i64,
    /// When it was taken, by this host's clock.
    pub received_timestamp: i64,
    /// 1 where the sender is an endpoint of the same session, else 0.
    pub own_session: u8,
    /// 0.
    pub reserved: [u8; 7],
}

/// Says where a message of `len` bytes is to be put: room for as many, or null where there is none.
/// It runs in the call that takes the message, and must not take one of the same endpoint itself.
pub type axon_room_t = Option<unsafe extern "C" fn(user: *mut c_void, len: usize) -> *mut u8>;

/// A subscription of a node. When it returns, the subscription is matched with those publishers that
/// the graph shows, unless they take longer than 50 ms. There are no content filters.
///
/// Returns as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to what they say; `subscription` points to room
/// for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    subscription: *mut axon_subscription_t,
) -> axon_ret_t {
    guarded(|| {
        present(subscription, "the place of the subscription")?;
        let node = named(node)?;
        // SAFETY: the caller's word.
        let (mut spec, request) = unsafe { spec(options) }?;
        let graph = node.session().graph();
        let others = graph.endpoints_of(EndpointKind::Publisher, &spec.topic);
        let others: Vec<Qos> = others.iter().map(|entry| entry.endpoint.qos).collect();
        spec.qos = request.for_subscription(&others);
        let created = node.create_subscription(spec)?;
        // SAFETY: the caller's word.
        unsafe { give(created, subscription) }
    })
}

/// Ends a subscription. Samples that were taken in place stay until they are released. Its callback
/// has returned, and is not called any more, when this returns.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_subscription_destroy(
    subscription: axon_subscription_t,
) -> axon_ret_t {
    guarded(|| end(subscription))
}

/// What the subscription is: its GID, and the profile that it has. Null where one is not wanted.
///
/// # Safety
/// `gid` and `qos` are null or point to room for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_describe(
    subscription: axon_subscription_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { describe(subscription, gid, qos) })
}

/// How many publishers the subscription receives from, on this host and on others.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_subscription_matched(
    subscription: axon_subscription_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { matched(subscription, count) })
}

/// Blocks until the subscription receives from at least `count` publishers, for at most `timeout`
/// nanoseconds (negative: for ever): AXON_RET_TIMEOUT where it does not.
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

/// Copies the oldest sample, by source timestamp among all publishers, to where `room` says, and
/// stores what is known of it at `info`, which may be null. `taken` is 0 where there was none, and
/// then `room` is not called. A publisher whose sample is in memory that this process has not been told
/// of yet, such as its first one of more than 4 KiB, holds up none of the others.
///
/// AXON_RET_BAD_ALLOC: `room` gave none; the sample is gone.
///
/// # Safety
/// `room` gives null, or room for as many bytes as it is asked for; `info` is null or points to room
/// for one; `taken` points to room for a number.
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
        // SAFETY: the caller's word.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| subscription.take_sample(), subscription.endpoint())
    })
}

/// Takes the oldest sample, by source timestamp among all publishers, in place: `len` bytes at `data`,
/// which stand until `axon_session_sample_release`. What was lent is aligned as it was, a copy as
/// the allocator does it (to 8 at least, but for one of 0 bytes, of which `data` is any address), and what a
/// publisher wrote that does not keep to the protocol anyhow. One of more than 4 KiB, and a loan of more
/// than 512 bytes whose publisher expects so many, is in the publisher's memory, of which a subscription
/// can keep five for each publisher; a sixth is copied.
/// Where there is none the handle is 0, and nothing else is stored.
///
/// Nobody may write to the bytes, and a forked child may not read them. Such a publisher, in another
/// process, could change them meanwhile: a parser reads each byte once, and checks what it read.
/// `AXON_SHM_COPY=1` has all of them copied.
///
/// # Safety
/// `sample`, `data` and `len` point to room for one each; `info` is null or does.
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
        // SAFETY: the caller's word.
        unsafe { to.put(|| subscription.take_sample(), subscription.endpoint()) }
    })
}

/// Gives a sample that was taken in place back: of a subscription, a server or a client. It may be
/// released after these have ended.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_sample_release(sample: axon_sample_t) -> axon_ret_t {
    guarded(|| revoke(sample).map(drop))
}

/// Samples of the subscription that were lost: overwritten before they were taken, or lost on their
/// way from another host.
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
        // SAFETY: the caller's word.
        unsafe { store(lost, count, "the place of the number") }
    })
}

/// Has `callback` told of new samples from now on, in place of the one before, which has returned and
/// is not called any more when this returns, unless this is called from within it. Null: nobody is
/// told. What is there to be taken, and nobody was told of, it is told at once, in this call; the rest on
/// the session's thread.
///
/// AXON_RET_ERROR: an event loop of the program's listens already.
///
/// # Safety
/// `callback` may be called with `user` from any thread until it is replaced or the subscription is
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

/// Where a message is to be copied.
pub(super) struct CopyTarget {
    room: unsafe extern "C" fn(user: *mut c_void, len: usize) -> *mut u8,
    user: *mut c_void,
    info: *mut axon_message_info_t,
    taken: *mut u8,
}

impl CopyTarget {
    /// # Safety
    /// As [`axon_session_subscription_take`] says, for as long as it stands.
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

    /// Copies what was taken there.
    pub(super) fn put(
        self,
        take: impl FnOnce() -> Option<(MessageInfo, Sample)>,
        endpoint: &Endpoint,
    ) -> Result<(), CallFailure> {
        let message = take();
        let found = message.is_some();
        if let Some((info, sample)) = message {
            let len = sample.len();
            // SAFETY: the caller of `new` says that it may be called so.
            let at = unsafe { (self.room)(self.user, len) };
            if at.is_null() && len > 0 {
                let text = format_args!("no room for a message of {len} bytes, which is lost");
                return Err(CallFailure::new(AXON_RET_BAD_ALLOC, text).of_endpoint(endpoint));
            }
            if len > 0 {
                let at = at.cast::<MaybeUninit<u8>>();
                // SAFETY: not null, and room for as many bytes, by the word of the caller of `new`. What
                // is in it does not matter.
                sample.write_to(unsafe { slice::from_raw_parts_mut(at, len) });
            }
            // SAFETY: as it was checked in `new`, and by its caller's word.
            unsafe { store_if_wanted(self.info, axon_message_info_t::new(&info, endpoint)) }?;
        }
        // SAFETY: as above.
        unsafe { store(self.taken, u8::from(found), "the place of the answer") }
    }
}

/// Where one goes that is taken in place.
pub(super) struct SampleInPlace {
    pub(super) sample: *mut axon_sample_t,
    pub(super) data: *mut *const u8,
    pub(super) len: *mut usize,
    pub(super) info: *mut axon_message_info_t,
}

impl SampleInPlace {
    /// # Safety
    /// The places are as [`axon_session_subscription_take_sample`] says.
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
            // SAFETY: the caller's word.
            return unsafe { store(self.sample, axon_sample_t { id: 0 }, "the place") };
        };
        let (at, len) = (sample.as_ptr(), sample.len());
        // The bytes stay where they are when the sample moves to its place in the table.
        // SAFETY: the caller's word.
        unsafe { give(sample, self.sample) }?;
        // SAFETY: the caller's word.
        unsafe { store(self.data, at, "the place of the pointer") }?;
        // SAFETY: the caller's word.
        unsafe { store(self.len, len, "the place of the length") }?;
        // SAFETY: the caller's word.
        unsafe { store_if_wanted(self.info, axon_message_info_t::new(&info, endpoint)) }
    }
}
