//! A record of one run: a hash over all its events, and the last events as text.

use std::{
    collections::{VecDeque, hash_map::DefaultHasher},
    fmt,
    hash::{Hash, Hasher},
    time::Duration,
};

/// Hash over all events of a run and a ring of the last ones.
///
/// An event is numbers and a fixed word, so recording it neither allocates nor formats. Two runs of one
/// program with one seed have the same hash. The hash is for one build: another Rust release may hash
/// differently.
pub(crate) struct Trace {
    hasher: DefaultHasher,
    events: u64,
    last: VecDeque<Line>,
    capacity: usize,
}

enum Line {
    Event { at: Duration, host: usize, what: &'static str, values: [u64; 3] },
    Text { at: Duration, text: String },
}

impl Trace {
    /// Creates a trace that keeps the last `capacity` events as text.
    pub(crate) fn new(capacity: usize) -> Self {
        Self {
            hasher: DefaultHasher::new(),
            events: 0,
            last: VecDeque::with_capacity(capacity),
            capacity,
        }
    }

    /// Records an event at a host. `values` distinguish it: lengths, numbers, peers. Leave out bytes that differ from
    /// run to run, such as TLS randoms.
    pub(crate) fn event(
        &mut self,
        at: Duration,
        host: usize,
        what: &'static str,
        values: [u64; 3],
    ) {
        (at, host, what, values).hash(&mut self.hasher);
        self.push(Line::Event { at, host, what, values });
    }

    /// Records a rare event as text: a fault, a restart, a failed check.
    pub(crate) fn text(&mut self, at: Duration, text: String) {
        (at, &*text).hash(&mut self.hasher);
        self.push(Line::Text { at, text });
    }

    fn push(&mut self, line: Line) {
        self.events += 1;
        if self.capacity == 0 {
            return;
        }
        if self.last.len() == self.capacity {
            self.last.pop_front();
        }
        self.last.push_back(line);
    }

    /// Returns the hash over all events so far.
    pub(crate) fn hash(&self) -> u64 {
        self.hasher.finish()
    }

    /// Returns the number of recorded events, including those that have left the ring.
    pub(crate) fn events(&self) -> u64 {
        self.events
    }
}

/// Prints the last events, one a line, below a line with the hash and the number of events that came before.
impl fmt::Display for Trace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let left = self.events - self.last.len() as u64;
        writeln!(
            f,
            "trace {:016x}: {} events, the first {left} left out",
            self.hash(),
            self.events
        )?;
        for line in &self.last {
            let at = match line {
                Line::Event { at, .. } | Line::Text { at, .. } => at,
            };
            write!(f, "{:>4}.{:09} ", at.as_secs(), at.subsec_nanos())?;
            match line {
                Line::Event { host, what, values: [a, b, c], .. } => {
                    writeln!(f, "host {host} {what} {a} {b} {c}")?;
                }
                Line::Text { text, .. } => writeln!(f, "{text}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn trace(events: &[(u64, usize, &'static str, [u64; 3])], capacity: usize) -> Trace {
        let mut trace = Trace::new(capacity);
        for (ms, host, what, values) in events {
            trace.event(at(*ms), *host, what, *values);
        }
        trace
    }

    #[test]
    fn hash_tells_each_field_and_the_order_apart() {
        let events = [(1, 0, "send", [1, 2, 3]), (1, 1, "receive", [1, 2, 3])];
        let hash = trace(&events, 4).hash();
        assert_eq!(trace(&events, 0).hash(), hash, "the ring's size does not matter");
        let [a, b] = events;
        let others = [
            vec![],
            vec![a],
            vec![b, a],
            vec![a, a],
            vec![(2, 0, "send", [1, 2, 3]), b],
            vec![(1, 2, "send", [1, 2, 3]), b],
            vec![(1, 0, "drop", [1, 2, 3]), b],
            vec![(1, 0, "send", [2, 1, 3]), b],
        ];
        for other in others {
            assert_ne!(trace(&other, 4).hash(), hash, "{other:?}");
        }
        let mut text = trace(&events, 4);
        text.text(at(2), "kill host 1".to_owned());
        assert_ne!(text.hash(), hash);
        assert_eq!(text.events(), 3);
    }

    #[test]
    fn ring_keeps_the_last_lines() {
        let mut trace = Trace::new(2);
        for n in 0..1_000 {
            trace.event(at(1_000 + n), 3, "send", [n, 1200, 0]);
        }
        trace.text(at(62_000), "kill host 1".to_owned());
        let text = trace.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with("1001 events, the first 999 left out"), "{text}");
        assert_eq!(
            lines[1..],
            ["   1.999000000 host 3 send 999 1200 0", "  62.000000000 kill host 1"]
        );
    }

    #[test]
    fn ring_without_room_keeps_nothing() {
        let trace = trace(&[(1, 0, "send", [0; 3])], 0);
        assert_eq!((trace.events(), trace.to_string().lines().count()), (1, 1));
    }
}
