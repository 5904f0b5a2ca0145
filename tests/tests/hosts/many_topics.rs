//! More topics between two hosts than may cross.

use axon_daemon::internal::link::{Message, Subscribe, Subscriber, Unsubscribe};
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec, Publisher, Session, Subscription,
    ids::{DaemonId, Gid},
    qos::Qos,
    status::LinkStatus,
};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::{PATIENCE, until},
    stranger::{Claim, Stranger},
};

/// What may cross.
const ROUTES: u32 = 1024;
const MORE: u32 = 30;
const TYPE: &str = "test/Bytes";

fn spec(number: u32) -> EndpointSpec {
    EndpointSpec::new(format!("/crowd_{number:04}"), TYPE, Qos::default())
}

fn subscribe(route: u32) -> Message {
    Message::Subscribe(Subscribe {
        route,
        topic: format!("/crowd_{route:04}"),
        type_name: TYPE.into(),
        kind: 0,
        subscribers: vec![Subscriber { gid: Gid([7; 16]), qos: Qos::default() }],
        last: vec![],
        acknowledges: None,
        short_headers: None,
    })
}

/// How many topics the host shows as refused.
fn refused(host: &Host) -> usize {
    let links = host.status().links;
    links.iter().map(|link| link.routes_refused.len() + link.more_routes_refused).sum()
}

#[test]
fn a_peer_that_asks_for_too_many_routes_is_refused_those_by_name_and_keeps_its_link() {
    let [host, _other] = Plan::new([classic(&[]), classic(&[])]).start();
    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "greedy", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(&host, &auth, &claim).expect("a link");
    for route in 0..ROUTES + MORE {
        stranger.say(&mut met, &subscribe(route));
    }
    for route in ROUTES..ROUTES + MORE {
        let refused = |m: &Message| matches!(m, Message::RouteRefused(r) if r.route == route);
        stranger.hear(&mut met, refused).expect("it is refused");
    }
    until("it is shown", || refused(&host) == MORE as usize);
    let shown = host.status().links.into_iter().find(|link| link.host == "greedy").unwrap();
    assert!(shown.routes_refused.keys().any(|topic| topic.contains("/crowd_1024")), "{shown:?}");
    // Where there is room it gets it.
    stranger.say(&mut met, &Message::Unsubscribe(Unsubscribe { route: 0 }));
    stranger.say(&mut met, &subscribe(ROUTES));
    let ready = |m: &Message| matches!(m, Message::RouteReady(ready) if ready.route == ROUTES);
    stranger.hear(&mut met, ready).expect("it is served");
    assert_eq!(met.connection.close_reason(), None);
    until("it is shown no more", || refused(&host) == MORE as usize - 1);
}

/// One end of each of so many topics.
fn ends<T>(session: &Session, create: impl Fn(&Session, EndpointSpec) -> T) -> Vec<T> {
    (0..ROUTES + MORE).map(|number| create(session, spec(number))).collect()
}

#[test]
fn topics_beyond_what_may_cross_are_named_on_the_subscribing_host_and_harm_nothing_else() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (here, there) = (hosts[0].session("publishers"), hosts[1].session("subscriptions"));
    let subscriptions: Vec<Subscription> =
        ends(&there, |session, spec| session.create_subscription(spec).unwrap());
    let publishers: Vec<Publisher> =
        ends(&here, |session, spec| session.create_publisher(spec).unwrap());
    let crossing = || publishers.iter().filter(|p| !p.matched().is_empty()).count();
    until("as many cross as may", || crossing() == ROUTES as usize);
    until("the others are named there", || refused(&hosts[1]) == MORE as usize);
    for publisher in &publishers {
        publisher.publish(b"one").unwrap();
    }
    let mut bytes = Vec::new();
    for (subscription, publisher) in subscriptions.iter().zip(&publishers) {
        if !publisher.matched().is_empty() {
            assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok());
        }
    }
    assert_eq!(crossing(), ROUTES as usize);
    // One that ends makes room for another.
    let first = publishers.iter().position(|publisher| !publisher.matched().is_empty()).unwrap();
    let mut publishers = publishers;
    drop(publishers.remove(first));
    let crossing = || publishers.iter().filter(|p| !p.matched().is_empty()).count();
    until("another crosses", || crossing() == ROUTES as usize);
    // That both dialled, and one of the two connections was closed, ends no link.
    for host in &hosts {
        host.link();
        assert_eq!(host.log_lines(&["link down"]), 0, "the link stood");
    }
}

/// Links that a daemon has at most.
const LINKS: u8 = 160;

#[test]
fn links_of_made_up_keys_from_one_address_keep_no_listed_host_out() {
    made_up_keys_keep_no_other_host_out(true);
}

#[test]
fn links_of_made_up_keys_from_one_address_keep_no_host_out_that_nobody_lists() {
    made_up_keys_keep_no_other_host_out(false);
}

fn made_up_keys_keep_no_other_host_out(listed: bool) {
    let plan = Plan { listed, ..Plan::new([classic(&[]), classic(&[])]) };
    let [mut host, mut other] = plan.prepare();
    host.start();
    let stranger = Stranger::new();
    let links: Vec<_> = (0..LINKS)
        .map(|number| {
            let mut daemon = [0xff; 16];
            daemon[15] = number;
            let claim = Claim { host: "crowd", daemon: DaemonId(daemon), auth: 0 };
            stranger.dial(&host, &Auth::None(SigningKey::generate().unwrap()), &claim)
        })
        .collect::<Result<_, _>>()
        .expect("there is a link for each");
    let claim = Claim { host: "crowd", daemon: DaemonId([0xfe; 16]), auth: 0 };
    let auth = Auth::None(SigningKey::generate().unwrap());
    let refused = stranger.dial(&host, &auth, &claim).expect_err("there is none for one more");
    assert!(refused.contains("as many links"), "{refused}");
    other.start();
    let is_other = |link: &LinkStatus| link.address.starts_with(&other.address.to_string());
    until("the other host is linked", || host.status().links.iter().any(is_other));
    host.wait_log(&["takes its place"]);
    host.wait_refusal("it is said once of the address", |text| text.contains("as many links"));
    drop(links);
}
