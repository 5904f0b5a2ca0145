//! Servers: the responding end of a service.

use std::ffi::c_void;

use super::{
    endpoint::{axon_endpoint_options_t, axon_gid_t, describe, end, matched, set_callback, spec},
    subscription::{CopyTarget, SampleInPlace, axon_message_info_t, axon_room_t},
};
use crate::{
    ffi::{
        callback::axon_callback_t,
        error::{CallFailure, axon_ret_t},
        guarded,
        handles::{axon_node_t, axon_sample_t, axon_server_t, give, named},
        memory::{elements, present, value},
        qos::axon_qos_t,
    },
    ids::Gid,
};

/// A server of a node: `topic` in the options is the service's name. Of requests that were not taken
/// a KEEP_LAST server keeps the newest of each client, as many as its depth, and a KEEP_ALL one all.
/// What is kept is never dropped to make room. When it returns, the server is matched with those
/// clients that the graph shows, unless they take longer than 50 ms.
///
/// Returns as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to what they say; `server` points to room for a
/// handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    server: *mut axon_server_t,
) -> axon_ret_t {
    guarded(|| {
        present(server, "the place of the server")?;
        let node = named(node)?;
        // SAFETY: the caller's word. Both ends of a service are created alike.
        let (spec, _) = unsafe { spec(options) }?;
        let created = node.create_server(spec)?;
        // SAFETY: the caller's word.
        unsafe { give(created, server) }
    })
}

/// Ends a server. Its callback has returned, and is not called any more, when this returns.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_server_destroy(server: axon_server_t) -> axon_ret_t {
    guarded(|| end(server))
}

/// What the server is: its GID, and the profile that it has for requests and for responses. Null
/// where one is not wanted.
///
/// # Safety
/// `gid` and `qos` are null or point to room for one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_describe(
    server: axon_server_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { describe(server, gid, qos) })
}

/// How many clients reach the server, and are reached by it.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_matched(
    server: axon_server_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: the caller's word.
    guarded(|| unsafe { matched(server, count) })
}

/// Copies the next request to where `room` says, as `axon_session_subscription_take`. The sender and
/// the publication's number in `info` are what the response must carry.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_take(
    server: axon_server_t,
    room: axon_room_t,
    user: *mut c_void,
    info: *mut axon_message_info_t,
    taken: *mut u8,
) -> axon_ret_t {
    guarded(|| {
        let server = named(server)?;
        // SAFETY: the caller's word.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| server.take_request_sample(), server.endpoint())
    })
}

/// Takes the next request in place, as `axon_session_subscription_take_sample`.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_take_sample(
    server: axon_server_t,
    sample: *mut axon_sample_t,
    data: *mut *const u8,
    len: *mut usize,
    info: *mut axon_message_info_t,
) -> axon_ret_t {
    guarded(|| {
        let server = named(server)?;
        let to = SampleInPlace { sample, data, len, info };
        // SAFETY: the caller's word.
        unsafe { to.put(|| server.take_request_sample(), server.endpoint()) }
    })
}

/// Answers request `sequence` of `client` with `len` bytes at `data`, which are copied. Nobody else
/// receives it. A client that is gone is no error.
///
/// May block for 100 ms where the client does not take its responses: AXON_RET_TIMEOUT when it made no
/// room. The rest is as for `axon_session_publisher_publish`.
///
/// # Safety
/// `client` points to a GID; `data` points to `len` bytes, or is null and `len` 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_respond(
    server: axon_server_t,
    client: *const axon_gid_t,
    sequence: u64,
    data: *const u8,
    len: usize,
) -> axon_ret_t {
    guarded(|| {
        let server = named(server)?;
        // SAFETY: the caller's word.
        let client = unsafe { value(client, "the client's GID") }?;
        // SAFETY: the caller's word.
        let payload = unsafe { elements(data, len, "the response") }?;
        let sent = server.send_response(Gid(client.bytes), sequence, payload);
        sent.map_err(|e| CallFailure::from(e).of_endpoint(server.endpoint()))
    })
}

/// Has `callback` told of new requests, as `axon_session_subscription_set_callback`.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_set_callback(
    server: axon_server_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| set_callback(server, callback, user))
}
