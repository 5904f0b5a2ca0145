//! Futures in a child that was forked off.

use std::{
    pin::pin,
    sync::atomic::{AtomicBool, Ordering},
    task::{Context, Poll, Waker},
    thread,
};

use axon_transport::{CallError, EndpointSpec, RecvError, qos::Qos};

use crate::support::{PATIENCE, alone, block_on, pair};

#[test]
fn a_forked_child_is_refused_and_held_up_by_no_lock_of_its_parent() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (busy, busily) = pair(&session, "/busy");
    let spec = || EndpointSpec::new("/s", "test/Service", Qos::keep_all());
    let server = session.create_server(spec()).unwrap();
    let client = session.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        // Keeps the locks in use.
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                busy.publish(b"x").unwrap();
                block_on(busily.recv_async()).unwrap();
            }
        });
        for _ in 0..40 {
            let mut context = Context::from_waker(Waker::noop());
            let mut waiting = Box::pin(subscription.recv_async());
            let mut calling = Box::pin(client.call(b"x"));
            assert!(waiting.as_mut().poll(&mut context).is_pending());
            assert!(calling.as_mut().poll(&mut context).is_pending());
            // SAFETY: the child calls what must work in one, and leaves by _exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                // SAFETY: has it killed if it hangs.
                unsafe { libc::alarm(30) };
                let forked = |polled| matches!(polled, Poll::Ready(Err(RecvError::Forked)));
                let call =
                    |polled| matches!(polled, Poll::Ready(Err(CallError::Recv(RecvError::Forked))));
                let refused = [
                    forked(waiting.as_mut().poll(&mut context).map_ok(drop)),
                    call(calling.as_mut().poll(&mut context).map_ok(drop)),
                    forked(pin!(subscription.recv_async()).poll(&mut context).map_ok(drop)),
                    forked(pin!(server.recv_request_async()).poll(&mut context).map_ok(drop)),
                    call(pin!(client.call(b"x")).poll(&mut context).map_ok(drop)),
                    {
                        drop((waiting, calling));
                        true
                    },
                ];
                let code = refused.iter().position(|refused| !refused).map_or(0, |n| n + 1);
                // SAFETY: ends the process without running anything else.
                unsafe { libc::_exit(i32::try_from(code).unwrap()) };
            }
            let mut status = -1;
            // SAFETY: waits for the child just made; `status` outlives the call.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert_eq!(status, 0, "the child was refused all of it, and killed by nothing");
        }
        over.store(true, Ordering::Relaxed);
    });
    publisher.publish(b"x").unwrap();
    assert!(block_on(subscription.recv_async()).is_ok());
}
