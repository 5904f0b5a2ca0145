//! The descriptors of a daemon whose sessions another host uses.

use axon_transport::{EndpointSpec, qos::Qos};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::PATIENCE,
};

fn open(host: &Host) -> u64 {
    host.status().descriptors.expect("they are counted").open
}

#[test]
fn session_that_another_host_uses_takes_no_further_descriptor_of_its_daemon() {
    const SESSIONS: usize = 16;
    // The subscription keeps a sample of each publisher, however late it takes them.
    let qos = Qos::default().with_depth(SESSIONS as u32);
    let spec = || EndpointSpec::new("/descriptors", "test/Bytes", qos);
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let sessions: Vec<_> = (0..SESSIONS).map(|_| hosts[0].session("publisher")).collect();
    // The descriptors of the link itself are open once the first session's publisher is matched.
    let first = sessions[0].create_publisher(spec()).unwrap();
    let subscription = hosts[1].session("subscriber").create_subscription(spec()).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE) && first.wait_matched(1, PATIENCE));
    let before = open(&hosts[0]);
    let others: Vec<_> =
        sessions[1..].iter().map(|session| session.create_publisher(spec()).unwrap()).collect();
    assert!(others.iter().all(|publisher| publisher.wait_matched(1, PATIENCE)));
    assert!(subscription.wait_matched(SESSIONS, PATIENCE));
    for publisher in &others {
        publisher.publish(b"sample").unwrap();
    }
    let mut bytes = Vec::new();
    for _ in &others {
        subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample of each");
    }
    let more = open(&hosts[0]).saturating_sub(before);
    assert!(more < others.len() as u64, "{more} more descriptors for {} sessions", others.len());
}
