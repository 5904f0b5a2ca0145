//! What all endpoints are made of.

use std::os::raw::c_char;

use super::{
    error::Failure,
    memory::{elements, text, value},
    qos::axon_qos_t,
};
use crate::{ids::Gid, qos::QosRequest, session::EndpointSpec};

/// The most bytes that the hash of a type may have.
pub const AXON_TYPE_HASH_SIZE: usize = 64;

/// Names an endpoint or a node: no other anywhere has the same.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_gid_t {
    /// In the order in which they are shown.
    pub bytes: [u8; 16],
}

impl From<Gid> for axon_gid_t {
    fn from(gid: Gid) -> Self {
        Self { bytes: gid.0 }
    }
}

/// What an endpoint is created with. All zeros but the two names is a usual one.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_endpoint_options_t {
    /// The full name of the topic or service, of at most 512 bytes. AXON gives it no meaning.
    pub topic: *const c_char,
    /// The type's name. Endpoints match on topic and type.
    pub type_name: *const c_char,
    /// The type's hash, of at most AXON_TYPE_HASH_SIZE bytes. Where both ends know it, it must be the
    /// same.
    pub type_hash: *const u8,
    /// 0: it is not known.
    pub type_hash_size: usize,
    /// What it offers or requests.
    pub qos: axon_qos_t,
    /// A subscription: not 0 to receive nothing from publishers of its own session.
    pub ignore_local: u8,
    /// 0.
    pub reserved: [u8; 7],
}

/// What is asked for, with the profile as it is asked for.
///
/// # Safety
/// `options` points to options whose pointers point to what they say.
pub(super) unsafe fn spec(
    options: *const axon_endpoint_options_t,
) -> Result<(EndpointSpec, QosRequest), Failure> {
    // SAFETY: the caller's word.
    let options = unsafe { value(options, "the pointer to the options") }?;
    // SAFETY: the caller's word.
    let topic = unsafe { text(options.topic, "the topic") }?;
    // SAFETY: the caller's word.
    let type_name = unsafe { text(options.type_name, "the type's name") }?;
    // SAFETY: the caller's word.
    let hash = unsafe { elements(options.type_hash, options.type_hash_size, "the type's hash") }?;
    let request = options.qos.request().map_err(|failure| failure.of(topic))?;
    let spec = EndpointSpec {
        type_hash: hash.to_vec(),
        ignore_local: options.ignore_local != 0,
        ..EndpointSpec::new(topic, type_name, request.for_service())
    };
    Ok((spec, request))
}
