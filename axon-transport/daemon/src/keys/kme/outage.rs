//! Remembers which calls to the KME fail at present, so that the log reports each outage and its end once.

use std::{
    collections::HashMap,
    time::{Duration, Instant},
};

use crate::keys::request::{FailureKind, KeyPurpose, KmeRequest, RequestFailure};

/// Time between two lines about one call and SAE: a KME that comes and goes is not worth more.
const LOG_INTERVAL: Duration = Duration::from_secs(10);
/// Number of refused `dec_keys` calls in a row before a line is logged. A peer may name keys again that its KME gave
/// away, and KMEs relay keys late.
const REFUSED: u64 = 20;
/// Calls and SAEs that are watched.
const MAX: usize = 512;

/// A line for the log.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Notice {
    Fails(String),
    Works(String),
}

/// The calls that fail, by their name and the other SAE.
pub(super) struct Outages {
    kme: String,
    sae: String,
    watched: HashMap<(&'static str, String), Outage>,
}

#[derive(Default)]
struct Outage {
    /// Failures in a row.
    calls: u64,
    since: Option<Instant>,
    /// The kind and the time of the last log line.
    kind: Option<FailureKind>,
    said: Option<Instant>,
}

impl Outages {
    pub(super) fn new(kme: &str, sae: &str) -> Self {
        Self { kme: kme.to_owned(), sae: sae.to_owned(), watched: HashMap::new() }
    }

    /// Records the end of a call. Returns the line to log, if any.
    pub(super) fn record(
        &mut self,
        now: Instant,
        request: &KmeRequest,
        failure: Option<&RequestFailure>,
    ) -> Option<Notice> {
        let (call, peer) = match request {
            KmeRequest::Enc { slave, .. } => ("enc_keys", slave),
            KmeRequest::Dec { master, .. } => ("dec_keys", master),
            KmeRequest::Status { slave } => ("status", slave),
        };
        let key = (call, peer.clone());
        let Some(failure) = failure else { return self.works(now, &key) };
        let refused = call == "dec_keys" && failure.kind == FailureKind::Refused;
        // A refusal of key names that a stranger invented is no failure of the KME.
        if refused && matches!(request, KmeRequest::Dec { purpose: KeyPurpose::Accept, .. })
            || failure.kind == FailureKind::Busy
            || self.watched.len() >= MAX && !self.watched.contains_key(&key)
        {
            return None;
        }
        let outage = self.watched.entry(key).or_default();
        outage.calls += 1;
        let since = *outage.since.get_or_insert(now);
        let told = outage.kind == Some(failure.kind);
        let early = outage.said.is_some_and(|at| now.saturating_duration_since(at) < LOG_INTERVAL);
        if told || early || refused && outage.calls < REFUSED {
            return None;
        }
        (outage.kind, outage.said) = (Some(failure.kind), Some(now));
        let times = match outage.calls {
            1 => String::new(),
            calls => {
                let time = now.saturating_duration_since(since);
                format!(" ({calls} calls in {:.0} s)", time.as_secs_f64())
            }
        };
        Some(Notice::Fails(format!(
            "KME {}: {call} of SAE {} for SAE {peer} fails{times}: {failure}. {}. Said once until it \
             works again",
            self.kme,
            self.sae,
            advice(failure.kind),
        )))
    }

    fn works(&mut self, now: Instant, key: &(&'static str, String)) -> Option<Notice> {
        let outage = self.watched.get_mut(key)?;
        let (calls, since) = (std::mem::take(&mut outage.calls), outage.since.take());
        let Some(_) = outage.kind.take() else {
            // The failure was never logged, so its end is not logged either.
            if outage.said.is_none() {
                self.watched.remove(key);
            }
            return None;
        };
        let time = now.saturating_duration_since(since.unwrap_or(now));
        Some(Notice::Works(format!(
            "KME {}: {} of SAE {} for SAE {} works again, after {calls} failed calls in {:.1} s",
            self.kme,
            key.0,
            self.sae,
            key.1,
            time.as_secs_f64(),
        )))
    }
}

/// Returns advice on how to fix the failure.
fn advice(kind: FailureKind) -> &'static str {
    match kind {
        FailureKind::Unreachable => {
            "Check that the KME runs, and AXON_KME_URL; TCP and TLS may take AXON_KME_CONNECT_TIMEOUT"
        }
        FailureKind::Unavailable => {
            "It has no keys for these two SAEs, or too much to do: see its key rate and its QKD link"
        }
        FailureKind::Refused => {
            "Check AXON_SAE_ID and the other SAE's ID against what the KME knows; keys that it does \
             not know were fetched before, or the two KMEs are out of step"
        }
        FailureKind::Unauthorized => {
            "Check AXON_SAE_CERT, AXON_SAE_KEY and AXON_KME_CA, the clocks, and that the KME knows \
             this SAE. A KME whose certificate names no host needs AXON_KME_ID and \
             AXON_KME_QUIRKS=no-name-check"
        }
        FailureKind::Ambiguous => {
            "Look at the KME, or set AXON_KME_ANSWER_TIMEOUT higher if it is slow; keys of such a \
             call are given up"
        }
        FailureKind::Repeated => {
            "These keys were used before and are not used again. Have the KME's operator see why, for \
             example whether it was set back to an older state"
        }
        FailureKind::Busy | FailureKind::Invalid => "See docs/configuration.md, qkd",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn enc(slave: &str) -> KmeRequest {
        KmeRequest::Enc { slave: slave.to_owned(), number: 1, purpose: KeyPurpose::Messages }
    }

    fn dec(master: &str, purpose: KeyPurpose) -> KmeRequest {
        KmeRequest::Dec { master: master.to_owned(), key_ids: Vec::new(), purpose }
    }

    fn says(notice: Option<Notice>, parts: &[&str]) {
        let Some(Notice::Fails(text)) = notice else { panic!("{notice:?}") };
        for part in parts {
            assert!(text.contains(part), "{part} in {text}");
        }
    }

    #[test]
    fn a_failure_is_said_once_by_name_and_so_is_its_end() {
        let mut outages = Outages::new("https://kme-a:1", "sae-a");
        let (start, s) = (Instant::now(), Duration::from_secs);
        let gone = RequestFailure::new(FailureKind::Unreachable, "connection refused");
        let all = ["https://kme-a:1", "sae-a", "sae-b", "enc_keys", "refused", "AXON_KME_URL"];
        says(outages.record(start, &enc("sae-b"), Some(&gone)), &all);
        for i in 1..100 {
            assert_eq!(outages.record(start + s(i), &enc("sae-b"), Some(&gone)), None);
        }
        // A success in one direction ends no outage of the other direction, nor of another SAE.
        assert_eq!(outages.record(start, &dec("sae-b", KeyPurpose::Messages), None), None);
        assert_eq!(outages.record(start, &enc("sae-c"), None), None);
        let slow = RequestFailure::new(FailureKind::Ambiguous, "no answer");
        says(
            outages.record(start + s(100), &enc("sae-b"), Some(&slow)),
            &["ANSWER_TIMEOUT", "101"],
        );
        let Some(Notice::Works(text)) = outages.record(start + s(101), &enc("sae-b"), None) else {
            panic!()
        };
        assert!(text.contains("after 101 failed calls"), "{text}");
        assert_eq!(outages.record(start + s(102), &enc("sae-b"), None), None);
    }

    #[test]
    fn a_kme_that_comes_and_goes_is_worth_a_line_in_ten_seconds() {
        let mut outages = Outages::new("kme", "sae-a");
        let start = Instant::now();
        let gone = RequestFailure::new(FailureKind::Unreachable, "refused");
        let mut lines = 0;
        for i in 0..600 {
            let now = start + Duration::from_millis(100 * i);
            lines += usize::from(outages.record(now, &enc("sae-b"), Some(&gone)).is_some());
            lines += usize::from(outages.record(now, &enc("sae-b"), None).is_some());
        }
        assert_eq!(lines, 2 * 6);
    }

    #[test]
    fn refused_names_are_the_kmes_failure_only_in_numbers_and_never_a_strangers() {
        let mut outages = Outages::new("kme", "sae-a");
        let now = Instant::now();
        let unknown = RequestFailure::new(FailureKind::Refused, "KME answered 400");
        for _ in 0..100 {
            let request = dec("sae-b", KeyPurpose::Accept);
            assert_eq!(outages.record(now, &request, Some(&unknown)), None);
        }
        let lines: Vec<_> = (0..100)
            .filter(|_| {
                outages.record(now, &dec("sae-b", KeyPurpose::Messages), Some(&unknown)).is_some()
            })
            .collect();
        assert_eq!(lines, [19]);
        says(outages.record(now, &enc("sae-b"), Some(&unknown)), &["AXON_SAE_ID"]);
        for i in 0..2 * MAX {
            outages.record(now, &enc(&format!("sae-{i}")), Some(&unknown));
        }
        assert!(outages.watched.len() <= MAX);
    }
}
