//! Tests names that look like others, or are not valid: rules compare every byte of any name that a peer announces.

use std::collections::BTreeSet;

use axon_daemon::internal::link::{GraphUpdate, LinkMessage, RouteSubscriber, Subscribe};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    internal::SessionKey,
};

use super::{super::greedy::Camera, *};

/// Rules for the camera: one topic by its name, one whose name is not ASCII, and all topics below a third name.
const RULES: &str = r#"
default = "deny"

[[allow]]
peer = "camera"
publish = ["/cmd_vel", "/größe", "/open/**"]
subscribe = ["/cmd_vel", "/größe", "/open/**"]
"#;

/// Names that the rules permit.
const PERMITTED: [&str; 7] =
    ["/größe", "/open", "/open/", "/open//x", "/open/日本/🤖", "/open/ /..", "/cmd_vel"];

/// Returns names that the rules deny, though each looks like an allowed one.
fn denied() -> Vec<String> {
    let mut names: Vec<String> = [
        "/cmd_vel/",
        "//cmd_vel",
        "/cmd_vel//",
        "/cmd_vel/x",
        "cmd_vel",
        "/CMD_VEL",
        "/cmd_vel ",
        "/cmd_vel\u{200b}",
        "/cmd_vel\u{301}",
        "/\u{441}md_vel",
        "/cmd_vel\n",
        "/cmd_ve*",
        "/*",
        "/**",
        "**",
        "/",
        "//",
        "/x/../cmd_vel",
        // Composed otherwise, it is another name.
        "/gro\u{308}ße",
        "/GRÖßE",
        "/opened",
        "/open\u{2215}x",
        "//open/x",
    ]
    .map(str::to_owned)
    .to_vec();
    names.push(format!("/cmd_vel{}", "x".repeat(512 - 8)));
    names
}

/// Creates the camera's endpoints of these topics.
fn endpoints<'a>(
    key: &SessionKey,
    names: impl Iterator<Item = &'a str>,
    kind: EndpointKind,
    first: u32,
) -> Vec<Endpoint> {
    let of = |(number, name): (u32, &str)| {
        Endpoint::new(Gid::new(key.id(), first + number), kind, name, "test/Bytes")
            .with_qos(Qos::keep_all())
            .with_node("camera", "/")
    };
    (0..).zip(names).map(of).collect()
}

fn subscribe(route: u32, topic: &str, gid: Gid) -> LinkMessage {
    LinkMessage::Subscribe(Subscribe {
        route,
        topic: topic.into(),
        type_name: "test/Bytes".into(),
        kind: 0,
        subscribers: vec![RouteSubscriber { gid, qos: Qos::keep_all() }],
        last: Vec::new(),
        acknowledges: Some(true),
        short_headers: None,
    })
}

#[test]
fn a_name_that_looks_like_one_that_rules_permit_is_another_name() {
    let camera = Camera::under(RULES);
    let session = camera.a.session("robot");
    let denied = denied();
    let all: Vec<&str> = denied.iter().map(String::as_str).chain(PERMITTED).collect();
    let spec = |topic: &str| EndpointSpec::new(topic.to_owned(), "test/Bytes", Qos::keep_all());
    let _reads: Vec<_> =
        all.iter().map(|topic| session.create_subscription(spec(topic)).unwrap()).collect();
    let _writes: Vec<_> =
        all.iter().map(|topic| session.create_publisher(spec(topic)).unwrap()).collect();
    let key = SessionKey::generate().unwrap();
    let mut link = camera.link(0xff);
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    let added = endpoints(&key, all.iter().copied(), EndpointKind::Publisher, 1);
    let announced = LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() });
    camera.stranger.say(&mut link, &announced);
    // It asks for all topics, and last for one that it may have.
    for (route, topic) in (100..).zip(&all) {
        camera.stranger.say(&mut link, &subscribe(route, topic, Gid::new(key.id(), 1000)));
    }
    let (mut asked, mut served) = (BTreeSet::new(), BTreeSet::new());
    let (mut refused, mut shown) = (BTreeSet::new(), BTreeSet::new());
    while asked.len() < PERMITTED.len() || served.len() + refused.len() < all.len() {
        match camera.stranger.hear(&mut link, |_| true).expect("the link stands") {
            LinkMessage::Subscribe(subscribe) => drop(asked.insert(subscribe.topic)),
            LinkMessage::RouteReady(ready) => {
                served.insert(all[ready.route as usize - 100].to_owned());
            }
            LinkMessage::RouteRefused(no) => {
                assert_eq!(no.reason, "denied: no [[allow]] in access.toml permits this");
                refused.insert(all[no.route as usize - 100].to_owned());
            }
            LinkMessage::Graph(graph) => shown.extend(graph.added.into_iter().map(|e| e.topic)),
            _ => {}
        }
    }
    let permitted: BTreeSet<_> = PERMITTED.map(str::to_owned).into();
    assert_eq!((&asked, &served), (&permitted, &permitted));
    assert_eq!(refused, denied.iter().cloned().collect());
    assert_eq!(shown, permitted, "what the camera is shown");
    let graph = session.graph();
    let seen = graph.endpoints.values().filter(|e| e.daemon.is_some());
    let seen: BTreeSet<_> = seen.map(|entry| entry.endpoint.topic.clone()).collect();
    assert_eq!(seen, permitted, "what the robot shows of it");
}

#[test]
fn too_long_names_end_their_link_and_no_other() {
    let camera = Camera::under(RULES);
    let session = camera.a.session("robot");
    let reads = subscription(&session, "/cmd_vel");
    for length in [513, 64 << 10] {
        for kind in [EndpointKind::Publisher, EndpointKind::Node] {
            let key = SessionKey::generate().unwrap();
            let mut link = camera.link(0xfe);
            camera.stranger.prove(&mut link, DaemonId([0xfe; 16]), &[&key]);
            let long = format!("/open/{}", "é".repeat(length / 2));
            let mut added = endpoints(&key, ["/cmd_vel", &long].into_iter(), kind, 1);
            if kind == EndpointKind::Node {
                for (node, name) in added.iter_mut().zip(["n", &long]) {
                    (node.topic, node.type_name) = (String::new(), String::new());
                    node.node = name.to_owned();
                }
            }
            let announced =
                LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() });
            camera.stranger.say(&mut link, &announced);
            let why = camera.stranger.hear(&mut link, |_| false).expect_err("it is closed");
            assert!(!why.is_empty());
            until("nothing of it is left", || {
                reads.matched().is_empty()
                    && camera.a.status().links.iter().all(|link| link.host != "camera")
            });
            camera.a.link();
        }
    }
}
