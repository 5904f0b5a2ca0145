//! A certificate of several names: its host has the rights of the one that it goes by on a link, and of no other.

use std::sync::Arc;

use axon_daemon::internal::link::{GraphUpdate, LinkMessage};
use axon_tls::identity::{Auth, CaMaterial};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    internal::SessionKey,
};

use super::{
    super::stranger::{Claim, Met, Stranger},
    *,
};

/// Announces publishers of `/cmd_vel` and `/status` under a daemon id. Returns the topics that the robot asks for, once these
/// are among them.
fn asked(
    stranger: &Stranger,
    (met, id): &mut (Met, u8),
    key: &SessionKey,
    awaited: &[&str],
) -> Vec<String> {
    stranger.prove(met, DaemonId([*id; 16]), &[key]);
    let endpoint = |number, kind, topic| {
        Endpoint::new(Gid::new(key.id(), number), kind, topic, "test/Bytes")
            .with_qos(spec(topic).qos)
            .with_node("stranger", "/")
    };
    let added = vec![
        endpoint(1, EndpointKind::Publisher, "/cmd_vel"),
        endpoint(2, EndpointKind::Publisher, "/status"),
    ];
    stranger
        .say(met, &LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() }));
    let mut asked = Vec::new();
    while !awaited.iter().all(|topic| asked.iter().any(|asked| asked == topic)) {
        let subscribe = |message: &LinkMessage| matches!(message, LinkMessage::Subscribe(_));
        match stranger.hear(met, subscribe) {
            Ok(LinkMessage::Subscribe(subscribe)) => asked.push(subscribe.topic),
            other => panic!("{other:?}"),
        }
    }
    asked.sort_unstable();
    asked
}

#[test]
fn certificate_with_two_names_gets_the_rights_of_the_selected_name() {
    const RULES: &str = "default = \"deny\"\n\
        [[allow]]\npeer = \"base\"\npublish = [\"/cmd_vel\", \"/status\"]\n\
        [[allow]]\npeer = \"guest\"\npublish = \"/status\"";
    let (files, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let own = |name: &str, serial| {
        let certificate = ca.issue(name, serial, 2100);
        authority::settings(files.path(), name, &ca.pem, &certificate, None)
    };
    let settings = [own("robot", 1), own("other", 2)];
    let hosts = Hosts::start(settings, "base", tempfile::tempdir().unwrap());
    hosts.write(RULES);
    assert_eq!(hosts.reload().error, None);
    let session = hosts.robot.session("robot");
    let _reads = ["/cmd_vel", "/status"].map(|topic| subscription(&session, topic));

    let both = ca.issue_for(&["guest", "base"], 3, 2100);
    let material = CaMaterial::from_pem(&ca.pem, &both.pem, &both.key, None).unwrap();
    let auth = Auth::Ca(Arc::new(material.with_names_checked_by_application()));
    let stranger = Stranger::new();
    // A host may have both names at once: each link has the rights of its name.
    let keys = [(); 2].map(|()| SessionKey::generate().unwrap());
    let mut links = [("guest", 0xfe), ("base", 0xff)].map(|(name, id)| {
        let claim = Claim { daemon: DaemonId([id; 16]), ..Claim::ca(name) };
        (stranger.dial(&hosts.robot, &auth, &claim).expect(name), id)
    });
    let [guest, base] = &mut links;
    assert_eq!(asked(&stranger, guest, &keys[0], &["/status"]), ["/status"]);
    let both = ["/cmd_vel", "/status"];
    assert_eq!(asked(&stranger, base, &keys[1], &both), both);
    until("the robot reads what base publishes, and says what guest may not", || {
        let links = hosts.robot.status().links;
        let of = |name: &str| links.iter().find(|link| link.host == name).map(|l| &l.denied);
        of("base").is_some_and(|denied| denied.is_empty())
            && of("guest").is_some_and(|d| d.contains_key("publish /cmd_vel (the peer's)"))
    });
    let why = stranger.dial(&hosts.robot, &auth, &Claim::ca("other")).expect_err("other");
    assert!(why.contains("its certificate does not name the host"), "{why}");
    drop(links);
}
