//! What each process of a program is told to do, and does.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt::Write as _,
    time::Duration,
};

use axon_transport::{
    config::{Config, OsFiles},
    ids::Gid,
    qos::Qos,
    session::{
        Client, EndpointSpec, Publisher, Server, Session, SessionOptions, Subscription, Waitable,
    },
};

use super::{
    model::{State, joined, profile},
    support::{PATIENCE, say, wait_for_the_end},
};

/// Two types of the second topic go by one name and have other hashes.
fn spec(topic: u64, hash: u64, qos: Qos) -> EndpointSpec {
    let type_hash = vec![hash as u8; 4];
    EndpointSpec { type_hash, ..EndpointSpec::new(format!("/t{topic}"), "test/Bytes", qos) }
}

/// With any history: all of them go together.
fn service(number: u64, profile: Qos) -> EndpointSpec {
    let Qos { history, depth, .. } = profile;
    let qos = Qos { history, depth, ..Qos::default() };
    EndpointSpec::new(format!("/s{number}"), "test/Echo", qos)
}

/// The endpoints of a process, by the numbers that its test gives them.
#[derive(Default)]
struct Cast {
    publishers: HashMap<u64, Publisher>,
    subscriptions: HashMap<u64, Subscription>,
    servers: HashMap<u64, Server>,
    clients: HashMap<u64, Client>,
}

impl Cast {
    /// What a subscription has to give: so many samples, and after them none.
    fn take(&self, id: u64, count: u64) -> String {
        let subscription = &self.subscriptions[&id];
        let mut taken = String::new();
        let mut bytes = Vec::new();
        for _ in 0..count {
            match subscription.recv(&mut bytes, Some(PATIENCE)) {
                Some(info) => {
                    let stamp = info.source_timestamp;
                    assert!(bytes.iter().all(|byte| *byte == stamp as u8));
                    write!(taken, "{stamp}/{} ", bytes.len()).unwrap();
                }
                None => taken.push_str("none "),
            }
        }
        if let Some(more) = subscription.take(&mut bytes) {
            write!(taken, "and {}", more.source_timestamp).unwrap();
        }
        format!("{} lost: {}", taken.trim(), subscription.lost())
    }

    /// Answers so many requests by what they say, and finds no more.
    fn answer(&self, id: u64, count: u64) -> String {
        let server = &self.servers[&id];
        let mut bytes = Vec::new();
        let mut taken = BTreeSet::new();
        for _ in 0..count {
            let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
            server.send_response(request.publisher, request.sequence, &bytes).unwrap();
            taken.insert(said(&request.publisher, &bytes));
        }
        assert!(server.take_request(&mut bytes).is_none());
        joined(&taken)
    }

    /// Takes so many responses, and finds no more.
    fn hear(&self, id: u64, count: u64) -> String {
        let client = &self.clients[&id];
        let mut bytes = Vec::new();
        let mut taken = BTreeSet::new();
        for _ in 0..count {
            let response = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            taken.insert(said(&response.publisher, &bytes));
        }
        assert!(client.take_response(&mut bytes).is_none());
        joined(&taken)
    }

    /// What a wait for everything finds, where it is to find something.
    fn ready(&self, session: &Session, some: bool) -> String {
        let subscriptions =
            self.subscriptions.iter().map(|(id, s)| (*id, Waitable::Subscription(s)));
        let servers = self.servers.iter().map(|(id, s)| (*id, Waitable::Server(s)));
        let clients = self.clients.iter().map(|(id, c)| (*id, Waitable::Client(c)));
        let (ids, all): (Vec<u64>, Vec<_>) = subscriptions.chain(servers).chain(clients).unzip();
        let timeout = if some { PATIENCE } else { Duration::ZERO };
        let ready = session.wait_for(&all, Some(timeout)).unwrap();
        joined(&ready.iter().map(|&index| ids[index].to_string()).collect())
    }

    fn state(&self, session: &Session) -> State {
        let graph = session.graph().endpoints.keys().map(ToString::to_string).collect();
        let publishers = self.publishers.iter().map(|(id, p)| (*id, p.matched()));
        let subscriptions = self.subscriptions.iter().map(|(id, s)| (*id, s.matched()));
        let servers = self.servers.iter().map(|(id, s)| (*id, s.clients()));
        let clients = self.clients.iter().map(|(id, c)| (*id, c.servers()));
        let mut matched = BTreeMap::new();
        for (id, gids) in publishers.chain(subscriptions).chain(servers).chain(clients) {
            let gids: BTreeSet<String> = gids.iter().map(ToString::to_string).collect();
            matched.insert(id, gids);
        }
        State { graph, matched }
    }
}

/// Who said what: the number that a request or response begins with.
fn said(who: &Gid, bytes: &[u8]) -> String {
    let (stamp, rest) = bytes.split_first_chunk().unwrap();
    let stamp = u64::from_le_bytes(*stamp);
    assert!(rest.iter().all(|byte| *byte == stamp as u8));
    format!("{who}/{stamp}")
}

/// What each process does: what its test tells it, line by line.
pub(super) fn play() {
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    let session = Session::open(&config, SessionOptions::new("program")).unwrap();
    let mut cast = Cast::default();
    say("ready");
    for line in std::io::stdin().lines() {
        let line = line.unwrap();
        let (what, numbers) = line.split_once(' ').unwrap_or((&line, ""));
        let numbers: Vec<u64> = numbers.split_whitespace().map(|n| n.parse().unwrap()).collect();
        match (what, numbers.as_slice()) {
            ("publisher", &[id, topic, hash, qos]) => {
                let made = session.create_publisher(spec(topic, hash, profile(qos))).unwrap();
                say(made.gid());
                cast.publishers.insert(id, made);
            }
            ("subscription", &[id, topic, hash, qos]) => {
                let made = session.create_subscription(spec(topic, hash, profile(qos))).unwrap();
                say(made.gid());
                cast.subscriptions.insert(id, made);
            }
            ("server", &[id, number, _, qos]) => {
                let made = session.create_server(service(number, profile(qos))).unwrap();
                say(made.gid());
                cast.servers.insert(id, made);
            }
            ("client", &[id, number, _, qos]) => {
                let made = session.create_client(service(number, profile(qos))).unwrap();
                say(made.gid());
                cast.clients.insert(id, made);
            }
            ("publish", &[id, stamp, len]) => {
                let payload = vec![stamp as u8; usize::try_from(len).unwrap()];
                let stamp = i64::try_from(stamp).unwrap();
                say(cast.publishers[&id].publish_at(stamp, &payload).unwrap());
            }
            ("ask", &[id, stamp, len]) => {
                let mut payload = stamp.to_le_bytes().to_vec();
                payload.resize(8 + usize::try_from(len).unwrap(), stamp as u8);
                say(cast.clients[&id].send_request(&payload).unwrap());
            }
            ("take", &[id, count]) => say(cast.take(id, count)),
            ("answer", &[id, count]) => say(cast.answer(id, count)),
            ("hear", &[id, count]) => say(cast.hear(id, count)),
            ("wait", &[some]) => say(cast.ready(&session, some > 0)),
            ("end", &[id]) => {
                cast.publishers.remove(&id);
                cast.subscriptions.remove(&id);
                cast.servers.remove(&id);
                cast.clients.remove(&id);
                say("ended");
            }
            ("state", []) => say(cast.state(&session)),
            _ => unreachable!("{line}"),
        }
    }
    wait_for_the_end();
}
