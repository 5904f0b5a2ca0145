//! Connects to the daemon: finds or starts it, checks its identity, and exchanges HELLO and WELCOME.

use std::{
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    time::{Duration, Instant},
};

use axon_shm::internal::{SessionSegment, descriptors::PassedFd, out_of_reach, peer_process};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{
    address::{Address, AddressError},
    socket::{self, SocketError},
};
use crate::{
    config::{Config, DaemonPolicy, DiscoveryRange, security_settings},
    ids::SessionId,
    session::{
        daemon::spawn::{SpawnOutcome, spawn},
        error::SessionError,
        options::SessionOptions,
    },
    wire::session::{PROTOCOL, SessionHello, SessionMessage, SessionRole, Welcome},
};

/// Maximum time that a daemon may take to start and answer.
const DAEMON_CONNECT_TIMEOUT: Duration = Duration::from_secs(20);
/// Time within which a daemon that has the address must answer.
const AFTER: Duration = Duration::from_millis(500);
/// Maximum number of times that an address may be bound without a listener. A daemon listens at once.
const UNSERVED: u32 = 4;
/// Maximum time that another process may take to start a daemon before this one starts one, too.
const TURN: Duration = Duration::from_secs(5);
/// The variable that a daemon names in its refusal if it cannot share memory with the session.
pub const SHM: &str = "AXON_SHM";

/// A connection to a daemon that accepted the session.
#[derive(Debug)]
pub(crate) struct Connected {
    pub(crate) socket: OwnedFd,
    pub(crate) welcome: Welcome,
    /// The descriptors that came with WELCOME.
    descriptors: Vec<PassedFd>,
}

/// The session that connects.
#[derive(Clone, Copy)]
pub(crate) struct Caller<'a> {
    pub(crate) config: &'a Config,
    pub(crate) options: &'a SessionOptions,
    pub(crate) id: SessionId,
    /// Absent for a tool, and for a relayed session.
    pub(crate) segment: Option<&'a SessionSegment>,
    /// The reason why the session is relayed, if it is.
    pub(crate) relay: Option<&'a str>,
    /// Returns whether the caller does not need the connection any more.
    pub(crate) cancel: Option<&'a dyn Fn() -> bool>,
}

impl<'a> Caller<'a> {
    /// Creates a caller without a segment that is not relayed and cannot be cancelled.
    pub(crate) fn new(config: &'a Config, options: &'a SessionOptions, id: SessionId) -> Self {
        Self { config, options, id, segment: None, relay: None, cancel: None }
    }

    /// Connects to the daemon. If there is none and the policy allows it, starts one.
    pub(crate) fn connect(&self) -> Result<Connected, SessionError> {
        let address = Address::of(self.config);
        let deadline = Instant::now() + DAEMON_CONNECT_TIMEOUT;
        let mut pause = Duration::from_millis(2);
        // A daemon may be ending, or another process may be starting one: waits a little before starting one, because
        // only one of many that start at once gets the address.
        let mut spawn_after = Instant::now();
        let (mut turn, mut gives_way_until) = (None, None);
        let mut taken = 0;
        loop {
            match self.try_connect(&address, deadline) {
                Err(Attempt::Final(error)) => return Err(error),
                Ok(connected) => return Ok(connected),
                Err(Attempt::Absent) if self.config.daemon != DaemonPolicy::Spawn => {
                    return Err(SessionError::NoDaemon { address: address.to_string() });
                }
                Err(Attempt::Absent) if Instant::now() >= spawn_after => {
                    // After the end of a daemon all its sessions look for the next one at the same time.
                    if turn.is_none() {
                        turn = address.turn();
                        if turn.is_some() {
                            // The process that had the turn before may have started a daemon.
                            continue;
                        }
                    }
                    let until = *gives_way_until.get_or_insert_with(|| Instant::now() + TURN);
                    if turn.is_some() || Instant::now() >= until {
                        let command = self.options.daemon_command.as_ref();
                        match spawn(self.config, command, &|| self.cancelled())? {
                            SpawnOutcome::Ready => continue,
                            SpawnOutcome::Taken => {
                                spawn_after = Instant::now() + AFTER;
                                taken += 1;
                            }
                        }
                        turn = None;
                    }
                }
                Err(Attempt::Absent | Attempt::Again) => {}
            }
            if taken > UNSERVED && address.is_open_to_others() {
                return Err(SessionError::Squatted { address: address.to_string() });
            }
            if self.cancelled() || Instant::now() >= deadline {
                return Err(SessionError::Silent { address: address.to_string() });
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(Duration::from_millis(100));
        }
    }

    fn cancelled(&self) -> bool {
        self.cancel.is_some_and(|cancel| cancel())
    }

    fn try_connect(&self, address: &Address, deadline: Instant) -> Result<Connected, Attempt> {
        let socket = match address.connect() {
            Ok(socket) => socket,
            Err(AddressError::Absent) => return Err(Attempt::Absent),
            Err(AddressError::Busy) => return Err(Attempt::Again),
            Err(error) => return Err(Attempt::Final(SessionError::Address(error.to_string()))),
        };
        let peer = peer_process(&socket).map_err(|_| Attempt::Again)?;
        let own = rustix::process::geteuid().as_raw();
        if peer.uid != own && !self.config.trusted_uids.contains(&peer.uid) {
            let address = address.to_string();
            return Err(Attempt::Final(SessionError::Untrusted { address, uid: peer.uid }));
        }
        let connected = self.greet(socket, &address.to_string(), peer.pid, deadline)?;
        if self.segment.is_some() {
            look_into(&connected.descriptors)?;
        }
        Ok(connected)
    }

    /// Exchanges HELLO and its answer over a connected socket.
    pub(in crate::session) fn greet_over(
        &self,
        socket: OwnedFd,
    ) -> Result<Connected, SessionError> {
        let deadline = Instant::now() + DAEMON_CONNECT_TIMEOUT;
        self.greet(socket, "the daemon's socket pair", std::process::id(), deadline).map_err(
            |attempt| match attempt {
                Attempt::Final(error) => error,
                Attempt::Absent | Attempt::Again => SessionError::Disconnected,
            },
        )
    }

    fn greet(
        &self,
        socket: OwnedFd,
        address: &str,
        pid: u32,
        deadline: Instant,
    ) -> Result<Connected, Attempt> {
        let settings = if self.options.role == SessionRole::Tool {
            Vec::new()
        } else {
            security_settings(self.config).map_err(SessionError::from)?
        };
        let hello = SessionMessage::Hello(SessionHello {
            protocol: PROTOCOL,
            session: self.id,
            role: self.options.role,
            name: self.options.name.clone(),
            domain: self.config.domain,
            settings,
            relay: self.relay.map(str::to_owned),
            range: Some(self.config.range.number()),
            static_peers: Some(self.config.static_peers.clone()),
        });
        let packet = hello.encode().map_err(SessionError::of_codec)?;
        let descriptors = match self.segment {
            Some(segment) => {
                let d = segment.descriptors().map_err(SessionError::from)?;
                vec![d.segment, d.doorbell, d.pidfd]
            }
            None => Vec::new(),
        };
        let descriptors: Vec<BorrowedFd<'_>> = descriptors.iter().map(AsFd::as_fd).collect();
        let say = |packet: &[u8], descriptors: &[BorrowedFd<'_>]| -> Result<(), Attempt> {
            loop {
                match socket::send(&socket, packet, descriptors) {
                    Ok(()) => return Ok(()),
                    Err(SocketError::NotReady) => {
                        self.await_socket(&socket, PollFlags::OUT, deadline, address)?;
                    }
                    // The daemon ended after the connection was made, and may have sent the reason.
                    Err(_) => return Err(refusal(&socket, address).unwrap_or(Attempt::Again)),
                }
            }
        };
        if let Some(key) = &self.options.key {
            say(&key.packet(), &[])?;
        }
        say(&packet, &descriptors)?;
        let mut buffer = Vec::new();
        loop {
            let received = match socket::receive(&socket, &mut buffer) {
                Ok(received) => received,
                Err(SocketError::NotReady) => {
                    self.await_socket(&socket, PollFlags::IN, deadline, address)?;
                    continue;
                }
                Err(SocketError::Closed) => return Err(Attempt::Again),
                Err(SocketError::NoDescriptors) if self.segment.is_some() => {
                    let text = "descriptors of the daemon do not arrive: a security module keeps \
                                them back, or this process can hold no more (ulimit -n)";
                    return Err(SessionError::NotShared(text.into()).into());
                }
                Err(error) => {
                    return Err(Attempt::Final(SessionError::Protocol(error.to_string())));
                }
            };
            return match received.message {
                SessionMessage::Welcome(welcome) if welcome.protocol == PROTOCOL => {
                    self.check_range(&welcome, address, pid)?;
                    Ok(Connected { socket, welcome, descriptors: received.descriptors })
                }
                SessionMessage::Welcome(welcome) => Err(Attempt::Final(SessionError::Refused {
                    address: address.to_owned(),
                    text: format!("it speaks protocol {}, this {PROTOCOL}", welcome.protocol),
                })),
                SessionMessage::Refused(refused) if refused.variable.is_empty() => {
                    let address = address.to_owned();
                    Err(Attempt::Final(SessionError::Refused { address, text: refused.text }))
                }
                SessionMessage::Refused(refused) if refused.variable == SHM => {
                    Err(Attempt::Final(SessionError::NotShared(refused.text)))
                }
                SessionMessage::Refused(refused) => Err(Attempt::Final(SessionError::Mismatch {
                    variable: refused.variable,
                    ours: refused.ours,
                    theirs: refused.theirs,
                    address: address.to_owned(),
                    pid,
                })),
                SessionMessage::Unknown(_) => continue,
                other => {
                    let text = format!("{other:?} before WELCOME");
                    Err(Attempt::Final(SessionError::Protocol(text)))
                }
            };
        }
    }
}

impl Caller<'_> {
    /// Refuses a daemon of an earlier version, which would apply its own range instead of the session's.
    fn check_range(&self, welcome: &Welcome, address: &str, pid: u32) -> Result<(), Attempt> {
        let applies = welcome.ranges.unwrap_or(false);
        let asks = self.options.role == SessionRole::Application
            && self.config.range != DiscoveryRange::Subnet;
        if applies || !asks {
            return Ok(());
        }
        let text = format!(
            "it is of a version that does not keep each session's discovery range, and this \
             session's is {}: end that daemon (process {pid}), and a new one is started",
            self.config.range.name()
        );
        Err(Attempt::Final(SessionError::Refused { address: address.to_owned(), text }))
    }

    fn await_socket(
        &self,
        socket: &OwnedFd,
        flags: PollFlags,
        deadline: Instant,
        address: &str,
    ) -> Result<(), Attempt> {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() || self.cancelled() {
            let address = address.to_owned();
            return Err(Attempt::Final(SessionError::Silent { address }));
        }
        let slice = left.min(Duration::from_millis(100));
        let timeout = Timespec::try_from(slice).unwrap_or_default();
        match poll(&mut [PollFd::new(socket, flags)], Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(errno) => {
                Err(Attempt::Final(SessionError::System { what: "poll", source: errno.into() }))
            }
        }
    }
}

/// Checks that the daemon's memory arrives and can be mapped: other processes' memory comes in the same way.
fn look_into(descriptors: &[PassedFd]) -> Result<(), SessionError> {
    let Some(probe) = descriptors.first() else {
        return Err(SessionError::NotShared("descriptors of the daemon do not arrive".into()));
    };
    match out_of_reach(probe) {
        Some(error) => {
            let text = format!("the daemon's memory cannot be mapped: {error}");
            Err(SessionError::NotShared(text))
        }
        None => Ok(()),
    }
}

/// Returns the refusal of a daemon that closed the connection before HELLO was sent.
fn refusal(socket: &OwnedFd, address: &str) -> Option<Attempt> {
    match socket::receive(socket, &mut Vec::new()).ok()?.message {
        SessionMessage::Refused(refused) if refused.variable.is_empty() => {
            let address = address.to_owned();
            Some(Attempt::Final(SessionError::Refused { address, text: refused.text }))
        }
        _ => None,
    }
}

/// The reason why one attempt failed.
enum Attempt {
    /// No process listens.
    Absent,
    /// A process listened, and ended or is busy.
    Again,
    /// An error that another attempt would not avoid.
    Final(SessionError),
}

impl From<SessionError> for Attempt {
    fn from(error: SessionError) -> Self {
        Self::Final(error)
    }
}
