//! Nodes.

use std::os::raw::c_char;

use super::{
    error::axon_ret_t,
    guarded,
    handles::{axon_guard_t, axon_node_t, axon_session_t, give, named, revoke},
    memory::{present, text},
};

/// A node, which is in the graph until it is destroyed; its endpoints do not end with it. Two nodes
/// may have the same name. It keeps its session open.
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
        // SAFETY: the caller's word.
        let name = unsafe { text(name, "the node's name") }?;
        // SAFETY: the caller's word.
        let namespace = unsafe { text(namespace_, "the node's namespace") }?;
        // SAFETY: the caller's word.
        let enclave = unsafe { text(enclave, "the node's enclave") }?;
        let created = session.create_node(name, namespace, enclave)?;
        // SAFETY: the caller's word.
        unsafe { give(created, node) }
    })
}

/// Takes a node out of the graph. It may block for milliseconds, as `axon_session_close` says.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_node_destroy(node: axon_node_t) -> axon_ret_t {
    guarded(|| revoke(node).map(drop))
}

/// The guard condition that is triggered after every change of the graph, once what one asks of the
/// graph shows it, and when a service or a client of the session finds or loses its other end. It
/// is a handle of its own, to be destroyed like one that was created, and lasts as long as the
/// session.
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
        // SAFETY: the caller's word.
        unsafe { give(changed, guard) }
    })
}
