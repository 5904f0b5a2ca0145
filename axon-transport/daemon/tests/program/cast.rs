//! The code of the processes of a program: each follows the orders of its test, line by line.

use std::{
    collections::{BTreeSet, HashMap},
    time::Duration,
};

use axon_shm::PublishError;
use axon_transport::internal::session::{from_unix_nanos, unix_nanos};
use axon_transport::{
    Client, EndpointSpec, MessageInfo, Node, Publisher, Server, Session, SessionOptions,
    Subscription, Waitable,
    config::{Config, OsFiles},
    events::EventStatus,
    graph::{Endpoint, EndpointKind},
    ids::Gid,
};
use serde::Serialize;

use super::{
    orders::{Call, Described, Kind, Losses, Order, Own, Published, Sample, State, Taken},
    rules::Profile,
    support::{PATIENCE, say, wait_for_the_end},
    watch::Watch,
};

/// The nodes and endpoints of a process, by the numbers that its test assigns.
struct Cast {
    session: Session,
    nodes: HashMap<u64, Node>,
    publishers: HashMap<u64, (Publisher, Watch)>,
    subscriptions: HashMap<u64, (Subscription, Watch)>,
    servers: HashMap<u64, Server>,
    clients: HashMap<u64, Client>,
}

pub(super) fn play() {
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    let session = Session::open(&config, SessionOptions::new("program")).unwrap();
    let mut cast = Cast {
        session,
        nodes: HashMap::new(),
        publishers: HashMap::new(),
        subscriptions: HashMap::new(),
        servers: HashMap::new(),
        clients: HashMap::new(),
    };
    say("ready");
    for line in std::io::stdin().lines() {
        cast.obey(serde_json::from_str(&line.unwrap()).unwrap());
    }
    wait_for_the_end();
}

fn tell(answer: impl Serialize) {
    say(serde_json::to_string(&answer).unwrap());
}

impl Cast {
    fn obey(&mut self, order: Order) {
        match order {
            Order::Create { id, by, what } => tell(self.create(id, by, *what).to_string()),
            Order::Publish { id, stamp, count, len } => tell(self.publish(id, stamp, count, len)),
            Order::Take { id, owed } => tell(self.take(id, owed)),
            Order::AwaitLoss { id } => {
                let (_, watch) = &self.subscriptions[&id];
                let lost = [Waitable::Event(watch.lost())];
                assert_eq!(self.session.wait_for(&lost, Some(PATIENCE)).unwrap(), [0]);
                tell(losses(watch));
            }
            Order::Ask { id, stamp, len } => {
                let mut payload = stamp.to_le_bytes().to_vec();
                payload.resize(8 + usize::try_from(len).unwrap(), stamp as u8);
                tell(self.clients[&id].send_request(&payload).unwrap());
            }
            Order::Answer { id, count } => tell(self.answer(id, count)),
            Order::Hear { id, count } => tell(self.hear(id, count)),
            Order::Wait { some } => tell(self.ready(some)),
            Order::End { id } => {
                self.nodes.remove(&id);
                self.publishers.remove(&id);
                self.subscriptions.remove(&id);
                self.servers.remove(&id);
                self.clients.remove(&id);
                tell(());
            }
            Order::State => tell(self.state()),
        }
    }

    fn create(&mut self, id: u64, by: Option<u64>, what: Described) -> Gid {
        let Described { kind, topic, type_name, hash, profile, node, namespace, enclave } = what;
        if kind == Kind::Node {
            let made = self.session.create_node(&node, &namespace, &enclave).unwrap();
            let gid = made.gid();
            self.nodes.insert(id, made);
            return gid;
        }
        let qos = profile.qos();
        let spec = EndpointSpec::new(topic, type_name, qos).type_hash(hash);
        // The endpoints of a node have its name, whatever they are told.
        let (session, node) = (&self.session, by.map(|by| &self.nodes[&by]));
        macro_rules! make {
            ($create:ident) => {
                node.map_or_else(
                    || session.$create(spec.clone()),
                    |node| node.$create(spec.clone()),
                )
                .unwrap()
            };
        }
        match kind {
            Kind::Node => unreachable!(),
            Kind::Publisher => {
                let made = make!(create_publisher);
                let (gid, watch) = (made.gid(), Watch::publisher(&made));
                self.publishers.insert(id, (made, watch));
                gid
            }
            Kind::Subscription => {
                let made = make!(create_subscription);
                let (gid, watch) = (made.gid(), Watch::subscription(&made));
                self.subscriptions.insert(id, (made, watch));
                gid
            }
            Kind::Server => {
                let made = make!(create_server);
                let gid = made.gid();
                self.servers.insert(id, made);
                gid
            }
            Kind::Client => {
                let made = make!(create_client);
                let gid = made.gid();
                self.clients.insert(id, made);
                gid
            }
        }
    }

    fn publish(&self, id: u64, stamp: i64, count: u64, len: u64) -> Published {
        let (publisher, _) = &self.publishers[&id];
        let mut payload = vec![0; usize::try_from(len).unwrap()];
        let mut first = None;
        for done in 0..count {
            let stamp = stamp + i64::try_from(done).unwrap();
            payload.fill(stamp as u8);
            match publisher.publish_at(from_unix_nanos(stamp), &payload) {
                Ok(sequence) => {
                    let first = *first.get_or_insert(sequence);
                    assert_eq!(sequence, first + done, "a number was left out");
                }
                Err(PublishError::Blocked { .. }) => {
                    return Published { first, count: done, blocked: true };
                }
                Err(error) => panic!("{error}"),
            }
        }
        Published { first, count, blocked: false }
    }

    /// Takes samples until no more of the `owed` ones can come: each was taken, or counts as lost or expired.
    fn take(&self, id: u64, owed: u64) -> Taken {
        let (subscription, watch) = &self.subscriptions[&id];
        let mut samples = Vec::new();
        let mut bytes = Vec::new();
        let mut take = || {
            let info = subscription.take(&mut bytes)?;
            assert!(bytes.iter().all(|byte| *byte == unix_nanos(info.source_timestamp) as u8));
            samples.push((sample(&info, bytes.len()), info.reception));
            Some(())
        };
        let mut taken = 0;
        loop {
            if take().is_some() {
                taken += 1;
                continue;
            }
            let gone = subscription.lost() + subscription.expired();
            if taken + gone >= owed + watch.gone_before() {
                watch.have_gone(gone);
                break;
            }
            let more = [Waitable::Subscription(subscription)];
            if self.session.wait_for(&more, Some(PATIENCE)).unwrap().is_empty() {
                // The test then sees too few samples.
                break;
            }
        }
        let (lost, expired) = (subscription.lost(), subscription.expired());
        Taken { samples, losses: losses(watch), lost, expired }
    }

    /// Answers `count` requests by their content, and checks that there are no more.
    fn answer(&self, id: u64, count: u64) -> BTreeSet<Call> {
        let server = &self.servers[&id];
        let mut bytes = Vec::new();
        let mut taken = BTreeSet::new();
        for _ in 0..count {
            let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
            server.send_response(request.publisher, request.sequence, &bytes).unwrap();
            taken.insert(said(&request.publisher, &bytes));
        }
        assert!(server.take_request(&mut bytes).is_none());
        taken
    }

    /// Takes `count` responses, and checks that there are no more.
    fn hear(&self, id: u64, count: u64) -> BTreeSet<Call> {
        let client = &self.clients[&id];
        let mut bytes = Vec::new();
        let mut taken = BTreeSet::new();
        for _ in 0..count {
            let response = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            taken.insert(said(&response.publisher, &bytes));
        }
        assert!(client.take_response(&mut bytes).is_none());
        taken
    }

    /// Returns the endpoints that a wait for everything finds ready.
    fn ready(&self, some: bool) -> BTreeSet<u64> {
        let subscriptions =
            self.subscriptions.iter().map(|(id, (s, _))| (*id, Waitable::Subscription(s)));
        let servers = self.servers.iter().map(|(id, s)| (*id, Waitable::Server(s)));
        let clients = self.clients.iter().map(|(id, c)| (*id, Waitable::Client(c)));
        let (ids, all): (Vec<u64>, Vec<_>) = subscriptions.chain(servers).chain(clients).unzip();
        let timeout = if some { PATIENCE } else { Duration::ZERO };
        let ready = self.session.wait_for(&all, Some(timeout)).unwrap();
        ready.iter().map(|&index| ids[index]).collect()
    }

    fn state(&self) -> State {
        let all = &self.session.graph().endpoints;
        let graph = all.iter().map(|(gid, entry)| {
            assert_eq!((entry.daemon, *gid), (None, entry.endpoint.gid), "it is of this host");
            (gid.to_string(), described(&entry.endpoint))
        });
        let own = |matched: Vec<Gid>, watch: Option<&Watch>| Own {
            matched: matched.iter().map(ToString::to_string).collect(),
            reported: watch.map(Watch::report),
        };
        let publishers =
            self.publishers.iter().map(|(id, (p, w))| (*id, own(p.matched(), Some(w))));
        let subscriptions =
            self.subscriptions.iter().map(|(id, (s, w))| (*id, own(s.matched(), Some(w))));
        let servers = self.servers.iter().map(|(id, s)| (*id, own(s.clients(), None)));
        let clients = self.clients.iter().map(|(id, c)| (*id, own(c.servers(), None)));
        let own = publishers.chain(subscriptions).chain(servers).chain(clients).collect();
        State { graph: graph.collect(), own }
    }
}

fn losses(watch: &Watch) -> Losses {
    // Querying the event finds losses before any sample is taken.
    watch.lost().is_ready();
    let EventStatus::Counted(status) = watch.lost().take() else { unreachable!() };
    Losses { total: status.total, change: status.change }
}

fn sample(info: &MessageInfo, len: usize) -> Sample {
    Sample {
        publisher: info.publisher.to_string(),
        sequence: info.sequence,
        stamp: unix_nanos(info.source_timestamp),
        len: len as u64,
    }
}

fn described(endpoint: &Endpoint) -> Described {
    let endpoint = endpoint.clone();
    Described {
        kind: match endpoint.kind {
            EndpointKind::Node => Kind::Node,
            EndpointKind::Publisher => Kind::Publisher,
            EndpointKind::Subscription => Kind::Subscription,
            EndpointKind::Server => Kind::Server,
            EndpointKind::Client => Kind::Client,
        },
        topic: endpoint.topic,
        type_name: endpoint.type_name,
        hash: endpoint.type_hash,
        profile: Profile::of(&endpoint.qos).expect("a profile that the test made"),
        node: endpoint.node,
        namespace: endpoint.namespace,
        enclave: endpoint.enclave,
    }
}

/// Returns the sender of a request or response, and its number.
fn said(who: &Gid, bytes: &[u8]) -> Call {
    let (stamp, rest) = bytes.split_first_chunk().unwrap();
    let stamp = u64::from_le_bytes(*stamp);
    assert!(rest.iter().all(|byte| *byte == stamp as u8));
    (who.to_string(), stamp)
}
