//! `play`, `echo`, `status` and `daemon` on one host, over the daemon that the tool starts itself.

#![forbid(unsafe_code)]

mod common;

use std::{
    io::Write as _,
    process::{Command, Stdio},
    time::Duration,
};

use axon_transport::{EndpointSpec, qos::Qos};
use common::{Echoes, Host, LOG, Running, Stderr, eventually};
use rustix::process::{Pid, Signal, kill_process};

#[test]
fn status_without_a_daemon_says_so_and_starts_none() {
    let host = Host::new();
    let output = host.run(&["status"]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = Stderr::of(&output.stderr);
    assert!(stderr.contains("no daemon"), "{stderr}");
    assert!(host.status().is_none());
}

#[test]
fn play_of_an_invalid_log_fails_and_names_the_file() {
    let host = Host::new();
    for file in ["/nonexistent.mcap", concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")] {
        let output = host.run(&["play", file]);
        assert_eq!(output.status.code(), Some(1));
        assert!(Stderr::of(&output.stderr).contains(file));
    }
    assert!(host.status().is_none(), "no daemon is started for a log that cannot be read");
}

#[test]
fn nothing_that_a_command_says_steers_a_terminal() {
    let host = Host::new();
    // The escapes are in the name of a file, and in a setting.
    let output = host.run(&["play", "/no\u{1b}[2Jne\u{2066}\u{61c}.mcap"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(str::from_utf8(&output.stderr).is_ok(), "UTF-8");
    let stderr = Stderr::of(&output.stderr);
    assert!(stderr.contains("\\u{1b}[2Jne\\u{2066}\\u{61c}.mcap"), "{stderr}");
    assert!(stderr.chars().all(|c| c == '\n' || !c.is_control()), "{stderr:?}");
}

/// Creates a log whose last tenth was not written.
fn log_without_its_end() -> tempfile::NamedTempFile {
    let whole = std::fs::read(LOG).expect("the log");
    let file = tempfile::NamedTempFile::new().expect("temporary file");
    std::fs::write(file.path(), &whole[..whole.len() / 10 * 9]).expect("write");
    file
}

/// Creates a log whose last chunk has a wrong checksum.
fn log_with_a_wrong_checksum() -> tempfile::NamedTempFile {
    const MAGIC: usize = 8;
    const CHUNK: u8 = 6;
    let mut bytes = std::fs::read(LOG).expect("the log");
    let (mut at, mut last) = (MAGIC, None);
    // Each record begins with its kind and the length of its body.
    while let Some((kind, length)) = bytes[at..].split_first().filter(|(_, rest)| rest.len() >= 8) {
        last = if *kind == CHUNK { Some(at + 9) } else { last };
        let length = u64::from_le_bytes(*length.first_chunk().expect("eight bytes"));
        at += 9 + usize::try_from(length).expect("a length");
    }
    // The checksum follows two times and the length after decompression.
    bytes[last.expect("a chunk") + 24] ^= 1;
    let file = tempfile::NamedTempFile::new().expect("temporary file");
    std::fs::write(file.path(), &bytes).expect("write");
    file
}

#[test]
fn play_of_a_damaged_log_publishes_nothing_unless_told_to_publish_its_whole_part() {
    publishes_the_whole_part_when_told(&log_without_its_end());
}

#[test]
fn play_publishes_only_messages_before_a_chunk_with_a_wrong_checksum() {
    publishes_the_whole_part_when_told(&log_with_a_wrong_checksum());
}

fn publishes_the_whole_part_when_told(damaged: &tempfile::NamedTempFile) {
    let host = Host::new();
    let file = damaged.path().to_str().expect("a path in UTF-8");
    let output = host.run(&["play", file, "--rate", "0"]);
    let said = Stderr::of(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains(file) && said.contains("--incomplete"), "{said}");
    assert!(host.status().is_none(), "no daemon is started for a log that is not played");

    let output = host.run(&["play", file, "--rate", "0", "--incomplete"]);
    let said = Stderr::of(&output.stderr);
    assert!(output.status.success(), "{said}");
    let number = |before: &str, after: &str| {
        let (_, rest) = said.split_once(before).unwrap_or_else(|| panic!("no {before:?}: {said}"));
        rest.split_once(after).unwrap_or_else(|| panic!("no {after:?}: {said}")).0.to_owned()
    };
    let whole = number("playing the ", " messages");
    assert_eq!(number(" before\naxon play: ", " messages"), whole, "{said}");
    assert_ne!(whole, "0");
}

#[test]
fn names_of_another_session_steer_no_terminal() {
    let host = Host::new();
    let daemon = Running::start(host.axon(&["daemon"]));
    eventually("the daemon", || host.status().is_some());
    let topic = "/no\u{1b}[2Jne\u{2066}\u{61c}\u{9b}";
    let session = host.session("a\u{202e}name\r");
    let spec = EndpointSpec::new(topic, "test/\u{1b}]0;Bytes", Qos::keep_all());
    let publisher = session.create_publisher(spec).expect("a publisher");
    let steers = |text: &str| {
        let of_bidi =
            |c| matches!(c, '\u{61c}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        text.chars().any(|c| c != '\n' && c.is_control() || of_bidi(c))
    };
    for arguments in [&["status"][..], &["status", "--json"]] {
        let output = host.run(arguments);
        let text = String::from_utf8(output.stdout).expect("UTF-8");
        assert!(text.contains("[2Jne"), "the topic is shown: {text}");
        assert!(!steers(&text), "{arguments:?}: {text:?}");
    }
    let mut echo = Running::start(host.axon(&["echo", topic, "--count", "1"]));
    assert!(publisher.wait_matched(1, Duration::from_secs(60)));
    publisher.publish(b"\x1b[2J").expect("published");
    let text: String = echo.lines().collect::<Vec<_>>().join("\n");
    let output = echo.finish();
    let said = Stderr::of(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(!text.is_empty() && !steers(&text) && !steers(&said), "{text:?} {said:?}");
    drop(daemon);
}

#[test]
fn echo_prints_every_message_that_play_publishes() {
    let host = Host::new();
    let echoes = Echoes::start(&host);
    let play = Running::start(host.axon(&["play", LOG, "--rate", "0", "--wait", "1"]));
    echoes.assert_whole();
    let play = play.finish();
    assert!(play.status.success(), "{}", Stderr::of(&play.stderr));
}

#[test]
fn echo_finds_the_type_and_shows_the_message() {
    let host = Host::new();
    let mut echo = Running::start(host.axon(&["echo", "/odom", "--count", "1"]));
    let mut lines = echo.lines();
    let _play = Running::start(host.axon(&["play", LOG, "--rate", "10", "--loop"]));
    let line = lines.next().expect("a line");
    assert!(line.contains(" B  00 01 00 00"), "no CDR header in {line:?}");
    assert!(lines.next().is_none());
    assert!(echo.finish().status.success());
}

/// The ends of an `axon echo`.
#[derive(Clone, Copy, Debug)]
enum End {
    Signal(Signal),
    /// Its output is not read any more.
    Unread,
    /// The requested number of messages came.
    Count,
}

/// Checks an `axon echo` that is stopped while more messages come than may wait.
fn assert_echo_says_what_it_missed(end: End) {
    let host = Host::new();
    let count = ["--count", "2500"];
    let count = if matches!(end, End::Count) { &count[..] } else { &[] };
    let mut echo = Running::start(host.axon(&[&["echo", "/tf"], count].concat()));
    let pid = Pid::from_child(&echo.0);
    let mut lines = echo.lines();
    let _play = Running::start(host.axon(&["play", LOG, "--rate", "200", "--loop"]));
    lines.next().expect("a line");
    kill_process(pid, Signal::STOP).expect("it runs");
    let before = host.published();
    eventually("more than may wait", || host.published() > before + 6_000);
    match end {
        End::Signal(signal) => {
            kill_process(pid, Signal::CONT).expect("it runs");
            // The program printed more before the stop than the pipe can hold.
            assert_eq!(lines.by_ref().take(2_000).count(), 2_000);
            kill_process(pid, signal).expect("it runs");
            lines.for_each(drop);
        }
        End::Unread => {
            drop(lines);
            kill_process(pid, Signal::CONT).expect("it runs");
        }
        End::Count => {
            kill_process(pid, Signal::CONT).expect("it runs");
            assert_eq!(lines.count(), 2_499);
        }
    }
    let output = echo.finish();
    let said = Stderr::of(&output.stderr);
    assert!(said.contains("axon echo: missed "), "{end:?}: {said}");
    assert!(output.status.success(), "{end:?}: {said}");
}

#[test]
fn echo_reports_missed_messages_when_ended_by_a_signal_or_hangup() {
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        if signal == Signal::HUP && ignores_hangup() {
            let said = "skipped: SIGHUP, which this test was started to ignore, as under nohup";
            let _ = writeln!(std::io::stderr(), "{said}");
        } else {
            assert_echo_says_what_it_missed(End::Signal(signal));
        }
    }
}

#[test]
fn echo_that_waits_for_its_reader_reports_missed_messages_when_the_pipe_is_closed() {
    let host = Host::new();
    let mut echo = Running::start(host.axon(&["echo", "/tf"]));
    let mut lines = echo.lines();
    let _play = Running::start(host.axon(&["play", LOG, "--rate", "200", "--loop"]));
    lines.next().expect("a line");
    // The pipe is full after some hundred lines. The write waits, and the messages overwrite each other meanwhile.
    let before = host.published();
    eventually("more than may wait", || host.published() > before + 6_000);
    drop(lines);
    let output = echo.finish();
    let said = Stderr::of(&output.stderr);
    assert!(said.contains("axon echo: missed "), "{said}");
    assert!(output.status.success(), "{said}");
}

/// Returns whether this process ignores SIGHUP: then the programs that it starts do as well.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux has it");
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).expect("a mask");
    u64::from_str_radix(ignored.trim(), 16).expect("a mask in hexadecimal") & 1 != 0
}

#[test]
fn echo_reports_missed_messages_on_a_closed_pipe_or_reached_count() {
    for end in [End::Unread, End::Count] {
        assert_echo_says_what_it_missed(end);
    }
}

fn bytes(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

#[test]
fn echo_reports_missed_messages_on_a_full_disk() {
    let host = Host::new();
    let _daemon = Running::start(host.axon(&["daemon"]));
    host.wait_daemon();
    let session = host.session("talker");
    let publisher = session.create_publisher(bytes("/t")).expect("a publisher");
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").expect("Linux has it");
    let mut echo = host.axon(&["echo", "/t"]);
    let echo = Running(echo.stdout(full).stderr(Stdio::piped()).spawn().expect("the tool starts"));
    assert!(publisher.wait_matched(1, Duration::from_secs(60)));
    publisher.publish(b"hello").expect("published");
    let output = echo.finish();
    let said = Stderr::of(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("axon echo: missed 1 message\n"), "{said}");
    assert!(said.contains("No space left on device"), "{said}");
}

#[test]
fn echo_under_nohup_outlives_its_terminal() {
    let host = Host::new();
    let _daemon = Running::start(host.axon(&["daemon"]));
    host.wait_daemon();
    let session = host.session("talker");
    let publisher = session.create_publisher(bytes("/t")).expect("a publisher");
    let echo = host.axon(&["echo", "/t", "--count", "2"]);
    let mut shell = Command::new("sh");
    shell
        .args(["-c", "trap '' HUP; exec \"$0\" \"$@\""])
        .arg(echo.get_program())
        .args(echo.get_args());
    for (name, value) in echo.get_envs() {
        match value {
            Some(value) => shell.env(name, value),
            None => shell.env_remove(name),
        };
    }
    let mut echo = Running::start(shell);
    let pid = Pid::from_child(&echo.0);
    let mut lines = echo.lines();
    assert!(publisher.wait_matched(1, Duration::from_secs(60)));
    publisher.publish(b"before").expect("published");
    lines.next().expect("a line");
    kill_process(pid, Signal::HUP).expect("it runs");
    publisher.publish(b"after").expect("published");
    lines.next().expect("another line");
    let output = echo.finish();
    assert!(output.status.success(), "{}", Stderr::of(&output.stderr));
}

#[test]
fn replay_survives_a_killed_daemon_without_loss() {
    let host = Host::new();
    let echoes = Echoes::start(&host);
    let play = Running::start(host.axon(&["play", LOG, "--rate", "60", "--wait", "1"]));
    eventually("the middle of the replay", || host.published() > 500);
    let before = host.wait_daemon();
    kill_process(Pid::from_raw(before).expect("a process id"), Signal::KILL).expect("it runs");
    eventually("the next daemon", || host.daemon().is_some_and(|pid| pid != before));
    assert!(host.published() < 5_000, "it was killed after the replay, which shows nothing");
    echoes.assert_whole();
    assert!(play.finish().status.success());
}

#[test]
fn status_shows_the_foreground_daemon_which_ends_on_sigterm() {
    let host = Host::new();
    let daemon = Running::start(host.axon(&["daemon"]));
    eventually("the daemon", || host.status().is_some());
    let shown = host.status().expect("a status");
    assert_eq!(shown["pid"], daemon.0.id());
    assert_eq!(shown["mode"], "classic");
    let text = String::from_utf8(host.run(&["status"]).stdout).expect("text");
    for part in ["Daemon", "Links", "Keys", "Topics", "Refusals", "classic"] {
        assert!(text.contains(part), "{part} is missing in:\n{text}");
    }
    assert!(host.kill_daemon(Signal::TERM));
    let output = daemon.finish();
    assert!(output.status.success(), "{}", Stderr::of(&output.stderr));
    assert!(host.status().is_none());
}

#[test]
fn the_daemon_in_the_foreground_stays_when_its_last_session_has_ended() {
    let host = Host::new();
    let mut command = host.axon(&["daemon"]);
    command.env("AXON_LINK_GRACE_S", "0");
    let daemon = Running::start(command);
    host.wait_daemon();
    for _ in 0..2 {
        drop(host.session("visitor"));
        eventually("the session is gone", || {
            let status = host.status().expect("a status");
            let sessions = status["sessions"].as_array().expect("sessions");
            sessions.iter().all(|session| session["name"] != "visitor")
        });
    }
    // A daemon that does not stay ends at once, without a grace time.
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(host.status().expect("a status")["pid"], daemon.0.id());
}
