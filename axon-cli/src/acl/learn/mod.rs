//! `axon acl learn`: watches what other hosts and users do here, and writes the rules that allow it.

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
    ids::{DaemonId, Gid},
    internal::graph::verb_of,
    status::{LinkStatus, Status},
};

use self::seen::{Observed, Owner, Seen};
use super::cli;
use crate::{failure::CliError, interrupt, logging, say::say, session};

/// The longest time between two checks while nothing changes.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// The time during which changes of the graph are collected.
const MOMENT: Duration = Duration::from_millis(10);
/// The time between two requests for the daemon's status while every host and session is known.
const STATUS: Duration = Duration::from_secs(2);
/// The time between two lines of progress on a terminal.
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
    // A daemon that this session started would know no other host or user.
    config.daemon = DaemonPolicy::Require;
    let session =
        Session::open(&config, SessionOptions::new("axon acl learn")).map_err(session::failure)?;
    let interrupt = interrupt::of(&session)?;
    let (known, seen) = (Known::default(), Seen::default());
    let mut watch = Watch { session, interrupt, known, seen, withheld: false };
    let until = match args.watch {
        Some(time) => format!("for {} s; Ctrl-C ends it earlier", time.as_secs_f64()),
        None => "until Ctrl-C".to_owned(),
    };
    say(format_args!("axon acl learn: watching other hosts and users {until}"));
    watch.run(args.watch);
    if watch.withheld {
        return Err(CliError::failed(
            "the daemon belongs to another user and has access rules: it tells no other user whose endpoints are; run this \
             as the daemon's user",
        ));
    }
    let (parties, uses) = watch.seen.counts();
    say(format_args!("axon acl learn: saw {uses} uses of {parties} hosts and users"));
    if watch.known.unnamed > 0 {
        say(format_args!(
            "axon acl learn: {} hosts left before their names were known: nothing of them is in the rules",
            watch.known.unnamed
        ));
    }
    if watch.known.unowned > 0 {
        say(format_args!(
            "axon acl learn: {} sessions of this host ended before it was known whose they were: nothing of them is in \
             the rules",
            watch.known.unowned
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
            // The reader of the pipe closed it, so it wants no more lines.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => {}
            written => written?,
        },
    }
    Ok(ExitCode::SUCCESS)
}

fn exists(file: &Path) -> CliError {
    CliError::failed(format!("{}: it exists; --force replaces it", file.display()))
}

/// Writes a file atomically: a daemon that reads it finds the former rules or these.
fn write(file: &Path, rules: &str, force: bool) -> Result<(), CliError> {
    let failed = |error: io::Error| CliError::failed(format!("{}: {error}", file.display()));
    let mut name = file.as_os_str().to_owned();
    name.push(format!(".{}.tmp", std::process::id()));
    let part = PathBuf::from(name);
    let mut new =
        fs::OpenOptions::new().write(true).create_new(true).open(&part).map_err(failed)?;
    let placed = new.write_all(rules.as_bytes()).and_then(|()| {
        // `hard_link` does not replace a file that was created in the meantime.
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
    /// The daemon reports nothing to this user.
    withheld: bool,
}

/// The owners of endpoints, as far as the daemon has reported them.
#[derive(Default)]
struct Known {
    /// The name of each other host, by its daemon. A name is kept after the link ends.
    hosts: HashMap<DaemonId, Option<String>>,
    /// The owner of each session of this host, by the first characters of the session's GIDs. `None` until the daemon
    /// reports it.
    sessions: HashMap<String, Option<LocalOwner>>,
    asked: Option<Instant>,
    /// The number of hosts that had endpoints and whose names never became known.
    unnamed: usize,
    /// The number of sessions of this host that had endpoints and whose owners never became known.
    unowned: usize,
}

/// The owner of a session of this host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LocalOwner {
    /// The daemon's own user.
    Own,
    /// The user with this id.
    User(u32),
}

/// The number of hexadecimal characters of a GID that all endpoints of a session share.
const OF_SESSION: usize = 24;

/// Returns the characters that all GIDs of an endpoint's session begin with.
fn session_of(gid: Gid) -> String {
    let mut text = gid.to_string();
    text.truncate(OF_SESSION);
    text
}

/// Returns the GID of each endpoint, and the daemon if the endpoint is of another host.
fn places(graph: &GraphView) -> impl Iterator<Item = (Option<DaemonId>, Gid)> {
    graph.endpoints.iter().map(|(gid, entry)| (entry.daemon, *gid))
}

impl Watch {
    /// Watches for a time, or until a signal.
    fn run(&mut self, time: Option<Duration>) {
        let begin = Instant::now();
        let (mut version, mut progress) = (None, begin);
        let is_terminal = io::stderr().is_terminal();
        while !self.interrupt.is_triggered() {
            let elapsed = begin.elapsed();
            let left = time.map_or(CHECK_INTERVAL, |time| time.saturating_sub(elapsed));
            if self.ask() {
                version = None;
            }
            if self.withheld {
                return;
            }
            let graph = self.session.graph();
            self.known.meet(places(&graph));
            let is_new = version != Some(graph.version);
            let has_strangers = self.known.has_strangers(places(&graph));
            // When the name of a host becomes known, its endpoints are evaluated again.
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
            // Changes within a short time are evaluated together.
            std::thread::sleep(MOMENT.min(left));
            self.session
                .wait_graph(CHECK_INTERVAL.min(left), |graph| version != Some(graph.version));
        }
        if is_terminal {
            let _ = write!(io::stderr().lock(), "\r\x1b[K");
        }
        let strangers = self.known.hosts.values().filter(|name| name.is_none());
        self.known.unnamed = strangers.count();
        self.known.unowned = self.known.sessions.values().filter(|owner| owner.is_none()).count();
    }

    /// Asks the daemon for its status, if the time has come. The time is shorter while a host or session is unknown.
    /// Returns whether a host or session became known; its endpoints then have to be evaluated again.
    fn ask(&mut self) -> bool {
        let graph = self.session.graph();
        let has_strangers = self.known.has_strangers(places(&graph));
        let time = if has_strangers { MOMENT } else { STATUS };
        if self.known.asked.is_some_and(|asked| asked.elapsed() < time) {
            return false;
        }
        // Without a daemon there is no status.
        let Ok(json) = self.session.status_json() else { return false };
        let Ok(status) = serde_json::from_str::<Status>(&json) else { return false };
        self.known.asked = Some(Instant::now());
        self.withheld = status.withheld;
        let before = self.known.counts();
        self.known.learn(&status, places(&graph));
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
                    None => match (*self.known.sessions.get(&session_of(endpoint.gid))?)? {
                        LocalOwner::Own => Owner::Own,
                        LocalOwner::User(uid) => Owner::User(uid),
                    },
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
    /// Returns whether an endpoint belongs to a host without a name or to a session without a known owner.
    fn has_strangers(&self, endpoints: impl IntoIterator<Item = (Option<DaemonId>, Gid)>) -> bool {
        endpoints.into_iter().any(|(daemon, gid)| match daemon {
            Some(daemon) => self.hosts.get(&daemon).is_none_or(Option::is_none),
            None => self.sessions.get(&session_of(gid)).is_none_or(Option::is_none),
        })
    }

    /// Records the sessions of this host that have these endpoints.
    fn meet(&mut self, endpoints: impl IntoIterator<Item = (Option<DaemonId>, Gid)>) {
        let local = endpoints.into_iter().filter(|(daemon, _)| daemon.is_none());
        for (_, gid) in local {
            self.sessions.entry(session_of(gid)).or_default();
        }
    }

    /// Returns the numbers of known hosts and of known sessions.
    fn counts(&self) -> (usize, usize) {
        (self.hosts.values().flatten().count(), self.sessions.values().flatten().count())
    }

    fn learn(
        &mut self,
        status: &Status,
        endpoints: impl IntoIterator<Item = (Option<DaemonId>, Gid)>,
    ) {
        let name = |daemon: &DaemonId| {
            let daemon = daemon.to_string();
            let of_daemon = |link: &&LinkStatus| link.peer == daemon && !link.party.is_empty();
            status.links.iter().find(of_daemon).map(|link| link.party.clone())
        };
        for (daemon, gid) in endpoints {
            let Some(daemon) = daemon else {
                self.meet([(None, gid)]);
                continue;
            };
            let known = self.hosts.entry(daemon).or_default();
            if known.is_none() {
                *known = name(&daemon);
            }
        }
        for session in status.sessions.iter().filter(|session| !session.gids.is_empty()) {
            let owner = session.user.map_or(LocalOwner::Own, LocalOwner::User);
            self.sessions.insert(session.gids.clone(), Some(owner));
        }
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::status::SessionStatus;

    use super::*;

    /// Returns one endpoint for each of these sessions of this host.
    fn of(sessions: &[u8]) -> Vec<(Option<DaemonId>, Gid)> {
        sessions.iter().map(|session| (None, Gid([*session; 16]))).collect()
    }

    fn status(sessions: &[(u8, Option<u32>)]) -> Status {
        let session_status = |(session, user): &(u8, Option<u32>)| {
            let mut status = SessionStatus::default();
            status.gids = session_of(Gid([*session; 16]));
            status.user = *user;
            status
        };
        let mut all = Status::default();
        all.sessions = sessions.iter().map(session_status).collect();
        all
    }

    /// A user's session may publish once and end between two looks at the status.
    #[test]
    fn a_session_that_ends_before_it_is_known_whose_it_is_counts_as_nobodys() {
        let mut known = Known::default();
        assert!(known.has_strangers(of(&[1])), "the daemon is asked at once");
        known.learn(&status(&[(1, None), (2, Some(1001))]), of(&[1, 2, 3]));
        assert!(!known.has_strangers(of(&[1, 2])) && known.has_strangers(of(&[3])));
        let owner = |session: u8| known.sessions[&session_of(Gid([session; 16]))];
        assert_eq!(owner(1), Some(LocalOwner::Own));
        assert_eq!(owner(2), Some(LocalOwner::User(1001)));
        assert_eq!((owner(3), known.counts()), (None, (0, 2)));
    }
}
