//! The publisher's lock without the kernel: a thread takes it while it is free, and releases it while no thread
//! waits.

use loom::{
    sync::{Arc, atomic::AtomicU32},
    thread,
};

use crate::{
    os::pi_mutex::{let_go, take},
    tests::model::{Cell, check},
};

/// `LetGoSwap`, `TakeSwap`: a thread that takes the lock sees the writes of its last holder.
#[test]
fn a_new_holder_sees_the_last_holders_writes() {
    check(3, || {
        let lock = Arc::new((AtomicU32::new(0), Cell::new(0)));
        let count = |lock: &(AtomicU32, Cell), thread| {
            for _ in 0..2 {
                if take(&lock.0, thread) {
                    lock.1.set(lock.1.get() + 1);
                    assert!(let_go(&lock.0, thread), "nobody waits in the kernel");
                    return 1;
                }
                thread::yield_now();
            }
            0
        };
        let other = {
            let lock = Arc::clone(&lock);
            thread::spawn(move || count(&lock, 2))
        };
        let counted = count(&lock, 1) + other.join().unwrap();
        assert!(counted > 0, "one of the two has it at once");
        assert!(take(&lock.0, 1));
        assert_eq!(lock.1.get(), counted);
    });
}
