//! Publishes samples of random length at random times.

use std::{
    sync::mpsc::{Receiver, RecvTimeoutError},
    thread,
    time::Duration,
};

use axon_transport::{Publisher, Session, ids::Gid};
use rand::{RngExt, rngs::StdRng};

use super::{broken, is_for_now, key, length};
use crate::{
    Result,
    part::{PATIENCE, now_ns, say},
    torture::{
        content::fill,
        words::{Order, Report, Topic},
    },
};

/// Samples that `Finish` asks for.
const LAST: usize = 10;
/// Short samples in a row that come now and then.
const BURST: usize = 20;
/// How long a publisher that ends waits for acknowledgements.
const ACKNOWLEDGED: Duration = Duration::from_secs(20);

struct Stream<'a> {
    publisher: Publisher,
    topic: Topic,
    random: &'a mut StdRng,
    published: u64,
    readers: Vec<Gid>,
    given_up: u64,
    bytes: Vec<u8>,
}

pub(super) fn run(
    session: &Session,
    topic: Topic,
    orders: &Receiver<Order>,
    random: &mut StdRng,
) -> Result<()> {
    let publisher = session.create_publisher(topic.publisher())?;
    say(&Report::Ready { gid: publisher.gid().to_string() })?;
    let (readers, bytes) = (Vec::new(), Vec::new());
    let mut stream = Stream { publisher, topic, random, published: 0, readers, given_up: 0, bytes };
    let mut is_quiet = false;
    loop {
        let pause = stream.random.random_range(0..=topic.pause_ms());
        match orders.recv_timeout(Duration::from_millis(pause)) {
            Err(RecvTimeoutError::Timeout) if is_quiet => stream.tell_given_up()?,
            Err(RecvTimeoutError::Timeout) => stream.publish_some()?,
            Ok(Order::Quiet) => is_quiet = true,
            Ok(Order::Finish) => stream.finish()?,
            Ok(Order::End { wait }) => return stream.end(wait),
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
    }
}

impl Stream<'_> {
    fn publish_some(&mut self) -> Result<()> {
        let (shortest, longest) = self.topic.lengths();
        if self.random.random_bool(0.02) {
            for _ in 0..BURST {
                let length = length(self.random, (shortest, 1_000));
                self.publish(length)?;
            }
            return Ok(());
        }
        let length = length(self.random, (shortest, longest));
        self.publish(length)
    }

    /// Publishes a sample, if there is room for it.
    fn publish(&mut self, length: usize) -> Result<()> {
        let (number, at) = (self.published + 1, now_ns());
        self.bytes.resize(length, 0);
        fill(&mut self.bytes, key(self.publisher.gid()), number, at);
        let before = self.publisher.matched();
        let published = self.publisher.publish(&self.bytes);
        self.tell_given_up()?;
        match published {
            Ok(given) if given == number => {}
            Ok(given) => return broken(format!("sample {given} after {}", self.published)),
            Err(error) if is_for_now(&error) => return Ok(()),
            Err(error) => return Err(error.into()),
        }
        self.published = number;
        // A reader that was there before and after it was there meanwhile.
        let after = self.publisher.matched();
        let mut readers: Vec<Gid> = before.into_iter().filter(|gid| after.contains(gid)).collect();
        readers.sort_unstable();
        if readers != self.readers {
            let names = readers.iter().map(Gid::to_string).collect();
            say(&Report::Matched { from: number, readers: names })?;
            self.readers = readers;
        }
        say(&Report::Published { number, bytes: length, at })
    }

    fn tell_given_up(&mut self) -> Result<()> {
        let total = self.publisher.given_up();
        if total == self.given_up {
            return Ok(());
        }
        self.given_up = total;
        say(&Report::GivenUp { total, at: now_ns() })
    }

    fn finish(&mut self) -> Result<()> {
        if !self.publisher.wait_matched(2, PATIENCE) {
            broken(format!("{:?} are matched, not both subscribers", self.publisher.matched()))?;
        }
        let target = self.published + LAST as u64;
        while self.published < target {
            self.publish_some()?;
            thread::sleep(Duration::from_millis(30));
        }
        say(&Report::Finished)
    }

    fn end(mut self, wait: bool) -> Result<()> {
        self.publish_some()?;
        let acknowledged = wait.then(|| self.publisher.wait_acknowledged(ACKNOWLEDGED));
        self.tell_given_up()?;
        say(&Report::Ended { acknowledged, at: now_ns() })
    }
}
