//! Very many topics between two hosts, and more than may cross.

use std::{
    collections::HashSet,
    fs, thread,
    time::{Duration, Instant},
};

use axon_daemon::internal::link::{LinkMessage, RouteSubscriber, Subscribe, Unsubscribe};
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec, Publisher, Session, Subscription,
    ids::{DaemonId, Gid},
    qos::{Durability, Qos, Reliability},
    status::LinkStatus,
};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::{PATIENCE, until},
    stranger::{Claim, Stranger, high_id},
};

/// Number of topics: more than may cross if the graph of a peer is bounded to 1 MiB.
const CROWD: u32 = 2_000;
const TYPE: &str = "test/Bytes";

fn spec(number: u32) -> EndpointSpec {
    EndpointSpec::new(format!("/crowd_{number:05}"), TYPE, Qos::default())
}

fn subscribe(route: u32) -> LinkMessage {
    LinkMessage::Subscribe(Subscribe {
        route,
        topic: format!("/crowd_{route:05}"),
        type_name: TYPE.into(),
        kind: 0,
        subscribers: vec![RouteSubscriber { gid: Gid([7; 16]), qos: Qos::default() }],
        last: vec![],
        acknowledges: None,
        short_headers: None,
    })
}

/// Returns how many topics the host shows as refused.
fn refused(host: &Host) -> usize {
    let links = host.status().links;
    links.iter().map(|link| link.routes_refused.len() + link.more_routes_refused).sum()
}

/// Starts two hosts that have little room for each other.
fn small_hosts() -> [Host; 2] {
    let plan = Plan::new([classic(&[]), classic(&[])]);
    Plan { graph_mb: Some(1), ..plan }.start()
}

#[test]
fn excess_routes_of_a_peer_are_refused_by_name_and_its_link_stays() {
    let [host, _other] = small_hosts();
    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "greedy", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(&host, &auth, &claim).expect("a link");
    for route in 0..CROWD {
        stranger.say(&mut met, &subscribe(route));
    }
    let is_refused = |m: &LinkMessage| matches!(m, LinkMessage::RouteRefused(_));
    let Ok(LinkMessage::RouteRefused(first)) = stranger.hear(&mut met, is_refused) else {
        panic!("nothing is refused")
    };
    assert!(first.route > 1024 && first.reason.contains("graph_mb"), "{first:?}");
    for route in first.route + 1..CROWD {
        let refused =
            |m: &LinkMessage| matches!(m, LinkMessage::RouteRefused(r) if r.route == route);
        stranger.hear(&mut met, refused).expect("it is refused");
    }
    let more = (CROWD - first.route) as usize;
    until("it is shown", || refused(&host) == more);
    let shown = host.status().links.into_iter().find(|link| link.host == "greedy").unwrap();
    let name = format!("/crowd_{:05}", first.route);
    assert!(shown.routes_refused.keys().any(|topic| topic.contains(&name)), "{shown:?}");
    // When there is room again, the route is served.
    stranger.say(&mut met, &LinkMessage::Unsubscribe(Unsubscribe { route: 0 }));
    stranger.say(&mut met, &subscribe(first.route));
    let ready =
        |m: &LinkMessage| matches!(m, LinkMessage::RouteReady(ready) if ready.route == first.route);
    stranger.hear(&mut met, ready).expect("it is served");
    assert_eq!(met.connection.close_reason(), None);
    until("it is shown no more", || refused(&host) == more - 1);
}

/// Number of threads that create endpoints. Each endpoint waits a while for its matches on the other host.
const CREATORS: u32 = 64;

/// Creates one end of each of `count` topics.
fn ends<T: Send>(
    session: &Session,
    count: u32,
    create: impl Fn(&Session, EndpointSpec) -> T + Sync,
) -> Vec<T> {
    let part = count.div_ceil(CREATORS);
    let create = &create;
    thread::scope(|scope| {
        let creator = |first: u32| {
            let numbers = first..count.min(first + part);
            scope.spawn(move || numbers.map(|n| create(session, spec(n))).collect::<Vec<_>>())
        };
        let creators: Vec<_> = (0..count).step_by(part as usize).map(creator).collect();
        creators.into_iter().flat_map(|creator| creator.join().unwrap()).collect()
    })
}

/// Publishers on one host, and subscriptions of the same topics on the other.
struct Crowd {
    publishers: Vec<Publisher>,
    subscriptions: Vec<Subscription>,
}

impl Crowd {
    fn new(hosts: &[Host; 2], count: u32) -> Self {
        let (here, there) = (hosts[0].session("publishers"), hosts[1].session("subscriptions"));
        let subscriptions = ends(&there, count, |s, spec| s.create_subscription(spec).unwrap());
        let publishers = ends(&here, count, |s, spec| s.create_publisher(spec).unwrap());
        Self { publishers, subscriptions }
    }

    fn crossing(&self) -> usize {
        self.publishers.iter().filter(|publisher| !publisher.matched().is_empty()).count()
    }

    /// Publishes one sample on each topic that crosses, and waits for it.
    fn exchange(&self) {
        let topics = self.subscriptions.iter().zip(&self.publishers);
        let crossing: Vec<_> = topics.filter(|(_, p)| !p.matched().is_empty()).collect();
        for (_, publisher) in &crossing {
            publisher.publish(b"one").unwrap();
        }
        let mut bytes = Vec::new();
        for (subscription, publisher) in crossing {
            let topic = &publisher.endpoint().topic;
            assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok(), "{topic}");
        }
    }
}

#[test]
fn excess_topics_are_named_on_the_subscribing_host_and_disturb_no_others() {
    let hosts = small_hosts();
    let mut crowd = Crowd::new(&hosts, CROWD);
    // A topic that does not cross is refused, by its name, on one of the hosts: as a route, or as an endpoint of a
    // graph.
    until("as many cross as may", || {
        let links = hosts.iter().map(Host::link);
        let left_out = links.map(|link| link.endpoints_left_out).sum::<u64>() as usize;
        let crossing = crowd.crossing();
        crossing < CROWD as usize && crossing + refused(&hosts[1]) + left_out >= CROWD as usize
    });
    let crossing = crowd.crossing();
    assert!(crossing > 1024, "{crossing} cross");
    crowd.exchange();
    assert_eq!(crowd.crossing(), crossing);
    // One that ends makes room for another.
    let of = |publisher: &Publisher| !publisher.matched().is_empty();
    let first = crowd.publishers.iter().position(of).unwrap();
    drop(crowd.publishers.remove(first));
    drop(crowd.subscriptions.remove(first));
    until("another crosses", || crowd.crossing() == crossing);
    // Both hosts dialled, and one of the two connections was closed. That ends no link.
    for host in &hosts {
        host.link();
        assert_eq!(host.log_lines(&["link down"]), 0, "the link stood");
    }
}

/// Returns the reasons that a host's status shows at an endpoint for which nothing flows.
fn waits(host: &Host, gid: Gid) -> Vec<String> {
    let topics = host.status().topics;
    let refused = topics.into_iter().flat_map(|topic| topic.refused);
    let own = refused.filter(|refused| refused.endpoint == gid.to_string());
    own.map(|refused| refused.reason).collect()
}

#[test]
fn a_refused_route_is_shown_at_the_subscription_and_at_the_publisher_that_wait() {
    let hosts = small_hosts();
    let mut crowd = Crowd::new(&hosts, CROWD);
    let shown_on_both = |crowd: &Crowd| {
        let at = |host: &Host| -> HashSet<String> {
            let topics = host.status().topics.into_iter();
            topics.flat_map(|topic| topic.refused).map(|refused| refused.endpoint).collect()
        };
        let (here, there) = (at(&hosts[0]), at(&hosts[1]));
        let topics = crowd.publishers.iter().zip(&crowd.subscriptions);
        let both = topics.enumerate().filter(|(_, (publisher, subscription))| {
            let shown = here.contains(&publisher.gid().to_string());
            shown && there.contains(&subscription.gid().to_string())
        });
        both.map(|(topic, _)| topic).collect::<Vec<_>>()
    };
    until("refused topics are shown on both hosts", || !shown_on_both(&crowd).is_empty());
    let refused = shown_on_both(&crowd);
    for topic in &refused {
        assert!(crowd.publishers[*topic].matched().is_empty(), "nothing flows");
    }
    let (publisher, subscription) =
        (crowd.publishers[refused[0]].gid(), crowd.subscriptions[refused[0]].gid());
    let [here, there] = [waits(&hosts[0], publisher), waits(&hosts[1], subscription)];
    assert!(here.iter().chain(&there).all(|why| why.contains(": ")), "{here:?} {there:?}");
    // Once there is room for all endpoints, no refusal is shown any more.
    let keep = refused[0];
    let keep = [crowd.publishers.swap_remove(keep)]
        .into_iter()
        .zip([crowd.subscriptions.swap_remove(keep)]);
    let keep: Vec<_> = keep.collect();
    drop(crowd);
    until("it crosses", || !keep[0].0.matched().is_empty());
    until("it is shown no more", || {
        waits(&hosts[0], publisher).is_empty() && waits(&hosts[1], subscription).is_empty()
    });
}

#[test]
fn subscriptions_without_a_relay_are_reported_on_both_hosts() {
    const TOPIC: &str = "/kinds";
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscriptions"));
    let all = Qos::default().with_durability(Durability::TransientLocal);
    let publisher = here.create_publisher(EndpointSpec::new(TOPIC, TYPE, all)).unwrap();
    let mut subscriptions = Vec::new();
    for reliability in [Reliability::Reliable, Reliability::BestEffort] {
        for durability in [Durability::Volatile, Durability::TransientLocal] {
            for history in [Some(1), Some(17), Some(257), Some(4_097), None] {
                let base =
                    history.map_or_else(Qos::keep_all, |depth| Qos::default().with_depth(depth));
                let qos = base.with_reliability(reliability).with_durability(durability);
                let spec = EndpointSpec::new(TOPIC, TYPE, qos);
                subscriptions.push(there.create_subscription(spec).unwrap());
            }
        }
    }
    let told = |host: &Host, gid: Gid, by: &str| {
        let why = "kinds of subscriptions get nothing: a topic has 16 relays";
        waits(host, gid).iter().any(|reason| reason.starts_with(by) && reason.contains(why))
    };
    until("both hosts say so", || {
        told(&hosts[0], publisher.gid(), "refused here")
            && told(&hosts[1], subscriptions[0].gid(), "refused by the peer")
    });
    publisher.publish(b"one").unwrap();
    let some = subscriptions[0].recv(&mut Vec::new(), Some(PATIENCE));
    assert!(some.is_ok(), "the other kinds get samples: {some:?}");
    subscriptions.truncate(10);
    until("nothing is refused any more", || {
        waits(&hosts[0], publisher.gid()).is_empty()
            && waits(&hosts[1], subscriptions[0].gid()).is_empty()
    });
}

/// Topics that two hosts are to bear.
const MANY: u32 = 20_000;

#[test]
fn twenty_thousand_topics_cross_between_two_hosts() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let crowd = Crowd::new(&hosts, MANY);
    let mut before = 0;
    // The test waits as long as there is progress, because a machine may be slow.
    while before < MANY as usize {
        until("more topics cross", || crowd.crossing() > before);
        before = crowd.crossing();
    }
    crowd.exchange();
    assert_eq!([0, 1].map(|host| refused(&hosts[host])), [0, 0]);
    for host in &hosts {
        host.link();
        assert_eq!(host.log_lines(&["link down"]), 0, "the link stood");
    }
}

/// Returns the processor time that all threads of a host's daemon have used.
fn processor(host: &Host) -> Duration {
    let pid = host.daemon.as_ref().unwrap().0.id();
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let used = tasks.filter_map(|task| {
        let text = fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<u64>().ok()
    });
    Duration::from_nanos(used.sum())
}

/// Measures the cost of a message for the daemons: messages of 64 bytes, one at a time, over 1 to 10,000 topics.
#[test]
#[ignore = "prints what it measures"]
#[allow(clippy::print_stdout, reason = "it prints what it measures")]
fn the_processor_cost_of_a_message_with_many_topics_is_printed() {
    const MESSAGES: u32 = 10_000;
    for topics in [1, 100, 1_000, 10_000] {
        let hosts = Plan::new([classic(&[]), classic(&[])]).start();
        hosts[0].link();
        let begun = Instant::now();
        let crowd = Crowd::new(&hosts, topics);
        let created = begun.elapsed();
        until("all cross", || crowd.crossing() == topics as usize);
        let matched = begun.elapsed();
        thread::sleep(Duration::from_secs(3));
        let idle = hosts.each_ref().map(processor);
        thread::sleep(Duration::from_secs(10));
        let idle = [0, 1].map(|host| (processor(&hosts[host]) - idle[host]) / 10);
        let mut costs = Vec::new();
        for all in [false, true] {
            let before = hosts.each_ref().map(processor);
            for number in 0..MESSAGES {
                let topic = if all { number as usize % crowd.publishers.len() } else { 0 };
                crowd.publishers[topic].publish(&[7; 64]).unwrap();
                thread::sleep(Duration::from_micros(500));
            }
            thread::sleep(Duration::from_millis(500));
            costs.push([0, 1].map(|host| (processor(&hosts[host]) - before[host]) / MESSAGES));
        }
        println!(
            "{topics} topics: created in {created:?}, matched in {matched:?}; idle {idle:?} a second; \
             a message over one of them {:?}, over each in turn {:?} (sending, receiving daemon)",
            costs[0], costs[1]
        );
    }
}

/// Links that a daemon has at most.
const LINKS: u8 = 160;

#[test]
fn links_of_made_up_keys_from_one_address_keep_no_listed_host_out() {
    made_up_keys_keep_no_other_host_out(true);
}

#[test]
fn made_up_keys_from_one_address_keep_no_unlisted_host_out() {
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
    let claim = Claim { host: "crowd", daemon: high_id(0xfe), auth: 0 };
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
