//! One of the processes: publishes and takes until it is told to come to an end, or is killed.

use std::{
    collections::HashMap,
    io::{self, BufRead, Write},
    sync::{
        Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant, SystemTime},
};

use axon_shm::{PublishError, Sample};
use axon_transport::{
    EndpointSpec, MessageInfo, Publisher, Session, SessionOptions, Subscription, config::Config,
    ids::Gid, qos::Qos,
};

use crate::{
    pair_log::PairLog,
    sample::{LONGEST, Random, fill, is_whole},
};

/// The environment variable that makes a process one of them; its value is the seed.
pub(crate) const ROLE: &str = "TORTURE_SEED";
/// What it takes if it is not wedged.
const PATIENCE: Duration = Duration::from_secs(120);
/// Samples that are kept for a while at most.
const KEPT: usize = 3;

struct Child {
    session: Session,
    every: [Publisher; 2],
    quiet: AtomicBool,
    over: AtomicBool,
    /// The last sample of each publisher that was taken, of those of which none may be missed.
    last: Mutex<HashMap<Gid, u64>>,
    taken: AtomicU64,
    /// What the KEEP_ALL subscription missed.
    missed: Mutex<Vec<Miss>>,
    pair_log: PairLog,
    /// How many samples were published by each publisher: the thread that publishes holds the lock meanwhile.
    published: [Mutex<u64>; 2],
}

/// Samples of one publisher that never came, though later ones did.
struct Miss {
    publisher: Gid,
    samples: u64,
    /// When the later one came, in milliseconds since the epoch.
    at: u128,
    /// Whether the subscription says that they are lost.
    counted: bool,
}

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", qos)
}

pub(crate) fn run(seed: u64) {
    // The other threads would wait for one that fails, and the conductor for all of them.
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        print(info);
        std::process::abort();
    }));
    let pair_log = PairLog::keep();
    let config = Config::from_env().expect("a configuration");
    let start = Instant::now();
    let session = loop {
        match Session::open(&config, SessionOptions::new("torture")) {
            Ok(session) => break session,
            // Daemons are killed while they start, too.
            Err(error) => assert!(start.elapsed() < PATIENCE, "{error}"),
        }
    };
    let qos = [Qos::keep_all(), Qos { depth: 4, ..Qos::default() }];
    let topics = ["/all", "/last"];
    let every = [0, 1].map(|n| session.create_publisher(spec(topics[n], qos[n])).expect("memory"));
    let subscriptions =
        [0, 1].map(|n| session.create_subscription(spec(topics[n], qos[n])).expect("memory"));
    let child = Child {
        session,
        every,
        quiet: AtomicBool::new(false),
        over: AtomicBool::new(false),
        last: Mutex::default(),
        taken: AtomicU64::new(0),
        missed: Mutex::default(),
        pair_log,
        published: Default::default(),
    };
    say(&hex(subscriptions[0].gid()));
    thread::scope(|scope| {
        scope.spawn(|| child.publish_all(&mut Random(seed)));
        let [all, last] = &subscriptions;
        scope.spawn(|| child.take_all(all, true, &mut Random(seed ^ 1)));
        scope.spawn(|| child.take_all(last, false, &mut Random(seed ^ 2)));
        child.obey();
        child.over.store(true, Ordering::Relaxed);
        child.session.segment().notify();
    });
}

impl Child {
    /// Does what the conductor says, a line at a time, until that one closes the pipe.
    fn obey(&self) {
        for line in io::stdin().lock().lines() {
            let line = line.expect("text");
            let mut words = line.split(' ');
            match words.next() {
                Some("count") => say(&format!(
                    "{} {}",
                    self.published.iter().map(|n| *n.lock().expect("no panic")).sum::<u64>(),
                    self.taken.load(Ordering::Relaxed)
                )),
                Some("missed") => {
                    let missed = self.missed.lock().expect("no panic");
                    let missed = missed.iter().map(|Miss { publisher, samples, at, counted }| {
                        format!("{} {samples} {at} {counted}", hex(*publisher))
                    });
                    say(&missed.collect::<Vec<_>>().join(" "));
                }
                // Of the pairs with this reader or writer, for people.
                Some("pair_log") => {
                    self.pair_log.print(words.next().expect("a GID"));
                    say("printed");
                }
                Some("quiet") => self.quiet.store(true, Ordering::Relaxed),
                // Everybody hears this publisher, and then its last samples.
                Some("final") => {
                    let (everybody, start) = (words.collect::<Vec<_>>(), Instant::now());
                    let everybody = everybody.iter();
                    let matched = || self.every[0].matched().into_iter().map(hex);
                    while !everybody.clone().all(|gid| matched().any(|one| one == *gid)) {
                        assert!(start.elapsed() < PATIENCE, "not everybody is matched");
                        thread::sleep(Duration::from_millis(10));
                    }
                    let mut random = Random(7);
                    let mut last = 0;
                    for _ in 0..10 {
                        last = self.publish(0, random.length());
                    }
                    say(&format!("{} {last}", hex(self.every[0].gid())));
                }
                Some("expect") => {
                    let gid = words.next().expect("a GID").to_owned();
                    let number: u64 = words.next().and_then(|n| n.parse().ok()).expect("a number");
                    let reached = || {
                        let last = self.last.lock().expect("no panic");
                        last.iter().any(|(g, last)| hex(*g) == gid && *last == number)
                    };
                    assert!(
                        self.session.wait(reached, Some(PATIENCE)),
                        "sample {number} of {gid} never came; {:?}",
                        self.last.lock().expect("no panic")
                    );
                    say("there");
                }
                other => panic!("{other:?}"),
            }
        }
    }

    fn publish_all(&self, random: &mut Random) {
        while !self.over.load(Ordering::Relaxed) {
            if self.quiet.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(5));
                continue;
            }
            self.publish(usize::from(random.below(2) == 1), random.length());
            thread::sleep(Duration::from_micros(random.below(4000)));
        }
    }

    /// Publishes a sample, whatever it takes, and returns its number; 0 when all is over.
    fn publish(&self, which: usize, length: usize) -> u64 {
        let publisher = &self.every[which];
        let mut published = self.published[which].lock().expect("no panic");
        let next = *published + 1;
        let mut payload = vec![0; length.min(LONGEST)];
        fill(stamp(publisher.gid()), next, &mut payload);
        loop {
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
                    *published = next;
                    return next;
                }
                Err(_) if self.over.load(Ordering::Relaxed) => return 0,
                // Somebody is stopped, or slow, or keeps too much.
                Err(
                    PublishError::Blocked { .. }
                    | PublishError::Pinned { .. }
                    | PublishError::NoMemory { .. },
                ) => {}
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// Records the samples missing between `before` and the sample that came, and prints how that came about.
    fn missed(&self, info: &MessageInfo, before: u64, counted: bool) {
        let (publisher, samples) = (info.publisher, info.sequence - before - 1);
        let at = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let at = at.expect("after the epoch").as_millis();
        self.missed.lock().expect("no panic").push(Miss { publisher, samples, at, counted });
        let said = if counted { "counted" } else { "NOT COUNTED" };
        self.pair_log.add(&format!(
            "{publisher}: {samples} samples missing between {before} and {}, {said}",
            info.sequence
        ));
    }

    fn take_all(&self, subscription: &Subscription, gapless: bool, random: &mut Random) {
        let mut last: HashMap<Gid, u64> = HashMap::new();
        let mut kept: Vec<(MessageInfo, Sample)> = Vec::new();
        let mut bytes = Vec::new();
        let mut all_missed = 0;
        while !self.over.load(Ordering::Relaxed) {
            let ready = || subscription.has_data() || self.over.load(Ordering::Relaxed);
            self.session.wait(ready, Some(Duration::from_millis(50)));
            let info = if random.below(2) == 0 {
                let Some(info) = subscription.take(&mut bytes) else { continue };
                assert!(is_whole(stamp(info.publisher), info.sequence, 0, &bytes), "{info:?}");
                info
            } else {
                let Some((info, sample)) = subscription.take_sample() else { continue };
                check(&info, &sample);
                kept.push((info, sample));
                info
            };
            // What was kept is still what it was when the publisher has gone far beyond it.
            if kept.len() > KEPT || random.below(4) == 0 {
                for (info, sample) in kept.drain(..) {
                    check(&info, &sample);
                }
            }
            let before = last.insert(info.publisher, info.sequence);
            if let Some(before) = before {
                assert!(info.sequence > before, "{info:?} after {before}");
                let missed = info.sequence - before - 1;
                // A publisher does not wait for subscriptions of its own session.
                let own = self.every.iter().any(|publisher| publisher.gid() == info.publisher);
                if gapless && missed > 0 {
                    all_missed += missed;
                    let counted = all_missed <= subscription.lost();
                    // Each miss that is not counted is told of once.
                    all_missed = all_missed.min(subscription.lost());
                    if !own {
                        self.missed(&info, before, counted);
                    }
                }
            }
            self.taken.fetch_add(1, Ordering::Relaxed);
            if gapless {
                self.last.lock().expect("no panic").insert(info.publisher, info.sequence);
                // The thread that waits for the last of all looks again.
                self.session.segment().notify();
            }
        }
    }
}

fn check(info: &MessageInfo, sample: &Sample) {
    let mut piece = vec![0; (64 << 10).min(sample.len())];
    let mut at = 0;
    while at < sample.len() {
        let read = sample.read_at(at, &mut piece);
        assert!(is_whole(stamp(info.publisher), info.sequence, at, &piece[..read]), "{info:?}");
        at += read;
    }
}

/// What the pattern knows of a publisher.
fn stamp(gid: Gid) -> u64 {
    let (low, high) = gid.0.split_at(8);
    let word = |half: &[u8]| u64::from_le_bytes(half.try_into().expect("eight bytes"));
    word(low) ^ word(high)
}

fn hex(gid: Gid) -> String {
    gid.0.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A line to the conductor.
fn say(text: &str) {
    let mut out = io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush()).expect("somebody who listens");
}
