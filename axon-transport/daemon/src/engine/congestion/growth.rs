//! Decides whether a larger window brings more bytes through, where packets are lost.
//!
//! A radio loses packets at any size of the window. A short queue drops packets that exceed it, before any delay can be
//! seen. Trials distinguish the two: growth must bring more bytes through, and a smaller window must lose less.

use std::time::Duration;

/// Factor by which the window grows in a trial.
pub(super) const TRIAL: f64 = 1.25;
/// Number of packets that must arrive in a trial with this growth, and in one without.
const PACKETS: (u64, u64) = (40, 200);
/// Excess of the loss over random loss above which growth must prove that it pays, and the excess from which the window
/// shrinks in any case.
const EXCESS: (f64, f64) = (0.02, 0.1);
/// The part of its growth that the window must bring in bytes.
const PAYS: f64 = 0.3;
/// Weight of a new round in the averages of losses, and the maximum dispersion of losses.
const AVERAGED: f64 = 1.0 / 16.0;
const MOST_DISPERSED: f64 = 8.0;
/// Rounds to wait before growth is tried again where it did not pay, at first and at most.
const RETRY_ROUNDS: (u32, u32) = (4, 64);

/// Some rounds over which the window may have grown.
#[derive(Debug, Clone)]
struct Trial {
    /// The window at the start.
    window: u64,
    acknowledged: u64,
    lost: u64,
    time: Duration,
    /// Bytes a second of the trial before this one.
    before: Option<f64>,
}

impl Trial {
    fn new(window: u64, before: Option<f64>) -> Self {
        Self { window, acknowledged: 0, lost: 0, time: Duration::ZERO, before }
    }
}

/// The judge of growth.
#[derive(Debug, Clone)]
pub(super) struct Growth {
    trial: Trial,
    /// The share of packets that is lost at any size of the window.
    random_loss: f64,
    /// The average share of lost packets.
    mean_loss: f64,
    /// The dispersion of the rounds' losses: their variance divided by the variance of independent losses. A radio
    /// loses packets in bursts; a trial then has the evidence of one with this factor fewer packets.
    dispersion: f64,
    /// The share of lost packets before the window was cut because of it.
    cut: Option<f64>,
    /// Rounds to wait before growth is tried again, and the remaining ones.
    patience: u32,
    waiting: u32,
}

impl Growth {
    pub(super) fn new(window: u64) -> Self {
        let trial = Trial::new(window, None);
        Self {
            trial,
            random_loss: 0.0,
            mean_loss: 0.0,
            dispersion: 1.0,
            cut: None,
            patience: 0,
            waiting: 0,
        }
    }

    /// Returns the share of packets that is lost by chance.
    #[cfg(test)]
    pub(super) fn random_loss(&self) -> f64 {
        self.random_loss
    }

    /// Returns whether the window grows only step by step, because growth did not pay.
    pub(super) fn is_careful(&self) -> bool {
        self.patience > 0
    }

    /// Takes the losses of a round in which growth paid.
    pub(super) fn add_random_loss(&mut self, lost: f64) {
        self.random_loss += (lost - self.random_loss) / 2.0;
    }

    /// Returns whether this loss exceeds random loss.
    pub(super) fn is_excessive(&self, lost: f64) -> bool {
        lost > self.random_loss + EXCESS.0
    }

    /// Adds a round.
    pub(super) fn add(&mut self, acknowledged: u64, lost: u64, time: Duration, mtu: u64) {
        self.trial.acknowledged += acknowledged;
        self.trial.lost += lost;
        self.trial.time += time;
        let (packets, lost) = ((acknowledged + lost) as f64 / mtu as f64, lost as f64 / mtu as f64);
        if packets < 1.0 {
            return;
        }
        let by_chance = packets * self.mean_loss * (1.0 - self.mean_loss);
        if by_chance > 0.5 {
            let dispersion = (lost - packets * self.mean_loss).powi(2) / by_chance;
            self.dispersion += (dispersion.min(4.0 * MOST_DISPERSED) - self.dispersion) * AVERAGED;
        }
        self.mean_loss += (lost / packets - self.mean_loss) * AVERAGED;
    }

    /// Begins a trial, after the window changed for another reason.
    pub(super) fn restart(&mut self, window: u64) {
        self.trial = Trial::new(window, None);
    }

    /// Returns whether the window stays for this round.
    pub(super) fn waits(&mut self, window: u64) -> bool {
        if self.waiting == 0 {
            return false;
        }
        self.waiting -= 1;
        self.trial = Trial::new(window, self.trial.before);
        true
    }

    /// Returns the window that brings this rate through, if packets are lost only by chance.
    pub(super) fn held(&self, rate: f64, rtt: Duration) -> u64 {
        (0.95 * rate * rtt.as_secs_f64() / (1.0 - self.random_loss).max(0.1)) as u64
    }

    /// Judges a trial that is over. Returns a smaller window, of `least` bytes or more, if that would lose fewer packets.
    pub(super) fn judge(
        &mut self,
        window: u64,
        mtu: u64,
        least: u64,
        rtt: Duration,
    ) -> Option<u64> {
        let trial = &self.trial;
        let has_grown = window as f64 >= trial.window as f64 * TRIAL;
        if trial.acknowledged < mtu * if has_grown { PACKETS.0 } else { PACKETS.1 } {
            return None;
        }
        let dispersion = self.dispersion.clamp(1.0, MOST_DISPERSED);
        let bytes = (trial.lost + trial.acknowledged) as f64;
        let lost = trial.lost as f64 / bytes;
        let rate = trial.acknowledged as f64 / trial.time.as_secs_f64().max(1e-6);
        let pays = trial.before.map(|before| rate > before * (1.0 + (TRIAL - 1.0) * PAYS));
        if let Some(before) = self.cut.take()
            && lost > before * 0.7
        {
            // The smaller window lost as much.
            self.random_loss = self.random_loss.max(lost.min(before));
        }
        if lost < self.random_loss {
            self.random_loss = (self.random_loss + lost) / 2.0;
        } else if has_grown && pays == Some(true) {
            self.random_loss += (lost - self.random_loss) / 4.0;
        }
        // Two standard deviations of the random loss of this many packets.
        let share = self.random_loss;
        let by_chance = 2.0 * (share * (1.0 - share) * dispersion * mtu as f64 / bytes).sqrt();
        let excess = lost - share - by_chance;
        let is_futile = has_grown && pays == Some(false) && excess > EXCESS.0;
        if !is_futile && excess < EXCESS.1 {
            if has_grown {
                self.patience = 0;
            }
            self.trial = Trial::new(window, Some(rate));
            return None;
        }
        let smaller = self.held(rate, rtt).clamp(window / 2, window / 10 * 9).max(least);
        self.cut = Some(lost);
        self.trial = Trial::new(smaller, is_futile.then_some(rate));
        if is_futile {
            self.patience = (self.patience * 2).clamp(RETRY_ROUNDS.0, RETRY_ROUNDS.1);
            self.waiting = self.patience;
        }
        Some(smaller)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MTU: u64 = 1_400;
    const RTT: Duration = Duration::from_millis(10);

    /// Runs rounds over a path that holds `most` bytes and loses `random` of the packets by chance. The window grows
    /// by an eighth a round. Returns the window after so many rounds.
    fn rounds(growth: &mut Growth, mut window: u64, most: u64, random: f64, rounds: u32) -> u64 {
        for _ in 0..rounds {
            let through = (window.min(most) as f64 * (1.0 - random)) as u64;
            growth.add(through, window - through, RTT, MTU);
            if let Some(smaller) = growth.judge(window, MTU, 3 * MTU, RTT) {
                assert!(smaller < window);
                window = smaller;
            } else if !growth.waits(window) {
                window += window / 8;
            }
        }
        window
    }

    #[test]
    fn losses_by_chance_do_not_end_growth() {
        for random in [0.0, 0.1, 0.4] {
            let mut growth = Growth::new(20 * MTU);
            let window = rounds(&mut growth, 20 * MTU, u64::MAX, random, 60);
            assert!(window > 1_000 * MTU, "{random}: {window}");
        }
    }

    #[test]
    fn a_queue_that_overflows_ends_growth() {
        let most = 200 * MTU;
        let mut growth = Growth::new(20 * MTU);
        let mut window = 20 * MTU;
        let mut largest = 0;
        for round in 0..1_000 {
            window = rounds(&mut growth, window, most, 0.0, 1);
            largest = largest.max(if round > 100 { window } else { 0 });
        }
        assert!(largest < most * 2, "{largest}");
        assert!(window > most / 2, "{window}");
        assert!(growth.random_loss() < 0.1, "{}", growth.random_loss());
    }

    #[test]
    fn a_path_that_begins_to_lose_by_chance_is_not_taken_for_a_queue() {
        let mut growth = Growth::new(20 * MTU);
        let window = rounds(&mut growth, 20 * MTU, u64::MAX, 0.0, 30);
        let after = rounds(&mut growth, window, u64::MAX, 0.3, 60);
        assert!(after > window, "{after} of {window}");
    }
}
