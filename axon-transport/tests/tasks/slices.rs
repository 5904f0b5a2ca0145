//! Samples as slices, of publishers that are trusted.

use std::{thread, time::Duration};

use axon_transport::{RecvError, shm::TrustPublishers};

use crate::support::{PATIENCE, alone, block_on, pair};

#[test]
fn a_trusted_subscription_has_slices_and_all_that_others_have() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    // SAFETY: the only publisher is of this process, and no slice gets into a child.
    let subscription = subscription.trusting(unsafe { TrustPublishers::new() });
    assert!(subscription.take_slice().is_none());
    let late = subscription.recv_slice(Some(Duration::from_millis(1))).unwrap_err();
    assert_eq!(late, RecvError::TimedOut);
    let task = thread::spawn(move || {
        let (_, first) = block_on(subscription.recv_slice_async()).unwrap();
        let (info, second) = subscription.recv_slice(Some(PATIENCE)).unwrap();
        assert!(first[..] == [1; 100_000] && second.sample().is_borrowed());
        assert_eq!((&second[..2], info.sequence), (&[2, 2][..], 2));
        // Both outlive the subscription, which is one like any other.
        let subscription = subscription.into_inner();
        assert_eq!(subscription.received(), 2);
        drop(subscription);
        first.len() + second.len()
    });
    publisher.publish(&[1; 100_000]).unwrap();
    publisher.publish(&[2; 100_000]).unwrap();
    assert_eq!(task.join().unwrap(), 200_000);
}
