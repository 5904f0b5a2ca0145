//! Tests several connections between the same daemons: which one becomes the link, for any order in which the network
//! delivers their messages.

use std::net::SocketAddr;

use axon_daemon::internal::link::{
    Elected, GraphResync, GraphUpdate, LinkMessage, RouteSubscriber, Subscribe,
};
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    qos::Qos,
};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::until,
    stranger::{Claim, Met, Stranger},
};

const TOPIC: &str = "/chatter";
const TYPE: &str = "test/Text";
/// The peer's subscription of the topic.
const SUBSCRIPTION: Gid = Gid([7; 16]);

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
        self.try_meet().expect("HELLO")
    }

    /// Connects like [`meet`](Self::meet), or returns the reason why the host closed the connection.
    fn try_meet(&self) -> Result<Met, String> {
        let to = SocketAddr::from((self.host.address, self.host.status().port.unwrap()));
        let claim = Claim { host: "elector", daemon: DaemonId([0; 16]), auth: 0 };
        self.stranger.meet(to, self.host.domain(), &self.auth, &claim)
    }

    fn elect(&self, met: &mut Met, election: u64) {
        let elected = Elected { link: [election as u8; 16], election, standby: None };
        self.stranger.say(met, &LinkMessage::Elected(elected));
    }

    /// Waits until the host sends its graph on the connection, the first message on a link.
    fn linked(&self, met: &mut Met) {
        let whole =
            |m: &LinkMessage| matches!(m, LinkMessage::Graph(GraphUpdate { before: 0, .. }));
        self.stranger.hear(met, whole).expect("the host's graph");
    }

    /// Creates a link, and another one that takes over from it.
    fn supersede(&self) -> (Met, Met) {
        let (mut first, mut last) = (self.meet(), self.meet());
        self.elect(&mut first, 1);
        self.linked(&mut first);
        self.elect(&mut last, 2);
        self.linked(&mut last);
        (first, last)
    }

    /// Sends a whole graph: the subscription for which routes are requested.
    fn say_subscription(&self, met: &mut Met) {
        let subscription = Endpoint::new(SUBSCRIPTION, EndpointKind::Subscription, TOPIC, TYPE)
            .with_node("one", "/");
        let graph = GraphUpdate { version: 1, added: vec![subscription], ..GraphUpdate::default() };
        self.stranger.say(met, &LinkMessage::Graph(graph));
    }

    /// Sends a whole graph of 600 publishers in two parts; the last publisher is of the topic.
    fn say_graph(&self, met: &mut Met, version: u64) {
        let publisher = |number: u16| {
            Endpoint::new(
                Gid(std::array::from_fn(|at| [9, (number >> 8) as u8, number as u8][at.min(2)])),
                EndpointKind::Publisher,
                if number == 599 { TOPIC.into() } else { format!("/other_{number}") },
                TYPE,
            )
            .with_node("many", "/")
        };
        for (part, more) in [(0..300, true), (300..600, false)] {
            let version = version + u64::from(!more);
            let before = if more { 0 } else { version - 1 };
            let (added, removed) = (part.map(publisher).collect(), Vec::new());
            let graph =
                GraphUpdate { version, before, added, removed, more, ..GraphUpdate::default() };
            self.stranger.say(met, &LinkMessage::Graph(graph));
        }
    }

    /// Asks for the topic under this route number.
    fn subscribe(&self, met: &mut Met, route: u32) {
        let subscribers = vec![RouteSubscriber { gid: SUBSCRIPTION, qos: Qos::default() }];
        let (topic, type_name) = (TOPIC.into(), TYPE.into());
        let subscribe = Subscribe {
            route,
            topic,
            type_name,
            kind: 0,
            subscribers,
            last: vec![],
            acknowledges: None,
            short_headers: None,
        };
        self.stranger.say(met, &LinkMessage::Subscribe(subscribe));
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
    // The host reads data that was sent over the link before.
    elector.stranger.open(&first).expect("room for a stream");
    let why = elector.stranger.closed(&first);
    assert!(why.contains("a successor took over"), "{why}");
    assert_eq!(last.connection.close_reason(), None);
    assert_eq!(elector.links(), 1);
    // The connection is still the link: a request on it is answered.
    elector.stranger.say(&mut last, &LinkMessage::GraphResync(GraphResync { version: 0 }));
    elector.linked(&mut last);
}

#[test]
fn the_last_elected_stands_when_it_is_heard_of_last() {
    let elector = Elector::new();
    let (first, last) = elector.supersede();
    let why = elector.stranger.closed(&first);
    assert!(why.contains("a successor took over"), "{why}");
    assert_eq!((last.connection.close_reason(), elector.links()), (None, 1));
}

#[test]
fn both_sides_say_that_they_are_done_before_a_superseded_link_is_closed() {
    let elector = Elector::new();
    let (mut first, last) = elector.supersede();
    elector.stranger.hear_out(&mut first);
    assert_eq!(first.connection.close_reason(), None);
    elector.stranger.end(&mut first);
    let why = elector.stranger.closed(&first);
    assert!(why.contains("a successor took over"), "{why}");
    assert_eq!((last.connection.close_reason(), elector.links()), (None, 1));
}

#[test]
fn lost_end_of_a_route_is_made_up_by_the_next_link() {
    let elector = Elector::new();
    let session = elector.host.session("talker");
    let publisher =
        session.create_publisher(EndpointSpec::new(TOPIC, TYPE, Qos::default())).unwrap();
    let mut link = elector.meet();
    elector.elect(&mut link, 1);
    elector.linked(&mut link);
    // A subscription of unknown range is matched with no publisher.
    elector.say_subscription(&mut link);
    elector.subscribe(&mut link, 1);
    until("the route is read", || publisher.matched().len() == 1);

    // UNSUBSCRIBE of 1 was lost; 2 asks for the same.
    let mut next = elector.meet();
    elector.elect(&mut next, 2);
    elector.linked(&mut next);
    elector.subscribe(&mut next, 2);
    let ready = |m: &LinkMessage| matches!(m, LinkMessage::RouteReady(ready) if ready.route == 2);
    elector.stranger.hear(&mut next, ready).expect("the route");
    assert_eq!(publisher.matched().len(), 1);

    // UNSUBSCRIBE of 2 was lost, too: the peer requests no route before it has sent its graph.
    let mut last = elector.meet();
    elector.elect(&mut last, 3);
    elector.linked(&mut last);
    assert_eq!(publisher.matched().len(), 1);
    elector.say_subscription(&mut last);
    until("nobody reads", || publisher.matched().is_empty());
}

#[test]
fn one_peer_has_so_many_connections_and_leaves_room_for_others() {
    let elector = Elector::new();
    let mut met: Vec<_> = (0..16).map(|_| elector.meet()).collect();
    // The host's HELLO may be lost by the close.
    let why = match elector.try_meet() {
        Ok(more) => elector.stranger.closed(&more),
        Err(why) => why,
    };
    assert!(why.contains("as many connections as it may"), "{why}");
    // The existing connections stay, and a peer with another identity is not kept out.
    elector.elect(&mut met[7], 1);
    elector.linked(&mut met[7]);
    let other = Elector { auth: Auth::None(SigningKey::generate().unwrap()), ..elector };
    let claim = Claim { host: "other", daemon: DaemonId([0xff; 16]), auth: 0 };
    other.stranger.dial(&other.host, &other.auth, &claim).expect("another one's link");
}

#[test]
fn a_whole_graph_in_parts_ends_no_route_in_between() {
    let elector = Elector::new();
    let session = elector.host.session("listener");
    let spec = EndpointSpec::new(TOPIC, TYPE, Qos::default());
    let subscription = session.create_subscription(spec).unwrap();
    let mut link = elector.meet();
    elector.elect(&mut link, 1);
    elector.linked(&mut link);
    elector.say_graph(&mut link, 1);
    let asked = |m: &LinkMessage| matches!(m, LinkMessage::Subscribe(subscribe) if subscribe.topic == TOPIC);
    elector.stranger.hear(&mut link, asked).expect("the host asks for the topic");
    until("it is matched", || !subscription.matched().is_empty());

    elector.say_graph(&mut link, 3);
    elector.stranger.say(&mut link, &LinkMessage::GraphResync(GraphResync { version: 0 }));
    let ended = std::cell::Cell::new(false);
    let next = |m: &LinkMessage| {
        ended.set(ended.get() || matches!(m, LinkMessage::Unsubscribe(_)));
        matches!(m, LinkMessage::Graph(GraphUpdate { before: 0, .. }))
    };
    elector.stranger.hear(&mut link, next).expect("the host's graph");
    assert!(!ended.get() && !subscription.matched().is_empty());
}
