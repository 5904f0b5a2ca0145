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

/// Creates a client in a node. `topic` in the options is the service's name. A KEEP_LAST client keeps the
/// newest untaken responses of each server, as many as its depth; a KEEP_ALL client keeps all. When the call
/// returns, the client is matched with the servers in the graph, unless that takes longer than 50 ms or many
/// endpoints are created in a row.
///
/// Returns the same codes as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to valid data. `client` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    client: *mut axon_client_t,
) -> axon_ret_t {
    guarded(|| {
        present(client, "the place of the client")?;
        let node = named(node)?;
        // SAFETY: guaranteed by the caller. Both ends of a service get the same profile.
        let (spec, _) = unsafe { spec(options) }?;
        let created = node.create_client(spec)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, client) }
    })
}

/// Destroys a client. When the call returns, the client's callback has returned and is not called again.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_client_destroy(client: axon_client_t) -> axon_ret_t {
    guarded(|| end(client))
}

/// Stores the client's GID, and its profile for requests and responses. A null pointer skips its value.
///
/// # Safety
/// `gid` and `qos` are null or point to room for their value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_describe(
    client: axon_client_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { describe(client, gid, qos) })
}

/// Counts the servers that receive a request sent now and whose responses reach the client. The service is
/// available if there is at least one.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_matched(
    client: axon_client_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { matched(client, count) })
}

/// Blocks until the service is available, for at most `timeout` nanoseconds (negative: without end).
/// AXON_RET_TIMEOUT: the service did not become available.
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

/// Sends a request to every matched server. Copies the `len` bytes at `data`. Stores the request's number,
/// which starts at 1, at `sequence`, which may be null. Without a server no response will arrive.
///
/// May block for 100 ms if a server does not take its requests. AXON_RET_TIMEOUT: the server made no room.
/// All other results are those of `axon_session_publisher_publish`.
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
        // SAFETY: guaranteed by the caller.
        let payload = unsafe { elements(data, len, "the request") }?;
        let sent = client.send_request(payload);
        let number = sent.map_err(|e| CallFailure::from(e).of_endpoint(client.endpoint()))?;
        // SAFETY: guaranteed by the caller.
        unsafe { store_if_wanted(sequence, number) }
    })
}

/// Copies the next response to the memory that `room` returns, as `axon_session_subscription_take` does. The
/// publication's number in `info` is the number of the request.
///
/// # Safety
/// As for `axon_session_subscription_take`.
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
        // SAFETY: guaranteed by the caller.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| client.take_response_sample(), client.endpoint())
    })
}

/// Takes the next response in place, as `axon_session_subscription_take_sample` does.
///
/// # Safety
/// As for `axon_session_subscription_take_sample`.
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
        // SAFETY: guaranteed by the caller.
        unsafe { to.put(|| client.take_response_sample(), client.endpoint()) }
    })
}

/// Sets the callback for new responses, as `axon_session_subscription_set_callback` does.
///
/// # Safety
/// As for `axon_session_subscription_set_callback`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_client_set_callback(
    client: axon_client_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| set_callback(client, callback, user))
}
