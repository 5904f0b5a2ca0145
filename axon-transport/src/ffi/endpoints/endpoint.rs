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
    session::{
        Client, EndpointSpec, NewDataCallback, Publisher, Server, SessionError, Subscription,
    },
};

/// The largest size of a type's hash in bytes.
pub const AXON_TYPE_HASH_SIZE: usize = 64;

/// The globally unique ID of an endpoint or a node.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_gid_t {
    /// The bytes in the order in which tools print them.
    pub bytes: [u8; 16],
}

impl From<Gid> for axon_gid_t {
    fn from(gid: Gid) -> Self {
        Self { bytes: gid.0 }
    }
}

/// The options of a new endpoint. All fields but the two names may be zero.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_endpoint_options_t {
    /// The full name of the topic or service, of at most 512 bytes. AXON does not interpret the name.
    pub topic: *const c_char,
    /// The type's name. Endpoints match on topic and type.
    pub type_name: *const c_char,
    /// The type's hash, of at most AXON_TYPE_HASH_SIZE bytes. If both ends know the hash, the two must be
    /// equal.
    pub type_hash: *const u8,
    /// The size of the hash in bytes; 0 if the hash is unknown.
    pub type_hash_size: usize,
    /// The profile that the endpoint offers or requests.
    pub qos: axon_qos_t,
    /// Subscription only: a value other than 0 ignores publishers of the subscription's own session.
    pub ignore_local: u8,
    /// Must be 0.
    pub reserved: [u8; 3],
    /// Publisher only: the length of most samples in bytes; 0 if unknown. With a length of more than 512, the
    /// publisher allocates memory for samples at creation, which each reader maps. Loans of more than 512
    /// bytes and all samples of more than 4 KiB are then in place there. Otherwise only samples of more than
    /// 4 KiB are in place, in memory that is allocated for the first of them.
    pub expected_len: u32,
}

/// Converts options to an endpoint specification, and returns the requested profile with it.
///
/// # Safety
/// `options` points to options whose pointers point to valid data.
pub(super) unsafe fn spec(
    options: *const axon_endpoint_options_t,
) -> Result<(EndpointSpec, QosRequest), CallFailure> {
    // SAFETY: guaranteed by the caller.
    let options = unsafe { value(options, "the pointer to the options") }?;
    // SAFETY: guaranteed by the caller.
    let topic = unsafe { text(options.topic, "the topic") }?;
    // SAFETY: guaranteed by the caller.
    let type_name = unsafe { text(options.type_name, "the type's name") }?;
    let hash_size = options.type_hash_size;
    if hash_size > AXON_TYPE_HASH_SIZE {
        let text = format_args!(
            "the type's hash has {hash_size} bytes, and may have {AXON_TYPE_HASH_SIZE}"
        );
        return Err(CallFailure::argument(text).of(topic));
    }
    // SAFETY: guaranteed by the caller.
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

/// The object that the handle of any endpoint names.
pub(super) trait EndpointObject {
    fn endpoint(&self) -> &Endpoint;

    /// Returns the number of matched endpoints.
    fn count(&self) -> usize;
}

/// An endpoint that takes messages.
pub(super) trait Taking: EndpointObject {
    fn set_on_new(&self, callback: Option<NewDataCallback>) -> Result<(), SessionError>;
    fn tell_no_more(&self);
}

macro_rules! objects {
    ($($object:ident: $count:expr $(, $set:ident)?;)+) => {$(
        impl EndpointObject for $object {
            fn endpoint(&self) -> &Endpoint {
                self.endpoint()
            }

            fn count(&self) -> usize {
                let count: fn(&Self) -> usize = $count;
                count(self)
            }
        }

        $(impl Taking for $object {
            fn set_on_new(&self, callback: Option<NewDataCallback>) -> Result<(), SessionError> {
                self.$set(callback)
            }

            fn tell_no_more(&self) {
                self.tell_no_more();
            }
        })?
    )+};
}

objects! {
    Publisher: Self::matched_count;
    Subscription: Self::matched_count, set_on_new_sample;
    Server: |server| server.clients().len(), set_on_new_request;
    Client: |client| client.servers().len(), set_on_new_response;
}

/// Stores the GID and the profile of an endpoint.
///
/// # Safety
/// `gid` and `qos` are null or point to room for their value.
pub(super) unsafe fn describe<H: FfiHandle<Object: EndpointObject>>(
    handle: H,
    gid: *mut axon_gid_t,
    qos: *mut axon_qos_t,
) -> Result<(), CallFailure> {
    present_if_wanted(gid)?;
    present_if_wanted(qos)?;
    let object = named(handle)?;
    let endpoint = object.endpoint();
    // SAFETY: guaranteed by the caller.
    unsafe { store_if_wanted(gid, endpoint.gid.into()) }?;
    // SAFETY: guaranteed by the caller.
    unsafe { store_qos(qos, &endpoint.qos) }
}

/// Stores the number of endpoints that an endpoint is matched with.
///
/// # Safety
/// `count` points to room for a number.
pub(super) unsafe fn matched<H: FfiHandle<Object: EndpointObject>>(
    handle: H,
    count: *mut usize,
) -> Result<(), CallFailure> {
    let matched = named(handle)?.count();
    // SAFETY: guaranteed by the caller.
    unsafe { store(count, matched, "the place of the number") }
}

/// Sets the callback for an endpoint's new messages.
pub(super) fn set_callback<H: FfiHandle<Object: Taking>>(
    handle: H,
    callback: axon_callback_t,
    user: *const c_void,
) -> Result<(), CallFailure> {
    let object = named(handle)?;
    let set = object.set_on_new(told(callback, user));
    set.map_err(|error| CallFailure::from(error).of_endpoint(object.endpoint()))?;
    // An object that was destroyed meanwhile has no callback.
    named(handle).map(drop)
}

/// Ends an endpoint that has a callback.
pub(super) fn end<H: FfiHandle<Object: Taking>>(handle: H) -> Result<(), CallFailure> {
    // A concurrent call may keep the object for a while.
    revoke(handle)?.tell_no_more();
    Ok(())
}
