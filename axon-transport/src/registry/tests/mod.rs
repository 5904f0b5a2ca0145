//! The registry under random sessions, some of them slow, checked against the guarantees for sessions. In the end
//! every session knows the graph, exactly the right pairs are attached at both ends, and a session receives another
//! session's descriptors exactly when it holds none.

mod cases;
mod unmet;
mod users;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use axon_shm::internal::Location;
use proptest::prelude::*;

use super::*;
use crate::{
    graph::EndpointKind,
    qos::{Qos, Reliability, compatible},
    wire::session::{
        Announce, Gone, Granted, Pair, Segment, SegmentName, SegmentOpened, SessionMessage, Unmatch,
    },
};

/// A descriptor in these tests: the session that owns it, and its name.
type Label = (SessionId, &'static str);

fn session_id(number: u8) -> SessionId {
    SessionId([number; 16])
}

fn handed(id: SessionId) -> [Label; 3] {
    [(id, "segment"), (id, "doorbell"), (id, "pidfd")]
}

fn endpoint(gid: Gid, kind: EndpointKind, topic: u8, qos: Qos) -> Endpoint {
    Endpoint { topic: format!("/t{topic}"), qos, ..Endpoint::example(gid, kind) }
}

const PLACE: Location = Location { segment: 0, offset: 4096 };

fn announce(endpoint: Endpoint) -> SessionMessage {
    announce_as(endpoint, EndpointRole::Application)
}

fn announce_as(endpoint: Endpoint, role: EndpointRole) -> SessionMessage {
    let has = matches!(endpoint.kind, EndpointKind::Publisher | EndpointKind::Client);
    let ring = has.then_some(PLACE);
    SessionMessage::Endpoint(Announce { endpoint, role, stands_for: vec![], ring, only: None })
}

/// A session that behaves like the client, without rings.
#[derive(Debug, Default)]
struct Client {
    id: SessionId,
    connected: bool,
    number: u32,
    endpoints: BTreeMap<Gid, Endpoint>,
    attached: BTreeSet<Pair>,
    held: HashMap<SessionId, HashSet<Pair>>,
    /// Its own segments, and those of the sessions whose memory it holds.
    segments: BTreeMap<u32, Segment>,
    mapped: HashMap<SessionId, BTreeSet<u32>>,
    /// The segments that were sent since the daemon began to send the complete state. The daemon does not report that
    /// others are gone.
    named: HashMap<SessionId, BTreeSet<u32>>,
    graph: BTreeMap<Gid, Option<DaemonId>>,
    building: Option<BTreeMap<Gid, Option<DaemonId>>>,
    repeated: Option<HashSet<Pair>>,
    told: bool,
    outgoing: Vec<(SessionMessage, Vec<Label>)>,
}

impl Client {
    fn hold(
        &mut self,
        of: SessionId,
        pair: Pair,
        output: &SessionPacket<Label>,
        segments: &[Segment],
    ) {
        let came = &output.descriptors;
        let (came, maps) = came.split_at(came.len() - segments.len());
        for (segment, label) in segments.iter().zip(maps) {
            self.map(of, segment, label);
        }
        if of == self.id {
            assert!(came.is_empty(), "one's own descriptors");
            return;
        }
        let pairs = self.held.entry(of).or_default();
        // The grant of a session that has ended is kept for its reader, and brings everything that the reader may lack.
        if pairs.is_empty() || output.kept_for.is_some() {
            assert_eq!(came, handed(of), "descriptors that are needed");
        } else {
            assert!(came.is_empty(), "descriptors that are held already");
        }
        pairs.insert(pair);
    }

    fn map(&mut self, of: SessionId, segment: &Segment, label: &Label) {
        assert_eq!(*label, (of, "map"));
        for held in [&mut self.mapped, &mut self.named] {
            held.entry(of).or_default().insert(segment.number);
        }
    }

    fn release(&mut self, pair: &Pair) {
        self.held.retain(|of, pairs| {
            pairs.remove(pair);
            if pairs.is_empty() {
                self.mapped.remove(of);
                self.named.remove(of);
            }
            !pairs.is_empty()
        });
    }

    fn handle(&mut self, output: &SessionPacket<Label>) {
        let fds = &output.descriptors;
        match SessionMessage::decode(&output.packet).unwrap() {
            SessionMessage::Graph(graph) => {
                if graph.whole {
                    self.building = Some(BTreeMap::new());
                    self.held.clear();
                    self.named.clear();
                    self.repeated = self.told.then(HashSet::new);
                    self.told = true;
                }
                let view = self.building.as_mut().unwrap_or(&mut self.graph);
                graph.removed.iter().for_each(|gid| {
                    view.remove(gid);
                });
                view.extend(graph.added.iter().map(|i| (i.endpoint.gid, i.daemon)));
                if !graph.more {
                    if let Some(view) = self.building.take() {
                        self.graph = view;
                    }
                    if let Some(repeated) = self.repeated.take() {
                        self.attached.retain(|pair| repeated.contains(pair));
                        self.mapped.clone_from(&self.named);
                    }
                }
            }
            SessionMessage::Match(pair) => {
                if let Some(repeated) = &mut self.repeated {
                    repeated.insert(pair);
                }
                if let Some(reader) = self.endpoints.get(&pair.reader) {
                    let attach = Attach {
                        reader: pair.reader,
                        writer: pair.writer,
                        lane: PLACE,
                        qos: reader.qos,
                        session: self.id,
                        stands_for: None,
                        segments: vec![],
                        after: None,
                        carries: None,
                    };
                    self.outgoing.push((SessionMessage::Attach(attach), vec![]));
                }
            }
            SessionMessage::Attach(attach) => {
                let pair = Pair { reader: attach.reader, writer: attach.writer };
                if let Some(repeated) = &mut self.repeated {
                    repeated.insert(pair);
                }
                self.hold(attach.session, pair, output, &attach.segments);
                if self.endpoints.contains_key(&pair.writer) {
                    self.attached.insert(pair);
                    let Pair { reader, writer } = pair;
                    let session = self.id;
                    let grant = Granted {
                        reader,
                        writer,
                        generation: 1,
                        first: 0,
                        session,
                        ring: PLACE,
                        segments: vec![],
                        after: None,
                        relayed: None,
                    };
                    self.outgoing.push((SessionMessage::Grant(grant), vec![]));
                }
            }
            SessionMessage::Grant(grant) => {
                let pair = Pair { reader: grant.reader, writer: grant.writer };
                if let Some(repeated) = &mut self.repeated {
                    repeated.insert(pair);
                }
                self.hold(grant.session, pair, output, &grant.segments);
                if self.endpoints.contains_key(&pair.reader) {
                    self.attached.insert(pair);
                }
            }
            SessionMessage::Unmatch(Unmatch { reader, writer, .. }) => {
                self.release(&Pair { reader, writer });
                self.attached.remove(&Pair { reader, writer });
            }
            SessionMessage::Detach(pair) => {
                self.release(&pair);
                self.attached.remove(&pair);
            }
            SessionMessage::Segment(SegmentOpened { session, segment }) => {
                self.map(session, &segment, &fds[0]);
            }
            SessionMessage::SegmentGone(SegmentName { session, number }) => {
                for held in [&mut self.mapped, &mut self.named] {
                    if let Some(numbers) = held.get_mut(&session) {
                        numbers.remove(&number);
                    }
                }
            }
            other => panic!("a session is never told {other:?}"),
        }
    }
}

#[derive(Clone, Debug)]
enum Step {
    Connect(u8),
    Disconnect(u8),
    Add {
        session: u8,
        topic: u8,
        writes: bool,
        reliable: bool,
    },
    Remove {
        session: u8,
        which: prop::sample::Index,
    },
    /// The session's messages arrive.
    Up(u8),
    /// Some packets reach the session.
    Down(u8, u8),
    Flush,
    Resync(u8),
    Remote {
        daemon: u8,
        reset: bool,
        add: u8,
        remove: u8,
    },
    RemoteGone(u8),
    /// The session opens a segment, for all publishers or for one.
    Open {
        session: u8,
        which: Option<prop::sample::Index>,
    },
    Close {
        session: u8,
        which: prop::sample::Index,
    },
    /// The session asks for a segment of another session, which may exist or not.
    Need {
        session: u8,
        of: u8,
        number: u32,
    },
}

const SESSIONS: u8 = 5;

fn step() -> impl Strategy<Value = Step> {
    let session = 0..SESSIONS;
    prop_oneof![
        2 => session.clone().prop_map(Step::Connect),
        1 => session.clone().prop_map(Step::Disconnect),
        8 => (session.clone(), 0u8..3, any::<bool>(), prop::bool::weighted(0.7)).prop_map(
            |(session, topic, writes, reliable)| Step::Add { session, topic, writes, reliable }
        ),
        4 => (session.clone(), any::<prop::sample::Index>())
            .prop_map(|(session, which)| Step::Remove { session, which }),
        8 => session.clone().prop_map(Step::Up),
        8 => (session.clone(), 0u8..40).prop_map(|(s, n)| Step::Down(s, n)),
        4 => Just(Step::Flush),
        1 => session.clone().prop_map(Step::Resync),
        4 => (session.clone(), prop::option::of(any::<prop::sample::Index>()))
            .prop_map(|(session, which)| Step::Open { session, which }),
        2 => (session.clone(), any::<prop::sample::Index>())
            .prop_map(|(session, which)| Step::Close { session, which }),
        1 => (session.clone(), session, 0u32..9)
            .prop_map(|(session, of, number)| Step::Need { session, of, number }),
        2 => (0u8..3, any::<bool>(), 0u8..8, 0u8..8)
            .prop_map(|(daemon, reset, add, remove)| Step::Remote { daemon, reset, add, remove }),
        1 => (0u8..3).prop_map(Step::RemoteGone),
    ]
}

#[derive(Default)]
struct World {
    registry: Registry<Label>,
    clients: BTreeMap<u8, Client>,
    generation: u8,
}

impl World {
    fn up(&mut self, session: u8) -> bool {
        let Some(client) = self.clients.get_mut(&session).filter(|c| c.connected) else {
            return false;
        };
        let outgoing = std::mem::take(&mut client.outgoing);
        let any = !outgoing.is_empty();
        for (message, descriptors) in outgoing {
            self.registry.handle_message(&client.id, message, descriptors).unwrap();
        }
        any
    }

    fn down(&mut self, session: u8, count: usize) -> bool {
        let Some(client) = self.clients.get_mut(&session).filter(|c| c.connected) else {
            return false;
        };
        let mut any = false;
        for _ in 0..count {
            let Some(output) = self.registry.poll_output(&client.id) else { break };
            client.handle(&output);
            any = true;
        }
        any
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Connect(session) => {
                self.take(Step::Disconnect(session));
                self.generation = self.generation.wrapping_add(SESSIONS);
                let id = session_id(self.generation.wrapping_add(session));
                self.registry
                    .handle_connect(
                        id,
                        SessionRole::Application,
                        String::new(),
                        1,
                        Some(handed(id)),
                        None,
                    )
                    .unwrap();
                let client = Client { id, connected: true, ..Client::default() };
                self.clients.insert(session, client);
            }
            Step::Disconnect(session) => {
                if let Some(client) = self.clients.remove(&session) {
                    self.registry.handle_disconnect(&client.id);
                }
            }
            Step::Add { session, topic, writes, reliable } => {
                let Some(client) = self.clients.get_mut(&session) else { return };
                client.number += 1;
                let gid = Gid::new(client.id, client.number);
                let kind =
                    if writes { EndpointKind::Publisher } else { EndpointKind::Subscription };
                let reliability =
                    if reliable { Reliability::Reliable } else { Reliability::BestEffort };
                let new = endpoint(gid, kind, topic, Qos::default().with_reliability(reliability));
                client.endpoints.insert(gid, new.clone());
                client.outgoing.push((announce(new), vec![]));
            }
            Step::Remove { session, which } => {
                let Some(client) = self.clients.get_mut(&session) else { return };
                if client.endpoints.is_empty() {
                    return;
                }
                let gid =
                    *client.endpoints.keys().nth(which.index(client.endpoints.len())).unwrap();
                client.endpoints.remove(&gid);
                client.attached.retain(|p| p.reader != gid && p.writer != gid);
                client.outgoing.push((SessionMessage::EndpointGone(Gone { gid }), vec![]));
            }
            Step::Up(session) => drop(self.up(session)),
            Step::Down(session, count) => drop(self.down(session, count.into())),
            Step::Flush => self.registry.flush(),
            Step::Resync(session) => {
                if let Some(client) = self.clients.get_mut(&session) {
                    client.outgoing.push((SessionMessage::Resync, vec![]));
                }
            }
            Step::Remote { daemon, reset, add, remove } => {
                let gid = |n: u8| Gid([100 + daemon.wrapping_mul(8) + n; 16]);
                let kind = EndpointKind::Publisher;
                let added = vec![endpoint(gid(add), kind, 0, Qos::default())];
                let id = DaemonId([daemon; 16]);
                self.registry.remote_graph(id, reset, added, vec![gid(remove)]);
            }
            Step::Open { session, which } => {
                let Some(client) = self.clients.get_mut(&session) else { return };
                client.number += 1;
                let own = |at: prop::sample::Index| {
                    let all = &client.endpoints;
                    (!all.is_empty()).then(|| *all.keys().nth(at.index(all.len())).unwrap())
                };
                let segment = Segment { number: client.number, publisher: which.and_then(own) };
                client.segments.insert(segment.number, segment);
                let opened = SegmentOpened { session: client.id, segment };
                client.outgoing.push((SessionMessage::Segment(opened), vec![(client.id, "map")]));
            }
            Step::Close { session, which } => {
                let Some(client) = self.clients.get_mut(&session) else { return };
                if client.segments.is_empty() {
                    return;
                }
                let at = which.index(client.segments.len());
                let number = *client.segments.keys().nth(at).unwrap();
                client.segments.remove(&number);
                let gone = SegmentName { session: client.id, number };
                client.outgoing.push((SessionMessage::SegmentGone(gone), vec![]));
            }
            Step::Need { session, of, number } => {
                let Some(of) = self.clients.get(&of).map(|client| client.id) else { return };
                let Some(client) = self.clients.get_mut(&session) else { return };
                let need = SegmentName { session: of, number };
                client.outgoing.push((SessionMessage::Need(need), vec![]));
            }
            Step::RemoteGone(daemon) => self.registry.remote_gone(&DaemonId([daemon; 16])),
        }
    }

    fn settle(&mut self) {
        for _ in 0..1000 {
            self.registry.flush();
            let mut any = false;
            for session in 0..SESSIONS {
                any |= self.up(session);
                any |= self.down(session, usize::MAX);
            }
            if !any && !self.registry.needs_flush() {
                return;
            }
        }
        panic!("the sessions never stop talking");
    }

    fn check_settled(&self) {
        let all: Vec<(SessionId, &Endpoint)> =
            self.clients.values().flat_map(|c| c.endpoints.values().map(|e| (c.id, e))).collect();
        let mut graph: BTreeMap<Gid, Option<DaemonId>> =
            all.iter().map(|(_, e)| (e.gid, None)).collect();
        graph.extend(self.registry.remote_endpoints().map(|(d, e)| (e.gid, Some(*d))));
        let mut pairs: BTreeMap<SessionId, BTreeSet<Pair>> = BTreeMap::new();
        for (writer_session, writer) in &all {
            for (reader_session, reader) in &all {
                let pair = Pair { reader: reader.gid, writer: writer.gid };
                if writer.kind == EndpointKind::Publisher
                    && reader.kind == EndpointKind::Subscription
                    && writer.topic == reader.topic
                    && compatible(&writer.qos, &reader.qos).is_ok()
                {
                    pairs.entry(*writer_session).or_default().insert(pair);
                    pairs.entry(*reader_session).or_default().insert(pair);
                }
            }
        }
        for client in self.clients.values() {
            assert_eq!(client.graph, graph, "the graph of {}", client.id);
            let expected = pairs.remove(&client.id).unwrap_or_default();
            assert_eq!(client.attached, expected, "the pairs of {}", client.id);
            let entry = self.registry.session(&client.id).unwrap();
            assert_eq!(entry.held.pairs(), client.held, "what {} holds", client.id);
            for pair in client.attached.iter().filter(|p| client.endpoints.contains_key(&p.reader))
            {
                self.check_mapped(client, pair);
            }
        }
        assert_eq!(self.registry.endpoints.iter().count(), all.len());
        assert!(self.registry.endpoints.topics().all(|m| m.writers.len() + m.readers.len() > 0));
        assert_eq!(self.registry.sessions.iter().count(), self.clients.len());
    }
}

impl World {
    /// Checks that a reader has all the memory that may contain its writer's samples.
    fn check_mapped(&self, client: &Client, pair: &Pair) {
        let owner = |c: &&Client| c.endpoints.contains_key(&pair.writer);
        let of = self.clients.values().find(owner).expect("a writer that is attached to");
        if of.id == client.id {
            return;
        }
        let none = BTreeSet::new();
        let mapped = client.mapped.get(&of.id).unwrap_or(&none);
        for segment in of.segments.values() {
            if segment.publisher.is_none_or(|publisher| publisher == pair.writer) {
                let number = segment.number;
                assert!(mapped.contains(&number), "{} lacks {number} of {}", client.id, of.id);
            }
        }
        assert!(mapped.iter().all(|number| of.segments.contains_key(number)), "gone is gone");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(256) })]

    #[test]
    fn all_sessions_converge_after_random_steps(steps in prop::collection::vec(step(), 0..400)) {
        let mut world = World::default();
        for step in steps {
            world.take(step);
            for (_, entry) in world.registry.sessions.iter() {
                entry.outbox.check();
            }
        }
        world.settle();
        world.check_settled();
    }
}
