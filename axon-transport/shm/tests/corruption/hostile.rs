//! The hostile one. It comes by its memory honestly; what it does with it is its own.

use std::{
    fs::{self, File},
    os::{fd::AsFd, unix::fs::MetadataExt as _},
    path::Path,
    sync::atomic::{
        AtomicU64,
        Ordering::{Relaxed, SeqCst},
    },
    thread,
    time::{Duration, Instant},
};

use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};
use rustix::fs::{SeekFrom, seek};

use crate::meeting::meet;

/// How long two try to come together, and stay so.
const ROUND: Duration = Duration::from_millis(250);

/// One life: shares memory, overwrites it, and ends without a word.
pub(crate) fn run(place: &Path, seed: u64) {
    let random = AtomicU64::new(seed);
    let context = Context::new().expect("memory");
    let qos = if next(&random).is_multiple_of(2) { Qos::keep_all() } else { Qos::default() };
    let options = PublisherOptions::new(qos).budget(4 << 20).max_len(1 << 20);
    let publisher = Publisher::new(&context, options).expect("memory");
    thread::scope(|scope| {
        scope.spawn(|| give(&publisher, place, &random));
        scope.spawn(|| take(&context, place));
        thread::sleep(Duration::from_millis(next(&random) % 100));
        let start = Instant::now();
        while start.elapsed() < ROUND {
            corrupt(&random);
        }
        // So that an attached process has something to notice, whatever chance did.
        deface();
        thread::sleep(Duration::from_millis(20));
        // The others may wait for ever for what they have overwritten.
        std::process::exit(0);
    });
}

fn give(publisher: &Publisher, place: &Path, random: &AtomicU64) {
    let _ = publisher.serve(meet(place, "take", false), Some(ROUND));
    loop {
        let length = [0, 40, 1000, 5000, 100_000][usize::try_from(next(random) % 5).expect("five")];
        let _ = publisher.try_publish(&vec![7; length]);
        thread::sleep(Duration::from_micros(next(random) % 500));
    }
}

fn take(context: &Context, place: &Path) {
    let socket = meet(place, "give", false);
    let options = SubscriberOptions::new(Qos::keep_all());
    let Ok(mut subscriber) = Subscriber::connect(context, &socket, options, Some(ROUND)) else {
        return;
    };
    let mut kept = Vec::new();
    loop {
        match subscriber.take() {
            Ok(Some(sample)) if kept.len() < 4 => kept.push(sample),
            Ok(Some(_)) => kept.clear(),
            Ok(None) => thread::yield_now(),
            Err(_) => return,
        }
    }
}

fn next(random: &AtomicU64) -> u64 {
    let mut z = random.fetch_add(0x9e37_79b9_7f4a_7c15, Relaxed);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Writable memory of this process that others have mapped, by address and length.
fn shared() -> Vec<(usize, usize)> {
    let mut found = Vec::new();
    let maps = fs::read_to_string("/proc/self/maps").expect("procfs");
    for line in maps.lines().filter(|line| line.contains(" rw-s ") && line.contains("/memfd:axon"))
    {
        let mut fields = line.split_ascii_whitespace();
        let range = fields.next().and_then(|range| range.split_once('-')).expect("a range");
        let base = usize::from_str_radix(range.0, 16).expect("an address");
        let inode: u64 = fields.nth(3).and_then(|inode| inode.parse().ok()).expect("an inode");
        let file = fs::read_dir("/proc/self/fd").expect("procfs").flatten().find_map(|entry| {
            let same = fs::metadata(entry.path()).is_ok_and(|found| found.ino() == inode);
            same.then(|| File::open(entry.path()).ok()).flatten()
        });
        let Some(file) = file else { continue };
        // Only what has memory: the rest would be taken by writing to it.
        let mut from = 0;
        while let Ok(start) = seek(file.as_fd(), SeekFrom::Data(from)) {
            let end = seek(file.as_fd(), SeekFrom::Hole(start)).unwrap_or(start);
            let number = |offset: u64| usize::try_from(offset).expect("an offset");
            found.push((base + number(start), number(end - start)));
            from = end;
        }
    }
    found
}

/// Writes what nothing of its own ever holds over all that is there.
fn deface() {
    for (base, bytes) in shared() {
        for at in (base..base + bytes).step_by(8) {
            word(at).store(u64::MAX, SeqCst);
        }
    }
}

fn word(at: usize) -> &'static AtomicU64 {
    // SAFETY: `at` is aligned, and inside a writable map of this process, which stands while its
    // context and publisher do: for as long as another process corrupts it. It may be written by others of its
    // threads, atomically. That what it breaks is its own is the point of this process.
    unsafe { &*std::ptr::with_exposed_provenance::<AtomicU64>(at) }
}

/// Writes here and there for some milliseconds.
fn corrupt(random: &AtomicU64) {
    let extents = shared();
    if extents.is_empty() {
        return;
    }
    let index = |bound: usize| usize::try_from(next(random)).expect("a number") % bound;
    let any = || {
        let (base, bytes) = extents[index(extents.len())];
        let words = bytes / 8;
        // Half of them where headers, lanes and slots are.
        let near = if next(random).is_multiple_of(2) { words.min(1 << 10) } else { words };
        word(base + 8 * index(near))
    };
    for _ in 0..2_000 {
        let target = any();
        let was = target.load(Relaxed);
        let crafted = match next(random) % 16 {
            0 => next(random),
            1 => 0,
            2 => 1,
            3 => 1 << 31,
            4 => (1 << 32) - 1,
            5 => 1 << 62,
            6 => u64::MAX,
            7 => i64::MAX as u64,
            8 => was.wrapping_add(1),
            9 => was.wrapping_sub(1),
            10 => was.wrapping_add(2),
            11 => was ^ (1 << (next(random) % 64)),
            12 => was & 0xffff_ffff,
            13 => was.wrapping_add(1 << 32),
            14 => next(random) % (8 << 20),
            _ => any().load(Relaxed),
        };
        match next(random) % 8 {
            // For good.
            0 if next(random).is_multiple_of(8) => target.store(crafted, SeqCst),
            // Back and forth while it is looked at.
            1 => {
                (0..500).for_each(|n| target.store(if n % 2 == 0 { crafted } else { was }, SeqCst))
            }
            // For a moment, so that what follows from it is reached.
            _ => {
                target.store(crafted, SeqCst);
                (0..1_u32 << (next(random) % 15)).for_each(|_| std::hint::spin_loop());
                target.store(was, SeqCst);
            }
        }
    }
}
