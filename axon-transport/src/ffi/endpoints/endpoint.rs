//! Code that the C functions of publishers, subscriptions, clients and servers share.

use std::{ffi::c_void, os::raw::c_char};

use crate::{
    ffi::{
        callback::{axon_callback_t, told},
        error::CallFailure,
        handles::{FfiHandle, named, revoke},
        memory::{elements, present_if_wanted, store, store_if_wanted, text, value},
        qos::{axon_qos_t, store_qos},
    },
    graph::Endpoint,
    ids::Gid,
    qos::QosRequest,
    session::{Client, EndpointSpec, OnNew, Publisher, Server, SessionError, Subscription},
};

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
    pub reserved: [u8; 3],
    /// A publisher: the length of most samples in bytes; 0 where it is not known. Where it is more than
    /// 512, the publisher has memory of its own for samples from the start, which each reader maps, and
    /// loans of more than 512 bytes are in place there, like all samples of more than 4 KiB. Otherwise
    /// only the latter are, in memory that comes with the first of them.
    pub expected_len: u32,
}

/// What is asked for, with the profile as it is asked for.
///
/// # Safety
/// `options` points to options whose pointers point to what they say.
pub(super) unsafe fn spec(
    options: *const axon_endpoint_options_t,
) -> Result<(EndpointSpec, QosRequest), CallFailure> {
    // SAFETY: the caller's word.
    let options = unsafe { value(options, "the pointer to the options") }?;
    // SAFETY: the caller's word.
    let topic = unsafe { text(options.topic, "the topic") }?;
    // SAFETY: the caller's word.
    let type_name = unsafe { text(options.type_name, "the type's name") }?;
    let hash_size = options.type_hash_size;
    if hash_size > AXON_TYPE_HASH_SIZE {
        let text = format_args!(
            "the type's hash has {hash_size} bytes, and may have {AXON_TYPE_HASH_SIZE}"
        );
        return Err(CallFailure::argument(text).of(topic));
    }
    // SAFETY: the caller's word.
    let hash = unsafe { elements(options.type_hash, hash_size, "the type's hash") }?;
    let request = options.qos.request().map_err(|failure| failure.of(topic))?;
    let spec = EndpointSpec {
        type_hash: hash.to_vec(),
        ignore_local: options.ignore_local != 0,
        expected_len: options.expected_len.into(),
        ..EndpointSpec::new(topic, type_name, request.for_service())
    };
    Ok((spec, request))
}

/// What a handle of any endpoint names.
pub(super) trait EndpointObject {
    fn endpoint(&self) -> &Endpoint;

    /// How many others it is matched with.
    fn count(&self) -> usize;
}

/// An endpoint of which something is taken.
pub(super) trait Taking: EndpointObject {
    fn set_on_new(&self, callback: Option<OnNew>) -> Result<(), SessionError>;
    fn tell_no_more(&self);
}

macro_rules! objects {
    ($($object:ident: $matched:ident $(, $set:ident)?;)+) => {$(
        impl EndpointObject for $object {
            fn endpoint(&self) -> &Endpoint {
                self.endpoint()
            }

            fn count(&self) -> usize {
                self.$matched().len()
            }
        }

        $(impl Taking for $object {
            fn set_on_new(&self, callback: Option<OnNew>) -> Result<(), SessionError> {
                self.$set(callback)
            }

            fn tell_no_more(&self) {
                self.tell_no_more();
            }
        })?
    )+};
}

objects! {
    Publisher: matched;
    Subscription: matched, set_on_new_sample;
    Server: clients, set_on_new_request;
    Client: servers, set_on_new_response;
}

/// Stores what an endpoint is.
///
/// # Safety
/// `gid` and `qos` are null or point to room for one.
pub(super) unsafe fn describe<H: FfiHandle<Object: EndpointObject>>(
    handle: H,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> Result<(), CallFailure> {
    present_if_wanted(gid)?;
    present_if_wanted(qos)?;
    let object = named(handle)?;
    let endpoint = object.endpoint();
    // SAFETY: the caller's word.
    unsafe { store_if_wanted(gid, endpoint.gid.into()) }?;
    // SAFETY: the caller's word.
    unsafe { store_qos(qos, &endpoint.qos) }
}

/// Stores how many others an endpoint is matched with.
///
/// # Safety
/// `count` points to room for a number.
pub(super) unsafe fn matched<H: FfiHandle<Object: EndpointObject>>(
    handle: H,
    count: *mut usize,
) -> Result<(), CallFailure> {
    let matched = named(handle)?.count();
    // SAFETY: the caller's word.
    unsafe { store(count, matched, "the place of the number") }
}

/// Has `callback` told of what comes to an endpoint.
pub(super) fn set_callback<H: FfiHandle<Object: Taking>>(
    handle: H,
    callback: axon_callback_t,
    user: *const c_void,
) -> Result<(), CallFailure> {
    let object = named(handle)?;
    let set = object.set_on_new(told(callback, user));
    set.map_err(|error| CallFailure::from(error).of_endpoint(object.endpoint()))?;
    // One that was destroyed meanwhile has none.
    named(handle).map(drop)
}

/// Ends an endpoint that has a callback.
pub(super) fn end<H: FfiHandle<Object: Taking>>(handle: H) -> Result<(), CallFailure> {
    // Another call may keep it for a while.
    revoke(handle)?.tell_no_more();
    Ok(())
}
