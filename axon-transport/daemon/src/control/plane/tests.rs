use std::{fs::File, os::fd::OwnedFd};

use axon_shm::{
    ids::{Gid, SessionId},
    internal::descriptors::PassedFd,
};
use axon_transport::{
    access::AccessRules,
    graph::{Endpoint, EndpointKind},
    internal::wire::session::{AccessCheck, Announce, EndpointRole, SessionMessage, SessionRole},
};
use serde_json::Value;

use super::{super::report::send_status, *};

const SESSION: SessionId = SessionId([1; 16]);
const DAEMON: DaemonId = DaemonId([2; 16]);

fn control() -> ControlPlane {
    ControlPlane::new(Arc::new(Config::default()), Vec::new(), SpareDescriptors::default())
}

/// Adds a link over which a route of topic /t does not cross.
fn link(control: &mut ControlPlane) {
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

/// Returns the number of REFUSED messages that are queued for the session.
fn told(control: &mut ControlPlane) -> usize {
    let packets = std::iter::from_fn(|| control.registry.poll_output(&SESSION));
    packets
        .filter(|out| matches!(SessionMessage::decode(&out.packet), Ok(SessionMessage::Refused(_))))
        .count()
}

#[test]
fn ended_gateway_clears_refused_routes() {
    let mut control = control();
    let (role, name) = (SessionRole::Application, String::new());
    control.registry.handle_connect(SESSION, role, name, 1, None, None).unwrap();
    let endpoint = Endpoint::new(Gid::new(SESSION, 1), EndpointKind::Subscription, "/t", "T");
    let role = EndpointRole::Application;
    let announce = Announce { endpoint, role, stands_for: vec![], ring: None, only: None };
    control.registry.handle_message(&SESSION, SessionMessage::Endpoint(announce), vec![]).unwrap();
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

const RULES: &str = "[[allow]]\npeer = \"uid:7\"\npublish = \"/x\"";

/// Creates a control plane with the given access rules, which may be empty. It has a session of another user and one of
/// its own user, each with an endpoint.
fn with_users(rules: &str) -> ControlPlane {
    let mut config = Config::default();
    if !rules.is_empty() {
        config.access = AccessRules::parse(rules, "access.toml").unwrap();
    }
    config.trusted_uids = vec![7];
    let mut control = ControlPlane::new(Arc::new(config), Vec::new(), SpareDescriptors::default());
    for session in [SESSION, OWN] {
        connect(&mut control, session, false);
        let endpoint = Endpoint::new(Gid::new(session, 1), EndpointKind::Subscription, "/t", "T");
        let role = EndpointRole::Application;
        let announce = Announce { endpoint, role, stands_for: vec![], ring: None, only: None };
        control
            .registry
            .handle_message(&session, SessionMessage::Endpoint(announce), vec![])
            .unwrap();
    }
    control.registry.set_user(&SESSION, 7);
    link(&mut control);
    control
}

const OWN: SessionId = SessionId([3; 16]);

fn connect(control: &mut ControlPlane, session: SessionId, shares_memory: bool) {
    let descriptor = || Arc::new(PassedFd::from(OwnedFd::from(File::open("/dev/null").unwrap())));
    let descriptors = shares_memory.then(|| [(); 3].map(|()| descriptor()));
    let (role, name) = (SessionRole::Application, String::new());
    control.registry.handle_connect(session, role, name, 1, descriptors, None).unwrap();
}

/// Returns the next report for a session.
fn report(control: &mut ControlPlane, session: SessionId) -> Value {
    let mut text = Vec::new();
    while let Some(output) = control.registry.poll_output(&session) {
        if let Ok(SessionMessage::Status(part)) = SessionMessage::decode(&output.packet) {
            text.extend(part.text);
        }
    }
    serde_json::from_slice(&text).unwrap()
}

#[test]
fn another_user_sees_no_details_where_there_are_rules_and_the_own_user_all() {
    for (rules, asks, sees) in [(RULES, SESSION, false), (RULES, OWN, true), ("", SESSION, true)] {
        let mut control = with_users(rules);
        send_status(&mut control, &asks);
        let status = report(&mut control, asks);
        assert!(status["daemon"].as_str().is_some_and(|id| !id.is_empty()), "{status}");
        for details in ["sessions", "topics", "links"] {
            let shown = status[details].as_array().is_some_and(|all| !all.is_empty());
            assert_eq!(shown, sees, "{details} of {status}");
        }
        assert_eq!(status["withheld"], !sees, "{status}");
        let digest = status["access_digest"].as_str().is_some_and(|digest| !digest.is_empty());
        assert_eq!(digest, sees && !rules.is_empty(), "{status}");
    }
}

#[test]
fn another_user_may_neither_reload_nor_query_peer_access() {
    let mut control = with_users("");
    control.ask_reload(&SESSION);
    let answer = report(&mut control, SESSION).to_string();
    assert!(answer.contains("user 7 may not change"), "{answer}");
    assert!(control.reload_asked.is_empty());
    control.ask_decisions(&SESSION, AccessCheck { daemon: DAEMON, uses: Vec::new() });
    let answer = report(&mut control, SESSION).to_string();
    assert!(answer.contains("user 7 may not ask"), "{answer}");
    assert!(control.questions.poll().is_none(), "the peer is not asked");
    control.ask_reload(&OWN);
    assert_eq!(control.reload_asked, [OWN]);
}

#[test]
fn settings_that_changed_end_the_sessions_of_other_users_that_they_exclude() {
    const SHARES: SessionId = SessionId([4; 16]);
    let mut control = with_users("");
    connect(&mut control, SHARES, true);
    control.registry.set_user(&SHARES, 7);
    let is_there = |control: &ControlPlane, id| control.registry.session(&id).is_some();
    let mut config = Config::clone(&control.config);
    config.access = AccessRules::parse(RULES, "access.toml").unwrap();
    control.set_config(config.clone());
    assert!(!is_there(&control, SHARES), "rules cannot be kept to where memory is shared");
    assert!(is_there(&control, SESSION) && is_there(&control, OWN));
    config.trusted_uids.clear();
    control.set_config(config);
    assert!(!is_there(&control, SESSION), "its user is not trusted any more");
    assert!(is_there(&control, OWN));
}
