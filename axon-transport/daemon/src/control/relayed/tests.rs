//! Tests a relay with a simulated process and a simulated control plane.

use std::time::Duration;

use axon_shm::ids::DaemonId;
use axon_transport::config::OsFiles;
use rustix::{
    event::{PollFd, PollFlags, poll},
    net::{AddressFamily, SocketFlags, SocketType, socketpair},
};

use super::*;

/// Timeout of a wait; only a lost message takes this long.
const EVER: Duration = Duration::from_secs(60);

fn pair() -> [OwnedFd; 2] {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None).unwrap().into()
}

fn say(socket: &OwnedFd, message: &SessionMessage) {
    socket::send(socket, &message.encode().unwrap(), &[]).unwrap();
}

/// Waits for the next message that `pick` accepts.
#[track_caller]
fn hear<T>(socket: &OwnedFd, mut pick: impl FnMut(SessionMessage) -> Option<T>) -> T {
    loop {
        match socket::receive(socket, &mut Vec::new()) {
            Ok(received) => {
                if let Some(picked) = pick(received.message) {
                    return picked;
                }
            }
            Err(SocketError::NotReady) => {
                let mut fds = [PollFd::new(socket, PollFlags::IN)];
                assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1), "in vain");
            }
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn a_relayed_process_receives_the_control_planes_refusal() {
    let ([process, far], [control, inside]) = (pair(), pair());
    let id = SessionId::random();
    let relay = DaemonRelay {
        socket: PassedFd::connection(far),
        inside,
        config: Arc::new(Config::resolve([], None, &OsFiles).unwrap()),
        name: "t".into(),
        id,
        tally: Arc::default(),
        pool: ArrivalPool::new(0),
        losses: Arc::default(),
    };
    relay.start().unwrap();
    hear(&control, |message| matches!(message, SessionMessage::Hello(_)).then_some(()));
    let pid = std::process::id();
    let welcome =
        Welcome { protocol: PROTOCOL, daemon: DaemonId([7; 16]), pid, ranges: Some(true) };
    say(&control, &SessionMessage::Welcome(welcome));
    hear(&process, |message| matches!(message, SessionMessage::Welcome(_)).then_some(()));
    let all = [
        EndpointKind::Publisher,
        EndpointKind::Subscription,
        EndpointKind::Client,
        EndpointKind::Server,
        EndpointKind::Node,
    ];
    for (number, kind) in (1..).zip(all) {
        let named = |name: &str| if kind == EndpointKind::Node { "" } else { name }.to_owned();
        let endpoint = Endpoint::new(Gid::new(id, number), kind, named("/t"), named("T"))
            .with_node("n", String::new());
        let (gid, role) = (endpoint.gid, EndpointRole::Application);
        let (stands_for, ring, only) = (Vec::new(), None, None);
        say(
            &process,
            &SessionMessage::Endpoint(Announce { endpoint, role, stands_for, ring, only }),
        );
        let announced = hear(&control, |message| match message {
            SessionMessage::Endpoint(announce) => Some(announce.endpoint),
            _ => None,
        });
        assert_eq!(announced.gid, gid);
        say(&control, &SessionMessage::Refused(SessionRefused::of(&announced, "there are enough")));
        let refused = hear(&process, |message| match message {
            SessionMessage::Refused(refused) => Some(refused),
            _ => None,
        });
        assert_eq!(refused.endpoint, Some(gid), "{kind:?}");
        assert!(refused.text.contains("there are enough"), "{}", refused.text);
        // The session also gives the endpoint up.
        hear(&control, |message| {
            matches!(message, SessionMessage::EndpointGone(gone) if gone.gid == gid).then_some(())
        });
    }
}
