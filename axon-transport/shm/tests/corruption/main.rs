//! A process that writes what it likes over everything it may write, and its neighbours, which must
//! not crash, hang, or take harm from it.
//!
//! The hostile one shares memory as any publisher and subscriber does, and then writes over every
//! byte of what others have mapped of it: random words, words that are nearly right, and words that
//! change back and forth while they are looked at. Its neighbour takes from it and publishes to it
//! all the while, and takes a third process's samples, of which none may be missing or changed. The
//! neighbour runs under valgrind where that is installed, so that not even a read outside its memory
//! goes unseen.
//!
//! Ten seconds by default; `cargo test --release -p axon-shm --test corruption -- --minutes 10`
//! for longer, `--seed N` for the same choices again. With the address sanitizer, on nightly:
//!
//! ```sh
//! RUSTFLAGS=-Zsanitizer=address cargo +nightly test --target x86_64-unknown-linux-gnu \
//!     -p axon-shm --test corruption -- --minutes 2
//! ```
//!
//! Whether anything checks the neighbour is tried first: a process reads beyond its memory, and must
//! be caught.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

mod hostile;
mod meeting;
mod neighbour;

use std::{
    env,
    io::{BufRead as _, BufReader},
    os::unix::net::UnixDatagram,
    path::Path,
    process::{Child, Command, ExitCode, Stdio},
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::{Duration, Instant},
};

use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};

/// The environment variables that make a process one of them: its role, and where they meet.
const ROLE: &str = "CORRUPTION_ROLE";
const PLACE: &str = "CORRUPTION_PLACE";
const SEED: &str = "CORRUPTION_SEED";
/// A hostile process that lives for so long stands still.
const LIFE: Duration = Duration::from_secs(3);
/// A neighbour that says nothing for so long is hanging.
const PATIENCE: Duration = Duration::from_secs(60);

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let Ok(role) = env::var(ROLE) {
        let place = env::var(PLACE).expect("a directory");
        let seed = env::var(SEED).ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
        match role.as_str() {
            "hostile" => hostile::run(Path::new(&place), seed),
            "honest" => neighbour::publish(Path::new(&place)),
            "probe" => probe(),
            "overrun" => overrun(),
            _ => neighbour::run(Path::new(&place)),
        }
        return ExitCode::SUCCESS;
    }
    if arguments.iter().any(|a| a == "--list") {
        println!("corruption: test");
        return ExitCode::SUCCESS;
    }
    let value = |name: &str| {
        let at = arguments.iter().position(|a| a == name)?;
        arguments.get(at + 1)?.parse::<u64>().ok()
    };
    let time = value("--minutes").map_or(Duration::from_secs(10), |m| Duration::from_secs(60 * m));
    let plain = arguments.iter().any(|a| a == "--plain");
    conduct(time, value("--seed").unwrap_or(1), plain);
    ExitCode::SUCCESS
}

/// A process that does not outlive this one.
struct Kept(Child);

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn play(role: &str, place: &Path, seed: u64, through: &[&str]) -> Kept {
    let own = env::current_exe().expect("its own path");
    let mut command = match through {
        [] => Command::new(own),
        [program, arguments @ ..] => {
            let mut command = Command::new(program);
            command.args(arguments).arg(own);
            command
        }
    };
    command.env(ROLE, role).env(PLACE, place).env(SEED, seed.to_string());
    if role == "hostile" || role == "overrun" {
        // How it fails is of no interest.
        command.stderr(Stdio::null());
    }
    Kept(command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a process"))
}

/// Reads beyond its memory, for whatever checks that.
fn overrun() {
    let bytes = std::hint::black_box(vec![1_u8; 64]);
    // SAFETY: none: this is the very error that a checker must see. Nothing else is done here.
    std::hint::black_box(unsafe { bytes.as_ptr().wrapping_add(64).read_volatile() });
}

/// Whether a read beyond memory is caught.
fn is_checked(through: &[&str], place: &Path) -> bool {
    let mut overrun = play("overrun", place, 0, through);
    !overrun.0.wait().expect("a child").success()
}

/// Shares memory with another, of the same process: fails where what that takes cannot be had.
fn probe() {
    let (one, another) = UnixDatagram::pair().expect("sockets");
    let [here, there] = [(), ()].map(|()| Context::new().expect("a context"));
    thread::scope(|scope| {
        scope.spawn(|| {
            let options = SubscriberOptions::new(Qos::default());
            drop(Subscriber::connect(&there, &another, options, Some(PATIENCE)).expect("served"));
        });
        let publisher = Publisher::new(&here, PublisherOptions::new(Qos::default()));
        publisher.expect("a publisher").serve(&one, Some(PATIENCE)).expect("a subscriber");
    });
}

/// Whether the neighbour can run under a checker; says why if it cannot.
fn works_under(checker: &[&str], place: &Path) -> bool {
    let [program, arguments @ ..] = checker else { return false };
    let mut probe = Command::new(program);
    probe.args(arguments).arg(env::current_exe().expect("its own path"));
    match probe.env(ROLE, "probe").env(PLACE, place).output() {
        Ok(output) if output.status.success() => true,
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr);
            let why = said.lines().find(|line| line.contains("unhandled")).unwrap_or("it fails");
            println!("the neighbour runs without {program}, which is too old for it: {why}");
            false
        }
        Err(error) => {
            println!("the neighbour runs without {program}: {error}");
            false
        }
    }
}

/// Lets one hostile process come after another. How many there were.
fn corrupt(place: &Path, seed: u64, over: &AtomicBool) -> u64 {
    let mut lives = 0;
    while !over.load(Ordering::Relaxed) {
        let mut hostile = play("hostile", place, seed + lives, &[]);
        lives += 1;
        // One that overwrites what it uses itself may well crash, or stand still.
        let start = Instant::now();
        while hostile.0.try_wait().expect("a child").is_none() && start.elapsed() < LIFE {
            thread::sleep(Duration::from_millis(5));
        }
    }
    lives
}

/// What the neighbour counts, of which the last is how often it noticed something.
fn numbers(line: &str) -> Vec<u64> {
    line.split(' ').filter_map(|word| word.parse().ok()).collect()
}

fn conduct(time: Duration, seed: u64, plain: bool) {
    let place = tempfile::tempdir().expect("a directory");
    let valgrind = ["valgrind", "-q", "--error-exitcode=99", "--fair-sched=yes"];
    let through = if plain || !works_under(&valgrind, place.path()) { &[] } else { &valgrind[..] };
    let checked = is_checked(through, place.path());
    assert!(checked || through.is_empty(), "valgrind does not see a read beyond memory");
    let start = Instant::now();
    let mut neighbour = play("neighbour", place.path(), seed, through);
    let _honest = play("honest", place.path(), seed, &[]);
    let said = BufReader::new(neighbour.0.stdout.take().expect("a pipe")).lines();
    let (sender, answers) = mpsc::channel();
    thread::spawn(move || said.map_while(Result::ok).try_for_each(|line| sender.send(line)));
    let (over, mut last) = (AtomicBool::new(false), String::new());
    let reported = |line: &str| numbers(line).last().copied().unwrap_or(0);
    let lives = thread::scope(|scope| {
        let hostile = scope.spawn(|| corrupt(place.path(), seed, &over));
        // It says once a second how it is. At its end the honest one's samples must still come. On
        // a busy machine it may take longer until the two have met at all.
        let enough = || start.elapsed() >= time;
        while !enough() || (reported(&last) == 0 && start.elapsed() < time + PATIENCE) {
            match answers.recv_timeout(PATIENCE) {
                Ok(line) => last = line,
                Err(error) => {
                    over.store(true, Ordering::Relaxed);
                    panic!("the neighbour is silent ({error}): {:?}", neighbour.0.try_wait())
                }
            }
        }
        over.store(true, Ordering::Relaxed);
        hostile.join().expect("no panic")
    });
    drop(neighbour.0.stdin.take());
    for line in answers {
        last = line;
    }
    let status = neighbour.0.wait().expect("a child");
    assert!(status.success(), "the neighbour took harm: {status}");
    let how = match (through.is_empty(), checked) {
        (false, true) => "under valgrind",
        (true, true) => "with the address sanitizer",
        (_, false) => "unchecked",
    };
    let seconds = start.elapsed().as_secs_f64();
    println!("corruption: seed {seed}, {seconds:.0} s, {lives} hostile processes, {how}: {last}");
    let numbers = numbers(&last);
    let [honest, .., reported] = numbers[..] else { panic!("{last}") };
    assert!(honest > 0, "the honest one was not heard");
    assert!(reported > 0, "nothing hostile was noticed");
}
