//! Tests that force races between threads.

use std::{
    cell::Cell,
    ffi::c_void,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    handles::{FfiHandle, give},
    *,
};
use crate::{
    config::{Config, DaemonPolicy, OsFiles},
    events::EventKind,
    qos::Qos,
    session::{EndpointSpec, Session, SessionOptions},
};

thread_local! {
    static MEANWHILE: Cell<Option<Box<dyn FnOnce()>>> = const { Cell::new(None) };
}

/// Runs at the point where a call has found the object of its handle and not used it yet.
pub(super) fn found() {
    if let Some(meanwhile) = MEANWHILE.take() {
        meanwhile();
    }
}

/// Has another thread run `what` when this thread's next call has found the object of its handle.
fn meanwhile(what: impl FnOnce() + Send + 'static) {
    MEANWHILE.set(Some(Box::new(|| thread::spawn(what).join().unwrap())));
}

/// The data of a callback. The program frees it once the callback's object is destroyed.
#[derive(Default)]
struct User {
    told: AtomicU64,
    freed: AtomicBool,
    told_when_freed: AtomicBool,
}

impl User {
    fn pointer(self: &Arc<Self>) -> *const c_void {
        Arc::as_ptr(self).cast()
    }
}

unsafe extern "C" fn hear(user: *const c_void, count: usize) {
    // SAFETY: the tests set this pointer. Its target outlives the callback's object.
    let user = unsafe { &*user.cast::<User>() };
    user.told_when_freed.fetch_or(user.freed.load(Ordering::SeqCst), Ordering::SeqCst);
    user.told.fetch_add(count as u64, Ordering::SeqCst);
}

/// Endpoints of one session. Each has an occurrence that a new callback is called for at once.
struct Place {
    publisher: axon_publisher_t,
    subscription: axon_subscription_t,
    server: axon_server_t,
    client: axon_client_t,
    event: axon_event_t,
}

fn ok(returned: axon_ret_t) {
    assert_eq!(returned, AXON_RET_OK);
}

fn handle<H: FfiHandle>(object: H::Object) -> H {
    let mut handle = H::of(0);
    // SAFETY: a place for one handle.
    unsafe { give(object, &raw mut handle) }.unwrap();
    handle
}

impl Place {
    fn new() -> Self {
        let alone = Config::resolve([], None, &OsFiles).unwrap();
        let alone = Config { daemon: DaemonPolicy::Off, ..alone };
        let session = Session::open(&alone, SessionOptions::new("ffi")).unwrap();
        let spec = || EndpointSpec::new("/t", "T", Qos::default());
        let publisher = session.create_publisher(spec()).unwrap();
        let subscription = session.create_subscription(spec()).unwrap();
        let server = session.create_server(spec()).unwrap();
        let client = session.create_client(spec()).unwrap();
        let event = publisher.event(EventKind::PublicationMatched).unwrap();
        assert!(client.wait_available(Duration::from_secs(60)));
        publisher.publish(b"x").unwrap();
        for _ in 0..2 {
            client.send_request(b"x").unwrap();
        }
        // One of the two requests is left.
        let request = server.take_request(&mut Vec::new()).unwrap();
        server.send_response(request.publisher, request.sequence, b"x").unwrap();
        Self {
            publisher: handle(publisher),
            subscription: handle(subscription),
            server: handle(server),
            client: handle(client),
            event: handle(event),
        }
    }

    fn end(self) {
        for returned in [
            axon_session_publisher_destroy(self.publisher),
            axon_session_subscription_destroy(self.subscription),
            axon_session_server_destroy(self.server),
            axon_session_client_destroy(self.client),
            axon_session_event_destroy(self.event),
        ] {
            assert!(matches!(returned, AXON_RET_OK | AXON_RET_INVALID_HANDLE));
        }
    }
}

type Set<H> = unsafe extern "C" fn(H, axon_callback_t, *const c_void) -> axon_ret_t;

/// Sets a callback while another thread destroys the object: between the look-up and the use of the object.
fn set_while_destroyed<H: Copy + Send + 'static>(
    object: H,
    set: Set<H>,
    destroy: extern "C" fn(H) -> axon_ret_t,
) {
    let user = Arc::new(User::default());
    let freed = user.clone();
    meanwhile(move || {
        ok(destroy(object));
        freed.freed.store(true, Ordering::SeqCst);
    });
    // SAFETY: the user lives until the end of this function. The object is destroyed before that.
    let returned = unsafe { set(object, Some(hear), user.pointer()) };
    assert_eq!(returned, AXON_RET_INVALID_HANDLE);
    assert!(!user.told_when_freed.load(Ordering::SeqCst), "told once it was destroyed");
    assert_eq!(user.told.load(Ordering::SeqCst), 0);
}

/// Sets a callback without a race, to show that it is called at once.
fn set_and_destroy<H: Copy>(object: H, set: Set<H>, destroy: extern "C" fn(H) -> axon_ret_t) {
    let user = Arc::new(User::default());
    // SAFETY: as above.
    ok(unsafe { set(object, Some(hear), user.pointer()) });
    assert!(user.told.load(Ordering::SeqCst) > 0, "there was nothing to be told");
    ok(destroy(object));
    user.freed.store(true, Ordering::SeqCst);
}

#[test]
fn no_callback_is_told_that_is_set_while_its_object_is_destroyed() {
    for raced in [false, true] {
        let place = Place::new();
        macro_rules! race {
            ($object:expr, $set:ident, $destroy:ident) => {
                if raced {
                    set_while_destroyed($object, $set, $destroy);
                } else {
                    set_and_destroy($object, $set, $destroy);
                }
            };
        }
        race!(place.event, axon_session_event_set_callback, axon_session_event_destroy);
        race!(
            place.subscription,
            axon_session_subscription_set_callback,
            axon_session_subscription_destroy
        );
        race!(place.client, axon_session_client_set_callback, axon_session_client_destroy);
        race!(place.server, axon_session_server_set_callback, axon_session_server_destroy);
        place.end();
    }
}

#[test]
fn the_end_of_one_handle_of_an_event_leaves_the_callback_of_another() {
    let place = Place::new();
    let kind = AXON_EVENT_PUBLICATION_MATCHED;
    let mut other = axon_event_t { id: 0 };
    // SAFETY: a place for one handle.
    ok(unsafe { axon_session_publisher_event(place.publisher, kind, &raw mut other) });
    let users = [Arc::new(User::default()), Arc::new(User::default())];
    for (event, user) in [place.event, other].into_iter().zip(&users) {
        // SAFETY: the users live until the events are destroyed.
        ok(unsafe { axon_session_event_set_callback(event, Some(hear), user.pointer()) });
    }
    let told = || users.each_ref().map(|user| user.told.load(Ordering::SeqCst));
    assert_eq!(told(), [1, 1]);
    ok(axon_session_event_destroy(place.event));
    users[0].freed.store(true, Ordering::SeqCst);
    // The session reports the event on this thread.
    ok(axon_session_subscription_destroy(place.subscription));
    assert_eq!(told(), [1, 2]);
    assert!(!users[0].told_when_freed.load(Ordering::SeqCst));
    ok(axon_session_event_destroy(other));
    place.end();
}

#[test]
fn a_panic_becomes_a_code_and_a_text() {
    let panicked = guarded(|| panic!("somewhere inside"));
    assert_eq!(panicked, AXON_RET_PANIC);
    // SAFETY: the text is valid until the next failed call in this thread.
    let text = unsafe { std::ffi::CStr::from_ptr(axon_session_last_error()) };
    assert!(text.to_str().unwrap().contains("defect of AXON"), "{text:?}");
    // The next call is not affected.
    assert_eq!(guarded(|| Ok(())), AXON_RET_OK);
}
