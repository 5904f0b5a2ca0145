//! What happens to the hosts: which fault, and when, follows from the seed.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use rand::{Rng, RngExt, SeedableRng, rngs::StdRng};

use super::{
    cast::Cast,
    record::{DaemonKill, Record},
    words::Role,
};
use crate::{
    Result,
    part::now_ns,
    path::{Loss, Settings},
    place::Place,
};

/// The longest time from fault to fault, in milliseconds.
const PAUSE_MS: u64 = 3_000;
/// Before and after a daemon is killed on a path that is left alone.
const CALM_BEFORE: Duration = Duration::from_secs(2);
const CALM_AFTER: Duration = Duration::from_secs(14);
/// The longest cut, as a power of ten of seconds, and the shortest.
const CUT: (f64, f64) = (-0.7, 1.477);

#[derive(Clone, Copy, Debug)]
enum Fault {
    Path(Settings),
    Cut(Duration),
    /// On these hosts, while the path is left alone, or not.
    KillDaemons {
        hosts: [bool; 2],
        calm: bool,
    },
    KillPublisher(u64),
    EndPublisher {
        pick: u64,
        wait: bool,
    },
    KillSubscriber(u64),
    KillClient(u64),
    KillServer(u64),
}

/// The faults to come.
pub(super) struct Faults {
    random: StdRng,
    /// The path without faults.
    whole: Settings,
    next: Instant,
    cut_until: Option<Instant>,
    /// The path is left alone until then, and daemons are not killed.
    calm_until: Instant,
    /// Daemons that are to be killed.
    kill_at: Option<(Instant, [bool; 2])>,
    /// How often each happened.
    pub(super) counts: BTreeMap<&'static str, u64>,
    pub(super) record: Record,
}

impl Faults {
    pub(super) fn new(seed: u64, whole: Settings) -> Self {
        let now = Instant::now();
        Self {
            random: StdRng::seed_from_u64(seed ^ 0xfa17),
            whole,
            next: now,
            cut_until: None,
            calm_until: now,
            kill_at: None,
            counts: BTreeMap::new(),
            record: Record::default(),
        }
    }

    /// Applies the faults whose time has come.
    pub(super) fn handle_time(&mut self, place: &Place, cast: &mut Cast<'_>) -> Result<()> {
        let now = Instant::now();
        if self.cut_until.take_if(|until| *until <= now).is_some() {
            self.change_path(place, |path| path.is_cut = false);
        }
        if let Some((_, hosts)) = self.kill_at.take_if(|(at, _)| *at <= now) {
            cast.note("the daemons are killed")?;
            self.kill_daemons(place, hosts, true);
        }
        if now < self.next {
            return Ok(());
        }
        self.next = now + Duration::from_millis(self.random.random_range(100..PAUSE_MS));
        let fault = self.draw();
        cast.note(&format!("{fault:?}"))?;
        self.apply(fault, place, cast)
    }

    /// Ends all faults of the path.
    pub(super) fn end(&mut self, place: &Place) {
        self.cut_until = None;
        let whole = self.whole;
        self.change_path(place, |path| *path = whole);
    }

    fn draw(&mut self) -> Fault {
        let pick = self.random.next_u64();
        match self.random.random_range(0..100) {
            ..30 => Fault::Path(self.draw_path()),
            30..42 => {
                let seconds = 10_f64.powf(self.random.random_range(CUT.0..CUT.1));
                Fault::Cut(Duration::from_secs_f64(seconds))
            }
            42..58 => {
                let hosts = [[true, false], [false, true], [true, true]];
                let hosts = hosts[(pick % 5 % 3) as usize];
                Fault::KillDaemons { hosts, calm: self.random.random_bool(0.6) }
            }
            58..68 => Fault::KillPublisher(pick),
            68..82 => Fault::EndPublisher { pick, wait: self.random.random_bool(0.5) },
            82..92 => Fault::KillSubscriber(pick),
            92..96 => Fault::KillClient(pick),
            _ => Fault::KillServer(pick),
        }
    }

    /// A path as good as in the beginning, in three of eight cases without losses.
    fn draw_path(&mut self) -> Settings {
        let random = &mut self.random;
        let share = [0.0, random.random_range(0.0..0.4)][usize::from(random.random_bool(0.6))];
        let burst = [1.0, 8.0][usize::from(random.random_bool(0.3))];
        let rate = 10_f64.powf(random.random_range(0.3..(self.whole.rate / 1e6).log10()));
        let round_trip = 10_f64.powf(random.random_range(0.0..2.3));
        Settings {
            rate: rate * 1e6,
            delay: Duration::from_secs_f64(round_trip / 2e3),
            loss: Loss { share, burst },
            ..self.whole
        }
    }

    fn apply(&mut self, fault: Fault, place: &Place, cast: &mut Cast<'_>) -> Result<()> {
        let is_calm = Instant::now() < self.calm_until;
        let publisher = |role: &Role| matches!(role, Role::Publisher(_));
        match fault {
            Fault::Path(_) | Fault::Cut(_) | Fault::KillDaemons { .. } if is_calm => {}
            Fault::Path(settings) => {
                self.count("paths");
                self.change_path(place, |path| {
                    *path = Settings { is_cut: path.is_cut, ..settings }
                });
            }
            Fault::Cut(time) => {
                self.count("cuts");
                self.cut_until = Some(Instant::now() + time);
                self.change_path(place, |path| path.is_cut = true);
            }
            Fault::KillDaemons { hosts, calm: true } => {
                self.end(place);
                self.kill_at = Some((Instant::now() + CALM_BEFORE, hosts));
                self.calm_until = Instant::now() + CALM_BEFORE + CALM_AFTER;
            }
            Fault::KillDaemons { hosts, calm: false } => self.kill_daemons(place, hosts, false),
            Fault::KillPublisher(pick) => {
                if let Some(id) = cast.choose(pick, publisher) {
                    self.count("publishers killed");
                    cast.kill(id)?;
                }
            }
            Fault::EndPublisher { pick, wait } => {
                if let Some(id) = cast.choose(pick, publisher) {
                    self.count("publishers ended");
                    cast.end(id, wait)?;
                }
            }
            Fault::KillSubscriber(pick) => {
                if let Some(id) = cast.choose(pick, |role| matches!(role, Role::Subscriber(_))) {
                    self.count("subscribers killed");
                    cast.kill(id)?;
                }
            }
            Fault::KillClient(pick) => {
                if let Some(id) = cast.choose(pick, |role| matches!(role, Role::Client(_))) {
                    self.count("clients killed");
                    cast.kill(id)?;
                }
            }
            Fault::KillServer(pick) => {
                if let Some(id) = cast.choose(pick, |role| matches!(role, Role::Server(_))) {
                    self.count("servers killed");
                    cast.kill(id)?;
                }
            }
        }
        Ok(())
    }

    fn kill_daemons(&mut self, place: &Place, hosts: [bool; 2], calm: bool) {
        let pids = [0, 1].map(|host| hosts[host].then(|| place.hosts[host].daemon()).flatten());
        for (host, pid) in pids.into_iter().enumerate() {
            if pid.is_some_and(crate::host::kill) {
                self.count("daemons killed");
                self.record.kills.push(DaemonKill { host, at: now_ns(), calm });
            }
        }
        if pids.iter().all(Option::is_some) {
            self.count("both at once");
        }
    }

    fn change_path(&mut self, place: &Place, change: impl Fn(&mut Settings)) {
        place.relay().set(&change);
        self.record.paths.push((now_ns(), place.relay().settings()));
    }

    fn count(&mut self, what: &'static str) {
        *self.counts.entry(what).or_default() += 1;
    }
}
