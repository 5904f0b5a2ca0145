//! Several connections between the same daemons: which one is the link, whatever the network does to the
//! order of what is said on them.

use std::net::SocketAddr;

use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    ids::{DaemonId, Gid},
    link::{Elected, Graph, GraphResync, Message, Subscribe, Subscriber},
    qos::Qos,
    session::EndpointSpec,
};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::until,
    stranger::{Claim, Met, Stranger},
};

const TOPIC: &str = "/chatter";
const TYPE: &str = "test/Text";

/// A daemon with the lowest id there is, so that it elects, and one that it dials.
struct Elector {
    stranger: Stranger,
    auth: Auth,
    host: Host,
    _other: Host,
}

impl Elector {
    fn new() -> Self {
        let [host, other] = Plan::new([classic(&[]), classic(&[])]).start();
        let auth = Auth::None(SigningKey::generate().unwrap());
        Self { stranger: Stranger::new(), auth, host, _other: other }
    }

    fn meet(&self) -> Met {
        let to = SocketAddr::from((self.host.address, self.host.status().port.unwrap()));
        let claim = Claim { host: "elector", daemon: DaemonId([0; 16]), auth: 0 };
        self.stranger.meet(to, self.host.domain(), &self.auth, &claim).expect("HELLO")
    }

    fn elect(&self, met: &mut Met, election: u64) {
        let elected = Elected { link: [election as u8; 16], election };
        self.stranger.say(met, &Message::Elected(elected));
    }

    /// Until the host says its graph on it, as it does first on a link.
    fn linked(&self, met: &mut Met) {
        let whole = |m: &Message| matches!(m, Message::Graph(Graph { before: 0, .. }));
        self.stranger.hear(met, whole).expect("the host's graph");
    }

    /// Asks for the topic under this route number.
    fn subscribe(&self, met: &mut Met, route: u32) {
        let subscribers = vec![Subscriber { gid: Gid([7; 16]), qos: Qos::default() }];
        let (topic, type_name) = (TOPIC.into(), TYPE.into());
        let subscribe = Subscribe { route, topic, type_name, kind: 0, subscribers, last: vec![] };
        self.stranger.say(met, &Message::Subscribe(subscribe));
    }

    fn links(&self) -> usize {
        self.host.status().links.iter().filter(|link| link.host == "elector").count()
    }
}

#[test]
fn the_last_elected_stands_when_it_is_heard_of_first() {
    let elector = Elector::new();
    let (mut first, mut last) = (elector.meet(), elector.meet());
    elector.elect(&mut last, 2);
    elector.linked(&mut last);
    elector.elect(&mut first, 1);
    // What was sent over it before is read.
    elector.stranger.open(&first).expect("room for a stream");
    let why = elector.stranger.closed(&first);
    assert!(why.contains("a successor took over"), "{why}");
    assert_eq!(last.connection.close_reason(), None);
    assert_eq!(elector.links(), 1);
    // It is the link still: what is asked on it is answered.
    elector.stranger.say(&mut last, &Message::GraphResync(GraphResync { version: 0 }));
    elector.linked(&mut last);
}

#[test]
fn the_last_elected_stands_when_it_is_heard_of_last() {
    let elector = Elector::new();
    let (mut first, mut last) = (elector.meet(), elector.meet());
    elector.elect(&mut first, 1);
    elector.linked(&mut first);
    elector.elect(&mut last, 2);
    elector.linked(&mut last);
    let why = elector.stranger.closed(&first);
    assert!(why.contains("a successor took over"), "{why}");
    assert_eq!((last.connection.close_reason(), elector.links()), (None, 1));
}

#[test]
fn a_route_whose_end_was_lost_with_a_link_ends_or_gives_way_to_its_successor() {
    let elector = Elector::new();
    let session = elector.host.session("talker");
    let publisher =
        session.create_publisher(EndpointSpec::new(TOPIC, TYPE, Qos::default())).unwrap();
    let mut link = elector.meet();
    elector.elect(&mut link, 1);
    elector.linked(&mut link);
    elector.subscribe(&mut link, 1);
    until("the route is read", || publisher.matched().len() == 1);

    // UNSUBSCRIBE of 1 was lost; 2 asks for the same.
    let mut next = elector.meet();
    elector.elect(&mut next, 2);
    elector.linked(&mut next);
    elector.subscribe(&mut next, 2);
    let ready = |m: &Message| matches!(m, Message::RouteReady(ready) if ready.route == 2);
    elector.stranger.hear(&mut next, ready).expect("the route");
    assert_eq!(publisher.matched().len(), 1);

    // And that of 2: nothing is asked for before the graph is said.
    let mut last = elector.meet();
    elector.elect(&mut last, 3);
    elector.linked(&mut last);
    assert_eq!(publisher.matched().len(), 1);
    elector.stranger.say(&mut last, &Message::Graph(Graph { version: 1, ..Graph::default() }));
    until("nobody reads", || publisher.matched().is_empty());
}

#[test]
fn one_peer_has_so_many_connections_and_leaves_room_for_others() {
    let elector = Elector::new();
    let mut met: Vec<_> = (0..16).map(|_| elector.meet()).collect();
    let more = elector.meet();
    let why = elector.stranger.closed(&more);
    assert!(why.contains("as many connections as it may"), "{why}");
    // Those that it has, it has; and who is somebody else is not kept out.
    elector.elect(&mut met[7], 1);
    elector.linked(&mut met[7]);
    let other = Elector { auth: Auth::None(SigningKey::generate().unwrap()), ..elector };
    let claim = Claim { host: "other", daemon: DaemonId([0xff; 16]), auth: 0 };
    other.stranger.dial(&other.host, &other.auth, &claim).expect("another one's link");
}
