//! The one beside the hostile process, and the honest one that both share a host with.

use std::{
    io::{self, Read as _, Write as _},
    path::Path,
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    thread,
    time::{Duration, Instant},
};

use axon_shm::{
    Context, Publisher, PublisherOptions, Sample, Subscriber, SubscriberOptions, qos::Qos,
};

use crate::meeting::meet;

/// The longest sample of the hostile one that is taken.
const LONGEST: u64 = 1 << 20;
/// How long two try to come together, and stay so.
const ROUND: Option<Duration> = Some(Duration::from_millis(250));

#[derive(Default)]
struct Counts {
    honest: AtomicU64,
    taken: AtomicU64,
    given: AtomicU64,
    reported: AtomicU64,
}

/// What the honest one publishes, and its neighbour must find.
fn sample(number: u64) -> Vec<u8> {
    let length = [8, 200, 5000][usize::try_from(number % 3).expect("less than three")];
    number.to_le_bytes().iter().cycle().take(length).copied().collect()
}

/// Publishes to the subscriber that meets it, for as long as this process lives.
pub(crate) fn publish(place: &Path) {
    let context = Context::new().expect("memory");
    let publisher =
        Publisher::new(&context, PublisherOptions::new(Qos::keep_all())).expect("memory");
    publisher.serve(meet(place, "honest", false), None).expect("a subscriber");
    for number in 1.. {
        while publisher.publish(&sample(number)).is_err() {}
        thread::sleep(Duration::from_micros(500));
    }
}

pub(crate) fn run(place: &Path) {
    let context = Context::new().expect("memory");
    let (counts, over) = (Counts::default(), AtomicBool::new(false));
    thread::scope(|scope| {
        scope.spawn(|| take_honest(&context, place, &counts, &over));
        scope.spawn(|| take_hostile(&context, place, &counts));
        scope.spawn(|| give_hostile(&context, place, &counts));
        scope.spawn(|| {
            let _ = io::stdin().read_to_end(&mut Vec::new());
            over.store(true, Relaxed);
        });
        while !over.load(Relaxed) {
            say(&counts);
            thread::sleep(Duration::from_secs(1));
        }
        // Alive and well: the honest one is heard still.
        let heard = counts.honest.load(Relaxed);
        while counts.honest.load(Relaxed) < heard + 10 {
            thread::sleep(Duration::from_millis(10));
        }
        say(&counts);
        // The others may be waiting for somebody who is no more.
        std::process::exit(0);
    });
}

fn say(counts: &Counts) {
    let Counts { honest, taken, given, reported } = counts;
    let [honest, taken, given, reported] =
        [honest, taken, given, reported].map(|count| count.load(Relaxed));
    let mut out = io::stdout().lock();
    writeln!(
        out,
        "{honest} honest samples, all there; of the hostile one {taken} taken, to it {given} given, \
         and {reported} times it was found out"
    )
    .and_then(|()| out.flush())
    .expect("somebody who listens");
}

fn take_honest(context: &Context, place: &Path, counts: &Counts, over: &AtomicBool) {
    let socket = meet(place, "honest", true);
    let options = SubscriberOptions::new(Qos::keep_all());
    let mut subscriber =
        Subscriber::connect(context, &socket, options, None).expect("the honest one");
    let mut bytes = Vec::new();
    let mut number = 0;
    while let Some(got) = subscriber.recv(None).expect("the honest one's sample") {
        number += 1;
        got.copy_to(&mut bytes).expect("memory");
        assert_eq!(got.meta().sequence, number);
        assert!(bytes == sample(number), "sample {number} is not what it was");
        assert_eq!(subscriber.lost(), 0);
        counts.honest.store(number, Relaxed);
    }
    assert!(over.load(Relaxed), "the honest one ended");
}

fn take_hostile(context: &Context, place: &Path, counts: &Counts) {
    let mut bytes = Vec::new();
    let mut kept: Vec<Sample> = Vec::new();
    loop {
        let socket = meet(place, "take", true);
        let depth = 1 + u32::try_from(counts.taken.load(Relaxed) % 20).expect("less than twenty");
        let qos = if depth > 16 { Qos::keep_all() } else { Qos::default().with_depth(depth) };
        let options = SubscriberOptions::new(qos).max_len(LONGEST);
        let Ok(mut subscriber) = Subscriber::connect(context, &socket, options, ROUND) else {
            continue;
        };
        let start = Instant::now();
        while start.elapsed() < ROUND.expect("a time") {
            let lost = subscriber.lost();
            match subscriber.recv(Some(Duration::from_millis(50))) {
                Ok(Some(sample)) => {
                    counts.taken.fetch_add(1, Relaxed);
                    if sample.copy_to(&mut bytes).is_ok() {
                        assert!(bytes.len() as u64 <= LONGEST);
                    }
                    sample.read_at(sample.len() / 2, &mut [0; 100]);
                    kept.push(sample);
                }
                Ok(None) => {}
                Err(_) => {
                    counts.reported.fetch_add(1, Relaxed);
                    break;
                }
            }
            counts.reported.fetch_add(subscriber.lost().saturating_sub(lost).min(1), Relaxed);
            if kept.len() > 8 {
                kept.clear();
            }
        }
    }
}

fn give_hostile(context: &Context, place: &Path, counts: &Counts) {
    let options = PublisherOptions::new(Qos::keep_all()).budget(2 << 20).max_len(LONGEST);
    let publisher = Publisher::new(context, options).expect("memory");
    for round in 0_usize.. {
        let socket = meet(place, "give", true);
        if publisher.serve(&socket, ROUND).is_err() {
            continue;
        }
        let start = Instant::now();
        while start.elapsed() < ROUND.expect("a time") {
            let length = [0, 50, 3000, 70_000][(round + counts.given.load(Relaxed) as usize) % 4];
            match publisher.publish(&vec![1; length]) {
                Ok(_) => counts.given.fetch_add(1, Relaxed),
                // It is held up for as long as it may be, and says by whom.
                Err(_) => counts.reported.fetch_add(1, Relaxed),
            };
            publisher.reap();
        }
        for subscriber in publisher.subscribers() {
            publisher.dismiss(subscriber);
        }
    }
}
