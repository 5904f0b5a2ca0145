//! What each process reported.

use std::collections::{HashMap, HashSet};

use super::words::{Report, Role, Topic};
use crate::part::now_ns;

/// How a process came to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    Lives,
    Killed {
        at: u64,
    },
    /// A publisher ended, and all its samples were acknowledged, or not, or that was not asked.
    Ended {
        at: u64,
        acknowledged: Option<bool>,
    },
}

/// A publisher.
#[derive(Default)]
pub(super) struct Publishing {
    /// When each sample was published.
    pub(super) times: Vec<u64>,
    pub(super) bytes: usize,
    /// From which number on which subscribers were matched.
    pub(super) matched: Vec<(u64, HashSet<String>)>,
    /// When how many samples had been given up.
    pub(super) given_up: Vec<(u64, u64)>,
    pub(super) is_finished: bool,
}

/// Samples that a subscriber did not get, though later ones came.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gap {
    pub(super) first: u64,
    pub(super) last: u64,
    /// When the next sample came.
    pub(super) at: u64,
}

/// What a subscriber got of one publisher, or a server of one client.
#[derive(Default)]
pub(super) struct Intake {
    pub(super) first: u64,
    pub(super) last: u64,
    pub(super) count: u64,
    pub(super) gaps: Vec<Gap>,
}

/// Calls of a client.
#[derive(Default)]
pub(super) struct Calling {
    /// When each call was sent, and to which servers.
    pub(super) calls: Vec<(u64, Vec<String>)>,
    pub(super) answers: HashMap<String, Intake>,
}

/// A process.
pub(super) struct Entry {
    pub(super) host: usize,
    pub(super) role: Role,
    pub(super) gid: String,
    pub(super) fate: Fate,
    pub(super) publishing: Publishing,
    pub(super) taken: HashMap<String, Intake>,
    pub(super) calling: Calling,
    /// What a subscriber counts as lost.
    pub(super) lost: u64,
}

/// A rule that was broken.
#[derive(Clone, Debug)]
pub(super) struct Violation {
    pub(super) of: String,
    pub(super) what: String,
}

/// All processes so far, by the order of their start.
#[derive(Default)]
pub(super) struct Ledger {
    pub(super) entries: Vec<Entry>,
    pub(super) violations: Vec<Violation>,
    pub(super) repeated: HashMap<Topic, u64>,
}

impl Ledger {
    pub(super) fn begin(&mut self, id: usize, host: usize, role: Role) {
        debug_assert_eq!(id, self.entries.len());
        self.entries.push(Entry {
            host,
            role,
            gid: String::new(),
            fate: Fate::Lives,
            publishing: Publishing::default(),
            taken: HashMap::new(),
            calling: Calling::default(),
            lost: 0,
        });
    }

    pub(super) fn set_fate(&mut self, id: usize, fate: Fate) {
        self.entries[id].fate = fate;
    }

    pub(super) fn break_rule(&mut self, id: usize, what: String) {
        let of = self.entries[id].name();
        self.violations.push(Violation { of, what: format!("at {}: {what}", now_ns()) });
    }

    /// Takes in what a process reported.
    pub(super) fn note(&mut self, id: usize, report: Report) {
        let entry = &mut self.entries[id];
        let wrong = match report {
            Report::Ready { gid } => {
                entry.gid = gid;
                None
            }
            Report::Matched { from, readers } => {
                entry.publishing.matched.push((from, readers.into_iter().collect()));
                None
            }
            Report::Published { bytes, at, .. } => {
                entry.publishing.times.push(at);
                entry.publishing.bytes += bytes;
                None
            }
            Report::GivenUp { total, at } => {
                entry.publishing.given_up.push((at, total));
                None
            }
            Report::Ended { acknowledged, at } => {
                entry.fate = Fate::Ended { at, acknowledged };
                None
            }
            Report::Finished => {
                entry.publishing.is_finished = true;
                None
            }
            Report::Took { publisher, number, at, .. } => {
                let intake = entry.taken.entry(publisher.clone()).or_default();
                let before = intake.take(number, at);
                before.map(|before| format!("sample {number} of {publisher} after {before}"))
            }
            Report::Lost { total } => {
                entry.lost = total;
                None
            }
            Report::Called { servers, at, .. } => {
                entry.calling.calls.push((at, servers));
                None
            }
            Report::Answered { server, number, at } => {
                let intake = entry.calling.answers.entry(server.clone()).or_default();
                let before = intake.take(number, at);
                before.map(|before| format!("answer {number} of {server} after {before}"))
            }
            Report::Served { client, number, at } => {
                let intake = entry.taken.entry(client.clone()).or_default();
                let before = intake.take(number, at);
                before.map(|before| format!("call {number} of {client} after {before}"))
            }
            Report::Broken { what } => {
                self.break_rule(id, what);
                return;
            }
        };
        if let Some(what) = wrong {
            if let Some(topic) = entry.topic() {
                *self.repeated.entry(topic).or_default() += 1;
            }
            self.break_rule(id, format!("{what}: repeated or out of order"));
        }
    }
}

impl Intake {
    /// Returns the last number if this one does not come after it.
    fn take(&mut self, number: u64, at: u64) -> Option<u64> {
        if number <= self.last {
            return Some(self.last);
        }
        if self.count == 0 {
            self.first = number;
        } else if number > self.last + 1 {
            self.gaps.push(Gap { first: self.last + 1, last: number - 1, at });
        }
        self.last = number;
        self.count += 1;
        None
    }

    /// How many numbers between the first and the last did not come.
    pub(super) fn missing(&self) -> u64 {
        self.gaps.iter().map(|gap| gap.last - gap.first + 1).sum()
    }

    pub(super) fn has(&self, number: u64) -> bool {
        let within = |gap: &Gap| (gap.first..=gap.last).contains(&number);
        self.count > 0
            && (self.first..=self.last).contains(&number)
            && !self.gaps.iter().any(within)
    }
}

impl Entry {
    pub(super) fn topic(&self) -> Option<Topic> {
        match self.role {
            Role::Publisher(topic) | Role::Subscriber(topic) => Some(topic),
            Role::Client(_) | Role::Server(_) => None,
        }
    }

    pub(super) fn lives(&self) -> bool {
        self.fate == Fate::Lives
    }

    pub(super) fn name(&self) -> String {
        format!("{:?} of host {} ({})", self.role, self.host + 1, self.gid)
    }

    /// How many samples it has published.
    pub(super) fn published(&self) -> u64 {
        self.publishing.times.len() as u64
    }

    /// The ranges of numbers that were published for this subscriber.
    pub(super) fn published_for(&self, reader: &str) -> Vec<(u64, u64)> {
        let changes = &self.publishing.matched;
        let ends = changes.iter().skip(1).map(|(from, _)| from - 1).chain([self.published()]);
        let ranges = changes.iter().zip(ends).filter(|((_, readers), _)| readers.contains(reader));
        // The last change may be of a sample of which nothing was heard any more.
        ranges.map(|((from, _), to)| (*from, to)).filter(|(from, to)| from <= to).collect()
    }

    /// Whether the publisher ever saw this subscriber.
    pub(super) fn was_matched(&self, reader: &str) -> bool {
        self.publishing.matched.iter().any(|(_, readers)| readers.contains(reader))
    }

    /// How often the publisher saw this subscriber go.
    pub(super) fn unmatched(&self, reader: &str) -> u64 {
        let changes = self.publishing.matched.windows(2);
        let gone = changes.filter(|pair| pair[0].1.contains(reader) && !pair[1].1.contains(reader));
        gone.count() as u64
    }

    /// How many samples the publisher has given up.
    pub(super) fn given_up(&self) -> u64 {
        self.publishing.given_up.last().map_or(0, |(_, total)| *total)
    }
}
