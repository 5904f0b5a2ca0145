//! The sockets for sessions: accepts connections and admits sessions.

use std::{
    cell::RefCell,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    ids::{Gid, SessionId},
    internal::{
        PeerProcess,
        descriptors::{self, PassedFd},
        peer_process,
    },
};
use axon_transport::{
    config::Config,
    internal::{
        SessionKey,
        graph::Scope,
        log_limit::LogLimit,
        registry::{MAX_OF_PROCESS, RelayCounters, SessionEntry},
        text,
        wire::session::{
            PROTOCOL, SessionHello, SessionMessage, SessionRefused, SessionRole, Welcome,
        },
    },
};
use rustix::{
    io::Errno,
    net::{AddressFamily, SocketFlags, SocketType, accept_with, socketpair},
};
use tokio::{io::unix::AsyncFd, sync::Notify, task::spawn_local, time::timeout};

use super::{
    descriptors::DescriptorRoom,
    handshake::{PreHelloMessage, first},
    pending::{MAX_PENDING_CONNECTIONS, MOST_WHERE_SHORT, PendingConnection, PendingConnections},
    plane::ControlPlane,
    scheduler::ProcessTurn,
    session_connection::{converse, say},
};
use crate::{
    async_fd::{watch, watch_shared},
    bridge::RefusalKind,
    control::relayed::DaemonRelay,
};

/// Maximum time that a connection may take to send HELLO.
const HELLO_TIMEOUT: Duration = Duration::from_secs(5);
/// Pause between attempts when no connection can be accepted.
const RETRY_INTERVAL: Duration = Duration::from_millis(50);

/// Accepts sessions for as long as it is polled.
pub(super) async fn accept(control: Rc<RefCell<ControlPlane>>, listeners: Vec<OwnedFd>) {
    let strangers = PendingConnections::default();
    let mut listeners = listeners.into_iter();
    // The listener at a path, the one at a name, or both.
    let [first, second] = [listeners.next(), listeners.next()].map(|listener| async {
        if let Some(listener) = listener {
            accept_at(control.clone(), listener, strangers.clone()).await;
        }
    });
    tokio::join!(first, second);
}

async fn accept_at(
    control: Rc<RefCell<ControlPlane>>,
    listener: OwnedFd,
    strangers: PendingConnections,
) {
    let listener = match watch(listener) {
        Ok(listener) => listener,
        Err(error) => return tracing::error!(%error, "the session socket cannot be watched"),
    };
    let spare = Rc::clone(&control.borrow().spare);
    let (mut full, failures, begun) = (false, LogLimit::default(), Instant::now());
    loop {
        let Ok(mut ready) = listener.readable().await else { return };
        if descriptors::close_queue_is_full() {
            // Existing sessions stay.
            if !std::mem::replace(&mut full, true) {
                tracing::error!("too many connections wait to be closed: no more are accepted");
            }
            tokio::time::sleep(RETRY_INTERVAL).await;
            continue;
        }
        full = false;
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let accept = |l: &AsyncFd<PassedFd>| match accept_with(l.get_ref(), flags) {
            // A spare descriptor serves to send the caller the reason for its refusal.
            Err(Errno::MFILE | Errno::NFILE) => {
                let _lent = spare.lend();
                accept_with(l.get_ref(), flags)
            }
            accepted => accepted,
        };
        let accepted = ready.try_io(|l| Ok(accept(l)?));
        match accepted {
            Ok(Ok(socket)) => {
                let socket = PassedFd::connection(socket);
                let pid = peer_process(&socket).map_or(0, |peer| peer.pid);
                let most = if descriptors::is_tight() {
                    MOST_WHERE_SHORT
                } else {
                    MAX_PENDING_CONNECTIONS
                };
                let stranger = strangers.add(pid, most);
                spawn_local(serve(control.clone(), socket, InternalPeer::No, Some(stranger)));
                // Lets the tasks of other connections continue.
                tokio::task::yield_now().await;
            }
            Ok(Err(error)) => {
                // No descriptor is left, or the caller has gone: neither ends the daemon.
                if let Some(times) = failures.count(begun.elapsed()) {
                    tracing::warn!(%error, times, "a session could not be accepted");
                }
                tokio::time::sleep(RETRY_INTERVAL).await;
            }
            Err(_not_ready) => {}
        }
    }
}

/// The owner of the other end of the socket that the daemon serves.
pub(super) enum InternalPeer {
    /// No internal peer: a process connected.
    No,
    /// The gateway.
    Gateway,
    /// A relayed session of process `pid`.
    Relay { pid: u32, uid: u32, tally: Arc<RelayCounters>, key: Option<Arc<SessionKey>> },
}

/// Interval at which the daemon checks whether a session that hung up came back.
const AWAIT_PROCESS: Duration = Duration::from_secs(1);

/// Serves one connection to its end. It counts as a `stranger` until it sent HELLO.
pub(super) async fn serve(
    control: Rc<RefCell<ControlPlane>>,
    socket: PassedFd,
    inside: InternalPeer,
    stranger: Option<PendingConnection>,
) {
    let Ok(peer) = peer_process(&socket) else { return };
    if !control.borrow().admission.trusts(peer.uid) {
        tracing::warn!(
            uid = peer.uid,
            pid = peer.pid,
            "closed the connection of a user who is not in AXON_TRUSTED_UIDS"
        );
        return;
    }
    let Ok(socket) = watch(socket.trusted()) else { return };
    let spare = Rc::clone(&control.borrow().spare);
    let has_room = || {
        let control = control.borrow();
        no_room(&control, SessionRole::Application, peer.pid, false).is_none()
    };
    let replaced = async {
        match &stranger {
            Some(stranger) => stranger.replaced().await,
            None => std::future::pending().await,
        }
    };
    let first = tokio::select! {
        first = timeout(HELLO_TIMEOUT, first(&spare, &socket, has_room)) => first,
        () = replaced => {
            return tracing::warn!(
                pid = peer.pid,
                "too many connections without HELLO: closed the oldest one of this process to accept a new one"
            );
        }
    };
    drop(stranger);
    let Ok(Some(first)) = first else { return };
    if first.hello.relay.is_some() {
        return relay(&control, socket, first, peer);
    }
    let Some(Admitted { id, bell, turn, death }) = admit(&control, &socket, first, peer, &inside)
    else {
        return;
    };
    let why = converse(&control, &socket, id, &bell, &turn, death.as_ref()).await;
    tracing::debug!(session = %id, why, "a session ended");
    // Its descriptors are closed at once, its endpoints removed in the turns of its process.
    drop(socket);
    loop {
        {
            let _turn = turn.lock().await;
            if !control.borrow_mut().remove_some(&id, &bell) {
                break;
            }
            tokio::task::yield_now().await;
        }
    }
    let Some(death) = death else { return };
    await_process(&control, &id, &death).await;
}

/// Waits until the process of a session that hung up has ended, if readers are to get its remaining memory. The session
/// may come back before.
async fn await_process(
    control: &RefCell<ControlPlane>,
    id: &SessionId,
    death: &AsyncFd<Arc<PassedFd>>,
) {
    while control.borrow().registry.awaits_process(id) {
        if timeout(AWAIT_PROCESS, death.readable()).await.is_ok() {
            let control = &mut *control.borrow_mut();
            control.registry.handle_process_end(id);
            control.settle();
        }
    }
}

/// Refuses a connection, and shows the refusal in log and status.
fn refuse(
    control: &mut ControlPlane,
    socket: &AsyncFd<PassedFd>,
    name: &str,
    peer: PeerProcess,
    refused: SessionRefused,
) {
    let what = if refused.variable.is_empty() { "session" } else { &refused.variable }.to_owned();
    let who = format!("session {name} (pid {})", peer.pid);
    control.refused(RefusalKind::Local, who, what, refused.text.clone());
    say(socket, SessionMessage::Refused(refused), &[]);
}

/// Refuses a session for want of descriptors.
fn refuse_for_room(
    control: &mut ControlPlane,
    socket: &AsyncFd<PassedFd>,
    name: &str,
    peer: PeerProcess,
    why: String,
) {
    control.refused_for_room(format!("session {name} (pid {})", peer.pid), why.clone());
    say(socket, SessionMessage::Refused(SessionRefused::because(why)), &[]);
}

/// Returns the reason why there are no descriptors for a session, if so. A tool needs only its connection.
fn no_room(
    control: &ControlPlane,
    role: SessionRole,
    pid: u32,
    is_relayed: bool,
) -> Option<String> {
    let room = DescriptorRoom::of(&control.registry, pid)?;
    match role {
        SessionRole::Gateway => None,
        SessionRole::Application => room.refuses_session(is_relayed),
        SessionRole::Tool if control.spare.can_keep_caller() => None,
        SessionRole::Tool => room.refuses_session(false),
    }
}

/// Returns the name of a session as it is shown in log and status.
fn shown(name: &str) -> String {
    text::plain(name, 64)
}

/// Starts the relay of a session whose memory is not shared.
fn relay(
    control: &Rc<RefCell<ControlPlane>>,
    socket: AsyncFd<PassedFd>,
    first: PreHelloMessage,
    peer: PeerProcess,
) {
    let its_own = first.is_its_own();
    let PreHelloMessage { mut hello, descriptors, key, .. } = first;
    hello.name = shown(&hello.name);
    let mut state = control.borrow_mut();
    let reason = hello.relay.clone().unwrap_or_default();
    let pair = || {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)
    };
    let trusted = its_own.and_then(|()| state.admission.still_trusts(peer.uid));
    if trusted.is_ok()
        && let Some(why) = no_room(&state, hello.role, peer.pid, true)
    {
        return refuse_for_room(&mut state, &socket, &hello.name, peer, why);
    }
    let checked = trusted.and_then(|()| state.admission.check(&hello, descriptors, peer, false));
    let checked = match checked {
        Err(refused) => Err(*refused),
        Ok(_)
            if state.registry.relayed()
                >= axon_transport::internal::session::relayed::MAX_SESSIONS =>
        {
            Err(SessionRefused::because(format!(
                "{} sessions are relayed already; one that shares memory is served",
                axon_transport::internal::session::relayed::MAX_SESSIONS
            )))
        }
        Ok(_) => pair()
            .map_err(|error| SessionRefused::because(format!("no socket to relay it by: {error}"))),
    };
    let (ours, theirs) = match checked {
        Ok(pair) => pair,
        Err(refused) => return refuse(&mut state, &socket, &hello.name, peer, refused),
    };
    let tally = Arc::new(RelayCounters::new(&reason));
    tracing::info!(name = hello.name, pid = peer.pid, reason, "a session is relayed");
    let inside =
        InternalPeer::Relay { pid: peer.pid, uid: peer.uid, tally: Arc::clone(&tally), key };
    spawn_local(serve(control.clone(), ours.into(), inside, None));
    let far = DaemonRelay {
        socket: socket.into_inner(),
        inside: theirs,
        config: scoped(&state.config, scope_of(&hello)),
        name: hello.name,
        id: hello.session,
        tally,
        pool: Arc::clone(&state.pool),
        losses: Arc::clone(&state.lost),
    };
    if let Err(error) = far.start() {
        tracing::error!(%error, "no thread to relay a session");
    }
}

/// Returns the discovery scope that a session requests.
fn scope_of(hello: &SessionHello) -> Scope {
    Scope::of(hello.range, hello.static_peers.clone().unwrap_or_default())
}

/// Returns the daemon's settings with the range of a relayed session, whose id they are used under.
fn scoped(config: &Config, scope: Scope) -> Arc<Config> {
    let Scope { range, static_peers, .. } = scope;
    let mut own = config.clone();
    (own.range, own.static_peers) = (range, static_peers);
    Arc::new(own)
}

/// An admitted session.
struct Admitted {
    id: SessionId,
    bell: Rc<Notify>,
    /// The turn of its process.
    turn: ProcessTurn,
    /// The pidfd that shows that its process ended.
    death: Option<AsyncFd<Arc<PassedFd>>>,
}

fn admit(
    control: &Rc<RefCell<ControlPlane>>,
    socket: &AsyncFd<PassedFd>,
    first: PreHelloMessage,
    peer: PeerProcess,
    inside: &InternalPeer,
) -> Option<Admitted> {
    let its_own = first.is_its_own();
    let PreHelloMessage { mut hello, descriptors, mut key, is_crowded } = first;
    hello.name = shown(&hello.name);
    let control = &mut *control.borrow_mut();
    let gateway = matches!(inside, InternalPeer::Gateway);
    // The settings may have changed since the connection was accepted.
    let uid = if let InternalPeer::Relay { uid, .. } = inside { *uid } else { peer.uid };
    let trusted = its_own.and_then(|()| control.admission.still_trusts(uid));
    // The connection of a relayed session was admitted together with this one.
    if trusted.is_ok()
        && matches!(inside, InternalPeer::No)
        && let Some(why) = no_room(control, hello.role, peer.pid, false)
    {
        refuse_for_room(control, socket, &hello.name, peer, why);
        return None;
    }
    if is_crowded {
        // Descriptors are free again, so the session connects again.
        return None;
    }
    let checked =
        trusted.and_then(|()| control.admission.check(&hello, descriptors, peer, gateway));
    let handed = match checked {
        Ok(handed) => handed,
        Err(refused) => {
            refuse(control, socket, &hello.name, peer, *refused);
            return None;
        }
    };
    let pid = if let InternalPeer::Relay { pid, .. } = inside { *pid } else { peer.pid };
    // Endpoints are named after their session's id: a session with the id of another one could end the other one's
    // endpoints.
    if let Some(pid) = taken_by(control, &hello.session, pid) {
        let text = format!("process {pid} has a session with this one's id or one like it");
        refuse(control, socket, &hello.name, peer, SessionRefused::because(text));
        return None;
    }
    let same = |(_, entry): &(&SessionId, &SessionEntry<_>)| entry.pid == pid;
    if !gateway && control.registry.sessions().filter(same).count() >= MAX_OF_PROCESS {
        let text = format!("its process has {MAX_OF_PROCESS} sessions already");
        refuse(control, socket, &hello.name, peer, SessionRefused::because(text));
        return None;
    }
    let handed = handed.map(|fds| fds.map(Arc::new));
    let death = match &handed {
        Some([_, _, pidfd]) => Some(watch_shared(pidfd).ok()?),
        None => None,
    };
    let scope = (!gateway).then(|| scope_of(&hello));
    let known = handed.clone();
    let SessionHello { session, role, name, .. } = hello;
    tracing::debug!(%session, name, pid, "a session");
    if let Err(violation) =
        control.registry.handle_connect(session, role, name.clone(), pid, handed, scope)
    {
        refuse(control, socket, &name, peer, SessionRefused::because(violation.to_string()));
        return None;
    }
    if let Some([_, doorbell, pidfd]) = known.filter(|_| !gateway) {
        control.known_peers.insert(session, &doorbell, &pidfd);
    }
    // Access rules decide what another user may do.
    if control.admission.is_another(uid) {
        control.registry.set_user(&session, uid);
    }
    control.relist();
    if let InternalPeer::Relay { tally, key: of_process, .. } = inside {
        control.registry.set_relayed(&session, Arc::clone(tally));
        key = of_process.clone();
    }
    if let Some(key) = key {
        control.keys_of_sessions.insert(key);
    }
    let turn = control.turns.of(pid);
    let pid = std::process::id();
    let welcome = Welcome { protocol: PROTOCOL, daemon: control.id, pid, ranges: Some(true) };
    let probe: Vec<BorrowedFd<'_>> = control.probe.iter().map(AsFd::as_fd).collect();
    if !say(socket, SessionMessage::Welcome(welcome), &probe) {
        control.registry.handle_disconnect(&session);
        control.keys_of_sessions.remove(&session);
        control.known_peers.remove(&session);
        control.settle();
        return None;
    }
    let bell = control.add_waker(session);
    control.settle();
    Some(Admitted { id: session, bell, turn, death })
}

/// Returns the process of a session whose endpoints would have the same GIDs as those of `session`, of process `pid`.
/// The session itself may come back.
fn taken_by(control: &ControlPlane, session: &SessionId, pid: u32) -> Option<u32> {
    let alike = |id: &SessionId| Gid::new(*id, 0) == Gid::new(*session, 0);
    let mut others = control.registry.sessions();
    others
        // A process that cannot be seen could be any.
        .find(|(id, entry)| alike(id) && (*id != session || entry.pid != pid || pid == 0))
        .map(|(_, entry)| entry.pid)
}
