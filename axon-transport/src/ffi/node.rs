//! The C functions of nodes.

use std::os::raw::c_char;

use super::{
    error::axon_ret_t,
    guarded,
    handles::{axon_guard_t, axon_node_t, axon_session_t, give, named, revoke},
    memory::{present, text},
};

/// Creates a node, which stays in the graph until it is destroyed. Its endpoints do not end with the node.
/// Two nodes may have the same name. A node keeps its session open.
///
/// AXON_RET_INVALID_ARGUMENT: the name is empty, or a name is longer than 512 bytes.
///
/// # Safety
/// The three names are strings; `node` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_node_create(
    session: axon_session_t,
    name: *const c_char,
    namespace_: *const c_char,
    enclave: *const c_char,
    node: *mut axon_node_t,
) -> axon_ret_t {
    guarded(|| {
        present(node, "the place of the node")?;
        let session = named(session)?;
        // SAFETY: guaranteed by the caller.
        let name = unsafe { text(name, "the node's name") }?;
        // SAFETY: guaranteed by the caller.
        let namespace = unsafe { text(namespace_, "the node's namespace") }?;
        // SAFETY: guaranteed by the caller.
        let enclave = unsafe { text(enclave, "the node's enclave") }?;
        let created = session.create_node(name, namespace, enclave)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(created, node) }
    })
}

/// Removes a node from the graph. The call may block for milliseconds, as `axon_session_close` may.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_node_destroy(node: axon_node_t) -> axon_ret_t {
    guarded(|| revoke(node).map(drop))
}

/// Creates a handle for the guard condition of the graph. Every change of the graph triggers the condition,
/// once graph queries return the new state. The condition is also triggered when a service or a client of the
/// session finds or loses its other end. The program must destroy the handle, as one that it created. The
/// condition lasts as long as the session.
///
/// # Safety
/// `guard` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_node_graph_guard(
    node: axon_node_t,
    guard: *mut axon_guard_t,
) -> axon_ret_t {
    guarded(|| {
        present(guard, "the place of the guard condition")?;
        let changed = named(node)?.graph_changed().clone();
        // SAFETY: guaranteed by the caller.
        unsafe { give(changed, guard) }
    })
}
