//! Kills a process at each instruction of each operation on shared memory, and checks that the
//! process at the other end loses, tears and leaks nothing.
//!
//! Each case is first walked: one process is stepped through the operation. Wherever a segment that it writes has
//! changed, there is a new state that a death may leave behind. A death between two such states leaves the first of
//! them, so one kill in each state is as good as a kill at every instruction. An instruction that copies thousands of
//! bytes may stop after each byte; after a few hundred bytes, one kill at its end replaces the rest.
//!
//! The bounded run kills around the states (all of them, if they are few) and at random instructions. The full run
//! (`cargo test --release -p axon-daemon --test kill -- --full`) kills at every single instruction, or, in an operation
//! of very many instructions, at even distances and around its states. An argument that is part of a name runs the
//! cases with that part in their names. `--steps=200000` is a full run with about that many steps per operation instead
//! of 2,000,000, for a slow machine.
//!
//! Some cases have a situation: a fork of the doomed process keeps its descriptors, `mlockall` is active, or no
//! descriptors or no memory are left; or the process is stopped at the point where it would be killed, and continues
//! later. The daemon is killed before and after each of its system calls.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

mod around;
mod cases;
mod daemon;
#[path = "../support/group.rs"]
mod group;
mod operation;
mod report;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod support;
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

use cases::cases;
use report::Report;
use worker::{Plan, STEPS};

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    // Before any thread is started, because a worker forks.
    if let Some(share) = arguments.iter().find_map(|a| a.strip_prefix("--worker=")) {
        worker::run(&Plan::parse(share));
        return ExitCode::SUCCESS;
    }
    if let Some(full) = arguments.iter().find_map(|a| a.strip_prefix("--daemon=")) {
        println!("{}", daemon::run(full == "true").line());
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
    let full = arguments.iter().any(|a| a == "--full").then_some(STEPS);
    let told = arguments.iter().find_map(|a| a.strip_prefix("--steps="));
    let steps = told.map(|steps| steps.parse().expect("a number of steps")).or(full);
    let filter = arguments.iter().find(|a| !a.starts_with('-'));
    let is_meant = |name: &str| filter.is_none_or(|part| name.contains(part.as_str()));
    let cases = cases();
    let chosen = cases.iter().enumerate().filter(|(_, case)| is_meant(case.name));
    let chosen: Vec<usize> = chosen.map(|(index, _)| index).collect();
    conduct(&chosen, is_meant(daemon::NAME), steps)
}

/// Distributes the cases to as many workers as there are processors, and prints their reports.
fn conduct(chosen: &[usize], daemon: bool, steps: Option<u64>) -> ExitCode {
    let start = Instant::now();
    let workers = thread::available_parallelism().map_or(1, usize::from).min(chosen.len());
    let share = |worker| chosen.iter().copied().skip(worker).step_by(workers).collect();
    let plan = |worker| format!("--worker={}", Plan { steps, cases: share(worker) });
    let mut plans: Vec<String> = (0..workers).map(plan).collect();
    if daemon {
        plans.push(format!("--daemon={}", steps.is_some()));
    }
    let (sender, reports) = mpsc::channel();
    let mut running: Vec<Child> = Vec::new();
    for (worker, plan) in plans.iter().enumerate() {
        let mut child = Command::new(env::current_exe().expect("its own path"))
            .arg(plan)
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
    println!("{}", Report::heading());
    let mut at = vec![String::new(); plans.len()];
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
