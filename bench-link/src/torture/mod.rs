//! Two hosts whose path and processes fail at random, while every sample and call is accounted for.

mod cast;
mod content;
mod faults;
mod judge;
mod ledger;
mod programs;
mod record;
mod words;

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use self::{
    cast::Cast,
    faults::Faults,
    judge::{HISTORY_MB, Judge},
    words::{Order, Topic},
};
pub(crate) use self::{programs::run, words::Role};
use crate::{
    Result,
    place::{Place, Plan},
    scenarios::Options,
    table::Table,
};

/// How long a torture takes if nothing else is said.
pub(crate) const TIME: Duration = Duration::from_secs(3_600);
/// How long the hosts have to meet, and to come to rest.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often the conductor looks whether something is due.
const LOOK: Duration = Duration::from_millis(50);
/// How often it says how far it is.
const PROGRESS: Duration = Duration::from_secs(60);
/// For the last reports.
const SETTLE: Duration = Duration::from_secs(2);
/// Violations that are shown.
const SHOWN: usize = 20;

/// Kills and ends processes and daemons and disturbs the path, and accounts for every sample.
pub(crate) fn torture(options: &Options) -> Result<Value> {
    let (seed, time) = (options.plan.seed, options.time.unwrap_or(TIME));
    println!(
        "\nEight publishers, eight subscribers, two servers and two clients on two hosts for {} s; seed {seed}.\n",
        time.as_secs()
    );
    // A publisher with a full history waits for as long as the path may be cut or poor.
    let plan = Plan { link: "stalled_s = 600\n", ..options.plan.clone() };
    let mut place = Place::new(options.path, &plan)?;
    place.set("AXON_RING_BUFFER_SIZE_MB", &HISTORY_MB.to_string());
    if std::env::var_os("AXON_LOG").is_none() {
        place.set("AXON_LOG", "info");
    }
    let mut cast = Cast::start(&place.hosts, seed, place.directory())?;
    if !wait(&mut cast, |cast| cast.ledger.is_matched())? {
        return Err("the two hosts do not meet".into());
    }
    let mut faults = Faults::new(seed, options.path);
    disturb(&place, &mut cast, &mut faults, time)?;
    faults.end(&place);
    let pending = come_to_rest(&mut cast)?;
    let mut judge = Judge::new(&cast.ledger, &faults.record);
    let topics = show_topics(&mut judge)?;
    let calls = judge.calls();
    println!(
        "\n{} calls, {} served, {} answered; {} were not, as a daemon or the server ended; unaccounted for: {}",
        calls.sent, calls.served, calls.answered, calls.excused, calls.unaccounted
    );
    let counts: Vec<String> =
        faults.counts.iter().map(|(what, count)| format!("{what}: {count}")).collect();
    println!("Faults: {}", counts.join(", "));
    if let Some(keys) = place.keys_drawn() {
        println!("Keys drawn: {keys}");
    }
    let violations = judge.violations();
    for violation in violations.iter().take(SHOWN) {
        println!("{}: {}", violation.of, violation.what);
    }
    if !violations.is_empty() || pending > 0 {
        drop(cast);
        return Err(format!(
            "seed {seed} in {}: {} rules broken, {pending} pairs wait in vain; the hosts' files are in {}",
            plan.mode.name(),
            violations.len(),
            place.keep().display()
        )
        .into());
    }
    Ok(json!({
        "seed": seed,
        "seconds": time.as_secs(),
        "topics": topics,
        "calls": calls.sent,
        "calls_answered": calls.answered,
        "calls_excused": calls.excused,
        "faults": faults.counts,
    }))
}

fn wait(cast: &mut Cast<'_>, mut done: impl FnMut(&Cast<'_>) -> bool) -> Result<bool> {
    let begin = Instant::now();
    while !done(cast) {
        if begin.elapsed() > PATIENCE {
            return Ok(false);
        }
        cast.listen(LOOK)?;
    }
    Ok(true)
}

fn disturb(place: &Place, cast: &mut Cast<'_>, faults: &mut Faults, time: Duration) -> Result<()> {
    let table = Table::new(&["after", ">published", ">received", ">faults", ">broken rules"]);
    let (begin, mut told) = (Instant::now(), Instant::now());
    while begin.elapsed() < time {
        cast.listen(LOOK)?;
        faults.handle_time(place, cast)?;
        if told.elapsed() >= PROGRESS.min(time / 4) {
            told = Instant::now();
            let entries = &cast.ledger.entries;
            let taken = entries.iter().flat_map(|entry| entry.taken.values());
            table.row([
                format!("{} s", begin.elapsed().as_secs()),
                entries.iter().map(|entry| entry.published()).sum::<u64>().to_string(),
                taken.map(|intake| intake.count).sum::<u64>().to_string(),
                faults.counts.values().sum::<u64>().to_string(),
                cast.ledger.violations.len().to_string(),
            ])?;
        }
    }
    Ok(())
}

/// Lets all that is under way arrive, and the last samples. Returns how many pairs still wait then.
fn come_to_rest(cast: &mut Cast<'_>) -> Result<usize> {
    cast.tell(Order::Quiet, |role| matches!(role, Role::Publisher(_) | Role::Client(_)))?;
    wait(cast, |cast| cast.is_settled() && cast.ledger.pending() == 0)?;
    cast.tell(Order::Finish, |role| matches!(role, Role::Publisher(_)))?;
    wait(cast, |cast| cast.ledger.is_finished() && cast.ledger.pending() == 0)?;
    cast.listen(SETTLE)?;
    Ok(cast.ledger.pending())
}

fn show_topics(judge: &mut Judge<'_>) -> Result<Vec<Value>> {
    println!();
    let header = [
        "topic",
        ">published",
        ">received there",
        ">here",
        ">lost, counted",
        ">given up",
        ">repeated",
        ">unaccounted",
    ];
    let table = Table::new(&header);
    let mut figures = Vec::new();
    for topic in Topic::EACH {
        let row = judge.topic(topic);
        let cells = [
            row.published,
            row.received,
            row.received_here,
            row.lost,
            row.given_up,
            row.repeated,
            row.unaccounted,
        ];
        let name = topic.name().to_owned();
        table.row([name].into_iter().chain(cells.iter().map(u64::to_string)))?;
        figures.push(json!({
            "topic": topic.name(),
            "published": row.published,
            "received": row.received,
            "received_on_the_same_host": row.received_here,
            "lost": row.lost,
            "given_up": row.given_up,
            "repeated": row.repeated,
            "unaccounted": row.unaccounted,
        }));
    }
    Ok(figures)
}
