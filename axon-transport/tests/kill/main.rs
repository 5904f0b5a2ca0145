//! Kills a process at each instruction of each operation on shared memory, and checks that the
//! process at the other end loses, tears and leaks nothing.
//!
//! Each case is first walked: one process is stepped through the operation, and wherever a segment
//! that it writes has changed there is a new state that a death may leave behind. A death between
//! two such states leaves the first of them, so killing once in each state stands for killing at
//! every instruction. The bounded run kills around the states, all of them where they are few, and at
//! instructions chosen at random; the full run
//! (`cargo test --release -p axon-transport --test kill -- --full`) at every single instruction.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

mod operation;
mod survivor;
mod trace;
mod wire;
mod worker;

use std::{
    env,
    io::{BufRead as _, BufReader},
    process::{Child, Command, ExitCode, Stdio},
    sync::mpsc,
    thread,
    time::Instant,
};

use operation::cases;
use worker::{Plan, Report};

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    // Before any thread is made: a worker forks.
    if let Some(share) = arguments.iter().find_map(|a| a.strip_prefix("--worker=")) {
        worker::run(&Plan::parse(share));
        return ExitCode::SUCCESS;
    }
    if arguments.iter().any(|a| a == "--list") {
        println!("kill: test");
        return ExitCode::SUCCESS;
    }
    if !cfg!(any(target_arch = "x86_64", target_feature = "lse")) {
        println!("skipped: compare-and-swap by reservation never succeeds under single steps");
        return ExitCode::SUCCESS;
    }
    if let Some(why) = trace::refused() {
        println!("skipped: {why}");
        return ExitCode::SUCCESS;
    }
    let full = arguments.iter().any(|a| a == "--full");
    let filter = arguments.iter().find(|a| !a.starts_with('-'));
    let chosen: Vec<usize> = cases()
        .iter()
        .enumerate()
        .filter(|(_, case)| filter.is_none_or(|f| case.name.contains(f.as_str())))
        .map(|(index, _)| index)
        .collect();
    conduct(&chosen, full)
}

/// Shares the cases out among as many workers as there are processors, and prints what they found.
fn conduct(chosen: &[usize], full: bool) -> ExitCode {
    let start = Instant::now();
    let workers = thread::available_parallelism().map_or(1, usize::from).min(chosen.len().max(1));
    let (sender, reports) = mpsc::channel();
    let mut running: Vec<Child> = Vec::new();
    for worker in 0..workers {
        let share = chosen.iter().copied().skip(worker).step_by(workers).collect();
        let mut child = Command::new(env::current_exe().expect("its own path"))
            .arg(format!("--worker={}", Plan { full, cases: share }))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a worker");
        let lines = BufReader::new(child.stdout.take().expect("its output")).lines();
        let sender = sender.clone();
        thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                let _ = sender.send((worker, line));
            }
        });
        running.push(child);
    }
    drop(sender);
    println!(
        "{:<44} {:>9} {:>12} {:>7} {:>7} {:>7}",
        "operation", "dies", "instructions", "states", "kills", "shown"
    );
    let mut at = vec![String::new(); workers];
    let mut kills = 0;
    for (worker, line) in reports {
        match Report::parse(&line) {
            Some(report) => {
                kills += report.kills;
                println!("{report}");
            }
            None => at[worker] = line,
        }
    }
    let mut well = true;
    for (child, at) in running.iter_mut().zip(at) {
        let status = child.wait().expect("a worker");
        if !status.success() {
            well = false;
            println!("FAILED at {at}: {status}");
        }
    }
    println!("{kills} kills in {:.0} s", start.elapsed().as_secs_f64());
    if well { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
