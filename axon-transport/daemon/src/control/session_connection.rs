//! The message exchange with an admitted session: passes packets between its socket and the registry.

use std::{
    cell::RefCell,
    os::fd::{AsFd, BorrowedFd},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    ids::SessionId,
    internal::descriptors::{self, PassedFd},
};
use axon_transport::internal::{
    registry::{MAX_QUEUE, SessionEntry},
    session::daemon::socket::{self, ReceivedMessage, SocketError},
    wire::session::SessionMessage,
};
use tokio::{io::unix::AsyncFd, sync::Notify};

use super::{
    descriptors::{DescriptorRoom, SpareDescriptors},
    plane::ControlPlane,
    report::send_status,
    scheduler::{PART, ProcessTurn},
};

/// Maximum number of packets queued for a session while its own packets are accepted: its endpoints may cause more
/// packets than it reads.
const UNREAD: usize = MAX_QUEUE / 4;
/// Maximum number of parts of work, each of [`PART`], for the packets that a session left in its socket.
const REST: usize = 1000;

/// Moves packets both ways until the session ends. Returns the reason for the end.
pub(super) async fn converse(
    control: &Rc<RefCell<ControlPlane>>,
    socket: &AsyncFd<PassedFd>,
    id: SessionId,
    bell: &Rc<Notify>,
    turn: &ProcessTurn,
    death: Option<&AsyncFd<Arc<PassedFd>>>,
) -> String {
    let mut buffer = Vec::new();
    loop {
        let sent = {
            let _turn = turn.lock().await;
            let sent = send_some(control, socket, &id, bell);
            if matches!(sent, Ok(SendOutcome::Some)) {
                // The task yields while it holds the turn: otherwise all sessions of the process would do a part before
                // other processes are served.
                tokio::task::yield_now().await;
            }
            sent
        };
        let full = match sent {
            Ok(SendOutcome::All) => false,
            Ok(SendOutcome::Full) => true,
            Ok(SendOutcome::Some) => continue,
            Err(error) => {
                take_rest(control, socket, &id, bell, turn).await;
                return error.to_string();
            }
        };
        let queued = control.borrow().registry.session(&id).map_or(0, SessionEntry::queued);
        tokio::select! {
            () = bell.notified() => {
                if !control.borrow().is_current(&id, bell) {
                    return "it came back on another connection".into();
                }
            }
            ready = socket.writable(), if full => {
                let Ok(mut ready) = ready else { return "its socket cannot be watched".into() };
                let sent = {
                    let _turn = turn.lock().await;
                    send_some(control, socket, &id, bell)
                };
                match sent {
                    Ok(SendOutcome::Full) => ready.clear_ready(),
                    Ok(SendOutcome::All | SendOutcome::Some) => {}
                    Err(error) => {
                        take_rest(control, socket, &id, bell, turn).await;
                        return error.to_string();
                    }
                }
            }
            // Too many descriptors are in flight. No event signals when that ends, so this waits for a time.
            () = tokio::time::sleep(Duration::from_millis(20)), if full => {}
            ready = socket.readable(), if queued < UNREAD => {
                let Ok(mut ready) = ready else { return "its socket cannot be watched".into() };
                let turn = turn.lock().await;
                let received = receive_some(control, socket, &id, bell, &mut buffer, UNREAD);
                match received {
                    Ok(true) => ready.clear_ready(),
                    Ok(false) => tokio::task::yield_now().await,
                    Err(why) => return why,
                }
                drop(turn);
            }
            () = ended(death) => {
                take_rest(control, socket, &id, bell, turn).await;
                return "its process ended".into();
            }
        }
    }
}

/// Receives the messages that a session sent before its process or its connection ended: they announce memory in which
/// its readers find the last samples.
async fn take_rest(
    control: &Rc<RefCell<ControlPlane>>,
    socket: &AsyncFd<PassedFd>,
    id: &SessionId,
    bell: &Rc<Notify>,
    turn: &ProcessTurn,
) {
    let mut buffer = Vec::new();
    // Bounded: a child that inherited the socket may send without end.
    for _ in 0..REST {
        let _turn = turn.lock().await;
        match receive_some(control, socket, id, bell, &mut buffer, usize::MAX) {
            Ok(false) => {}
            Ok(true) | Err(_) => return,
        }
    }
}

/// The result of sending.
enum SendOutcome {
    /// No packet waits any more.
    All,
    /// Packets wait, and other processes have their turn first.
    Some,
    /// The socket is full.
    Full,
}

/// Sends queued packets to a session for the time of one turn.
fn send_some(
    control: &Rc<RefCell<ControlPlane>>,
    socket: &AsyncFd<PassedFd>,
    id: &SessionId,
    bell: &Rc<Notify>,
) -> Result<SendOutcome, SocketError> {
    let control = &mut *control.borrow_mut();
    // The queued packets are for the connection on which the session came back.
    if !control.is_current(id, bell) {
        return Ok(SendOutcome::All);
    }
    let sent = send_packets(control, socket, id);
    if control.registry.has_fences() {
        control.settle();
    }
    sent
}

fn send_packets(
    control: &mut ControlPlane,
    socket: &AsyncFd<PassedFd>,
    id: &SessionId,
) -> Result<SendOutcome, SocketError> {
    let (registry, begin) = (&mut control.registry, Instant::now());
    while let Some(output) = registry.poll_output(id) {
        let descriptors: Vec<BorrowedFd<'_>> =
            output.descriptors.iter().map(|d| d.as_fd()).collect();
        match socket::send(socket.get_ref(), &output.packet, &descriptors) {
            Ok(()) => {
                control.traffic.packets_out += 1;
                control.traffic.bytes_out += output.packet.len() as u64;
            }
            Err(SocketError::NotReady) => {
                drop(descriptors);
                registry.return_output(id, output);
                return Ok(SendOutcome::Full);
            }
            Err(error) => return Err(error),
        }
        if begin.elapsed() >= PART {
            return Ok(SendOutcome::Some);
        }
    }
    Ok(SendOutcome::All)
}

/// Receives one packet. If descriptors are short, it frees the spare ones for the packet's descriptors, so that the
/// daemon can refuse the packet's request.
pub(super) fn receive(
    spare: &SpareDescriptors,
    socket: &PassedFd,
    buffer: &mut Vec<u8>,
) -> Result<ReceivedMessage, SocketError> {
    let (clogged, tight) = (descriptors::is_clogged(), descriptors::is_tight());
    if !(clogged || tight) || !descriptors::carries_descriptors(socket) {
        return socket::receive(socket, buffer);
    }
    if clogged {
        return Err(SocketError::NoDescriptors);
    }
    match socket::receive_few(socket, buffer) {
        Err(SocketError::NoDescriptors) => {
            let _lent = spare.lend();
            socket::receive_few(socket, buffer)
        }
        received => received,
    }
}

/// Receives packets for the time of one turn, or until `unread` packets wait for the session to read them. Returns
/// whether the socket is empty now.
fn receive_some(
    control: &Rc<RefCell<ControlPlane>>,
    socket: &AsyncFd<PassedFd>,
    id: &SessionId,
    bell: &Rc<Notify>,
    buffer: &mut Vec<u8>,
    unread: usize,
) -> Result<bool, String> {
    let control = &mut *control.borrow_mut();
    if !control.is_current(id, bell) {
        return Err("it came back on another connection".into());
    }
    let (mut outcome, begin) = (Ok(false), Instant::now());
    let queued = |c: &ControlPlane| c.registry.session(id).map_or(0, SessionEntry::queued);
    while begin.elapsed() < PART && queued(control) < unread {
        match receive(&control.spare, socket.get_ref(), buffer) {
            Ok(ReceivedMessage { message: SessionMessage::StatusRequest, .. }) => {
                send_status(control, id)
            }
            Ok(ReceivedMessage { message: SessionMessage::Reload, .. }) => control.ask_reload(id),
            Ok(ReceivedMessage { message: SessionMessage::AccessCheck(check), .. }) => {
                control.ask_decisions(id, check);
            }
            // A memfd is the only descriptor that is handed over after HELLO, and the only one that the daemon reads:
            // reading any other file may block.
            Ok(ReceivedMessage { descriptors, .. })
                if !descriptors.iter().all(PassedFd::is_memfd) =>
            {
                tracing::warn!(session = %id, "a session that sent no memfd was disconnected");
                outcome = Err("it sent a descriptor that is no memfd".into());
                break;
            }
            Ok(ReceivedMessage { message, descriptors }) => {
                control.traffic.packets_in += 1;
                // The session continues without a segment. Without its connection, it would have to come back with all
                // its endpoints.
                if matches!(message, SessionMessage::Segment(_))
                    && let Some(why) = no_room_for_segment(control, id)
                {
                    control.registry.refuse_segment(id, &why);
                    continue;
                }
                let descriptors = descriptors.into_iter().map(Arc::new).collect();
                if let Err(violation) = control.registry.handle_message(id, message, descriptors) {
                    tracing::warn!(session = %id, %violation, "a session was disconnected");
                    outcome = Err(violation.to_string());
                    break;
                }
            }
            Err(SocketError::NotReady) => {
                outcome = Ok(true);
                break;
            }
            Err(error) => {
                if !matches!(error, SocketError::Closed) {
                    tracing::warn!(session = %id, %error, "a session was disconnected");
                }
                outcome = Err(error.to_string());
                break;
            }
        }
    }
    control.settle();
    outcome
}

/// Returns the reason why the daemon has no descriptor for another segment of a session, if so.
fn no_room_for_segment(control: &ControlPlane, id: &SessionId) -> Option<String> {
    let pid = control.registry.session(id)?.pid;
    DescriptorRoom::of(&control.registry, pid)?.refuses_segment()
}

async fn ended(death: Option<&AsyncFd<Arc<PassedFd>>>) {
    match death {
        Some(pidfd) => drop(pidfd.readable().await),
        None => std::future::pending().await,
    }
}

/// Sends a message to a new connection, whose socket has space. Returns whether it was sent.
pub(super) fn say(
    socket: &AsyncFd<PassedFd>,
    message: SessionMessage,
    descriptors: &[BorrowedFd<'_>],
) -> bool {
    let packet = message.encode();
    let sent = packet.map(|packet| socket::send(socket.get_ref(), &packet, descriptors));
    matches!(sent, Ok(Ok(())))
}
