//! Watches whether the peer of one link answers.

use std::time::Duration;

use super::prober::{Prober, Step, Traffic};
use crate::link::Side;

/// Time without arrivals after which a link is probed, even if nothing was asked: two of QUIC's keep-alives are lost.
const UNHEARD: Duration = Duration::from_secs(10);
/// A superseded link that waits for acknowledgements is silent if its last arrival is this much older than that of the
/// link in use.
const OUTLIVED: Duration = Duration::from_secs(3);
/// Time of silence after which a peer counts as gone. Its link stays until QUIC gives it up.
const GONE: Duration = Duration::from_secs(20);

/// The state of a peer's answers over its link. It is a state machine as described in `docs/architecture.md`.
///
/// A link is *unheard* while nothing arrives, *probed* once something was asked and nothing arrived for a second,
/// *silent* once its path was found cut or a successor was dialled, and its peer is *gone* after a longer time. An
/// acknowledgement ends all of these states.
#[derive(Debug)]
pub(in crate::engine::links) struct LinkSilence {
    side: Side,
    /// The traffic at the last check.
    traffic: Traffic,
    /// The traffic when the last datagram came.
    heard: Traffic,
    /// The time at which the last datagram came.
    heard_at: Duration,
    /// Probes of the path, while the link is silent.
    probing: Option<Probing>,
    /// True if its path was found cut, or a successor was dialled, and nothing was acknowledged since.
    silent: bool,
    /// The traffic when the peer was found gone, while it is.
    gone: Option<Traffic>,
}

/// Probes of the path of a silent link.
#[derive(Debug)]
struct Probing {
    prober: Prober,
    nonce: Nonce,
    /// The time at which the probing began.
    begun: Duration,
    /// The traffic before.
    traffic: Traffic,
    /// True if the cut path was reported.
    said_cut: bool,
}

/// The bytes that a probe carries and its echo repeats.
pub(in crate::engine::links) type Nonce = [u8; 8];

/// The result of checking a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct CheckResult {
    /// True if the peer counts as gone from now on.
    pub(super) gone: bool,
    /// True if the link's path is probed from now on.
    pub(super) probed: bool,
}

/// The action for a link that is probed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ProbeAction {
    /// Send a probe.
    Probe(Nonce),
    /// Send a probe, and report that the path is cut: the previous ones were not answered.
    ProbeCut(Nonce),
    /// The peer answers: no echo of this nonce is expected any more. True if the cut path was reported.
    Answered(Nonce, bool),
    /// Dial a successor.
    Replace,
}

impl LinkSilence {
    pub(in crate::engine::links) fn new(side: Side, now: Duration) -> Self {
        let (traffic, heard) = (Traffic::default(), Traffic::default());
        Self { side, traffic, heard, heard_at: now, probing: None, silent: false, gone: None }
    }

    /// Returns whether the peer counts as gone.
    pub(in crate::engine::links) fn is_gone(&self) -> bool {
        self.gone.is_some()
    }

    /// Returns whether its path was found cut, or a successor dialled, and nothing was acknowledged since.
    pub(in crate::engine::links) fn is_silent(&self) -> bool {
        self.silent
    }

    /// Records the traffic of the link when a datagram came. Later data has no answer yet. QUIC does not always
    /// retransmit it: its probes may only ask for an acknowledgement. Returns whether a peer that was gone is back.
    pub(super) fn handle_heard(&mut self, now: Duration, traffic: Traffic) -> bool {
        if !traffic.has_come_since(self.heard) {
            return false;
        }
        (self.heard, self.heard_at) = (traffic, now);
        // Packets over a path that works in one direction only bring no peer back.
        self.gone.take_if(|gone| traffic.answered_since(*gone)).is_some()
    }

    /// Checks the traffic once a second. Probing begins if something was sent and nothing arrived since the last check;
    /// the probes carry the value of `nonce`.
    pub(super) fn handle_second(
        &mut self,
        now: Duration,
        traffic: Traffic,
        nonce: impl FnOnce() -> Nonce,
    ) -> CheckResult {
        let before = std::mem::replace(&mut self.traffic, traffic);
        // The link is no longer silent: data in flight arrives.
        self.silent &= !traffic.answered_since(before);
        let unheard = now.saturating_sub(self.heard_at);
        let gone = unheard >= GONE && self.gone.is_none();
        if gone {
            self.gone = Some(traffic);
        }
        let silent = traffic.is_silent(before, self.heard) || unheard >= UNHEARD;
        let probed = silent && self.probing.is_none();
        if probed {
            let (prober, nonce) = (Prober::new(self.side), nonce());
            self.probing = Some(Probing { prober, nonce, begun: now, traffic, said_cut: false });
        }
        CheckResult { gone, probed }
    }

    /// Handles the answer to a probe. Returns whether the cut path was reported.
    pub(super) fn handle_echo(&mut self, now: Duration) -> bool {
        let Some(probing) = self.probing.as_mut().filter(|probing| probing.prober.awaits_echo())
        else {
            return false;
        };
        probing.prober.handle_echo(now.saturating_sub(probing.begun));
        std::mem::take(&mut probing.said_cut)
    }

    /// Returns whether the path counts as cut: probes of it are not answered, and nothing was acknowledged since.
    pub(in crate::engine::links) fn is_cut(&self, traffic: Traffic) -> bool {
        let cut = |probing: &Probing| probing.said_cut && !traffic.answered_since(probing.traffic);
        self.probing.as_ref().is_some_and(cut)
    }

    /// Handles that another path takes over, because this one does not answer.
    pub(in crate::engine::links) fn handle_failover(&mut self, traffic: Traffic) {
        (self.silent, self.traffic, self.probing) = (true, traffic, None);
    }

    /// Handles that a successor took over. Returns whether the link is silent.
    pub(in crate::engine::links) fn handle_superseded(&mut self, traffic: Traffic) -> bool {
        self.silent &= !traffic.answered_since(self.traffic);
        self.probing = None;
        self.silent
    }

    /// Returns the time of the last arrival.
    pub(in crate::engine::links) fn heard_at(&self) -> Duration {
        self.heard_at
    }

    /// Checks, once a second, a superseded link with streams that the peer has not acknowledged. `heard_at` is the time
    /// of the last arrival over the link in use. Returns whether this link is silent from now on.
    pub(in crate::engine::links) fn handle_second_superseded(
        &mut self,
        heard_at: Duration,
    ) -> bool {
        let cut = !self.silent && heard_at.saturating_sub(self.heard_at) >= OUTLIVED;
        self.silent |= cut;
        cut
    }

    pub(in crate::engine::links) fn poll_timeout(&self) -> Option<Duration> {
        let probing = self.probing.as_ref()?;
        Some(probing.begun + probing.prober.poll_timeout()?)
    }

    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        traffic: Traffic,
        round_trip: Duration,
    ) -> Option<ProbeAction> {
        let probing = self.probing.as_mut()?;
        if traffic.answered_since(probing.traffic) {
            let answered = ProbeAction::Answered(probing.nonce, probing.said_cut);
            self.probing = None;
            return Some(answered);
        }
        match probing.prober.handle_timeout(now.saturating_sub(probing.begun))? {
            Step::Probe => {
                let cut = probing.prober.find_cut(now.saturating_sub(probing.begun), round_trip);
                probing.said_cut |= cut;
                self.silent |= cut;
                let action = if cut { ProbeAction::ProbeCut } else { ProbeAction::Probe };
                Some(action(probing.nonce))
            }
            Step::Replace => {
                self.silent = true;
                Some(ProbeAction::Replace)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Duration = Duration::from_secs(1000);
    const ROUND_TRIP: Duration = Duration::from_millis(30);
    const NONCE: Nonce = [7; 8];

    fn second(number: u64) -> Duration {
        START + Duration::from_secs(number)
    }

    /// Returns the traffic with these counts of arrivals, acknowledgements and requests.
    fn traffic(came: u64, acknowledged: u64, asked: u64) -> Traffic {
        Traffic::of(came, acknowledged, asked)
    }

    #[test]
    fn a_link_that_is_asked_nothing_is_not_silent() {
        let mut silence = LinkSilence::new(Side::Client, START);
        assert!(!silence.handle_heard(START, traffic(1, 1, 1)));
        for number in 1..10 {
            assert_eq!(
                silence.handle_second(second(number), traffic(1, 1, 1), || NONCE),
                CheckResult::default()
            );
        }
        assert_eq!(silence.poll_timeout(), None);
        let look = silence.handle_second(second(10), traffic(1, 1, 1), || NONCE);
        assert_eq!(look, CheckResult { gone: false, probed: true }, "keep-alives are lost");
    }

    #[test]
    fn a_question_without_an_answer_is_probed_and_an_echo_brings_a_successor() {
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_heard(START, traffic(1, 1, 1));
        silence.handle_second(second(1), traffic(1, 1, 1), || NONCE);
        let look = silence.handle_second(second(2), traffic(1, 1, 2), || NONCE);
        assert_eq!(look, CheckResult { gone: false, probed: true });
        assert_eq!(
            silence.handle_second(second(3), traffic(1, 1, 2), || [9; 8]),
            CheckResult::default()
        );
        let asked = traffic(1, 1, 2);
        assert_eq!(
            silence.handle_timeout(second(3), asked, ROUND_TRIP),
            Some(ProbeAction::Probe(NONCE))
        );
        silence.handle_echo(second(3));
        let due = silence.poll_timeout().unwrap();
        assert_eq!(silence.handle_timeout(due, asked, ROUND_TRIP), Some(ProbeAction::Replace));
        assert!(silence.is_silent());
        // An acknowledgement ends the silence.
        let answered = traffic(2, 2, 2);
        assert_eq!(
            silence.handle_timeout(due, answered, ROUND_TRIP),
            Some(ProbeAction::Answered(NONCE, false))
        );
        assert_eq!(
            (silence.poll_timeout(), silence.handle_timeout(due, answered, ROUND_TRIP)),
            (None, None)
        );
        silence.handle_second(second(5), answered, || NONCE);
        assert!(!silence.is_silent());
    }

    #[test]
    fn unanswered_probes_report_the_path_as_cut_and_answers_restore_it() {
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_second(second(1), traffic(0, 0, 1), || NONCE);
        let asked = traffic(0, 0, 1);
        let probe = |silence: &mut LinkSilence| {
            let due = silence.poll_timeout().unwrap();
            (due, silence.handle_timeout(due, asked, ROUND_TRIP).unwrap())
        };
        for answered in [false, true] {
            let found: Vec<_> = (0..20).map(|_| probe(&mut silence).1).collect();
            // The fourth probe is sent when three are unanswered. The cut is reported again after a while.
            let said = |action: &ProbeAction| *action == ProbeAction::ProbeCut(NONCE);
            let said: Vec<_> = (0..).zip(&found).filter(|(_, a)| said(a)).map(|(n, _)| n).collect();
            assert_eq!(said, [3, 19]);
            assert!(silence.is_cut(asked) && !silence.is_cut(traffic(1, 1, 1)));
            if answered {
                let due = silence.poll_timeout().unwrap();
                let more = traffic(1, 1, 1);
                assert_eq!(
                    silence.handle_timeout(due, more, ROUND_TRIP),
                    Some(ProbeAction::Answered(NONCE, true))
                );
            } else {
                let due = silence.poll_timeout().unwrap();
                assert!(silence.handle_echo(due), "it was said");
                assert!(!silence.handle_echo(due), "once");
                let (_, action) = probe(&mut silence);
                assert_eq!(action, ProbeAction::Replace);
            }
            assert!(!silence.is_cut(asked));
        }
    }

    #[test]
    fn a_path_is_not_cut_while_an_echo_may_be_on_its_way() {
        let slow = Duration::from_millis(900);
        let cut = slow * 2;
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_second(second(1), traffic(0, 0, 1), || NONCE);
        let begin = silence.poll_timeout().unwrap();
        loop {
            let due = silence.poll_timeout().unwrap();
            let action = silence.handle_timeout(due, traffic(0, 0, 1), slow).unwrap();
            if due >= begin + cut {
                assert_eq!(action, ProbeAction::ProbeCut(NONCE), "at once");
                break;
            }
            assert_eq!(action, ProbeAction::Probe(NONCE));
            assert!(!silence.is_cut(traffic(0, 0, 1)));
        }
    }

    #[test]
    fn an_echo_of_no_probe_changes_nothing() {
        let mut silence = LinkSilence::new(Side::Server, START);
        assert!(!silence.handle_echo(START));
        silence.handle_second(second(1), traffic(0, 0, 1), || NONCE);
        let due = silence.poll_timeout();
        silence.handle_echo(second(1));
        assert_eq!(silence.poll_timeout(), due);
    }

    #[test]
    fn a_peer_is_gone_after_a_time_and_back_with_an_acknowledgement() {
        let mut silence = LinkSilence::new(Side::Client, START);
        let before = (1..20).map(|n| silence.handle_second(second(n), traffic(0, 0, 1), || NONCE));
        assert!(before.collect::<Vec<_>>().iter().all(|look| !look.gone));
        assert!(silence.handle_second(second(20), traffic(0, 0, 1), || NONCE).gone);
        assert!(!silence.handle_second(second(21), traffic(0, 0, 1), || NONCE).gone, "once");
        assert!(!silence.handle_heard(second(22), traffic(1, 0, 1)), "the path works one way");
        assert!(silence.is_gone());
        assert!(silence.handle_heard(second(23), traffic(2, 1, 1)));
        assert!(!silence.is_gone());
    }

    #[test]
    fn a_superseded_link_is_silent_once_its_successor_is_heard_and_it_is_not() {
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_heard(START, traffic(1, 1, 1));
        assert!(!silence.handle_superseded(traffic(1, 1, 1)));
        // The path may be cut for both.
        assert!(!silence.handle_second_superseded(second(2)));
        assert!(!silence.is_silent());
        silence.handle_heard(second(4), traffic(2, 2, 2));
        assert!(!silence.handle_second_superseded(second(6)));
        assert!(silence.handle_second_superseded(second(7)));
        assert!(!silence.handle_second_superseded(second(8)), "once");
        assert!(silence.is_silent());
    }

    #[test]
    fn path_that_another_one_replaces_is_silent_though_it_answered_in_this_second() {
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_second(second(1), traffic(1, 1, 1), || NONCE);
        let now = traffic(5, 5, 9);
        silence.handle_heard(second(1), now);
        silence.handle_failover(now);
        assert!(silence.handle_superseded(now));
        silence.handle_failover(now);
        assert!(!silence.handle_superseded(traffic(6, 6, 9)), "it answers after all");
    }

    #[test]
    fn a_superseded_link_is_probed_no_more() {
        let mut silence = LinkSilence::new(Side::Client, START);
        silence.handle_second(second(1), traffic(0, 0, 1), || NONCE);
        silence.handle_timeout(second(1), traffic(0, 0, 1), ROUND_TRIP);
        silence.handle_echo(second(1));
        let due = silence.poll_timeout().unwrap();
        assert_eq!(
            silence.handle_timeout(due, traffic(0, 0, 1), ROUND_TRIP),
            Some(ProbeAction::Replace)
        );
        assert!(silence.handle_superseded(traffic(0, 0, 1)));
        assert_eq!(silence.poll_timeout(), None);
        assert!(!silence.handle_superseded(traffic(1, 1, 1)), "it answers after all");
    }
}
