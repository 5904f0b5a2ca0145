//! Requests to a daemon over a connection of their own: its status, and the requests of its tools.

use std::{
    os::fd::OwnedFd,
    time::{Duration, Instant},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{
    address::Address,
    connect::Caller,
    socket::{self, SocketError},
    status_text::StatusText,
};
use crate::{
    access::Verb,
    config::{Config, DaemonLocation, DaemonPolicy},
    ids::{DaemonId, SessionId},
    session::{error::SessionError, options::SessionOptions},
    status::{PeerDecisions, ReloadReport},
    wire::session::{AccessCheck, CheckedUse, SessionMessage, SessionRole},
};

/// Maximum time that a daemon may take to answer.
pub(in crate::session) const ANSWER: Duration = Duration::from_secs(5);
/// Maximum time that a peer may take to answer: a lost packet is retransmitted by then.
const PEER_ANSWER: Duration = Duration::from_secs(3);

/// Returns the status of the daemon of this user and domain. Starts no daemon; the daemon answers whatever the security
/// settings are.
///
/// ```
/// # use axon_transport::config::Config;
/// use axon_transport::{SessionError, daemon_status};
///
/// # let directory = std::env::temp_dir().join(format!("axon-example-{}", std::process::id()));
/// # std::fs::create_dir_all(&directory)?;
/// let config = Config::builder().runtime_dir(&directory).domain(231).build()?;
/// match daemon_status(&config) {
///     Ok(json) => println!("{json}"),
///     Err(SessionError::NoDaemon { .. }) => println!("no daemon runs"),
///     Err(error) => return Err(error.into()),
/// }
/// # std::fs::remove_dir_all(&directory)?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`SessionError::NoDaemon`] if there is no daemon.
pub fn daemon_status(config: &Config) -> Result<String, SessionError> {
    daemon_status_at(&DaemonLocation::from(config))
}

/// Like [`daemon_status`], if only the daemon's location is known: other settings may be wrong.
///
/// ```no_run
/// use axon_transport::{config::DaemonLocation, daemon_status_at};
///
/// println!("{}", daemon_status_at(&DaemonLocation::from_env()?)?);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// As for [`daemon_status`].
pub fn daemon_status_at(place: &DaemonLocation) -> Result<String, SessionError> {
    let config = Config { daemon: DaemonPolicy::Require, ..place.config() };
    let options = SessionOptions::new("status").role(SessionRole::Tool);
    let connected = Caller::new(&config, &options, SessionId::random()).connect()?;
    let address = Address::of(&config).to_string();
    status_text(ask(&connected.socket, &SessionMessage::StatusRequest, &address, ANSWER)?)
}

/// Makes the daemon of this user and domain read the settings again that may change while it runs: access rules, peers,
/// trusted users and the log filter, from its own environment and files. If any of them is wrong, nothing changes, and
/// the report gives the reason.
///
/// ```no_run
/// use axon_transport::{config::DaemonLocation, daemon_reload_at};
///
/// let report = daemon_reload_at(&DaemonLocation::from_env()?)?;
/// match report.error {
///     Some(error) => eprintln!("nothing changed: {error}"),
///     None => println!("changed: {}", report.changed.join(", ")),
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// As for [`daemon_status`].
pub fn daemon_reload_at(place: &DaemonLocation) -> Result<ReloadReport, SessionError> {
    let config = Config { daemon: DaemonPolicy::Require, ..place.config() };
    let options = SessionOptions::new("reload").role(SessionRole::Tool);
    let connected = Caller::new(&config, &options, SessionId::random()).connect()?;
    let address = Address::of(&config).to_string();
    let text = status_text(ask(&connected.socket, &SessionMessage::Reload, &address, ANSWER)?)?;
    serde_json::from_str(&text).map_err(|e| SessionError::Protocol(format!("reload: {e}")))
}

/// Asks a linked peer, through the daemon of this user and domain, which of the peer's access rules decide what this
/// host may do there: at most 32 uses at a time, each a verb and the name of a topic, service or node. `peer` is the
/// daemon that [`LinkStatus::peer`](crate::status::LinkStatus::peer) names. If the daemon cannot pass the question on,
/// for example because the peer is not linked, [`PeerDecisions::error`] has the reason.
///
/// ```no_run
/// use axon_transport::{
///     access::Verb, config::DaemonLocation, daemon_check_access_at, daemon_status_at, status::Status,
/// };
///
/// let place = DaemonLocation::from_env()?;
/// let status: Status = serde_json::from_str(&daemon_status_at(&place)?)?;
/// for link in &status.links {
///     let uses = [(Verb::Publish, "/cmd_vel".to_owned())];
///     let answer = daemon_check_access_at(&place, &link.peer, &uses)?;
///     for decision in answer.decisions {
///         println!("{}: {}", link.host, decision.reason);
///     }
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// As for [`daemon_status`].
pub fn daemon_check_access_at(
    place: &DaemonLocation,
    peer: &str,
    uses: &[(Verb, String)],
) -> Result<PeerDecisions, SessionError> {
    let daemon = u128::from_str_radix(peer, 16).map(|id| DaemonId(id.to_be_bytes()));
    let daemon = daemon
        .map_err(|e| SessionError::Protocol(format!("access check: no daemon id {peer:?}: {e}")))?;
    let config = Config { daemon: DaemonPolicy::Require, ..place.config() };
    let options = SessionOptions::new("access check").role(SessionRole::Tool);
    let connected = Caller::new(&config, &options, SessionId::random()).connect()?;
    let address = Address::of(&config).to_string();
    let uses = uses.iter().map(|(verb, name)| CheckedUse { verb: *verb as u8, name: name.clone() });
    let question = SessionMessage::AccessCheck(AccessCheck { daemon, uses: uses.collect() });
    let text = status_text(ask(&connected.socket, &question, &address, PEER_ANSWER)?)?;
    serde_json::from_str(&text).map_err(|e| SessionError::Protocol(format!("access check: {e}")))
}

/// Decodes a status as text.
pub(in crate::session) fn status_text(bytes: Vec<u8>) -> Result<String, SessionError> {
    String::from_utf8(bytes).map_err(|e| SessionError::Protocol(format!("status: {e}")))
}

/// Sends a request, and returns the text of the answer.
fn ask(
    socket: &OwnedFd,
    question: &SessionMessage,
    address: &str,
    patience: Duration,
) -> Result<Vec<u8>, SessionError> {
    let silent = || SessionError::Silent { address: address.to_owned() };
    let protocol = |e: SocketError| SessionError::Protocol(e.to_string());
    let deadline = Instant::now() + patience;
    socket::send(socket, &question.encode().map_err(SessionError::of_codec)?, &[])
        .map_err(protocol)?;
    let (mut text, mut buffer) = (StatusText::default(), Vec::new());
    loop {
        match socket::receive(socket, &mut buffer) {
            Ok(received) => {
                if let SessionMessage::Status(part) = received.message
                    && let Some(whole) = text.add(&part)
                {
                    return Ok(whole);
                }
            }
            Err(SocketError::NotReady) => {
                let left = deadline.saturating_duration_since(Instant::now());
                let timeout = Timespec::try_from(left).unwrap_or_default();
                let mut fds = [PollFd::new(socket, PollFlags::IN)];
                if left.is_zero() || poll(&mut fds, Some(&timeout)) == Ok(0) {
                    return Err(silent());
                }
            }
            Err(SocketError::Closed) => return Err(SessionError::Disconnected),
            Err(error) => return Err(protocol(error)),
        }
    }
}
