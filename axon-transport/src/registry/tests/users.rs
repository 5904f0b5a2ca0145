//! The rights of other users of the host: two sessions of the daemon's user, two of others.

use std::collections::BTreeSet;

use axon_shm::internal::Location;

use crate::{
    access::AccessRules,
    graph::{Endpoint, EndpointKind, RemoteEndpoint},
    ids::{DaemonId, Gid, SessionId},
    registry::Registry,
    wire::session::{Announce, EndpointRole, Pair, SessionMessage, SessionRole},
};

use EndpointKind::{Node, Publisher, Subscription};

type Label = &'static str;

/// The sessions of the daemon's own user.
const OWN: [u8; 2] = [1, 2];
/// The sessions of other users.
const USER: [(u8, u32); 2] = [(3, 1001), (4, 1002)];
const GATEWAY: u8 = 100;

fn id(number: u8) -> SessionId {
    SessionId([number; 16])
}

struct World(Registry<Label>);

impl World {
    fn new(rules: &str) -> Self {
        let mut world = Self(Registry::default());
        world.set(rules);
        world.connect(GATEWAY, SessionRole::Gateway);
        OWN.into_iter().for_each(|number| world.connect(number, SessionRole::Application));
        for (number, user) in USER {
            world.connect(number, SessionRole::Application);
            world.0.set_user(&id(number), user);
        }
        world
    }

    fn set(&mut self, rules: &str) {
        self.0.set_access(AccessRules::parse(rules, "access.toml").unwrap());
    }

    fn connect(&mut self, number: u8, role: SessionRole) {
        let handed = Some(["segment", "doorbell", "pidfd"]);
        self.0.handle_connect(id(number), role, String::new(), 1, handed, None).unwrap();
    }

    fn drain(&mut self, number: u8) -> Vec<SessionMessage> {
        std::iter::from_fn(|| self.0.poll_output(&id(number)))
            .map(|output| SessionMessage::decode(&output.packet).unwrap())
            .collect()
    }

    fn own(&mut self, session: u8, kind: EndpointKind, topic: &str) -> Gid {
        let number = self.0.session(&id(session)).unwrap().endpoints.len() as u32;
        let gid = Gid::new(id(session), number);
        let mut endpoint = Endpoint::example(gid, kind);
        endpoint.topic = topic.into();
        if kind == Node {
            (endpoint.type_name, endpoint.node) = (String::new(), "node".into());
            (endpoint.namespace, endpoint.topic) = ("/ns".into(), String::new());
        }
        let ring = (kind == Publisher).then_some(Location { segment: 0, offset: 4096 });
        let (role, stands_for, only) = (EndpointRole::Application, Vec::new(), None);
        let announce = Announce { endpoint, role, stands_for, ring, only };
        self.0.handle_message(&id(session), SessionMessage::Endpoint(announce), vec![]).unwrap();
        gid
    }

    fn pairs(&self) -> BTreeSet<Pair> {
        self.0.pairs.keys().copied().collect()
    }

    /// Returns the GIDs that a session sees after it was sent the complete state.
    fn seen(&mut self, session: u8) -> BTreeSet<Gid> {
        self.0.flush();
        self.0.sessions.request_resync(&id(session));
        let mut seen = BTreeSet::new();
        for message in self.drain(session) {
            let SessionMessage::Graph(graph) = message else { continue };
            if graph.whole {
                seen.clear();
            }
            graph.removed.iter().for_each(|gid| {
                seen.remove(gid);
            });
            seen.extend(graph.added.iter().map(|item| item.endpoint.gid));
        }
        seen
    }
}

const RULES: &str = "[[allow]]\npeer = \"uid:1001\"\npublish = \"/in\"\nsubscribe = \"/out\"";

#[test]
fn another_user_has_the_pairs_that_rules_allow_it_and_the_own_user_all() {
    let mut world = World::new(RULES);
    let all = ["/in", "/out"].map(|topic| {
        let w = [1, 3, 4].map(|session| world.own(session, Publisher, topic));
        let r = [2, 3, 4].map(|session| world.own(session, Subscription, topic));
        (w, r)
    });
    let pairs = world.pairs();
    let has = |writer: Gid, reader: Gid| pairs.contains(&Pair { reader, writer });
    let [(in_w, in_r), (out_w, out_r)] = all;
    // Session 3 may publish /in and subscribe to /out; 4 is named by no rule.
    assert!(has(in_w[1], in_r[0]) && has(in_w[1], in_r[2]));
    assert!(!has(in_w[0], in_r[1]) && !has(in_w[2], in_r[1]), "3 may not subscribe to /in");
    assert!(has(out_w[0], out_r[1]) && has(out_w[2], out_r[1]));
    assert!(!has(out_w[1], out_r[0]) && !has(out_w[1], out_r[2]), "3 may not publish /out");
    assert!(has(out_w[0], out_r[0]) && has(in_w[2], in_r[0]) && has(in_w[0], in_r[2]));
    // Denied endpoints are in no graph, including the gateway's.
    let denied = [in_r[1], out_w[1]];
    for session in [1, 4, GATEWAY] {
        let seen = world.seen(session);
        assert!(denied.iter().all(|gid| !seen.contains(gid)), "{session}");
        assert!(seen.contains(&in_w[1]) && seen.contains(&out_r[1]), "{session}");
    }
    // The session sees what it needs.
    let seen = world.seen(3);
    assert!(seen.contains(&in_r[0]) && seen.contains(&out_w[0]));
    assert!(!seen.contains(&in_w[0]) && !seen.contains(&out_r[0]), "{seen:?}");
}

#[test]
fn the_refusals_name_a_denied_endpoint_and_its_rule_and_its_session_keeps_it() {
    let mut world = World::new(&format!("{RULES}\n[[deny]]\npeer = \"local\"\npublish = \"/in\""));
    world.drain(3);
    world.own(3, Publisher, "/in");
    let told = world.drain(3);
    let refused: Vec<_> = told.iter().filter(|m| matches!(m, SessionMessage::Refused(_))).collect();
    let [SessionMessage::Refused(refused)] = refused[..] else { panic!("{told:?}") };
    assert_eq!(refused.endpoint, None, "an endpoint would be refused for good");
    assert!(refused.text.contains("denied by line 7 of access.toml"), "{}", refused.text);
    let said = world.0.take_refused();
    assert!(said.len() == 1 && said[0].1.contains("denied by line 7 of access.toml"), "{said:?}");
    // The same rules once more cause no message; other rules do.
    world.set(&format!("{RULES}\n[[deny]]\npeer = \"local\"\npublish = \"/in\""));
    assert!(world.0.take_refused().is_empty());
    assert!(!world.drain(3).iter().any(|m| matches!(m, SessionMessage::Refused(_))));
    world.set("default = \"allow\"");
    world.set("default = \"deny\"");
    assert!(world.0.take_refused()[0].1.contains("default = "));
}

#[test]
fn rules_that_change_end_pairs_and_make_pairs_at_once() {
    let mut world = World::new(RULES);
    let (publisher, subscription) =
        (world.own(3, Publisher, "/in"), world.own(2, Subscription, "/in"));
    let node = world.own(1, Node, "");
    let pair = Pair { reader: subscription, writer: publisher };
    assert!(world.pairs().contains(&pair));
    [2, 3].into_iter().for_each(|session| drop(world.drain(session)));
    assert!(!world.seen(3).contains(&node));
    world.set("default = \"deny\"");
    assert!(world.pairs().is_empty());
    let told = world.drain(2);
    let unmatched =
        |m: &SessionMessage| matches!(m, SessionMessage::Unmatch(u) if u.writer == publisher);
    assert!(told.iter().any(unmatched), "{told:?}");
    assert!(!world.seen(2).contains(&publisher) && !world.seen(3).contains(&subscription));
    world.set("[[allow]]\npeer = \"local\"\npublish = \"**\"\nsee = \"/ns/*\"");
    assert!(world.pairs().contains(&pair));
    assert!(world.seen(2).contains(&publisher) && world.seen(3).contains(&node));
    // The same rules once more change nothing.
    world.set("[[allow]]\npeer = \"local\"\npublish = \"**\"\nsee = \"/ns/*\"");
    assert!(world.pairs().contains(&pair));
}

#[test]
fn another_user_sees_only_permitted_endpoints_of_other_hosts() {
    let mut world = World::new(RULES);
    let gids = ["/out", "/in"].map(|topic| {
        let mut gid = Gid([9; 16]);
        gid.0[15] = topic.len() as u8;
        let mut endpoint = Endpoint::example(gid, Publisher);
        endpoint.topic = topic.into();
        let remote = vec![RemoteEndpoint::from(endpoint)];
        world.0.remote_graph(DaemonId([200; 16]), false, remote, vec![]);
        gid
    });
    assert_eq!(world.seen(3), BTreeSet::from([gids[0]]));
    assert_eq!(world.seen(4), BTreeSet::from(gids));
}
