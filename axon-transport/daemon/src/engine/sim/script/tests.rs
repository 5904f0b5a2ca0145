use std::collections::BTreeSet;

use super::*;
use crate::engine::sim::trace::Trace;

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn recipe() -> Recipe {
    Recipe {
        hosts: 5,
        interfaces: 2,
        topics: 3,
        faults: 60,
        until: ms(20_000),
        longest: ms(5_000),
        weights: Weights::default(),
    }
}

/// Returns the name that a fault's kind has in text.
fn name(fault: &Fault) -> String {
    fault.kind.to_string().split(' ').next().unwrap().to_owned()
}

#[test]
fn seed_decides_the_script() {
    let text = |seed| Script::generate(seed, &recipe()).to_string();
    let mut seen = BTreeSet::new();
    for seed in 0..200 {
        assert_eq!(text(seed), text(seed));
        assert!(seen.insert(text(seed).split_once('\n').unwrap().1.to_owned()), "seed {seed}");
    }
}

#[test]
fn generated_scripts_are_valid_and_end_in_quiet() {
    let recipe = recipe();
    let mut names = BTreeSet::new();
    for seed in 0..500 {
        let mut script = Script::generate(seed, &recipe);
        assert_eq!((script.seed, script.hosts, script.faults.len()), (seed, 5, 60));
        assert!(script.faults.is_sorted_by_key(|fault| fault.at));
        assert!(script.end() <= recipe.until);
        for fault in &mut script.faults {
            names.insert(name(fault));
            assert!(fault.kind.hosts_mut().iter().all(|host| **host < 5), "{fault}");
            let ends = fault.lasts.is_some();
            match &fault.kind {
                Kind::Partition { hosts } => {
                    assert!(ends && (1..=2).contains(&hosts.len()), "{fault}");
                    assert!(hosts.is_sorted_by(|a, b| a < b), "{fault}");
                }
                Kind::Cut { from, to } => assert!(ends && from != to, "{fault}"),
                Kind::Path { from, to, .. } => assert_ne!(from, to),
                Kind::Rebind { .. } | Kind::Move { .. } | Kind::Publish { .. } => assert!(!ends),
                Kind::Publisher { .. } | Kind::Subscription { .. } => {}
                _ => assert!(ends, "{fault}"),
            }
        }
    }
    assert_eq!(names.len(), 12, "each kind is drawn: {names:?}");
}

#[test]
fn weights_choose_the_kinds() {
    let weights = Weights { pause: 1, kme: 3, ..Weights::NONE };
    let recipe = Recipe { weights, faults: 4_000, ..recipe() };
    let script = Script::generate(3, &recipe);
    let pauses = script.faults.iter().filter(|fault| name(fault) == "pause").count();
    assert!((900..1_100).contains(&pauses), "{pauses}");
    assert!(script.faults.iter().all(|fault| ["pause", "kme"].contains(&&*name(fault))));
}

#[test]
fn single_host_gets_no_fault_between_hosts() {
    let recipe = Recipe { hosts: 1, interfaces: 1, topics: 1, faults: 1_000, ..recipe() };
    let script = Script::generate(3, &recipe);
    let between = ["partition", "cut", "path"];
    assert!(script.faults.iter().all(|fault| !between.contains(&&*name(fault))));
}

#[test]
fn printed_script_is_parsed_back() {
    for seed in 0..500 {
        let script = Script::generate(seed, &recipe());
        assert_eq!(script.to_string().parse(), Ok(script));
    }
    let odd = Script {
        seed: u64::MAX,
        hosts: 0,
        faults: vec![Fault {
            at: Duration::from_nanos(1_000_001),
            lasts: Some(Duration::from_nanos(u64::MAX)),
            kind: Kind::Partition { hosts: vec![] },
        }],
    };
    assert_eq!(odd.to_string().parse(), Ok(odd));
}

#[test]
fn script_written_by_hand_is_read() {
    let text = "
        # A failure of last week.
        seed=42 hosts=5

        1500ms partition hosts=0,2 for=800ms
        2s kill host=1 orderly=no for=1s
        2500us path  from=0 to=1 jitter=5ms delay=20ms loss=400 duplicate=0 reorder=10 rate=125000
        0s publish host=4 topic=1 count=3 size=1200 every=0s";
    let script: Script = text.parse().unwrap();
    let fault = |at, lasts, kind| Fault { at, lasts, kind };
    let change = PathChange {
        delay: ms(20),
        jitter: ms(5),
        loss: 400,
        duplicate: 0,
        reorder: 10,
        rate: Some(125_000),
    };
    let publish = Kind::Publish { host: 4, topic: 1, count: 3, size: 1_200, every: ms(0) };
    let faults = vec![
        fault(ms(1_500), Some(ms(800)), Kind::Partition { hosts: vec![0, 2] }),
        fault(ms(2_000), Some(ms(1_000)), Kind::Kill { host: 1, orderly: false }),
        fault(Duration::from_micros(2_500), None, Kind::Path { from: 0, to: 1, change }),
        fault(ms(0), None, publish),
    ];
    assert_eq!(script, Script { seed: 42, hosts: 5, faults });
}

#[test]
fn malformed_scripts_are_refused_with_the_line() {
    let fault = |line: &str| format!("seed=1 hosts=2\n\n{line}");
    let cases = [
        (String::new(), "the script is empty"),
        ("hosts=2".to_owned(), "line 1: `seed` is missing"),
        ("seed=1 hosts=2 x=3".to_owned(), "line 1: `x` is unknown here"),
        ("seed=-1 hosts=2".to_owned(), "line 1: seed: `-1`: invalid digit"),
        (fault("1s"), "line 3: a fault needs a time and a kind"),
        (fault("1s pause"), "line 3: a fault needs fields"),
        (fault("1s panic host=1"), "line 3: `panic` is no kind of fault"),
        (fault("1 pause host=1"), "line 3: `1` has no unit"),
        (fault("s pause host=1"), "line 3: ``: cannot parse"),
        (fault("1.5s pause host=1"), "line 3: `1.5s` has no unit"),
        (fault("20000000000s pause host=1"), "line 3: `20000000000s` is too long"),
        (fault("1s pause host=2"), "line 3: host 2 of 2"),
        (fault("1s partition hosts=0,7"), "line 3: host 7 of 2"),
        (fault("1s pause host=1 host=0"), "line 3: `host` stands there twice"),
        (fault("1s pause host"), "line 3: `host` has no `=`"),
        (fault("1s kill host=1 orderly=maybe"), "line 3: orderly: `maybe` is not yes or no"),
        (fault("1s kme host=1 failure=sad"), "line 3: failure: `sad` is unknown"),
        (
            fault("1s path from=0 to=1 delay=0s jitter=0s loss=1001 duplicate=0 reorder=0"),
            "line 3: loss: 1001 thousandths",
        ),
    ];
    for (text, expected) in cases {
        let error = text.parse::<Script>().unwrap_err();
        assert!(error.starts_with(expected), "{text:?}: {error}");
    }
}

#[test]
fn steps_are_in_order() {
    let fault = |at, lasts: Option<u64>| Fault {
        at: ms(at),
        lasts: lasts.map(ms),
        kind: Kind::Pause { host: 0 },
    };
    let faults = vec![
        fault(20, Some(0)),
        fault(10, Some(10)),
        fault(20, None),
        fault(5, Some(100)),
        fault(20, Some(5)),
    ];
    let script = Script { seed: 1, hosts: 1, faults };
    let steps: Vec<_> =
        script.steps().iter().map(|step| (step.at.as_millis(), step.fault, step.edge)).collect();
    use Edge::{Begin, End};
    let expected = [
        (5, 3, Begin),
        (10, 1, Begin),
        (20, 1, End),
        (20, 0, Begin),
        (20, 2, Begin),
        (20, 4, Begin),
        (20, 0, End),
        (25, 4, End),
        (105, 3, End),
    ];
    assert_eq!(steps, expected);
    assert_eq!(script.end(), ms(105));
    assert_eq!(Script { faults: vec![], ..script }.end(), ms(0));
}

/// Returns whether `script` has these faults, in any order, with any others between them.
fn has(script: &Script, wanted: &[&dyn Fn(&Fault) -> bool]) -> bool {
    wanted.iter().all(|wanted| script.faults.iter().any(wanted))
}

#[test]
fn shrinking_finds_the_one_fault_that_matters() {
    for seed in 0..50 {
        let script = Script::generate(seed, &recipe());
        let fails =
            |script: &Script| has(script, &[&|fault| matches!(fault.kind, Kind::Kill { .. })]);
        if !fails(&script) {
            continue;
        }
        let shrunk = script.shrink(10_000, fails);
        assert!(!shrunk.stopped);
        let [only] = &*shrunk.script.faults else { panic!("{}", shrunk.script) };
        assert!(matches!(only.kind, Kind::Kill { host: 0, .. }), "{only}");
        assert_eq!((only.at, only.lasts, shrunk.script.hosts), (ms(0), Some(ms(0)), 1));
        assert_eq!(shrunk.script.seed, seed);
    }
}

#[test]
fn shrinking_keeps_faults_that_matter_together() {
    // A partition of one second or more around host 3, a burst of at least 37 samples above 1,200 bytes, and
    // loss of 5 per cent or more, on a network of at least 4 hosts.
    let partition = |fault: &Fault| match &fault.kind {
        Kind::Partition { hosts } => hosts.contains(&3) && fault.lasts >= Some(ms(1_000)),
        _ => false,
    };
    let publish = |fault: &Fault| match fault.kind {
        Kind::Publish { count, size, .. } => count >= 37 && size > 1_200,
        _ => false,
    };
    let loss = |fault: &Fault| match fault.kind {
        Kind::Path { change, .. } => change.loss >= 50,
        _ => false,
    };
    let fails = |s: &Script| s.hosts >= 4 && has(s, &[&partition, &publish, &loss]);
    let mut tried = 0;
    for seed in 0..300 {
        let script = Script::generate(seed, &Recipe { faults: 100, ..recipe() });
        if !fails(&script) {
            continue;
        }
        tried += 1;
        let Shrunk { script, runs, stopped } = script.shrink(10_000, fails);
        assert!(!stopped && runs < 1_000, "{runs} runs");
        assert!(fails(&script));
        let mut kinds: Vec<String> = script.faults.iter().map(name).collect();
        kinds.sort();
        assert_eq!(kinds, ["partition", "path", "publish"], "{script}");
        for fault in &script.faults {
            assert_eq!(fault.at, ms(0), "{fault}");
            match &fault.kind {
                Kind::Partition { hosts } => {
                    assert_eq!((&**hosts, fault.lasts), (&[3][..], Some(ms(1_000))));
                }
                Kind::Publish { count, size, every, .. } => {
                    assert_eq!((*count, *size, *every), (37, 1_201, ms(0)));
                }
                Kind::Path { change, .. } => {
                    assert_eq!(*change, PathChange { loss: 50, ..PathChange::default() });
                }
                _ => unreachable!(),
            }
        }
    }
    assert!(tried > 20, "{tried} scripts failed");
}

#[test]
fn shrinking_finds_an_ordered_pair() {
    // A kill of a host while it is paused, which needs the order of the steps.
    let fails = |script: &Script| {
        let mut paused = BTreeSet::new();
        script.steps().iter().any(|step| match (&script.faults[step.fault].kind, step.edge) {
            (Kind::Pause { host }, Edge::Begin) => {
                paused.insert(*host);
                false
            }
            (Kind::Pause { host }, Edge::End) => {
                paused.remove(host);
                false
            }
            (Kind::Kill { host, .. }, Edge::Begin) => paused.contains(host),
            _ => false,
        })
    };
    let script = (0..).map(|seed| Script::generate(seed, &recipe())).find(fails).unwrap();
    let shrunk = script.shrink(10_000, fails);
    let names: BTreeSet<String> = shrunk.script.faults.iter().map(name).collect();
    assert_eq!(shrunk.script.faults.len(), 2, "{}", shrunk.script);
    assert_eq!(names, BTreeSet::from(["kill".to_owned(), "pause".to_owned()]));
    assert_eq!(shrunk.script.hosts, 1);
    assert!(fails(&shrunk.script));
}

#[test]
fn failure_without_a_fault_shrinks_to_nothing() {
    let script = Script::generate(9, &recipe());
    let shrunk = script.shrink(10_000, |_| true);
    assert_eq!((shrunk.script.faults.len(), shrunk.script.hosts), (0, 0));
    assert!(shrunk.runs < 10, "{}", shrunk.runs);
}

#[test]
fn failure_that_does_not_come_again_leaves_the_script() {
    let script = Script::generate(9, &recipe());
    let shrunk = script.shrink(10_000, |_| false);
    assert_eq!(shrunk.script, script);
    assert!(!shrunk.stopped);
}

#[test]
fn shrinking_stops_at_its_limit_of_runs() {
    let script = Script::generate(9, &recipe());
    for limit in [0, 1, 7] {
        let mut runs = 0;
        let shrunk = script.shrink(limit, |candidate| {
            runs += 1;
            candidate.faults.len() >= 20
        });
        assert_eq!((runs, shrunk.runs, shrunk.stopped), (limit, limit, true));
        assert!(shrunk.script.faults.len() >= 20);
    }
}

#[test]
fn shrinking_is_deterministic() {
    let script = Script::generate(9, &recipe());
    let run = || {
        let mut trace = Trace::new(0);
        let shrunk = script.shrink(10_000, |candidate| {
            trace.text(ms(0), candidate.to_string());
            candidate.faults.iter().filter(|fault| fault.lasts.is_some()).count() >= 3
        });
        (trace.hash(), shrunk.script)
    };
    assert_eq!(run(), run());
}
