//! Two paths between two hosts, of which one after the other is cut.

use std::{
    thread,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng, rngs::StdRng};
use serde_json::{Value, json};

use super::{MS, Options, ms, quantile};
use crate::{
    Result,
    part::{Arrival, Stream, now_ns},
    place::{Outcome, Place, Plan},
    table::Table,
};

/// The settings of both hosts. Without the entries, `messages10` sends no copies.
const TWO_PATHS: &str = "paths = 2\n\n[[topic]]\nname = '/there'\nredundant = true\n\n\
                         [[topic]]\nname = '/back'\nredundant = true\n";
/// How long samples flow if nothing else is said.
const TIME: Duration = Duration::from_secs(60);
/// How long the hosts have to link over the second path.
const PATIENCE: Duration = Duration::from_secs(60);
/// From cut to cut, and how long one lasts, in seconds.
const PAUSE: (f64, f64) = (1.0, 5.0);
const CUT: (f64, f64) = (0.2, 5.0);
/// How long after a cut samples may still be late because of it.
const AFTER: u64 = 1_000 * MS;

/// A path that was cut.
struct Cut {
    begin: u64,
    end: u64,
    /// A second link stood by.
    is_covered: bool,
}

/// 1 KB at 100 Hz in each direction over two paths that are cut at random, alone and beside a stream that fills a path.
pub(crate) fn paths(options: &Options) -> Result<Value> {
    println!(
        "\n1 KB at 100 Hz, RELIABLE, KEEP_ALL, each way; one of two paths is cut at random for {} to {} s.\n",
        CUT.0, CUT.1
    );
    let header = [
        "samples",
        "beside",
        ">published",
        ">received",
        ">twice",
        ">p50",
        ">p99",
        ">longest",
        ">longest pause",
        ">with a second link",
    ];
    let table = Table::new(&header);
    let plan = Plan { link: TWO_PATHS, paths: 2, ..options.plan.clone() };
    let mut figures = Vec::new();
    for beside in ["nothing", "bulk"] {
        let mut place = Place::new(options.path, &plan)?;
        place.set("AXON_LOG", "info");
        let mut streams = vec![(0, sensor("/there")), (1, sensor("/back"))];
        if beside == "bulk" {
            streams.push((0, bulk()));
        }
        let mut running = place.streams_of(&streams)?;
        wait_for_second_link(&place)?;
        running.begin()?;
        let cuts = cut_at_random(&place, options.time.unwrap_or(TIME), plan.seed)?;
        let outcomes = running.end()?;
        for ((_, stream), outcome) in streams.iter().zip(&outcomes) {
            let ages = outcome.ages();
            let [p50, p99, longest] = [50, 99, 100].map(|percent| quantile(&ages, percent));
            let [pause, covered] = longest_pauses(outcome, &cuts);
            let numbers = outcome.numbers();
            let twice = outcome.taken.arrivals.len() - numbers;
            table.row([
                stream.topic.clone(),
                beside.to_owned(),
                outcome.published().to_string(),
                numbers.to_string(),
                twice.to_string(),
                ms(p50),
                ms(p99),
                ms(longest),
                ms(Some(pause)),
                ms(Some(covered)),
            ])?;
            figures.push(json!({
                "topic": stream.topic,
                "beside": beside,
                "published": outcome.published(),
                "received": numbers,
                "twice": twice,
                "lost": outcome.taken.lost,
                "p50_ms": p50,
                "p99_ms": p99,
                "longest_ms": longest,
                "longest_pause_ms": pause,
                "longest_pause_with_second_link_ms": covered,
                "cuts": cuts.len(),
            }));
        }
        let uncovered = cuts.iter().filter(|cut| !cut.is_covered).count();
        println!(
            "{} cuts, {uncovered} of them while no second link stood by; the second link took over {} times",
            cuts.len(),
            place.log_lines("the second link takes over")
        );
    }
    Ok(json!(figures))
}

fn sensor(topic: &str) -> Stream {
    Stream {
        topic: topic.to_owned(),
        bytes: 1_000,
        every: Duration::from_millis(10),
        is_reliable: true,
        depth: None,
    }
}

fn bulk() -> Stream {
    Stream {
        topic: "/bulk".to_owned(),
        bytes: 64_000,
        every: Duration::ZERO,
        is_reliable: true,
        depth: None,
    }
}

fn wait_for_second_link(place: &Place) -> Result<()> {
    let begin = Instant::now();
    while !stands_by(place) {
        if begin.elapsed() > PATIENCE {
            return Err("no second link comes to stand by".into());
        }
        thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// Whether a second link stands by on both hosts.
fn stands_by(place: &Place) -> bool {
    place.hosts.iter().all(|host| {
        let links = host.status().and_then(|status| status["links"].as_array().cloned());
        links.is_some_and(|links| links.iter().any(|link| !link["standby"].is_null()))
    })
}

/// Cuts one path at a time.
fn cut_at_random(place: &Place, time: Duration, seed: u64) -> Result<Vec<Cut>> {
    let mut random = StdRng::seed_from_u64(seed);
    let (begin, mut cuts) = (Instant::now(), Vec::new());
    loop {
        let pause = Duration::from_secs_f64(random.random_range(PAUSE.0..PAUSE.1));
        let cut = Duration::from_secs_f64(random.random_range(CUT.0..CUT.1));
        let path = random.random_range(0..2);
        let left = time.saturating_sub(begin.elapsed());
        if left < pause + cut {
            thread::sleep(left);
            return Ok(cuts);
        }
        thread::sleep(pause);
        let is_covered = stands_by(place);
        let begin = now_ns();
        place.relays[path].set(|settings| settings.is_cut = true);
        thread::sleep(cut);
        place.relays[path].set(|settings| settings.is_cut = false);
        cuts.push(Cut { begin, end: now_ns(), is_covered });
    }
}

/// The longest time without a sample, in milliseconds: of all, and apart from cuts without a second link.
fn longest_pauses(outcome: &Outcome, cuts: &[Cut]) -> [f64; 2] {
    let pauses = |is_counted: &dyn Fn(&[Arrival]) -> bool| {
        let pairs = outcome.taken.arrivals.windows(2).filter(|pair| is_counted(pair));
        let longest = pairs.map(|pair| pair[1].arrived - pair[0].arrived).max();
        longest.unwrap_or(0) as f64 / MS as f64
    };
    let is_of = |cut: &Cut, pair: &[Arrival]| {
        pair[0].arrived <= cut.end + AFTER && pair[1].arrived >= cut.begin
    };
    let covered = |pair: &[Arrival]| !cuts.iter().any(|cut| !cut.is_covered && is_of(cut, pair));
    [pauses(&|_| true), pauses(&covered)]
}
