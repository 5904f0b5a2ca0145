//! Servers: the responding end of a service.

use std::ffi::c_void;

use super::{
    endpoint::{axon_endpoint_options_t, axon_gid_t, describe, end, matched, set_callback, spec},
    publisher::{AXON_TIME_NOW, time},
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
    session::from_unix_nanos,
};

/// Creates a server in a node. `topic` in the options is the service's name. A KEEP_LAST server keeps the
/// newest untaken requests of each client, as many as its depth; a KEEP_ALL server keeps all. A kept request
/// is never dropped to make room. When the call returns, the server is matched with the clients in the graph,
/// unless that takes longer than 50 ms or many endpoints are created in a row.
///
/// Returns the same codes as `axon_session_publisher_create`.
///
/// # Safety
/// `options` points to options whose pointers point to valid data. `server` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_create(
    node: axon_node_t,
    options: *const axon_endpoint_options_t,
    server: *mut axon_server_t,
) -> axon_ret_t {
    guarded(|| {
        present(server, "the place of the server")?;
        let node = named(node)?;
        // SAFETY: guaranteed by the caller. Both ends of a service get the same profile.
        let (spec, _) = unsafe { spec(options) }?;
        let created = node.create_server(spec)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, server) }
    })
}

/// Destroys a server. When the call returns, the server's callback has returned and is not called again.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_server_destroy(server: axon_server_t) -> axon_ret_t {
    guarded(|| end(server))
}

/// Stores the server's GID, and its profile for requests and responses. A null pointer skips its value.
///
/// # Safety
/// `gid` and `qos` are null or point to room for their value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_describe(
    server: axon_server_t,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { describe(server, gid, qos) })
}

/// Counts the clients that are matched in both directions: their requests reach the server, and its responses
/// reach them.
///
/// # Safety
/// `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_matched(
    server: axon_server_t,
    count: *mut usize,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { matched(server, count) })
}

/// Copies the next request to the memory that `room` returns, as `axon_session_subscription_take` does. The
/// response must carry the sender and the publication's number in `info`.
///
/// # Safety
/// As for `axon_session_subscription_take`.
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
        // SAFETY: guaranteed by the caller.
        let place = unsafe { CopyTarget::new(room, user, info, taken) }?;
        place.put(|| server.take_request_sample(), server.endpoint())
    })
}

/// Takes the next request in place, as `axon_session_subscription_take_sample` does.
///
/// # Safety
/// As for `axon_session_subscription_take_sample`.
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
        // SAFETY: guaranteed by the caller.
        unsafe { to.put(|| server.take_request_sample(), server.endpoint()) }
    })
}

/// Answers request `sequence` of `client`. Copies the `len` bytes at `data`. Only this client receives the
/// response. A client that no longer exists is no error.
///
/// May block for 100 ms if the client does not take its responses. AXON_RET_TIMEOUT: the client made no room.
/// All other results are those of `axon_session_publisher_publish`.
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
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { respond(server, client, sequence, AXON_TIME_NOW, data, len) })
}

/// Answers as `axon_session_server_respond` does, with the caller's `source_timestamp`: nanoseconds since the
/// Unix epoch, or AXON_TIME_NOW.
///
/// # Safety
/// As for `axon_session_server_respond`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_respond_at(
    server: axon_server_t,
    client: *const axon_gid_t,
    sequence: u64,
    source_timestamp: i64,
    data: *const u8,
    len: usize,
) -> axon_ret_t {
    // SAFETY: guaranteed by the caller.
    guarded(|| unsafe { respond(server, client, sequence, source_timestamp, data, len) })
}

/// Sends a response.
///
/// # Safety
/// As for `axon_session_server_respond`.
unsafe fn respond(
    server: axon_server_t,
    client: *const axon_gid_t,
    sequence: u64,
    source_timestamp: i64,
    data: *const u8,
    len: usize,
) -> Result<(), CallFailure> {
    let server = named(server)?;
    // SAFETY: guaranteed by the caller.
    let client = unsafe { value(client, "the client's GID") }?;
    // SAFETY: guaranteed by the caller.
    let payload = unsafe { elements(data, len, "the response") }?;
    let client = Gid(client.bytes);
    let sent = match time(source_timestamp) {
        Some(time) => server.send_response_at(client, sequence, from_unix_nanos(time), payload),
        None => server.send_response(client, sequence, payload),
    };
    sent.map_err(|e| CallFailure::from(e).of_endpoint(server.endpoint()))
}

/// Sets the callback for new requests, as `axon_session_subscription_set_callback` does.
///
/// # Safety
/// As for `axon_session_subscription_set_callback`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_server_set_callback(
    server: axon_server_t,
    callback: axon_callback_t,
    user: *const c_void,
) -> axon_ret_t {
    guarded(|| set_callback(server, callback, user))
}
