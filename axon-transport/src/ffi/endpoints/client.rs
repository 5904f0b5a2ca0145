//! Clients: the requesting end of a service.

use std::ffi::c_void;

use super::{
    endpoint::{axon_endpoint_options_t, axon_gid_t, describe, end, matched, set_callback, spec},
    subscription::{CopyTarget, SampleInPlace, axon_message_info_t, axon_room_t},
};
use crate::ffi::{
    callback::axon_callback_t,
    error::{CallFailure, axon_ret_t},
    guarded,
    handles::{axon_client_t, axon_node_t, axon_sample_t, give, named},
    memory::{elements, present, present_if_wanted, store_if_wanted},
    qos::axon_qos_t,
    wait::duration,
};

/// A client of a node: `topic` in the options is the service's name. Of responses that were not taken
/// it keeps of each server what a server keeps of each client's requests. When it returns, the client
/// is matched with those servers that the graph shows, unless they take longer than 50 ms.
///
/// Returns as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to what they say; `client` points to room for a
/// handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    client: *mut axon_client_t,
) -> axon_ret_t {
    guarded(|| {
        present(client, "the place of the client")?;
        let node = named(node)?;
        // SAFETY: the caller's word. Both ends of a service are created alike.
        let (spec, _) = unsafe { spec(options) }?;
        let created = node.create_client(spec)?;
        // SAFETY: the caller's word.
        unsafe { give(created, client) }
    })
}

/// Ends a client. Its callback has returned, and is not called any more, when this returns.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_client_destroy(client: axon_client_t) -> axon_ret_t {
    guarded(|| end(client))
}

/// What the client is: its GID, and the profile that it has for requests and for responses. Null
/// where one is not wanted.
///
/// # Safety
/// `gid` and `qos` are null or point to room for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_describe(
    client: axon_client_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { describe(client, gid, qos) })
}

/// How many servers a request that is sent now reaches, and whose responses reach the client: the
/// service is available where there is one.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_matched(
    client: axon_client_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { matched(client, count) })
}

/// Blocks until the service is available, for at most `timeout` nanoseconds (negative: for ever):
/// AXON_RET_TIMEOUT where it is not.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_client_wait_available(
    client: axon_client_t,
    timeout: i64,
) -> axon_ret_t {
    guarded(|| {
        let client = named(client)?;
        if client.wait_available(duration(timeout)) {
            return Ok(());
        }
        Err(CallFailure::timeout("the service is not available").of_endpoint(client.endpoint()))
    })
}

/// Sends a request of `len` bytes at `data`, which are copied, to every server that is there, and
/// stores its number, from 1, at `sequence`, which may be null. Where there is no server, nobody will
/// answer.
///
/// May block for 100 ms where a server does not take its requests: AXON_RET_TIMEOUT when it made no
/// room. The rest is as for `axon_session_publisher_publish`.
///
/// # Safety
/// `data` points to `len` bytes, or is null and `len` 0; `sequence` is null or points to room for a
/// number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_request(
    client: axon_client_t,
    data: *const u8,
    len: usize,
    sequence: *mut u64,
) -> axon_ret_t {
    guarded(|| {
        present_if_wanted(sequence)?;
        let client = named(client)?;
        // SAFETY: the caller's word.
        let payload = unsafe { elements(data, len, "the request") }?;
        let sent = client.send_request(payload);
        let number = sent.map_err(|e| CallFailure::from(e).of_endpoint(client.endpoint()))?;
        // SAFETY: the caller's word.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// Copies the next response to where `room` says, as `axon_session_subscription_take`. The
/// publication's number in `info` is that of the request.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_take(
    client: axon_client_t,
    room: axon_room_t,
    user: *mut c_void,
    info: *mut axon_message_info_t,
    taken: *mut u8,
) -> axon_ret_t {
    guarded(|| {
        let client = named(client)?;
        // SAFETY: the caller's word.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| client.take_response_sample(), client.endpoint())
    })
}

/// Takes the next response in place, as `axon_session_subscription_take_sample`.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_take_sample(
    client: axon_client_t,
    sample: *mut axon_sample_t,
    data: *mut *const u8,
    len: *mut usize,
    info: *mut axon_message_info_t,
) -> axon_ret_t {
    guarded(|| {
        let client = named(client)?;
        let to = SampleInPlace { sample, data, len, info };
        // SAFETY: the caller's word.
        unsafe { to.put(|| client.take_response_sample(), client.endpoint()) }
    })
}

/// Has `callback` told of new responses, as `axon_session_subscription_set_callback`.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_set_callback(
    client: axon_client_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| set_callback(client, callback, user))
}
