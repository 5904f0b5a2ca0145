//! The C functions that query the graph.

use std::{
    ffi::{CString, c_void},
    os::raw::c_char,
};

use super::{
    endpoints::axon_gid_t,
    error::{AXON_RET_NO_NODE, CallFailure, axon_ret_t},
    guarded,
    handles::{axon_session_t, named},
    memory::{store, text},
    qos::axon_qos_t,
};
use crate::graph::{EndpointKind, GraphEntry};

/// Endpoint kind: publisher.
pub const AXON_KIND_PUBLISHER: u32 = 1;
/// Endpoint kind: subscription.
pub const AXON_KIND_SUBSCRIPTION: u32 = 2;
/// Endpoint kind: server.
pub const AXON_KIND_SERVER: u32 = 4;
/// Endpoint kind: client.
pub const AXON_KIND_CLIENT: u32 = 8;

/// An endpoint of the graph. Its pointers are valid during the call of the visitor.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_endpoint_t {
    /// The endpoint's GID.
    pub gid: axon_gid_t,
    /// AXON_KIND_*.
    pub kind: u32,
    /// 1 if the endpoint is on another host, else 0.
    pub remote: u32,
    /// The name of the topic or service.
    pub topic: *const c_char,
    /// The type's name.
    pub type_name: *const c_char,
    /// The type's hash.
    pub type_hash: *const u8,
    /// The length of the type's hash in bytes; 0 if the hash is unknown.
    pub type_hash_size: usize,
    /// The profile that the endpoint offers or requests.
    pub qos: axon_qos_t,
    /// The name of the endpoint's node; empty if the endpoint has no node.
    pub node: *const c_char,
    /// The namespace of the node.
    pub namespace_: *const c_char,
}

/// A function that receives one node.
pub type axon_node_visitor_t = Option<
    unsafe extern "C" fn(
        user: *mut c_void,
        name: *const c_char,
        namespace_: *const c_char,
        enclave: *const c_char,
    ),
>;

/// A function that receives the name of one topic or service, and the types of its endpoints: at least one.
pub type axon_name_visitor_t = Option<
    unsafe extern "C" fn(
        user: *mut c_void,
        name: *const c_char,
        types: *const *const c_char,
        type_count: usize,
    ),
>;

/// A function that receives one endpoint.
pub type axon_endpoint_visitor_t =
    Option<unsafe extern "C" fn(user: *mut c_void, endpoint: *const axon_endpoint_t)>;

/// Calls `visitor` with every node of the graph, in order of namespace and name. Several nodes of the same
/// name give one call each. The strings are valid until the visitor returns. The library holds no lock during
/// the call of the visitor.
///
/// # Safety
/// `visitor` may be called with `user`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_graph_nodes(
    session: axon_session_t,
    visitor: axon_node_visitor_t,
    user: *mut c_void,
) -> axon_ret_t {
    guarded(|| {
        let visitor = visitor.ok_or_else(no_visitor)?;
        for node in named(session)?.graph().nodes() {
            let (name, namespace) = (string(&node.name)?, string(&node.namespace)?);
            let enclave = string(&node.enclave)?;
            // SAFETY: guaranteed by the caller; the strings stand until it returns.
            unsafe { visitor(user, name.as_ptr(), namespace.as_ptr(), enclave.as_ptr()) };
        }
        Ok(())
    })
}

/// Calls `visitor` with the topic and service names of the endpoints of the given kinds (the sum of
/// AXON_KIND_*), in order, each with its types. Null for `node` selects all endpoints. Otherwise the
/// endpoints of the node with this name and namespace are selected.
///
/// AXON_RET_NO_NODE: the graph has no such node.
///
/// # Safety
/// `node` and `namespace_` are strings, or `node` is null; `visitor` may be called with `user`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_graph_names(
    session: axon_session_t,
    kinds: u32,
    node: *const c_char,
    namespace_: *const c_char,
    visitor: axon_name_visitor_t,
    user: *mut c_void,
) -> axon_ret_t {
    guarded(|| {
        let visitor = visitor.ok_or_else(no_visitor)?;
        let kinds = of_sum(kinds)?;
        let graph = named(session)?.graph();
        let names = if node.is_null() {
            graph.names_and_types(&kinds)
        } else {
            // SAFETY: guaranteed by the caller.
            let node = unsafe { text(node, "the node's name") }?;
            // SAFETY: guaranteed by the caller.
            let namespace = unsafe { text(namespace_, "the node's namespace") }?;
            graph.names_and_types_of(node, namespace, &kinds).ok_or_else(|| {
                let text = format_args!("there is no node {node} in namespace {namespace}");
                CallFailure::new(AXON_RET_NO_NODE, text)
            })?
        };
        for (name, types) in names {
            let name = string(&name)?;
            let types = types.iter().map(|one| string(one)).collect::<Result<Vec<_>, _>>()?;
            let types: Vec<*const c_char> = types.iter().map(|one| one.as_ptr()).collect();
            // SAFETY: guaranteed by the caller; the strings stand until it returns.
            unsafe { visitor(user, name.as_ptr(), types.as_ptr(), types.len()) };
        }
        Ok(())
    })
}

/// Calls `visitor` with every endpoint of a kind (AXON_KIND_*) that has this topic or service name. Null for
/// `topic` selects all endpoints of the kind.
///
/// # Safety
/// `topic` is null or a string; `visitor` may be called with `user`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_graph_endpoints(
    session: axon_session_t,
    kind: u32,
    topic: *const c_char,
    visitor: axon_endpoint_visitor_t,
    user: *mut c_void,
) -> axon_ret_t {
    guarded(|| {
        let visitor = visitor.ok_or_else(no_visitor)?;
        let known = of_number(kind)?;
        let graph = named(session)?.graph();
        let endpoints = if topic.is_null() {
            graph.endpoints_of_kind(known)
        } else {
            // SAFETY: guaranteed by the caller.
            graph.endpoints_of(known, unsafe { text(topic, "the topic") }?)
        };
        for GraphEntry { endpoint, daemon, .. } in endpoints {
            let (name, type_name) = (string(&endpoint.topic)?, string(&endpoint.type_name)?);
            let (node, namespace) = (string(&endpoint.node)?, string(&endpoint.namespace)?);
            let shown = axon_endpoint_t {
                gid: endpoint.gid.into(),
                kind,
                remote: u32::from(daemon.is_some()),
                topic: name.as_ptr(),
                type_name: type_name.as_ptr(),
                type_hash: endpoint.type_hash.as_ptr(),
                type_hash_size: endpoint.type_hash.len(),
                qos: axon_qos_t::from(&endpoint.qos),
                node: node.as_ptr(),
                namespace_: namespace.as_ptr(),
            };
            // SAFETY: guaranteed by the caller; what it points to stands until it returns.
            unsafe { visitor(user, &raw const shown) };
        }
        Ok(())
    })
}

/// Counts the endpoints of a kind (AXON_KIND_*) that have this topic or service name. A publisher or
/// subscription of another process counts once its pairs with the session's own endpoints are attached, at most a
/// second after it was announced. So a sample that is published after the count reaches every counted subscription
/// with a compatible profile, unless its process is stopped. For services, `axon_session_client_matched` tells more.
///
/// # Safety
/// `topic` is a string; `count` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_graph_count(
    session: axon_session_t,
    kind: u32,
    topic: *const c_char,
    count: *mut usize,
) -> axon_ret_t {
    guarded(|| {
        let kind = of_number(kind)?;
        // SAFETY: guaranteed by the caller.
        let topic = unsafe { text(topic, "the topic") }?;
        let found = named(session)?.graph().count(kind, topic);
        // SAFETY: guaranteed by the caller.
        unsafe { store(count, found, "the place of the number") }
    })
}

const KINDS: [(u32, EndpointKind); 4] = [
    (AXON_KIND_PUBLISHER, EndpointKind::Publisher),
    (AXON_KIND_SUBSCRIPTION, EndpointKind::Subscription),
    (AXON_KIND_SERVER, EndpointKind::Server),
    (AXON_KIND_CLIENT, EndpointKind::Client),
];

fn of_number(number: u32) -> Result<EndpointKind, CallFailure> {
    let found = KINDS.iter().find(|(of, _)| *of == number).map(|(_, kind)| *kind);
    found
        .ok_or_else(|| CallFailure::argument(format_args!("there is no kind of endpoint {number}")))
}

fn of_sum(sum: u32) -> Result<Vec<EndpointKind>, CallFailure> {
    let all = KINDS.iter().fold(0, |all, (of, _)| all | of);
    if sum == 0 || sum & !all != 0 {
        return Err(CallFailure::argument(format_args!("{sum} is no sum of kinds of endpoints")));
    }
    Ok(KINDS.iter().filter(|(of, _)| sum & of != 0).map(|(_, kind)| *kind).collect())
}

fn no_visitor() -> CallFailure {
    CallFailure::argument("the visitor is null")
}

/// Converts a name of the graph, which holds no NUL: the session checks every name on arrival.
fn string(text: &str) -> Result<CString, CallFailure> {
    CString::new(text).map_err(|_| CallFailure::argument("a name in the graph holds a NUL"))
}
