use axon_shm::ids::{Gid, SessionId};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    internal::wire::session::{Announce, EndpointRole, Message, SessionRole},
};

use super::*;

const SESSION: SessionId = SessionId([1; 16]);
const DAEMON: DaemonId = DaemonId([2; 16]);

fn control() -> Control {
    Control::new(Arc::new(Config::default()), Vec::new(), Spare::default())
}

/// A link over which a route of topic /t does not cross.
fn link(control: &mut Control) {
    let mut status = LinkStatus::default();
    status.peer = DAEMON.to_string();
    let refused = RefusedRoute {
        topic: "/t".into(),
        type_name: None,
        waits: EndpointKind::Subscription,
        reason: "no room".into(),
    };
    control.gateway_says(ToControl::Link(Box::new(status), vec![refused]));
}

/// How often the session is told that a route does not cross.
fn told(control: &mut Control) -> usize {
    let packets = std::iter::from_fn(|| control.registry.poll_output(&SESSION));
    packets.filter(|out| matches!(Message::decode(&out.packet), Ok(Message::Refused(_)))).count()
}

#[test]
fn a_gateway_that_ended_leaves_no_refused_route_and_sessions_are_told_by_the_next() {
    let mut control = control();
    let (role, name) = (SessionRole::Application, String::new());
    control.registry.handle_connect(SESSION, role, name, 1, None, None).unwrap();
    let endpoint = Endpoint::new(Gid::new(SESSION, 1), EndpointKind::Subscription, "/t", "T");
    let role = EndpointRole::Application;
    let announce = Announce { endpoint, role, stands_for: vec![], ring: None, only: None };
    control.registry.handle_message(&SESSION, Message::Endpoint(announce), vec![]).unwrap();
    told(&mut control);
    link(&mut control);
    assert_eq!(told(&mut control), 1);
    link(&mut control);
    assert_eq!(told(&mut control), 0, "once while the peer is linked");

    control.gateway_ended("failed");
    assert!(control.links.is_empty() && control.refused_routes.is_empty());
    link(&mut control);
    assert_eq!(told(&mut control), 1);
}
