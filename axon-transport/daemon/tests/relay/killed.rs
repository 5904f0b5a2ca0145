//! Daemons that are killed while samples pass through them.

use super::*;
use crate::support::Player;

/// Length of a sample, such that at least one sample is in flight whenever the daemon is killed.
fn len_of(sequence: u64) -> usize {
    if sequence.is_multiple_of(50) { 40_000 } else { 90 }
}

/// Kills the daemon, and starts the next one.
fn replace(host: &Host, daemon: &mut Option<Kept>) {
    drop(daemon.take());
    *daemon = Some(host.daemon());
}

fn depth_four(reliability: Reliability) -> Qos {
    Qos::default().with_reliability(reliability).with_depth(4)
}

/// Ends the daemon in good order, and starts the next one.
fn relieve(host: &Host, daemon: &mut Option<Kept>) {
    if let Some(Kept(child)) = daemon {
        signal(child.id(), Signal::TERM);
        child.wait().unwrap();
    }
    replace(host, daemon);
}

#[test]
fn keep_all_samples_survive_killed_daemons() {
    keep_all_survives(replace);
}

#[test]
fn keep_all_samples_survive_daemons_that_end_in_good_order() {
    keep_all_survives(relieve);
}

fn keep_all_survives(end: fn(&Host, &mut Option<Kept>)) {
    const SAMPLES: u64 = 3600;
    for (from_shares, to_shares) in ENDS {
        let host = host();
        let mut daemon = Some(host.daemon());
        let from = session(&host, "from", from_shares);
        let to = session(&host, "to", to_shares);
        let (publisher, subscription) = connect(&from, &to, "/t", Qos::keep_all());
        let taken = AtomicU32::new(0);
        thread::scope(|scope| {
            let publishing = scope.spawn(|| {
                for sequence in 1..=SAMPLES {
                    let sample = pattern(sequence, len_of(sequence));
                    assert_eq!(publish(&publisher, &sample), sequence);
                    // It also goes on while there is no daemon.
                    if sequence.is_multiple_of(4) {
                        thread::sleep(Duration::from_millis(1));
                    }
                }
            });
            let taking = scope.spawn(|| {
                let mut bytes = Vec::new();
                for sequence in 1..=SAMPLES {
                    let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("in time");
                    let of = (from_shares, to_shares);
                    assert_eq!((info.sequence, subscription.lost()), (sequence, 0), "{of:?}");
                    assert_eq!(bytes, pattern(sequence, len_of(sequence)));
                    taken.store(sequence as u32, Ordering::Relaxed);
                }
            });
            for kill_at in [600, 1800, 3000] {
                until("some are taken", || {
                    taken.load(Ordering::Relaxed) >= kill_at || taking.is_finished()
                });
                end(&host, &mut daemon);
            }
            taking.join().unwrap();
            publishing.join().unwrap();
        });
        assert!(publisher.wait_acknowledged(PATIENCE));
        assert_eq!(publisher.given_up(), 0);
        assert!(subscription.take(&mut Vec::new()).is_none(), "nothing is repeated");
    }
}

#[test]
fn a_full_path_survives_killed_daemons() {
    for (from_shares, to_shares) in ENDS {
        let host = host();
        let mut daemon = Some(host.daemon());
        let from = session(&host, "from", from_shares);
        let to = session(&host, "to", to_shares);
        let (publisher, subscription) = connect(&from, &to, "/t", Qos::keep_all());
        let mut last = fill(|number| publisher.publish(&pattern(number, 50_000)));
        for _ in 0..2 {
            replace(&host, &mut daemon);
            await_pair(&publisher, &subscription);
        }
        let ends = (from_shares, to_shares);
        // Samples that its reader did not take are still in its ring, or come with the next daemon.
        for sequence in last + 1..=last + 20 {
            if publisher.publish(&pattern(sequence, 50_000)).is_err() {
                break;
            }
            last = sequence;
        }
        let taken = take_until(&subscription, last);
        let steps: Vec<_> = taken.windows(2).filter(|two| two[0] + 1 != two[1]).collect();
        let counts = (subscription.lost(), publisher.given_up());
        assert!(
            taken.first() == Some(&1) && steps.is_empty(),
            "{ends:?}: from {:?} to {last}, not one after the other at {steps:?}; {counts:?}",
            taken.first()
        );
        assert!(publisher.wait_acknowledged(PATIENCE), "{ends:?}");
        assert_eq!((subscription.lost(), publisher.given_up()), (0, 0), "{ends:?}");
    }
}

#[test]
fn unread_samples_of_a_relayed_reader_are_not_acknowledged() {
    let host = host();
    let _daemon = host.daemon();
    for (from_shares, to_shares) in [(true, false), (false, false)] {
        let from = session(&host, "from", from_shares);
        let to = session(&host, "to", to_shares);
        let topic = format!("/of/{from_shares}");
        let (publisher, subscription) = connect(&from, &to, &topic, Qos::keep_all());
        // More than all buffers on the way can hold.
        let last = fill(|number| publisher.publish(&pattern(number, 50_000)));
        assert!(!publisher.wait_acknowledged(Duration::from_millis(50)));
        assert_eq!(take_until(&subscription, last).len() as u64, last);
        assert!(publisher.wait_acknowledged(PATIENCE));
    }
}

#[test]
fn without_a_daemon_nothing_new_is_acknowledged() {
    for (from_shares, to_shares) in [(false, true), (true, false), (false, false)] {
        let host = host();
        let daemon = host.daemon();
        let from = session(&host, "from", from_shares);
        let to = session(&host, "to", to_shares);
        let (publisher, subscription) = connect(&from, &to, "/t", Qos::keep_all());
        publish(&publisher, &pattern(1, 10));
        assert_eq!(take_until(&subscription, 1), [1]);
        assert!(publisher.wait_acknowledged(PATIENCE));
        drop(daemon);
        publish(&publisher, &pattern(2, 10));
        publish(&publisher, &pattern(3, 5_000));
        let ends = (from_shares, to_shares);
        assert!(!publisher.wait_acknowledged(Duration::from_millis(50)), "{ends:?}");
        let _daemon = host.daemon();
        assert!(publisher.wait_acknowledged(PATIENCE), "{ends:?}");
        assert_eq!(take_until(&subscription, 3), [2, 3]);
        assert_eq!((subscription.lost(), publisher.given_up()), (0, 0), "{ends:?}");
    }
}

#[test]
fn samples_of_a_dropped_publisher_go_through_the_next_daemon() {
    for to_shares in [true, false] {
        for dropped_first in [true, false] {
            let host = host();
            let daemon = host.daemon();
            let from = session(&host, "from", false);
            let to = session(&host, "to", to_shares);
            let (publisher, subscription) = connect(&from, &to, "/t", Qos::keep_all());
            stop(&daemon);
            for sequence in 1..=20 {
                publish(&publisher, &pattern(sequence, 500));
            }
            let gid = publisher.gid();
            if dropped_first {
                drop(publisher);
                drop(daemon);
            } else {
                drop(daemon);
                drop(publisher);
            }
            let _daemon = host.daemon();
            let case = (to_shares, dropped_first);
            assert!(take_until(&subscription, 20).into_iter().eq(1..=20), "{case:?}");
            assert_eq!(subscription.lost(), 0, "{case:?}");
            until("the publisher is gone from the graph", || {
                !to.graph().endpoints.contains_key(&gid)
            });
        }
    }
}

/// Number of samples that such a child publishes.
const LEFT: u64 = 20;

/// In a child: publishes a little when told to, and ends when told to. Its log goes to its output.
pub(super) fn publish_and_end(session: &Session) {
    let warnings = tracing_subscriber::fmt().with_max_level(tracing::Level::WARN);
    warnings.with_ansi(false).with_writer(std::io::stdout).init();
    let publisher = session.create_publisher(spec("/t", Qos::keep_all())).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    say("matched");
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).unwrap();
    for sequence in 1..=LEFT {
        publish(&publisher, &pattern(sequence, 500));
    }
    say("published");
    std::io::stdin().read_line(&mut line).unwrap();
}

/// Returns the number of samples that a process counted as lost when it ended, from its log.
fn given_up(log: &[String]) -> u64 {
    let lost = log.iter().filter(|line| line.contains("gave up samples: no daemon confirmed them"));
    lost.filter_map(|line| {
        let (_, count) = line.split_once("samples=")?;
        count.split_whitespace().next()?.parse::<u64>().ok()
    })
    .sum()
}

/// A relayed process that has published and not ended yet, and a subscription that shares memory. The daemon between
/// them is stopped. Tests destructure it, so that the fields are dropped from the last to the first.
struct Leaving {
    host: Host,
    _relaying: Host,
    _listener: Session,
    subscription: Subscription,
    leaver: Player,
}

impl Leaving {
    fn new() -> Self {
        let host = host();
        let daemon = host.daemon();
        let (relaying, listener) = (relaying(&host), session(&host, "listener", true));
        let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
        let mut leaver = relaying.play("publisher that ends");
        assert_eq!(leaver.hear(), "matched");
        stop(&daemon);
        leaver.go();
        assert_eq!(leaver.hear(), "published");
        Self { host, _relaying: relaying, _listener: listener, subscription, leaver }
    }
}

#[test]
fn a_process_that_ends_hands_over_to_the_next_daemon() {
    let Leaving { host, _relaying, _listener, subscription, mut leaver } = Leaving::new();
    let _daemon = host.daemon();
    leaver.go();
    // The process waits at most a second, which may be too short on a slow machine. It counts the samples that it could
    // not hand over as lost, although some of them may have arrived.
    let lost = given_up(&leaver.finish_and_tell());
    let mut bytes = Vec::new();
    let mut taken = 0;
    while taken + lost < LEFT {
        let info = subscription.recv(&mut bytes, Some(PATIENCE));
        let info = info.unwrap_or_else(|e| panic!("{e}: {taken} arrived and {lost} were counted"));
        taken += 1;
        assert_eq!((info.sequence, &bytes), (taken, &pattern(taken, 500)));
    }
    eprintln!("{taken} arrived, {lost} were counted");
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn a_process_that_ends_without_a_daemon_counts_its_undelivered_samples() {
    let Leaving { host: _host, _relaying, _listener, subscription: _subscription, mut leaver } =
        Leaving::new();
    leaver.go();
    assert_eq!(given_up(&leaver.finish_and_tell()), LEFT);
}

#[test]
fn the_publisher_and_its_daemon_may_be_killed_together() {
    for to_shares in [true, false] {
        let host = host();
        let daemon = host.daemon();
        let (relaying, listener) = (relaying(&host), session(&host, "listener", to_shares));
        let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
        let talker = relaying.play("talker");
        assert_eq!(take_until(&subscription, 100).len(), 100);
        drop(daemon);
        drop(talker);
        let _daemon = host.daemon();
        until("it is gone", || subscription.matched().is_empty());
        talker::take_rest_of_talker(&host, &subscription);
        let publisher = listener.create_publisher(spec("/t", Qos::keep_all())).unwrap();
        await_pair(&publisher, &subscription);
        assert_eq!(publish(&publisher, &pattern(1, 10)), 1);
        assert_eq!(take_until(&subscription, 1), [1]);
    }
}

#[test]
fn a_reader_that_stays_away_holds_its_publisher_for_a_while_only() {
    let host = host();
    let daemon = host.daemon();
    let relaying = relaying(&host);
    let sharing = session(&host, "sharing", true);
    let relayed = session(&host, "relayed", false);
    let publishers = [&sharing, &relayed]
        .map(|session| session.create_publisher(spec("/t", Qos::keep_all())).unwrap());
    let mut deaf = relaying.play("deaf");
    assert_eq!(deaf.hear(), "matched");
    publishers.iter().for_each(|publisher| assert!(publisher.wait_matched(1, PATIENCE)));
    for publisher in &publishers {
        fill(|_| publisher.publish(&vec![0; 100_000]));
    }
    // The daemon is killed before it sees the end of the process.
    stop(&daemon);
    signal(deaf.pid(), Signal::KILL);
    drop(daemon);
    let _daemon = host.daemon();
    // The process may have been killed with the daemon, or be stopped, so the publishers wait for a while.
    for (publisher, of) in publishers.iter().zip(["sharing", "relayed"]) {
        publish(publisher, &vec![0; 100_000]);
        assert!(!publisher.wait_acknowledged(PATIENCE), "{of}");
        assert!(publisher.given_up() > 0, "{of}");
    }
}

#[test]
fn another_reader_goes_on_when_one_ends_without_a_daemon() {
    for (from_shares, to_shares) in ENDS {
        let host = host();
        let mut daemon = Some(host.daemon());
        let from = session(&host, "from", from_shares);
        let [one, other] = ["one", "other"].map(|name| session(&host, name, to_shares));
        let (publisher, stays) = connect(&from, &one, "/t", Qos::keep_all());
        let ends = other.create_subscription(spec("/t", Qos::keep_all())).unwrap();
        await_pair(&publisher, &ends);
        for sequence in 1..=50 {
            publish(&publisher, &pattern(sequence, len_of(sequence)));
        }
        drop(daemon.take());
        drop((ends, other));
        for sequence in 51..=60 {
            publish(&publisher, &pattern(sequence, len_of(sequence)));
        }
        daemon = Some(host.daemon());
        assert!(take_until(&stays, 60).into_iter().eq(1..=60), "{:?}", (from_shares, to_shares));
        assert_eq!(stays.lost(), 0);
        assert!(publisher.wait_acknowledged(PATIENCE) || publisher.given_up() > 0);
        drop(daemon);
    }
}

#[test]
fn keep_last_and_best_effort_losses_of_a_killed_daemon_are_counted() {
    for reliability in [Reliability::Reliable, Reliability::BestEffort] {
        for (from_shares, to_shares) in ENDS {
            let host = host();
            let mut daemon = Some(host.daemon());
            let from = session(&host, "from", from_shares);
            let to = session(&host, "to", to_shares);
            let publisher = from.create_publisher(spec("/t", depth_four(reliability))).unwrap();
            let keeps = Qos::keep_all().with_reliability(reliability);
            let subscription = to.create_subscription(spec("/t", keeps)).unwrap();
            await_pair(&publisher, &subscription);
            // Before its first sample, a subscription does not know which samples came before.
            let mut published = publish(&publisher, &pattern(1, 10));
            assert_eq!(take_until(&subscription, 1), [1]);
            for _ in 0..2 {
                for _ in 0..300 {
                    published = publish(&publisher, &pattern(published + 1, 3_000));
                }
                replace(&host, &mut daemon);
                await_pair(&publisher, &subscription);
            }
            published = publish(&publisher, &pattern(published + 1, 3_000));
            let taken = take_until(&subscription, published);
            assert!(taken.is_sorted_by(|a, b| a < b), "nothing is repeated");
            let case = (reliability, from_shares, to_shares);
            assert_eq!(1 + taken.len() as u64 + subscription.lost(), published, "{case:?}");
        }
    }
}

#[test]
fn a_late_joiner_gets_the_history_from_the_next_daemon() {
    let all = Qos::keep_all().with_durability(Durability::TransientLocal);
    for (from_shares, to_shares) in ENDS {
        let host = host();
        let mut daemon = Some(host.daemon());
        let from = session(&host, "from", from_shares);
        let to = session(&host, "to", to_shares);
        let (publisher, first) = connect(&from, &to, "/t", all);
        for sequence in 1..=30 {
            publish(&publisher, &pattern(sequence, len_of(sequence)));
        }
        replace(&host, &mut daemon);
        let ends = (from_shares, to_shares);
        let joiner = to.create_subscription(spec("/t", all)).unwrap();
        assert!(take_until(&joiner, 30).into_iter().eq(1..=30), "{ends:?}");
        assert!(take_until(&first, 30).into_iter().eq(1..=30), "{ends:?}");
        publish(&publisher, &pattern(31, 10));
        assert_eq!((take_until(&first, 31), take_until(&joiner, 31)), (vec![31], vec![31]));
        assert_eq!((first.lost(), joiner.lost()), (0, 0), "{ends:?}");
        // A late joiner gets them, too.
        let late = to.create_subscription(spec("/t", all)).unwrap();
        assert!(take_until(&late, 31).into_iter().eq(1..=31), "{ends:?}");
    }
}
