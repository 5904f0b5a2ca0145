//! Tests the status of a slow link, and the reason that it gives.

use std::time::Duration;

use axon_tests::Sizes;
use axon_transport::{
    qos::Qos,
    status::{LinkStatus, WaitingStatus},
};

use super::{
    cut::wired,
    load::across,
    mode::classic,
    pair::Host,
    process::{PATIENCE, until},
};

/// Returns a RELIABLE QoS that keeps `depth` samples. Samples that a KEEP_ALL publisher cannot send wait in its own
/// ring.
fn keeping(depth: u32) -> Qos {
    Qos::default().with_depth(depth)
}

/// Waits until the status of the one link shows something.
#[track_caller]
fn shown(host: &Host, what: &str, fits: impl Fn(&LinkStatus) -> bool) -> LinkStatus {
    let mut link = host.link();
    until(what, || {
        link = host.link();
        fits(&link)
    });
    link
}

#[test]
fn waiting_bytes_are_shown_by_class_with_the_oldest_age() {
    const LONGS: u32 = 4;
    const SHORTS: u32 = 1024;
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let (long, read_long) = across(&hosts, "/long", keeping(LONGS));
    let (short, read_short) = across(&hosts, "/short", keeping(SHORTS));
    let idle = shown(&hosts[0], "nothing waits", |link| link.waiting_bytes == 0);
    assert_eq!((idle.waiting, idle.oldest_waits), (WaitingStatus::default(), Duration::ZERO));
    assert!(idle.mtu >= 1200 && idle.congestion_window > 0, "{idle:?}");
    assert!(!idle.rtt_min.is_zero() && idle.packets_sent > 0, "{idle:?}");
    wire.cut();
    for (publisher, size, count) in [(&long, 1 << 20, LONGS), (&short, 4096, SHORTS)] {
        let sample = vec![0x5a; size];
        (0..count).for_each(|_| assert!(publisher.publish(&sample).is_ok()));
    }
    let full = shown(&hosts[0], "both wait", |link| {
        link.waiting.bulk > 0 && link.waiting.small_reliable > 0 && !link.oldest_waits.is_zero()
    });
    let WaitingStatus { services, small_reliable, small_best_effort, bulk, .. } = full.waiting;
    assert_eq!(full.waiting_bytes, small_reliable + bulk, "{full:?}");
    assert_eq!((services, small_best_effort), (0, 0));
    wire.mend();
    let mut bytes = Vec::new();
    for (subscription, count) in [(&read_long, LONGS), (&read_short, SHORTS)] {
        // Another test covers samples that are overwritten meanwhile.
        while subscription.recv(&mut bytes, Some(PATIENCE)).unwrap().sequence < u64::from(count) {}
    }
    let idle = shown(&hosts[0], "nothing waits", |link| link.waiting_bytes == 0);
    assert_eq!((idle.waiting, idle.oldest_waits), (WaitingStatus::default(), Duration::ZERO));
}

#[test]
fn lost_packets_are_shown_with_bytes_and_congestion_events() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Mixed);
    let mut publisher = hosts[0].flood(Sizes::Mixed, 1);
    there.wait_taken(publisher.published() + 1);
    wire.lose();
    let link = shown(&hosts[0], "packets are lost", |link| link.packets_lost > 0);
    assert!(link.bytes_lost >= link.packets_lost, "{link:?}");
    assert!(link.packets_sent > link.packets_lost && link.congestion_events > 0, "{link:?}");
    wire.mend();
    let sent = publisher.stop();
    there.wait_taken(sent);
}

#[test]
fn marks_of_a_congested_router_are_shown_at_both_ends() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].flood(Sizes::Small, 1);
    there.wait_taken(publisher.published() + 1);
    let links = hosts.each_ref().map(Host::link);
    let marks = links.map(|link| (link.ecn_marks_in, link.ecn_marks_out));
    assert_eq!(marks, [(0, 0); 2]);
    wire.mark();
    shown(&hosts[1], "marked packets arrive", |link| link.ecn_marks_in > 0);
    let here = shown(&hosts[0], "the peer reports them", |link| link.ecn_marks_out > 0);
    assert_eq!(here.ecn_marks_in, 0, "the way back is not marked");
    let sent = publisher.stop();
    there.wait_taken(sent);
}
