//! The two ends in two processes: this test binary runs itself as the second process. The descriptors go over a
//! socket pair, as they do between sessions.

#![allow(unsafe_code)]

use std::{env, io::Write as _, os::fd::AsFd, thread, time::Duration};

use super::*;
use crate::tests::wire::{LARGE, Other, PART, Wire};

fn large_writer(session: &Arc<SessionSegment>, qos: Qos, budget: u64) -> Writer {
    let gid = Gid::new(session.id(), 1);
    let options = RingOptions { gid, qos, budget, max_message: LARGE, expected: LARGE };
    Writer::create(session.clone(), options).unwrap()
}

/// Publishes a sample, and retries as long as necessary: on a loaded host a reader may not run for longer than a
/// publish waits.
fn publish(writer: &Writer, sequence: u64, payload: &[u8]) {
    while let Err(error) = writer.publish(meta(sequence), payload) {
        assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
    }
}

/// Takes the next sample and checks it.
fn take(reader: &mut Reader, session: &SessionSegment, out: &mut Vec<u8>) -> u64 {
    loop {
        await_data(session, reader);
        if let Some(taken) = reader.take(out).unwrap() {
            let sequence = taken.meta.sequence;
            assert_eq!(taken.meta, meta(sequence));
            assert!(*out == pattern(sequence, out.len()), "sample {sequence} is torn");
            return sequence;
        }
    }
}

/// The code of the other process; not a test of its own.
#[test]
fn the_other_process() {
    let Ok(part) = env::var(PART) else { return };
    let wire = Wire(std::io::stdin().as_fd().try_clone_to_owned().unwrap());
    let session = session();
    let mut out = Vec::new();
    match part.as_str() {
        "take all" => {
            let mut reader = wire.join(&session, Qos::keep_all());
            let (total, pause) = (wire.receive_numbers()[0], 97);
            for sequence in 0..total {
                assert_eq!(take(&mut reader, &session, &mut out), sequence);
                if sequence % pause == 0 {
                    thread::yield_now();
                }
            }
            wire.send_numbers(&[reader.received(), reader.lost(), reader.skipped()]);
        }
        "take the last" => {
            let mut reader = wire.join(&session, keep_last(1));
            let total = wire.receive_numbers()[0];
            for sequence in 0..total {
                assert_eq!(take(&mut reader, &session, &mut out), sequence);
                wire.send_numbers(&[out.len() as u64]);
            }
        }
        "take what is there at the end" => {
            let mut reader = wire.join(&session, keep_last(20));
            wire.receive_numbers();
            while reader.has_data() {
                take(&mut reader, &session, &mut out);
            }
            wire.send_numbers(&[reader.received(), reader.lost(), reader.skipped()]);
        }
        "take nothing" => {
            let _reader = wire.join(&session, Qos::keep_all());
            wire.send_numbers(&[]);
            thread::sleep(Duration::from_secs(600));
        }
        "subscribe" => {
            let context = Context::new().unwrap();
            let options = SubscriberOptions::new(Qos::keep_all());
            let mut subscriber =
                Subscriber::connect(&context, &wire.0, options, Some(EVER)).unwrap();
            let total = lengths().len() as u64;
            for sequence in 1..=total {
                let sample = subscriber.recv(Some(EVER)).unwrap().expect("a sample");
                assert_eq!(sample.meta().sequence, sequence);
                sample.copy_to(&mut out).unwrap();
                assert!(out == pattern(sequence, out.len()), "sample {sequence} is torn");
            }
            wire.send_numbers(&[subscriber.received(), subscriber.lost()]);
            // The wait ends when the publisher is gone.
            assert!(subscriber.recv(None).unwrap().is_none() && subscriber.publisher_ended());
        }
        "publish and go" => {
            let context = Context::new().unwrap();
            let options = PublisherOptions::new(Qos::keep_all());
            let publisher = Publisher::new(&context, options).unwrap();
            publisher.serve(&wire.0, Some(EVER)).unwrap();
            for (sequence, len) in lengths().into_iter().enumerate() {
                let payload = pattern(sequence as u64 + 1, len);
                while let Err(error) = publisher.publish(&payload) {
                    assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
                }
            }
            wire.receive();
        }
        "keep samples" => {
            let mut reader = wire.join(&session, keep_last(1));
            let mut kept = Vec::new();
            for _ in 0..5 {
                await_data(&session, &reader);
                kept.push(reader.take_sample().unwrap().expect("the only one"));
                wire.send_numbers(&[]);
            }
            // Reports its samples each time that the test asks.
            while !wire.receive().0.is_empty() {
                for sample in &kept {
                    assert!(sample.is_borrowed());
                    sample.copy_to(&mut out).unwrap();
                    assert!(out == pattern(sample.meta().sequence, sample.len()));
                }
                wire.send_numbers(&[kept.len() as u64]);
            }
        }
        "publish for ever" => {
            let writer = large_writer(&session, keep_last(2), 1 << 20);
            wire.serve(&session, &writer, keep_last(2));
            for sequence in 0.. {
                // In steps, so that a kill is likely in the middle of a sample.
                let payload = pattern(sequence, 100_000);
                let mut loan = writer.loan(payload.len()).unwrap();
                for piece in payload.chunks(1000) {
                    loan.write_all(piece).unwrap();
                }
                loan.publish(meta(sequence)).unwrap();
                writer.publish(meta(sequence), &payload[..90]).unwrap();
            }
        }
        "fork" => {
            let writer = large_writer(&session, keep_last(1), 1 << 20);
            let mut reader = attach(&writer, &session, &session, keep_last(1));
            writer.publish(meta(7), &pattern(7, 9000)).unwrap();
            let kept = reader.take_sample().unwrap().unwrap();
            let loan = writer.loan(9000).unwrap();
            writer.publish(meta(0), b"before").unwrap();
            // SAFETY: the child only makes the following calls, which take no lock that another thread may have held,
            // and leaves by _exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                let poisoned = writer.publish(meta(1), b"child") == Err(PublishError::Forked)
                    && kept.read_at(0, &mut [0; 8]) == 0
                    && writer.readers().is_empty()
                    && reader.take(&mut out) == Err(TakeError::Forked)
                    // The child does not have the publisher's memory, because the publisher is of the same session.
                    && !reader.has_data()
                    && (reader.unread(), reader.is_drained()) == (0, true)
                    && matches!(session.allocate_lane(), Err(ShmError::Forked))
                    && !session.wait(|| false, None);
                drop((kept, loan));
                drop((reader, writer, session));
                // SAFETY: ends the process without running anything else.
                unsafe { libc::_exit(if poisoned { 0 } else { 1 }) };
            }
            let mut status = -1;
            // SAFETY: waits for the child just made; `status` outlives the call.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert_eq!(status, 0, "the child was refused, and killed by nothing");
            // The parent is not affected.
            for sequence in 8..40 {
                writer.publish(meta(sequence), &pattern(sequence, 9000)).unwrap();
                reader.take(&mut out).unwrap().unwrap();
            }
            kept.copy_to(&mut out).unwrap();
            assert!(out == pattern(7, 9000), "the child did not give back what the parent keeps");
            drop(loan);
            writer.publish(meta(0), b"before").unwrap();
            assert_eq!(reader.take(&mut out).unwrap().unwrap().meta, meta(0));
            writer.publish(meta(1), b"after").unwrap();
            assert_eq!(reader.take(&mut out).unwrap().unwrap().meta, meta(1));
        }
        "fork with a slice" => {
            let writer = large_writer(&session, keep_last(1), 1 << 20);
            let mut loan = writer.loan(9000).unwrap();
            let slice: &mut [u8] = &mut loan;
            let page = (slice.as_mut_ptr() as usize & !4095) as *mut libc::c_void;
            // SAFETY: the child only makes system calls and one store.
            let child = unsafe { libc::fork() };
            if child == 0 {
                let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_FIXED_NOREPLACE;
                // SAFETY: the call replaces no mapping.
                let found = unsafe { libc::mmap(page, 4096, libc::PROT_READ, flags, -1, 0) };
                if found == page {
                    // SAFETY: ends the process without running anything else.
                    unsafe { libc::_exit(2) };
                }
                slice[100] = 1;
                // SAFETY: as above.
                unsafe { libc::_exit(3) };
            }
            let mut status = -1;
            // SAFETY: waits for the child just made; `status` outlives the call.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert!(!libc::WIFEXITED(status), "status {}", libc::WEXITSTATUS(status));
            assert_eq!(libc::WTERMSIG(status), libc::SIGSEGV);
            slice[100] = 1;
            loan.publish_next(1).unwrap();
        }
        "echo" => {
            let mut ping = wire.join(&session, Qos::keep_all());
            let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
            wire.serve(&session, &writer, Qos::keep_all());
            let total = wire.receive_numbers()[0];
            for sequence in 0..total {
                assert_eq!(take(&mut ping, &session, &mut out), sequence);
                publish(&writer, sequence, &out);
            }
            // The last sample must be read before this process ends.
            wire.receive();
        }
        other => panic!("no such part: {other}"),
    }
}

#[test]
fn each_length_crosses() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
    let other = Other::start("take all");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let lengths = lengths();
    let total = lengths.len() as u64;
    other.wire.send_numbers(&[total]);
    for (sequence, len) in lengths.into_iter().enumerate() {
        publish(&writer, sequence as u64, &pattern(sequence as u64, len));
    }
    assert_eq!(other.wire.receive_numbers(), [total, 0, 0]);
    other.succeed();
}

#[test]
fn keep_all_loses_nothing_to_a_slow_reader() {
    let session = session();
    // The ring holds 64 samples.
    let writer = large_writer(&session, Qos::keep_all(), 64 * 1024);
    let other = Other::start("take all");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let total = 20_000;
    other.wire.send_numbers(&[total]);
    for sequence in 0..total {
        publish(&writer, sequence, &pattern(sequence, 1024));
    }
    assert_eq!(other.wire.receive_numbers(), [total, 0, 0]);
    other.succeed();
}

#[test]
fn the_largest_message_crosses_at_depth_one() {
    let session = session();
    let writer = large_writer(&session, keep_last(1), 1 << 20);
    let other = Other::start("take the last");
    other.wire.serve(&session, &writer, keep_last(1));
    other.wire.send_numbers(&[3]);
    for sequence in 0..3 {
        publish(&writer, sequence, &pattern(sequence, LARGE as usize));
        assert_eq!(other.wire.receive_numbers(), [LARGE]);
    }
    other.succeed();
}

#[test]
fn missed_samples_of_a_keep_last_reader_are_counted() {
    let session = session();
    // The ring holds eight samples; the reader's depth is 20.
    let writer = large_writer(&session, keep_last(1), 8 * 1024);
    let other = Other::start("take what is there at the end");
    other.wire.serve(&session, &writer, keep_last(20));
    for sequence in 0..1000 {
        publish(&writer, sequence, &pattern(sequence, 1024));
    }
    other.wire.send_numbers(&[]);
    assert_eq!(other.wire.receive_numbers(), [8, 12, 980]);
    other.succeed();
}

#[test]
fn a_reader_killed_while_it_holds_the_publisher_lets_it_go() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 64 * 1024);
    let mut other = Other::start("take nothing");
    other.wire.serve(&session, &writer, Qos::keep_all());
    other.wire.receive_numbers();
    let mut sequence = 0;
    while writer.try_publish(meta(sequence), &pattern(sequence, 1024)).is_ok() {
        sequence += 1;
    }
    assert!(matches!(
        writer.publish(meta(sequence), &pattern(sequence, 1024)),
        Err(PublishError::Blocked { .. })
    ));
    thread::scope(|scope| {
        scope.spawn(|| publish(&writer, sequence, &pattern(sequence, 1024)));
        other.kill();
    });
    assert_eq!(writer.readers().len(), 1);
    assert_eq!(writer.drop_dead().len(), 1);
    assert!(!writer.has_readers());
    for sequence in 0..1000 {
        writer.try_publish(meta(sequence), &pattern(sequence, 1024)).unwrap();
    }
}

#[test]
fn two_processes_need_no_daemon() {
    // One process publishes and ends; the other takes all samples and detects the end.
    let (publisher, subscriber) = (Other::start("publish and go"), Other::start("subscribe"));
    for (from, to) in [(&subscriber, &publisher), (&publisher, &subscriber)] {
        from.wire.pass_on(&to.wire);
    }
    assert_eq!(subscriber.wire.receive_numbers(), [lengths().len() as u64, 0]);
    publisher.wire.send(b"done", &[]);
    publisher.succeed();
    subscriber.succeed();
}

/// Starts the process of a reader that keeps five samples, and creates their publisher.
fn keeper(session: &Arc<SessionSegment>) -> (Other, Writer) {
    let writer = large_writer(session, keep_last(1), 0);
    let other = Other::start("keep samples");
    other.wire.serve(session, &writer, keep_last(1));
    for sequence in 0..5 {
        publish(&writer, sequence, &pattern(sequence, KEPT));
        other.wire.receive();
    }
    (other, writer)
}

const KEPT: usize = 100_000;

fn retired(writer: &Writer) -> usize {
    writer.lock().history.pinned().retired().len()
}

#[test]
fn samples_pinned_by_another_process_are_not_overwritten() {
    let session = session();
    let (other, writer) = keeper(&session);
    for round in 0..20 {
        for sequence in 0..10 {
            let sequence = 5 + round * 10 + sequence;
            writer.try_publish(meta(sequence), &pattern(sequence, KEPT)).unwrap();
        }
        if round == 10 {
            // The samples stay in use when their reader is detached.
            assert!(writer.detach(writer.readers()[0]));
        }
        other.wire.send_numbers(&[0]);
        assert_eq!(other.wire.receive_numbers(), [5]);
    }
    assert!((5..=7).contains(&retired(&writer)));
    other.wire.send(b"", &[]);
    other.succeed();
    // Its process has ended: the publisher is told or finds out.
    writer.drop_dead();
    (0..4).for_each(|n| publish(&writer, 1000 + n, &pattern(1000 + n, KEPT)));
    assert!(retired(&writer) <= 1);
}

#[test]
fn a_process_killed_with_samples_in_use_gives_them_back() {
    let session = session();
    let (mut other, writer) = keeper(&session);
    let large = |sequence| {
        writer.try_publish(meta(sequence), &pattern(sequence, KEPT)).unwrap();
    };
    // A stopped process counts as alive, and does not hold up the publisher.
    let pid = rustix::process::Pid::from_child(&other.child);
    rustix::process::kill_process(pid, rustix::process::Signal::STOP).unwrap();
    (5..200).for_each(large);
    assert!((5..=7).contains(&retired(&writer)));
    other.kill();
    assert_eq!(writer.drop_dead().len(), 1);
    (200..210).for_each(large);
    assert!(retired(&writer) <= 1);
    assert_eq!(writer.lock().reader_set.pin_lanes(), 0);
}

#[test]
fn samples_outlive_the_process_that_published_them() {
    let session = session();
    let mut other = Other::start("publish for ever");
    let mut reader = other.wire.join(&session, keep_last(2));
    let mut kept = Vec::new();
    while kept.len() < 5 {
        await_data(&session, &reader);
        kept.extend(reader.take_sample().unwrap().filter(Sample::is_borrowed));
    }
    other.kill();
    drop(reader);
    let mut out = Vec::new();
    for sample in kept {
        sample.copy_to(&mut out).unwrap();
        assert!(out == pattern(sample.meta().sequence, out.len()), "a sample is torn");
    }
}

#[test]
fn a_publisher_killed_in_the_middle_of_a_sample_leaves_no_torn_one() {
    let session = session();
    let mut out = Vec::new();
    for round in 0..20 {
        let mut other = Other::start("publish for ever");
        let mut reader = other.wire.join(&session, keep_last(2));
        for _ in 0..10 + round * 3 {
            take(&mut reader, &session, &mut out);
        }
        assert!(!reader.writer_dead());
        other.kill();
        assert!(reader.writer_dead());
        // The samples that it published before are drained.
        while reader.has_data() {
            take(&mut reader, &session, &mut out);
        }
        assert_eq!(reader.take(&mut out), Ok(None));
        assert_eq!(reader.lost(), 0);
    }
}

#[test]
fn no_wake_up_is_lost_between_two_that_sleep() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
    let other = Other::start("echo");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let mut echo = other.wire.join(&session, Qos::keep_all());
    let total = 20_000;
    other.wire.send_numbers(&[total]);
    let mut out = Vec::new();
    for sequence in 0..total {
        publish(&writer, sequence, &pattern(sequence, 40));
        assert_eq!(take(&mut echo, &session, &mut out), sequence);
    }
    other.wire.send(b"done", &[]);
    other.succeed();
}

#[test]
fn a_forked_child_is_refused_and_harms_nothing() {
    Other::start("fork").succeed();
}

#[test]
fn a_slice_that_is_kept_over_a_fork_faults() {
    Other::start("fork with a slice").succeed();
}
