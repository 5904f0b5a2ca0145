//! The graph of one host as the other has it: every field of every node and endpoint, and nothing else;
//! a thread that waits for it to change needs to look at no other time.

use std::time::Duration;

use axon_transport::{
    EndpointSpec, Node, Session, Waitable,
    graph::{Endpoint, EndpointKind, GraphView},
    ids::Gid,
    qos::{Durability, History, Liveliness, Qos, Reliability},
};
use rustix::process::Signal;

use super::{
    mode::classic,
    pair::{Host, Plan, signal},
    process::PATIENCE,
};

fn hosts() -> [Host; 2] {
    Plan::new([classic(&[]), classic(&[])]).start()
}

/// A session, and its node, which gets the changes of the graph.
struct Witness {
    session: Session,
    node: Node,
}

impl Witness {
    fn on(host: &Host) -> Self {
        let session = host.session("witness");
        let node = session.create_node("witness", "/", "/").unwrap();
        Self { session, node }
    }

    /// Waits until the graph is as it must be, woken by its changes and by nothing else.
    #[track_caller]
    fn sees(&self, reached: impl Fn(&GraphView) -> bool) {
        while !reached(&self.session.graph()) {
            let changed = [Waitable::GuardCondition(self.node.graph_changed())];
            let woken = self.session.wait_for(&changed, Some(PATIENCE)).unwrap();
            assert_eq!(woken, [0], "nothing changes in {:#?}", self.session.graph());
        }
    }

    /// Returns the endpoints of the graph without those of the node itself.
    fn others(graph: &GraphView) -> Vec<&Endpoint> {
        let all = graph.endpoints.values().map(|entry| &*entry.endpoint);
        all.filter(|endpoint| endpoint.node != "witness").collect()
    }
}

/// Returns a QoS that differs from any default in each of its policies.
fn odd() -> Qos {
    Qos::default()
        .with_reliability(Reliability::BestEffort)
        .with_durability(Durability::TransientLocal)
        .with_depth(7)
        .with_deadline(Duration::from_nanos(3_600_000_000_001))
        .with_lifespan(Duration::from_nanos(5_000_000_003))
        .with_liveliness(Liveliness::ManualByTopic, Duration::from_nanos(7_200_000_000_005))
}

fn named(gid: Gid, node: &str, namespace: &str, enclave: &str) -> Endpoint {
    Endpoint::new(gid, EndpointKind::Node, "", "").with_node(node, namespace).with_enclave(enclave)
}

#[test]
fn the_remote_graph_shows_every_endpoint_field_while_the_endpoint_exists() {
    let [a, b] = hosts();
    let witness = Witness::on(&b);
    let session = a.session("everything");
    let daemon = session.daemon();
    let mut expected: Vec<Endpoint> = Vec::new();
    // The endpoints appear one after another, so that each must be announced.
    let appears = |expected: &mut Vec<Endpoint>, new: Endpoint| {
        let gid = new.gid;
        expected.push(new);
        witness.sees(|graph| graph.endpoints.contains_key(&gid));
        let graph = witness.session.graph();
        assert_eq!(Witness::others(&graph).len(), expected.len());
        for one in expected {
            let entry = &graph.endpoints[&one.gid];
            assert_eq!(*entry.endpoint, *one);
            assert_eq!(entry.daemon, daemon, "whose host it is on");
        }
    };
    let left = session.create_node("left", "/front", "/robot").unwrap();
    appears(&mut expected, named(left.gid(), "left", "/front", "/robot"));
    let right = session.create_node("right", "/front/low", "/").unwrap();
    appears(&mut expected, named(right.gid(), "right", "/front/low", "/"));

    let all = odd().with_history(History::KeepAll).with_depth(3);
    let few = Qos::default().with_depth(4);
    let spec = |topic: &str, hash: u8, qos| {
        EndpointSpec::new(topic, format!("test/Of{hash}"), qos).type_hash(vec![hash; 32])
    };
    let of = |node: &Node, gid, kind, topic: &str, hash: u8, qos| {
        let mut endpoint = named(gid, node.name(), node.namespace(), "");
        endpoint.gid = gid;
        endpoint.kind = kind;
        endpoint.topic = topic.into();
        endpoint.type_name = format!("test/Of{hash}");
        endpoint.type_hash = vec![hash; 32];
        endpoint.qos = qos;
        endpoint.enclave = String::new();
        endpoint
    };
    let publisher = left.create_publisher(spec("/a", 1, odd())).unwrap();
    let kind = EndpointKind::Publisher;
    appears(&mut expected, of(&left, publisher.gid(), kind, "/a", 1, odd()));
    let subscription = right.create_subscription(spec("/b", 2, all)).unwrap();
    let kind = EndpointKind::Subscription;
    appears(&mut expected, of(&right, subscription.gid(), kind, "/b", 2, all));
    let server = left.create_server(spec("/c", 3, few)).unwrap();
    appears(&mut expected, of(&left, server.gid(), EndpointKind::Server, "/c", 3, few));
    let client = right.create_client(spec("/d", 4, odd())).unwrap();
    appears(&mut expected, of(&right, client.gid(), EndpointKind::Client, "/d", 4, odd()));
    // This endpoint has no node, and a type without a name and a hash.
    let bare = session.create_publisher(EndpointSpec::new("/e", "", Qos::default())).unwrap();
    let unknown = {
        let mut endpoint = of(&left, bare.gid(), EndpointKind::Publisher, "/e", 5, Qos::default());
        endpoint.type_name = String::new();
        endpoint.type_hash = Vec::new();
        endpoint.node = String::new();
        endpoint.namespace = String::new();
        endpoint
    };
    appears(&mut expected, unknown);

    let disappears = |gid: Gid| {
        witness.sees(|graph| !graph.endpoints.contains_key(&gid));
    };
    let gone: [(Gid, Box<dyn FnOnce()>); 7] = [
        (client.gid(), Box::new(move || drop(client))),
        (left.gid(), Box::new(move || drop(left))),
        (publisher.gid(), Box::new(move || drop(publisher))),
        (server.gid(), Box::new(move || drop(server))),
        (bare.gid(), Box::new(move || drop(bare))),
        (subscription.gid(), Box::new(move || drop(subscription))),
        (right.gid(), Box::new(move || drop(right))),
    ];
    for (gid, end) in gone {
        end();
        disappears(gid);
        expected.retain(|one| one.gid != gid);
        let graph = witness.session.graph();
        assert_eq!(Witness::others(&graph).len(), expected.len(), "only what ended is gone");
    }
}

#[test]
fn endpoints_of_a_killed_process_leave_the_remote_graph() {
    use EndpointKind::{Client, Publisher, Server, Subscription};
    let [a, b] = hosts();
    let witness = Witness::on(&b);
    for _ in 0..3 {
        let mut node = a.node(&["everything", "/all"]);
        node.wait_ready();
        witness.sees(|graph| {
            let kinds = [Publisher, Subscription, Server, Client];
            kinds.iter().all(|kind| graph.count(*kind, "/all") == 1)
                && graph.has_node("everything", "/of/a/process")
        });
        assert_eq!(Witness::others(&witness.session.graph()).len(), 5);
        signal(node.pid(), Signal::KILL);
        witness.sees(|graph| Witness::others(graph).is_empty());
    }
}
