//! The processes of both hosts, and what they report.

use std::{
    collections::HashMap,
    fs::File,
    io::{BufRead as _, BufWriter, Write as _},
    path::Path,
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    thread,
    time::{Duration, Instant},
};

use rand::{Rng, SeedableRng, rngs::StdRng};

use super::{
    ledger::{Fate, Ledger},
    words::{Order, Report, Role, Topic},
};
use crate::{
    Result,
    host::{Host, Running},
    part::{Part, now_ns},
};

/// How long a process that ends may take for it.
const ENDING: Duration = Duration::from_secs(60);

/// What a process said, or `None` where its output ends.
type Line = (usize, Option<Report>);

struct Player {
    host: usize,
    role: Role,
    running: Running,
}

/// All processes.
pub(super) struct Cast<'a> {
    hosts: &'a [Host; 2],
    players: HashMap<usize, Player>,
    /// They were told to end.
    leaving: HashMap<usize, (Running, Instant)>,
    next: usize,
    seeds: StdRng,
    sender: Sender<Line>,
    reports: Receiver<Line>,
    pub(super) ledger: Ledger,
    /// All reports, for people who look for a cause.
    file: BufWriter<File>,
}

impl<'a> Cast<'a> {
    /// Starts one process for each role on each host. `directory` gets a file of all reports.
    pub(super) fn start(hosts: &'a [Host; 2], seed: u64, directory: &Path) -> Result<Self> {
        let (sender, reports) = channel();
        let mut cast = Self {
            hosts,
            players: HashMap::new(),
            leaving: HashMap::new(),
            next: 0,
            seeds: StdRng::seed_from_u64(seed),
            sender,
            reports,
            ledger: Ledger::default(),
            file: BufWriter::new(File::create(directory.join("reports.txt"))?),
        };
        for host in 0..2 {
            for topic in Topic::EACH {
                cast.add(host, Role::Subscriber(topic))?;
                cast.add(host, Role::Publisher(topic))?;
            }
            cast.add(host, Role::Server(host))?;
            cast.add(host, Role::Client(1 - host))?;
        }
        Ok(cast)
    }

    fn add(&mut self, host: usize, role: Role) -> Result<()> {
        let seed = self.seeds.next_u64();
        let mut running = self.hosts[host].start_part(&Part::Torture(role, seed))?;
        let (id, sender) = (self.next, self.sender.clone());
        self.next += 1;
        let output = running.take_output()?;
        thread::spawn(move || {
            for line in output.lines().map_while(|line| line.ok()) {
                // The last line of a killed process may be half of one.
                let Ok(report) = serde_json::from_str(&line) else { break };
                if sender.send((id, Some(report))).is_err() {
                    return;
                }
            }
            let _ = sender.send((id, None));
        });
        writeln!(self.file, "{id} begins at {}: {role:?} of host {}", now_ns(), host + 1)?;
        self.ledger.begin(id, host, role);
        self.players.insert(id, Player { host, role, running });
        Ok(())
    }

    /// Takes in what the processes say, for this long.
    pub(super) fn listen(&mut self, time: Duration) -> Result<()> {
        let end = Instant::now() + time;
        loop {
            match self.reports.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok((id, Some(report))) => {
                    writeln!(self.file, "{id} {}", serde_json::to_string(&report)?)?;
                    self.ledger.note(id, report);
                }
                Ok((id, None)) => self.handle_end(id),
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => return Err("no process is left".into()),
            }
        }
        let slow = self.leaving.iter().find(|(_, (_, since))| since.elapsed() > ENDING);
        if let Some(id) = slow.map(|(id, _)| *id) {
            self.leaving.remove(&id);
            self.ledger.break_rule(id, "does not end".to_owned());
        }
        Ok(())
    }

    fn handle_end(&mut self, id: usize) {
        if self.players.remove(&id).is_some() {
            self.ledger.break_rule(id, "ended by itself".to_owned());
        }
        self.leaving.remove(&id);
    }

    /// The processes that fit, in the order of their start.
    fn find(&self, fits: impl Fn(&Role) -> bool) -> Vec<usize> {
        let fitting = self.players.iter().filter(|(_, player)| fits(&player.role));
        let mut all: Vec<usize> = fitting.map(|(id, _)| *id).collect();
        all.sort_unstable();
        all
    }

    /// Chooses one of the processes that fit.
    pub(super) fn choose(&self, pick: u64, fits: impl Fn(&Role) -> bool) -> Option<usize> {
        let all = self.find(fits);
        let at = pick.checked_rem(all.len() as u64)?;
        all.get(at as usize).copied()
    }

    /// Kills a process, and starts another one in its place.
    pub(super) fn kill(&mut self, id: usize) -> Result<()> {
        let Some(player) = self.players.remove(&id) else { return Ok(()) };
        writeln!(self.file, "{id} is killed at {}", now_ns())?;
        self.ledger.set_fate(id, Fate::Killed { at: now_ns() });
        drop(player.running);
        self.add(player.host, player.role)
    }

    /// Has a publisher end, and starts another one in its place.
    pub(super) fn end(&mut self, id: usize, wait: bool) -> Result<()> {
        let Some(mut player) = self.players.remove(&id) else { return Ok(()) };
        player.running.tell(&Order::End { wait })?;
        self.leaving.insert(id, (player.running, Instant::now()));
        self.add(player.host, player.role)
    }

    /// Notes what happens to the hosts.
    pub(super) fn note(&mut self, what: &str) -> Result<()> {
        Ok(writeln!(self.file, "at {}: {what}", now_ns())?)
    }

    /// Tells all processes that fit.
    pub(super) fn tell(&mut self, order: Order, fits: impl Fn(&Role) -> bool) -> Result<()> {
        for id in self.find(fits) {
            if let Some(player) = self.players.get_mut(&id) {
                player.running.tell(&order)?;
            }
        }
        Ok(())
    }

    /// Whether all processes that were told to end have ended.
    pub(super) fn is_settled(&self) -> bool {
        self.leaving.is_empty()
    }
}
