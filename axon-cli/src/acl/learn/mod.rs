//! `axon acl learn`: watches what other hosts and users do here, and writes the rules that let them go on.

mod seen;

use std::{
    collections::HashMap,
    fs,
    io::{self, IsTerminal as _, Write as _},
    path::{Path, PathBuf},
    process::ExitCode,
    time::{Duration, Instant},
};

use axon_transport::{
    GuardCondition, Session, SessionOptions,
    config::DaemonPolicy,
    graph::GraphView,
    ids::DaemonId,
    internal::graph::verb_of,
    status::{LinkStatus, Status},
};

use self::seen::{Observed, Owner, Seen};
use super::cli;
use crate::{failure::CliError, interrupt, logging, say::say, session};

/// Between two looks while nothing changes.
const LOOK: Duration = Duration::from_millis(100);
/// How long changes of the graph are collected.
const MOMENT: Duration = Duration::from_millis(10);
/// Between two looks at the daemon's status, if there is no new host.
const STATUS: Duration = Duration::from_secs(2);
/// Between two lines of progress on a terminal.
const PROGRESS: Duration = Duration::from_secs(1);

/// Runs `axon acl learn`.
pub(super) fn run(args: &cli::Learn) -> Result<ExitCode, CliError> {
    if let Some(file) = &args.output
        && !args.force
        && file.symlink_metadata().is_ok()
    {
        return Err(exists(file));
    }
    let mut config = logging::configure()?;
    // What it would start has nothing to show.
    config.daemon = DaemonPolicy::Require;
    let session =
        Session::open(&config, SessionOptions::new("axon acl learn")).map_err(session::failure)?;
    let interrupt = interrupt::of(&session)?;
    let mut watch = Watch { session, interrupt, known: Known::default(), seen: Seen::default() };
    let until = match args.watch {
        Some(time) => format!("for {} s; Ctrl-C ends it earlier", time.as_secs_f64()),
        None => "until Ctrl-C".to_owned(),
    };
    say(format_args!("axon acl learn: watching other hosts and users {until}"));
    watch.run(args.watch);
    let (parties, uses) = watch.seen.counts();
    say(format_args!("axon acl learn: saw {uses} uses of {parties} hosts and users"));
    if watch.known.unnamed > 0 {
        say(format_args!(
            "axon acl learn: {} hosts left before their names were known: nothing of them is in the rules",
            watch.known.unnamed
        ));
    }
    if watch.session.daemon().is_none() {
        say("axon acl learn: the daemon has ended: what came later was not seen");
    }
    if watch.seen.is_empty() {
        return Err(CliError::failed(
            "no other host or user did anything with a topic or service of this host: no rules were written",
        ));
    }
    let rules = watch.seen.rules(args.see).map_err(CliError::failed)?;
    match &args.output {
        Some(file) => write(file, &rules, args.force)?,
        None => match io::stdout().lock().write_all(rules.as_bytes()) {
            // The reader of the pipe closed it: it wants no more lines.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => {}
            written => written?,
        },
    }
    Ok(ExitCode::SUCCESS)
}

fn exists(file: &Path) -> CliError {
    CliError::failed(format!("{}: it exists; --force replaces it", file.display()))
}

/// Writes a file at once: a daemon that reads it finds the rules of before, or these.
fn write(file: &Path, rules: &str, force: bool) -> Result<(), CliError> {
    let failed = |error: io::Error| CliError::failed(format!("{}: {error}", file.display()));
    let mut name = file.as_os_str().to_owned();
    name.push(format!(".{}.tmp", std::process::id()));
    let part = PathBuf::from(name);
    let mut new =
        fs::OpenOptions::new().write(true).create_new(true).open(&part).map_err(failed)?;
    let placed = new.write_all(rules.as_bytes()).and_then(|()| {
        // A link takes no name that somebody has taken meanwhile.
        if force { fs::rename(&part, file) } else { fs::hard_link(&part, file) }
    });
    let _ = fs::remove_file(&part);
    match placed {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Err(exists(file)),
        placed => placed.map_err(failed),
    }
}

struct Watch {
    session: Session,
    interrupt: GuardCondition,
    known: Known,
    seen: Seen,
}

/// What the daemon says of whose endpoints are.
#[derive(Default)]
struct Known {
    /// The names of other hosts, by their daemons. They stay known when a link ends.
    hosts: HashMap<DaemonId, Option<String>>,
    /// The other users of this host, by what begins the GIDs of their sessions.
    users: HashMap<String, u32>,
    asked: Option<Instant>,
    /// Hosts that had endpoints and whose names were never known.
    unnamed: usize,
}

impl Watch {
    /// Watches for a time, or until a signal.
    fn run(&mut self, time: Option<Duration>) {
        let begin = Instant::now();
        let (mut version, mut progress) = (None, begin);
        let is_terminal = io::stderr().is_terminal();
        while !self.interrupt.is_triggered() {
            let elapsed = begin.elapsed();
            let left = time.map_or(LOOK, |time| time.saturating_sub(elapsed));
            if self.ask() {
                version = None;
            }
            let graph = self.session.graph();
            let is_new = version != Some(graph.version);
            let has_strangers = graph
                .endpoints
                .values()
                .any(|entry| entry.daemon.is_some_and(|daemon| self.known.is_unnamed(&daemon)));
            // After a host's name is known its endpoints are looked at again.
            if is_new || has_strangers || self.known.asked.is_none() {
                version = (!has_strangers).then_some(graph.version);
                self.look(&graph);
            }
            if left.is_zero() {
                break;
            }
            if is_terminal && progress.elapsed() >= PROGRESS {
                progress = Instant::now();
                let (parties, uses) = self.seen.counts();
                let seconds = elapsed.as_secs();
                let _ = write!(
                    io::stderr().lock(),
                    "\r{seconds} s: {uses} uses of {parties} hosts and users\x1b[K\r"
                );
            }
            // Changes of a moment are looked at together.
            std::thread::sleep(MOMENT.min(left));
            self.session.wait_graph(LOOK.min(left), |graph| version != Some(graph.version));
        }
        if is_terminal {
            let _ = write!(io::stderr().lock(), "\r\x1b[K");
        }
        let strangers = self.known.hosts.values().filter(|name| name.is_none());
        self.known.unnamed = strangers.count();
    }

    /// Asks the daemon for its status, if it is time, or if there is a host of which nothing is known. Returns whether a host
    /// or user became known: its endpoints are to be looked at again.
    fn ask(&mut self) -> bool {
        let graph = self.session.graph();
        let mut daemons = graph.endpoints.values().filter_map(|entry| entry.daemon);
        let has_strangers = daemons.any(|daemon| self.known.is_unnamed(&daemon));
        let is_due = self.known.asked.is_none_or(|asked| asked.elapsed() >= STATUS);
        if !has_strangers && !is_due {
            return false;
        }
        // Without a daemon there is nothing to ask.
        let Ok(json) = self.session.status_json() else { return false };
        let Ok(status) = serde_json::from_str::<Status>(&json) else { return false };
        self.known.asked = Some(Instant::now());
        let before = self.known.counts();
        self.known.learn(&status, &graph);
        for link in &status.links {
            if !link.party.is_empty() {
                self.seen.observe_denied(&link.party, &link.denied, link.more_denied);
            }
        }
        self.known.counts() != before
    }

    fn look(&mut self, graph: &GraphView) {
        let all: Vec<_> = graph
            .endpoints
            .values()
            .filter_map(|entry| {
                let endpoint = &entry.endpoint;
                let owner = match entry.daemon {
                    Some(daemon) => Owner::Host(self.known.hosts.get(&daemon)?.as_deref()?),
                    None => {
                        let gid = endpoint.gid.to_string();
                        let user = self.known.users.iter().find(|(gids, _)| gid.starts_with(*gids));
                        user.map_or(Owner::Own, |(_, uid)| Owner::User(*uid))
                    }
                };
                let mut session = [0; 12];
                session.copy_from_slice(&endpoint.gid.0[..12]);
                Some(Observed {
                    owner,
                    session,
                    verb: verb_of(endpoint.kind)?,
                    name: &endpoint.topic,
                })
            })
            .collect();
        self.seen.observe(&all);
    }
}

impl Known {
    fn is_unnamed(&self, daemon: &DaemonId) -> bool {
        self.hosts.get(daemon).is_none_or(Option::is_none)
    }

    /// Hosts and users that are known.
    fn counts(&self) -> (usize, usize) {
        (self.hosts.values().flatten().count(), self.users.len())
    }

    fn learn(&mut self, status: &Status, graph: &GraphView) {
        let name = |daemon: &DaemonId| {
            let daemon = daemon.to_string();
            let of_daemon = |link: &&LinkStatus| link.peer == daemon && !link.party.is_empty();
            status.links.iter().find(of_daemon).map(|link| link.party.clone())
        };
        for daemon in graph.endpoints.values().filter_map(|entry| entry.daemon) {
            let known = self.hosts.entry(daemon).or_default();
            if known.is_none() {
                *known = name(&daemon);
            }
        }
        for session in status.sessions.iter().filter(|session| !session.gids.is_empty()) {
            if let Some(user) = session.user {
                self.users.insert(session.gids.clone(), user);
            }
        }
    }
}
