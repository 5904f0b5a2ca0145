//! Rules that change while another peer floods this host with its graph.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    thread,
    time::Instant,
};

use axon_daemon::internal::link::{GraphUpdate, LinkMessage};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    internal::SessionKey,
};

use super::{super::greedy::Camera, *};

/// Endpoints that come, and go, in one message.
const PART: u32 = 500;
/// Number of changes of the rules.
const ROUNDS: usize = 5;

const OPEN: &str = "default = \"allow\"";
const CLOSED: &str = "[[deny]]\npeer = \"host-1\"\npublish = \"/cmd_vel\"";

/// Announces and withdraws endpoints until it is over. Returns in how many messages.
fn flood(camera: &Camera, over: &AtomicBool, said: &AtomicU64) {
    let key = SessionKey::generate().unwrap();
    let mut link = camera.link(0xff);
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    let mut version = 0;
    // Relaxed, here and below: the flag orders nothing else.
    while !over.load(Relaxed) {
        let first = (version as u32 / 2) * PART;
        let gids = (first..first + PART).map(|number| Gid::new(key.id(), 1 + number));
        let (mut added, mut removed) = (Vec::new(), Vec::new());
        if version % 2 == 0 {
            let endpoint = |(n, gid)| {
                Endpoint::new(gid, EndpointKind::Publisher, format!("/flood_{n}"), "test/Bytes")
                    .with_node("camera", "/")
            };
            added = gids.enumerate().map(endpoint).collect();
        } else {
            removed = gids.collect();
        }
        let (before, next) = (version, version + 1);
        let graph = GraphUpdate { version: next, before, added, removed, ..GraphUpdate::default() };
        camera.stranger.say(&mut link, &LinkMessage::Graph(graph));
        version = next;
        said.store(version, Relaxed);
    }
    camera.stranger.leave(&link);
}

#[test]
fn no_sample_published_after_rules_deny_it_arrives_under_a_graph_flood() {
    let camera = Camera::under(OPEN);
    let (here, there) = (camera.a.session("robot"), camera.b.session("base"));
    let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
    let (scans, scan) = (subscription(&here, "/scan"), publisher(&there, "/scan"));
    let (over, said) = (AtomicBool::new(false), AtomicU64::new(0));
    let mut took = Vec::new();
    thread::scope(|scope| {
        scope.spawn(|| flood(&camera, &over, &said));
        until("the flood comes", || said.load(Relaxed) > 10);
        let mut bytes = Vec::new();
        for _ in 0..ROUNDS {
            meet(&drives, &drive);
            meet(&scan, &scans);
            for publisher in [&drives, &scan] {
                publisher.publish(b"open").unwrap();
            }
            for subscription in [&drive, &scans] {
                subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
            }
            let (begin, before) = (Instant::now(), said.load(Relaxed));
            camera.set_rules(CLOSED);
            let answered = begin.elapsed();
            until("the pair ends", || drive.matched().is_empty());
            took.push((answered, begin.elapsed(), said.load(Relaxed) - before));
            while drive.take(&mut bytes).is_some() {}
            // Published after the answer and the pass that ended the pair.
            for _ in 0..100 {
                drives.publish(b"closed").unwrap();
                scan.publish(b"open").unwrap();
            }
            for _ in 0..100 {
                scans.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
                assert_eq!(bytes, b"open");
            }
            assert!(!drive.has_data(), "a sample that was published after the rules changed");
            until("its publisher hears of it", || drives.matched().is_empty());
            assert!(!drive.has_data());
            camera.set_rules(OPEN);
            // The publisher keeps its history: samples that were denied arrive now that they are allowed.
            for _ in 0..100 {
                drive.recv(&mut bytes, Some(PATIENCE)).expect("history");
            }
            while drive.take(&mut bytes).is_some() {}
            while scans.take(&mut bytes).is_some() {}
        }
        over.store(true, Relaxed);
    });
    for (answered, ended, messages) in took {
        eprintln!(
            "answered after {answered:?}, ended after {ended:?}; {messages} messages of {PART}"
        );
    }
}
