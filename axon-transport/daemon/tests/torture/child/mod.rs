//! One of the processes: it publishes, takes, calls and answers until it is told to end, or is killed.

mod calls;
mod publishing;
mod taking;

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

use axon_transport::{
    Client, EndpointSpec, MessageInfo, Session, SessionOptions, config::Config, ids::Gid, qos::Qos,
};

use self::{calls::Calls, publishing::Stream};
use crate::{pair_log::PairLog, sample::Random};

/// The environment variable that makes this program one of the processes. Its value is the seed.
pub(crate) const ROLE: &str = "TORTURE_SEED";
/// The niceness of the processes. The conductor has a higher priority, so that it disturbs them in time however busy
/// the machine is.
const NICER: i32 = 5;
/// Time after which an operation counts as stuck.
const PATIENCE: Duration = Duration::from_secs(120);

struct Child {
    session: Session,
    /// The GID of the subscription that must not miss a sample.
    gapless: String,
    /// The KEEP_ALL and the KEEP_LAST publisher.
    streams: [Mutex<Stream>; 2],
    quiet: AtomicBool,
    over: AtomicBool,
    /// The last taken sample of each publisher of which no sample may be missed.
    last: Mutex<HashMap<Gid, u64>>,
    taken: AtomicU64,
    calls: Calls,
    answers: AtomicU64,
    misses: Mutex<Vec<Miss>>,
    pair_log: PairLog,
}

/// Messages of one partner that never came.
struct Miss {
    kind: Kind,
    partner: Gid,
    messages: u64,
    /// The time when that was seen, in milliseconds since the epoch.
    at: u128,
}

/// The kind of the missing messages.
#[derive(Clone, Copy)]
enum Kind {
    /// Samples for the KEEP_ALL subscription, although later ones arrived.
    Sample {
        /// True if the subscription counts them as lost.
        counted: bool,
    },
    /// Requests for the server, although later ones arrived.
    Request,
    /// Responses for the client, although later ones arrived.
    Response,
    /// Responses of a server that is gone.
    Unanswered,
}

impl Kind {
    fn word(self) -> &'static str {
        match self {
            Self::Sample { counted: true } => "counted",
            Self::Sample { counted: false } => "uncounted",
            Self::Request => "request",
            Self::Response => "response",
            Self::Unanswered => "unanswered",
        }
    }
}

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", qos)
}

pub(crate) fn run(seed: u64) {
    // If one thread fails, the other threads would wait for it, and the conductor for all of them.
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        print(info);
        std::process::abort();
    }));
    let _ = rustix::process::nice(NICER);
    let pair_log = PairLog::keep();
    let config = Config::from_env().expect("a configuration");
    let start = Instant::now();
    let session = loop {
        match Session::open(&config, SessionOptions::new("torture")) {
            Ok(session) => break session,
            // Daemons are also killed while they start.
            Err(error) => assert!(start.elapsed() < PATIENCE, "{error}"),
        }
    };
    let qos = [Qos::keep_all(), Qos::default().with_depth(4)];
    let topics = ["/all", "/last"];
    let streams = [0, 1].map(|n| {
        let publisher = session.create_publisher(spec(topics[n], qos[n])).expect("memory");
        Mutex::new(Stream::new(publisher))
    });
    let subscriptions =
        [0, 1].map(|n| session.create_subscription(spec(topics[n], qos[n])).expect("memory"));
    let server = session.create_server(spec("/call", Qos::keep_all())).expect("memory");
    let client = session.create_client(spec("/call", Qos::keep_all())).expect("memory");
    let child = Child {
        session,
        gapless: hex(subscriptions[0].gid()),
        streams,
        quiet: AtomicBool::new(false),
        over: AtomicBool::new(false),
        last: Mutex::default(),
        taken: AtomicU64::new(0),
        calls: Calls::default(),
        answers: AtomicU64::new(0),
        misses: Mutex::default(),
        pair_log,
    };
    say(&child.gapless);
    thread::scope(|scope| {
        scope.spawn(|| child.publish_all(&mut Random(seed)));
        let [all, last] = &subscriptions;
        scope.spawn(|| child.take_all(all, true, &mut Random(seed ^ 1)));
        scope.spawn(|| child.take_all(last, false, &mut Random(seed ^ 2)));
        scope.spawn(|| child.call_all(&client, &mut Random(seed ^ 3)));
        scope.spawn(|| child.answer_all(&server));
        child.obey(&client);
        child.over.store(true, Ordering::Relaxed);
        child.session.segment().notify();
    });
}

impl Child {
    /// Follows the conductor's orders, one line at a time, until it closes the pipe or ends this process.
    fn obey(&self, client: &Client) {
        for line in io::stdin().lock().lines() {
            let line = line.expect("text");
            let mut words = line.split(' ');
            match words.next() {
                Some("count") => say(&format!(
                    "{} {} {}",
                    self.published(),
                    self.taken.load(Ordering::Relaxed),
                    self.answers.load(Ordering::Relaxed)
                )),
                Some("missed") => {
                    let misses = self.misses.lock().expect("no panic");
                    let misses = misses.iter().map(|Miss { kind, partner, messages, at }| {
                        format!("{} {messages} {at} {}", hex(*partner), kind.word())
                    });
                    say(&misses.collect::<Vec<_>>().join(" "));
                }
                // Prints the log of the pairs with this reader or writer, for people.
                Some("pair_log") => {
                    self.pair_log.print(words.next().expect("a GID"));
                    say("printed");
                }
                Some("quiet") => self.quiet.store(true, Ordering::Relaxed),
                Some("final") => self.finish(&words.collect::<Vec<_>>(), PATIENCE),
                Some("calls") => match self.finish_calls(client) {
                    Some(server) => say(&format!("{} {}", hex(client.gid()), hex(server))),
                    None => say("answered"),
                },
                // Ends after the given number of milliseconds.
                Some("end") => {
                    let after = words.next().and_then(|n| n.parse().ok()).expect("a time");
                    let process = words.next() == Some("process");
                    thread::sleep(Duration::from_millis(after));
                    self.end_publisher(process);
                    if process {
                        return;
                    }
                }
                Some("expect") => {
                    let gid = words.next().expect("a GID").to_owned();
                    let number: u64 = words.next().and_then(|n| n.parse().ok()).expect("a number");
                    let reached = || {
                        let last = self.last.lock().expect("no panic");
                        last.iter().any(|(g, last)| hex(*g) == gid && *last == number)
                    };
                    let unmet = || self.pair_log.unmet(&self.gapless, Some(&gid));
                    let done = || reached() || unmet().is_some();
                    let came = self.session.wait(done, Some(PATIENCE));
                    // The subscription lost all of its samples, or none.
                    if let Some(samples) = unmet() {
                        let taken = self.last.lock().expect("no panic");
                        let taken = taken.keys().any(|publisher| hex(*publisher) == gid);
                        assert!(!taken, "{gid}: samples were taken of a publisher that was unmet");
                        assert!((1..=number).contains(&samples), "{samples} of {number}");
                        say("counted");
                        continue;
                    }
                    if !came {
                        self.pair_log.print(&gid);
                        let last = self.last.lock().expect("no panic");
                        let last = last.iter().find(|(g, _)| hex(**g) == gid);
                        assert!(last.is_none(), "sample {number} of {gid} never came: {last:?}");
                        say("never");
                        continue;
                    }
                    say("there");
                }
                other => panic!("{other:?}"),
            }
        }
    }

    /// Records the messages that are missing before the one that arrived.
    fn missed(&self, kind: Kind, info: &MessageInfo, messages: u64) {
        self.note(kind, info.publisher, messages);
        self.pair_log.add(&format!(
            "{}: {messages} missing before {}, {}",
            info.publisher,
            info.sequence,
            kind.word()
        ));
    }

    fn note(&self, kind: Kind, partner: Gid, messages: u64) {
        let at = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let at = at.expect("after the epoch").as_millis();
        self.misses.lock().expect("no panic").push(Miss { kind, partner, messages, at });
    }
}

/// Returns the part of a publisher's GID that the pattern contains.
fn stamp(gid: Gid) -> u64 {
    let (low, high) = gid.0.split_at(8);
    let word = |half: &[u8]| u64::from_le_bytes(half.try_into().expect("eight bytes"));
    word(low) ^ word(high)
}

fn hex(gid: Gid) -> String {
    gid.0.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Sends a line to the conductor.
fn say(text: &str) {
    let mut out = io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush()).expect("somebody who listens");
}
