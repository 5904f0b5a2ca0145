//! Samples in place as slices.

#![allow(unsafe_code)]

use super::*;
use crate::TrustPublishers;

const IMAGE: usize = 200_000;

/// Of the publishers of this test.
fn trust() -> TrustPublishers {
    // SAFETY: they are of this crate, and a child that a test forks uses no slice that was borrowed before.
    unsafe { TrustPublishers::new() }
}

#[test]
fn a_slice_is_where_the_sample_is_and_keeps_it() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    for reading in [&a, &b] {
        let mut reader = attach(&writer, &a, reading, keep_last(1));
        writer.publish(meta(1), &pattern(1, IMAGE)).unwrap();
        let sample = reader.take_sample().unwrap().expect("a sample");
        assert!(sample.is_borrowed());
        let place = sample.as_ptr();
        let slice = sample.into_slice(trust());
        assert_eq!((slice.as_ptr(), slice.meta()), (place, meta(1)));
        for sequence in 2..50 {
            writer.publish(meta(sequence), &pattern(sequence, IMAGE)).unwrap();
        }
        drop(reader);
        assert!(slice[..] == pattern(1, IMAGE), "the sample changed");
    }
}

#[test]
fn in_a_forked_child_a_slice_is_empty() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &a, keep_last(1));
    writer.publish(meta(1), &pattern(1, IMAGE)).unwrap();
    let slice = reader.take_sample().unwrap().expect("a sample").into_slice(trust());
    assert_eq!(slice.len(), IMAGE);
    // SAFETY: the child takes no lock, allocates nothing and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let empty = slice.is_empty();
        // SAFETY: ends the process without running anything else.
        unsafe { libc::_exit(i32::from(!empty)) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made; `status` outlives the call.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert_eq!(status, 0);
}
