//! Which samples and calls had to arrive, and which did not.
//!
//! - No sample comes twice or out of order, none is altered, and none comes that was not published.
//! - What a subscription that lives did not get between two samples of one publisher, it counts as lost.
//! - Between KEEP_ALL endpoints that live no sample is missing that was published while the subscriber was matched, unless
//!   the publisher counts it as given up. It gives up samples only after a daemon was killed whose successor did not link
//!   in time, so never where the path was left alone; or for a subscriber that ended when the daemon of its publisher's
//!   host was killed, as the next daemon cannot know of it. A sample may be published after a relay was given up and
//!   before the publisher hears that its subscriber is gone. On one host nothing is missing.
//! - All samples of a publisher that ended arrive if they were acknowledged, or if no daemon was killed and the path was
//!   good around its end. Of a publisher that was killed the last ones may be missing.
//! - A TRANSIENT_LOCAL subscriber gets the whole history, whenever it came.
//! - The last ten samples of a RELIABLE publisher arrive once all faults are over.
//! - A server sees no call twice, and a client gets no answer twice. A call has an answer unless a daemon was killed, or
//!   the server ended, before a later call was answered.

use super::{
    ledger::{Entry, Fate, Gap, Intake, Ledger, Violation},
    record::{Record, SECOND},
    words::{Role, Topic},
};

/// `AXON_RING_BUFFER_SIZE_MB` of all processes.
pub(super) const HISTORY_MB: usize = 16;
/// Samples that a publisher publishes when all faults are over.
const LAST: u64 = 10;
/// How long after a daemon's death a publisher may give up what the daemon had not delivered: it keeps that for ten
/// seconds, and then may be busy.
const GIVEN_UP: u64 = 60 * SECOND;
/// How long a publisher keeps samples for the relay of a daemon that was killed.
const ABSENCE: u64 = 10 * SECOND;
/// Around the end of a publisher a daemon's death may cost samples: it may have been down before, and the publisher stays
/// for ten seconds.
const ENDING: [u64; 2] = [15 * SECOND, 25 * SECOND];

/// What became of the samples of a topic, or of the calls.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Row {
    pub(super) published: u64,
    /// By subscribers on the other host, and on the same one.
    pub(super) received: u64,
    pub(super) received_here: u64,
    /// What the subscriptions count.
    pub(super) lost: u64,
    pub(super) given_up: u64,
    pub(super) repeated: u64,
    pub(super) unaccounted: u64,
}

/// The calls of all clients.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Calls {
    pub(super) sent: u64,
    pub(super) served: u64,
    pub(super) answered: u64,
    /// A daemon or the server had ended.
    pub(super) excused: u64,
    pub(super) unaccounted: u64,
}

/// Looks at what all processes reported.
pub(super) struct Judge<'a> {
    ledger: &'a Ledger,
    record: &'a Record,
    violations: Vec<Violation>,
}

impl<'a> Judge<'a> {
    pub(super) fn new(ledger: &'a Ledger, record: &'a Record) -> Self {
        Self { ledger, record, violations: ledger.violations.clone() }
    }

    pub(super) fn violations(self) -> Vec<Violation> {
        self.violations
    }

    pub(super) fn topic(&mut self, topic: Topic) -> Row {
        let ledger = self.ledger;
        let of = |role| ledger.entries.iter().filter(move |entry| entry.role == role);
        let (publishers, subscribers) = (Role::Publisher(topic), Role::Subscriber(topic));
        let mut row = Row {
            repeated: ledger.repeated.get(&topic).copied().unwrap_or(0),
            published: of(publishers).map(Entry::published).sum(),
            given_up: of(publishers).map(Entry::given_up).sum(),
            lost: of(subscribers).map(|entry| entry.lost).sum(),
            ..Row::default()
        };
        for subscriber in of(subscribers) {
            row.unaccounted += self.check_count(subscriber);
            for (gid, intake) in &subscriber.taken {
                let Some(publisher) = of(publishers).find(|entry| entry.gid == *gid) else {
                    self.tell(subscriber, format!("got samples of {gid}, which is no publisher"));
                    continue;
                };
                // Of the last sample of a killed publisher nothing may have been heard.
                let most = publisher.published() + u64::from(!publisher.lives());
                if intake.last > most {
                    let number = intake.last;
                    self.tell(subscriber, format!("got sample {number} of {gid}, of {most}"));
                }
                match publisher.host == subscriber.host {
                    true => row.received_here += intake.count,
                    false => row.received += intake.count,
                }
            }
            for publisher in of(publishers) {
                row.unaccounted += self.check_pair(topic, publisher, subscriber);
            }
        }
        if topic.is_keep_all() {
            of(publishers).for_each(|publisher| self.check_given_up(publisher));
        }
        row
    }

    /// A subscription counts what is missing between the samples that came.
    fn check_count(&mut self, subscriber: &Entry) -> u64 {
        let missing: u64 = subscriber.taken.values().map(Intake::missing).sum();
        let uncounted = missing.saturating_sub(subscriber.lost);
        if subscriber.lives() && uncounted > 0 {
            let lost = subscriber.lost;
            self.tell(subscriber, format!("misses {missing} samples, and counts {lost} as lost"));
            return uncounted;
        }
        0
    }

    fn check_pair(&mut self, topic: Topic, publisher: &Entry, subscriber: &Entry) -> u64 {
        let none = Intake::default();
        let intake = subscriber.taken.get(&publisher.gid).unwrap_or(&none);
        let both_live = publisher.lives() && subscriber.lives();
        if both_live && topic.is_reliable() && publisher.publishing.is_finished {
            let last = publisher.published();
            let first = (last + 1).saturating_sub(LAST);
            let missing = (first..=last).filter(|number| !intake.has(*number));
            let missing: Vec<u64> = missing.collect();
            if !missing.is_empty() {
                let what = "that were published after all faults";
                return self.tell_missing(publisher, subscriber, &missing, what);
            }
        }
        if !topic.is_keep_all() {
            return 0;
        }
        let history = publisher.publishing.bytes + 128 * publisher.publishing.times.len();
        if topic == Topic::Map && both_live && history < HISTORY_MB << 19 {
            let missing = (1..=publisher.published()).filter(|number| !intake.has(*number));
            let missing: Vec<u64> = missing.collect();
            if !missing.is_empty() {
                let what = "of the history";
                return self.tell_missing(publisher, subscriber, &missing, what);
            }
        }
        let mut missing = missing(publisher, subscriber, intake);
        let is_here = publisher.host == subscriber.host;
        match publisher.fate {
            Fate::Lives => {}
            Fate::Killed { at } => {
                let after = |number: u64| {
                    let gap = |gap: &&Gap| (gap.first..=gap.last).contains(&number);
                    intake.gaps.iter().find(gap).is_some_and(|gap| gap.at >= at)
                };
                missing.retain(|number| *number <= intake.last && !after(*number));
            }
            Fate::Ended { at, acknowledged } => {
                let (from, to) = (at.saturating_sub(ENDING[0]), at + ENDING[1]);
                let is_excused =
                    self.record.has_kill(from, to) || !is_here && self.record.was_poor(from, to);
                if is_excused && acknowledged != Some(true) {
                    return 0;
                }
            }
        }
        let (given_up, unmatched) = (publisher.given_up(), publisher.unmatched(&subscriber.gid));
        let between = if given_up > 0 { unmatched } else { 0 };
        let allowed = if is_here { 0 } else { given_up + between };
        if missing.len() as u64 > allowed {
            let what = format!("published for it ({allowed} given up, {:?})", publisher.fate);
            return self.tell_missing(publisher, subscriber, &missing, &what);
        }
        if both_live { self.check_unmatched(publisher, subscriber, intake) } else { 0 }
    }

    /// Samples that were published while the subscriber was not matched, though it was before and after.
    fn check_unmatched(&mut self, publisher: &Entry, subscriber: &Entry, intake: &Intake) -> u64 {
        let is_here = publisher.host == subscriber.host;
        let time = |number: u64| publisher.publishing.times[number as usize - 1];
        let wrong = intake.gaps.iter().filter(|gap| {
            let from = time(gap.first).saturating_sub(GIVEN_UP);
            is_here || !self.record.has_kill(from, gap.at)
        });
        let wrong: Vec<u64> = wrong.flat_map(|gap| gap.first..=gap.last).collect();
        if wrong.is_empty() {
            return 0;
        }
        self.tell_missing(publisher, subscriber, &wrong, "though no daemon was killed")
    }

    fn check_given_up(&mut self, publisher: &Entry) {
        for (at, total) in &publisher.publishing.given_up {
            let is_excused = self.record.has_rough_kill(at.saturating_sub(GIVEN_UP), *at)
                || self.has_ended_reader(publisher, *at);
            if !is_excused {
                let what = "though no daemon was killed over a path that was cut or poor";
                self.tell(publisher, format!("has given up {total} samples at {at}, {what}"));
            }
        }
    }

    /// Whether a matched subscriber of the other host was killed around the death of the daemon of the publisher's host,
    /// long enough before `at` for its samples to be given up.
    fn has_ended_reader(&self, publisher: &Entry, at: u64) -> bool {
        let died = |subscriber: &Entry| match subscriber.fate {
            Fate::Killed { at } if subscriber.host != publisher.host => Some(at),
            _ => None,
        };
        let was_matched = |subscriber: &&Entry| publisher.was_matched(&subscriber.gid);
        let mut deaths = self.ledger.entries.iter().filter(was_matched).filter_map(died);
        deaths.any(|death| {
            let (from, to) = (death.saturating_sub(ABSENCE), death + ABSENCE);
            let to = to.min(at.saturating_sub(ABSENCE));
            death + GIVEN_UP > at && self.record.has_kill_on(publisher.host, from, to)
        })
    }

    pub(super) fn calls(&mut self) -> Calls {
        let ledger = self.ledger;
        let mut all = Calls::default();
        for entry in &ledger.entries {
            if matches!(entry.role, Role::Server(_)) {
                all.served += entry.taken.values().map(|intake| intake.count).sum::<u64>();
            }
            all.sent += entry.calling.calls.len() as u64;
            all.answered += entry.calling.answers.values().map(|a| a.count).sum::<u64>();
            let none = Intake::default();
            for (number, (sent, servers)) in (1..).zip(&entry.calling.calls) {
                for server in servers {
                    let intake = entry.calling.answers.get(server).unwrap_or(&none);
                    if intake.has(number) || number > intake.last && !entry.lives() {
                        continue;
                    }
                    let gap =
                        intake.gaps.iter().find(|gap| (gap.first..=gap.last).contains(&number));
                    let end = gap.map_or(u64::MAX, |gap| gap.at);
                    let lives = ledger.entries.iter().any(|e| e.gid == *server && e.lives());
                    if !lives || self.record.has_kill(sent.saturating_sub(SECOND), end) {
                        all.excused += 1;
                    } else {
                        all.unaccounted += 1;
                        self.tell(entry, format!("call {number} to {server} has no answer"));
                    }
                }
            }
        }
        all
    }

    fn tell(&mut self, of: &Entry, what: String) {
        self.violations.push(Violation { of: of.name(), what });
    }

    fn tell_missing(&mut self, of: &Entry, by: &Entry, numbers: &[u64], what: &str) -> u64 {
        let time = |number: u64| of.publishing.times[number as usize - 1];
        let (first, last) = (numbers[0], numbers[numbers.len() - 1]);
        let count = numbers.len() as u64;
        let whose = of.name();
        let (from, to) = (time(first), time(last));
        self.tell(
            by,
            format!("misses {count} samples of {whose} {what}: from {first} (at {from}) to {last} (at {to})"),
        );
        count
    }
}

/// Returns the samples that were published for a subscriber and did not come. Of a dead subscriber only samples before
/// its last one count.
fn missing(publisher: &Entry, subscriber: &Entry, intake: &Intake) -> Vec<u64> {
    let until = if subscriber.lives() { u64::MAX } else { intake.last };
    let ranges = publisher.published_for(&subscriber.gid).into_iter();
    let numbers = ranges.flat_map(|(from, to)| from..=to.min(until));
    numbers.filter(|number| !intake.has(*number)).collect()
}

impl Ledger {
    /// Whether each publisher has seen both subscribers, and each client its server.
    pub(super) fn is_matched(&self) -> bool {
        self.entries.iter().all(|entry| match entry.role {
            Role::Publisher(_) => {
                entry.publishing.matched.last().is_some_and(|(_, readers)| readers.len() == 2)
            }
            Role::Client(_) => !entry.calling.answers.is_empty(),
            Role::Subscriber(_) | Role::Server(_) => true,
        })
    }

    /// Whether all publishers that live have published their last samples.
    pub(super) fn is_finished(&self) -> bool {
        let publishes = |entry: &&Entry| entry.lives() && matches!(entry.role, Role::Publisher(_));
        self.entries.iter().filter(publishes).all(|entry| entry.publishing.is_finished)
    }

    /// How many pairs that live wait for a last sample, or for a last answer.
    pub(super) fn pending(&self) -> usize {
        let living = || self.entries.iter().filter(|entry| entry.lives());
        let waits = |reader: &Entry| {
            let gid = &reader.gid;
            let Role::Subscriber(topic) = reader.role else { return 0 };
            let publishers = living().filter(|entry| entry.role == Role::Publisher(topic));
            let late = publishers.filter(|publisher| {
                let matched = publisher.publishing.matched.last();
                let last = reader.taken.get(&publisher.gid).map_or(0, |intake| intake.last);
                matched.is_some_and(|(_, readers)| readers.contains(gid))
                    && last < publisher.published()
            });
            if topic.is_reliable() { late.count() } else { 0 }
        };
        let unanswered = |client: &Entry| {
            let last = client.calling.calls.last();
            let servers = last.map_or(&[][..], |(_, servers)| servers);
            let number = client.calling.calls.len() as u64;
            let answered = |gid: &String| {
                client.calling.answers.get(gid).is_some_and(|intake| intake.last == number)
            };
            let lives = |gid: &String| living().any(|entry| entry.gid == *gid);
            servers.iter().filter(|gid| lives(gid) && !answered(gid)).count()
        };
        living().map(|entry| waits(entry) + unanswered(entry)).sum()
    }
}
