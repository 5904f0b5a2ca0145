//! The operations, and the situations in which they are killed.

use axon_transport::qos::{Durability, History, Qos};

use crate::{
    around::Around::{self, Child, Locked, NoDescriptor, NoMemory, Nothing, Stopped},
    operation::{Case, Operation, Operation::*},
};

impl Case {
    fn around(self, around: Around) -> Self {
        Self { around, ..self }
    }

    fn with_pinned(self, pinned: u64) -> Self {
        Self { pinned, ..self }
    }

    fn long(self) -> Self {
        Self { long: true, ..self }
    }
}

fn last(depth: u32) -> Qos {
    Qos::default().with_history(History::KeepLast).with_depth(depth)
}

fn case(
    name: &'static str,
    operation: Operation,
    reader: Qos,
    (before, taken): (u64, u64),
    len: usize,
) -> Case {
    let publisher = if reader.history == History::KeepAll { Qos::keep_all() } else { last(1) };
    let publisher = publisher.with_durability(reader.durability);
    let (pinned, around, long) = (0, Nothing, false);
    Case { name, operation, publisher, reader, before, len, taken, pinned, around, long }
}

pub(crate) fn cases() -> Vec<Case> {
    let all = Qos::keep_all();
    let latched = |depth| last(depth).with_durability(Durability::TransientLocal);
    vec![
        case("create a ring", Create, last(4), (0, 0), 0),
        case("attach a reader", Attach, last(4), (0, 0), 40),
        case("attach a reader that gets history", Attach, latched(1), (2, 1), 40),
        case("publish nothing", Publish, last(4), (0, 0), 0),
        case("publish inline, the first", Publish, last(4), (0, 0), 88),
        case("publish inline", Publish, last(4), (3, 1), 8),
        case("publish inline to a reader that sleeps", Wake, last(4), (3, 1), 8),
        case("publish inline to a reader with all unread", Publish, last(20), (30, 0), 88),
        case("publish inline over the ring's end", Publish, last(4), (32, 2), 52),
        case("publish over the first descriptor", Publish, last(20), (32, 15), 52),
        case("publish and grow", Publish, last(4), (16, 2), 52),
        case("publish and grow, all unread", Publish, last(20), (16, 0), 88),
        case("publish and grow, by copy", Publish, all, (16, 10), 300),
        case("publish and open a segment for descriptors", Publish, last(3000), (1024, 1000), 8)
            .long(),
        case("publish and move to that segment", Publish, last(3000), (1025, 1000), 8).long(),
        case("publish by copy, the first", Publish, last(4), (0, 0), 89),
        case("publish by copy", Publish, last(4), (3, 1), 1024),
        case("publish by copy in place of the oldest", Publish, last(20), (8, 0), 1024),
        case("publish by copy in place of many", Publish, last(20), (40, 20), 200),
        case("publish a large one, the first", Publish, last(4), (0, 0), 5000).long(),
        case("publish a large one", Publish, last(1), (2, 1), 5000).long(),
        case("publish a large one while one is pinned", Publish, last(4), (3, 1), 4200)
            .with_pinned(1)
            .long(),
        case("publish a large one in place of one", Publish, last(4), (4, 1), 4200).long(),
        case("have memory ready for a large one", Prepare, last(4), (1, 1), 5000),
        case("give the memory of large ones up", Tend, last(4), (2, 2), 5000),
        case("give it up but for what is pinned", Tend, last(4), (2, 1), 5000).with_pinned(1),
        case("publish, KEEP_ALL", Publish, all, (3, 3), 300),
        case("publish, KEEP_ALL and held", PublishHeld, all, (8, 0), 1024),
        case("loan, write, publish inline", LoanAndPublish, last(4), (3, 1), 60),
        case("loan, write, publish", LoanAndPublish, last(4), (3, 1), 2000),
        case("loan, write, publish a large one", LoanAndPublish, last(4), (3, 1), 4200).long(),
        case("loan, drop", LoanAndDrop, last(4), (3, 1), 2000),
        case("loan a large one, drop", LoanAndDrop, last(4), (3, 1), 4200).long(),
        case("detach a reader", Detach, last(4), (3, 1), 300),
        case("drop the publisher", DropWriter, last(4), (3, 1), 300),
        case("drop a publisher of large ones, one pinned", DropWriter, last(4), (3, 1), 4200)
            .with_pinned(1),
        case("map a ring", Map, last(4), (3, 0), 300),
        case("take inline", Take, last(4), (3, 1), 60),
        case("take by copy", Take, last(4), (3, 1), 200),
        case("take a large one by copy", Take, last(1), (2, 0), 4200).long(),
        case("take from a ring that grew", Take, last(20), (20, 3), 60),
        case("take over what its depth skips", Take, last(2), (9, 0), 100),
        case("take over what is lost", Take, last(20), (12, 0), 1024).long(),
        case("take, KEEP_ALL, held publisher", Take, all, (8, 0), 1024).long(),
        case("take nothing", Take, last(4), (2, 2), 10),
        case("pin a large one", Pin, last(4), (3, 1), 5000),
        case("unpin", Unpin, last(4), (3, 1), 5000),
        case("unpin, its reader gone", UnpinLast, last(4), (3, 1), 5000),
        case("peek", Peek, last(4), (3, 1), 1024),
        case("skip", Skip, last(4), (3, 1), 1024),
        case("drop the reader", DropReader, last(4), (3, 1), 300),
        case("drop the reader, KEEP_ALL", DropReader, all, (8, 2), 1024),
        // A forked child keeps the descriptors.
        case("forked: attach a reader", Attach, last(4), (0, 0), 40).around(Child),
        case("forked: publish inline", Publish, last(4), (3, 1), 8).around(Child),
        case("forked: drop the publisher", DropWriter, last(4), (3, 1), 300).around(Child),
        case("forked: map a ring", Map, last(4), (3, 0), 300).around(Child),
        case("forked: pin a large one", Pin, last(4), (3, 1), 5000).around(Child),
        // The process is not killed but stopped, and continues later.
        case("stopped: attach a reader", Attach, last(4), (0, 0), 40).around(Stopped),
        case("stopped: publish by copy", Publish, last(4), (3, 1), 1024).around(Stopped),
        case("stopped: map a ring", Map, last(4), (3, 0), 300).around(Stopped),
        case("stopped: take inline", Take, last(4), (3, 1), 60).around(Stopped),
        case("stopped: pin a large one", Pin, last(4), (3, 1), 4200).around(Stopped),
        // Resources that the system refuses.
        case("mlockall: map a ring of large ones", Map, last(4), (3, 0), 5000).around(Locked),
        case("mlockall: pin a large one", Pin, last(4), (3, 1), 5000).around(Locked),
        case("no descriptor: publish inline", Publish, last(4), (3, 1), 8).around(NoDescriptor),
        case("no descriptor: the first large one", PublishRefused, last(4), (0, 0), 5000)
            .around(NoDescriptor),
        case("no descriptor: map a ring", Map, last(4), (3, 0), 300).around(NoDescriptor),
        case("no memory: publish inline", Publish, last(4), (3, 1), 8).around(NoMemory),
        case("no memory: the first large one", PublishRefused, last(4), (0, 0), 5000)
            .around(NoMemory)
            .long(),
    ]
}
