//! Publishes samples of random length, some through loans that are held while other samples go out.

use std::{
    sync::{MutexGuard, atomic::Ordering},
    thread,
    time::Duration,
};

use axon_shm::PublishError;
use axon_transport::Publisher;

use super::{Child, hex, say, spec, stamp};
use crate::sample::{Random, fill};

/// A publisher, and the number of samples that it has published. Publishing and ending hold its lock.
pub(super) struct Stream {
    publisher: Publisher,
    published: u64,
}

impl Stream {
    pub(super) fn new(publisher: Publisher) -> Self {
        Self { publisher, published: 0 }
    }
}

impl Child {
    pub(super) fn publish_all(&self, random: &mut Random) {
        while !self.over.load(Ordering::Relaxed) {
            if self.quiet.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(5));
                continue;
            }
            let mut stream = self.stream(usize::from(random.below(2) == 1));
            if random.below(16) == 0 {
                self.publish_around_loan(&mut stream, random);
            } else {
                self.publish(&mut stream, random.length());
            }
            drop(stream);
            thread::sleep(Duration::from_micros(random.below(4000)));
        }
    }

    pub(super) fn stream(&self, which: usize) -> MutexGuard<'_, Stream> {
        self.streams[which].lock().expect("no panic")
    }

    /// Waits until all `readers` are matched, and then publishes ten samples.
    pub(super) fn finish(&self, readers: &[&str], patience: Duration) {
        let start = std::time::Instant::now();
        let mut stream = self.stream(0);
        let matched = || stream.publisher.matched().into_iter().map(hex);
        while !readers.iter().all(|gid| matched().any(|one| one == *gid)) {
            assert!(start.elapsed() < patience, "not everybody is matched");
            thread::sleep(Duration::from_millis(10));
        }
        let mut random = Random(7);
        for _ in 0..10 {
            self.publish(&mut stream, random.length());
        }
        say(&format!("{} {}", hex(stream.publisher.gid()), stream.published));
    }

    /// Ends the KEEP_ALL publisher after a last sample. Reports its GID, the number of that sample, and the readers
    /// that must get it. Another publisher replaces it unless the process is about to end.
    pub(super) fn end_publisher(&self, process: bool) {
        let mut stream = self.stream(0);
        let readers: Vec<String> = stream.publisher.matched().into_iter().map(hex).collect();
        self.publish(&mut stream, 100);
        let (gid, last) = (hex(stream.publisher.gid()), stream.published);
        if process {
            // The publisher ends together with its session.
            self.over.store(true, Ordering::Relaxed);
        } else {
            let spec = spec("/all", axon_transport::qos::Qos::keep_all());
            *stream = Stream::new(self.session.create_publisher(spec).expect("memory"));
        }
        say(&format!("{gid} {last} {}", readers.join(" ")));
    }

    pub(super) fn published(&self) -> u64 {
        (0..2).map(|which| self.stream(which).published).sum()
    }

    /// Takes a loan, publishes other samples, and only then publishes or drops the loan.
    fn publish_around_loan(&self, stream: &mut Stream, random: &mut Random) {
        let (length, others) = (random.length(), 1 + random.below(3));
        // The publisher publishes other samples, by copy and by loan, while this loan is held.
        let held = stream.publisher.loan(length).ok().map(|mut loan| {
            let mut published = stream.published;
            for _ in 0..others {
                published = self.publish_next(&stream.publisher, published, random.length());
                thread::sleep(Duration::from_millis(random.below(20)));
            }
            if self.over.load(Ordering::Relaxed) || random.below(4) == 0 {
                return published;
            }
            let next = published + 1;
            fill(stamp(stream.publisher.gid()), next, &mut loan);
            match loan.publish() {
                Ok(number) => {
                    assert_eq!(number, next, "numbers rise by one");
                    next
                }
                Err(error) => {
                    assert!(is_for_now(&error), "{error}");
                    published
                }
            }
        });
        if let Some(published) = held {
            stream.published = published;
        }
    }

    /// Publishes a sample. Retries as long as necessary, unless the test is over.
    fn publish(&self, stream: &mut Stream, length: usize) {
        stream.published = self.publish_next(&stream.publisher, stream.published, length);
    }

    /// Like [`publish`](Self::publish); returns the number of published samples.
    fn publish_next(&self, publisher: &Publisher, published: u64, length: usize) -> u64 {
        let next = published + 1;
        let mut payload = vec![0; length];
        fill(stamp(publisher.gid()), next, &mut payload);
        // A publisher that has ended publishes nothing more.
        while !self.over.load(Ordering::Relaxed) {
            let done = if length.is_multiple_of(2) {
                publisher.publish(&payload)
            } else {
                publisher.loan(length).and_then(|mut loan| {
                    loan.copy_from_slice(&payload);
                    loan.publish()
                })
            };
            match done {
                Ok(number) => {
                    assert_eq!(number, next, "numbers rise by one");
                    return next;
                }
                Err(error) => assert!(is_for_now(&error), "{error}"),
            }
        }
        published
    }
}

/// Returns whether the error is temporary: a peer is stopped, slow or keeps too much.
pub(super) fn is_for_now(error: &PublishError) -> bool {
    matches!(
        error,
        PublishError::Blocked { .. } | PublishError::Pinned { .. } | PublishError::NoMemory { .. }
    )
}
