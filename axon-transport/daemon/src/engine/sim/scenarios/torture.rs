//! Tests a peer that sends anything in any state, by chance: messages of all types too early, twice, altered and cut
//! off; streams of routes and publishers that are not its own; closes and resets. Honest hosts are linked meanwhile.

use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::config::Config;
use bytes::Bytes;
use quinn_proto::StreamId;
use rand::{Rng, RngExt};

use super::hostile::{HIGHEST, LOWEST};
use crate::engine::sim::{
    raw::Raw,
    rings::FOREIGN,
    rng::{SimRng, Stream, stream},
    tests::{all_cases, millis, secs, setting},
    world::{Pair, World},
};
use crate::{
    engine::sample::stream_header::StreamHeader,
    link::{CloseCode, Elected, LastSeen, LinkHello, LinkMessage},
    wire::link::samples,
};

/// Acts of the peer in one run.
const ACTS: usize = 80;
/// Connections of the peer at a time.
const CONNECTIONS: usize = 6;

struct Torture {
    rng: SimRng,
    world: World,
    /// Samples go from one honest host to the other.
    pair: Pair,
    /// GIDs that the peer may name: its own, and those of other hosts.
    gids: Vec<Gid>,
    streams: Vec<(usize, StreamId)>,
    /// The last frame, which may be sent again.
    last: Bytes,
}

impl Torture {
    fn new(seed: u64) -> Self {
        let mut rng = stream(seed, Stream::Workload { host: u32::MAX });
        let mut world = World::new(seed, 2, |_| Config::default());
        world.add_raw(Config::default(), if rng.random_bool(0.5) { LOWEST } else { HIGHEST });
        let pair = world.pair(0, 1, "/scan", Qos::keep_all());
        let mut gids = vec![pair.publisher.1, pair.subscription.1, Gid::default()];
        for (topic, qos) in [("/scan", Qos::default()), ("/t", Qos::sensor_data())] {
            gids.push(world.hosts[0].rings.create_publisher(topic, qos));
            gids.push(world.hosts[0].rings.create_subscription(topic, qos, None));
        }
        for number in 1..4 {
            let mut own = [number; 16];
            own[..12].copy_from_slice(&FOREIGN);
            gids.push(Gid(own));
        }
        world.hosts[0].touch_graph();
        world.until(secs(5), World::is_whole);
        if rng.random_bool(0.5) {
            // The host dials the peer, too.
            let (daemon, address, now) = (world.raws[0].daemon, world.raws[0].address, world.now);
            world.hosts[0].want(daemon, address, None, now);
        }
        world.run_for(secs(1));
        Self { rng, world, pair, gids, streams: Vec::new(), last: Bytes::new() }
    }

    fn gid(&mut self) -> Gid {
        self.gids[self.rng.random_range(0..self.gids.len())]
    }

    /// Returns a number that a test of bounds would choose.
    fn number(&mut self) -> u64 {
        let some = [0, 1, 2, 3, 7, 1024, u64::from(u32::MAX), u64::MAX - 1, u64::MAX];
        some[self.rng.random_range(0..some.len())]
    }

    /// Returns any message, with numbers and GIDs that exist here.
    fn message(&mut self) -> LinkMessage {
        let mut all = samples::messages();
        let mut message = all.swap_remove(self.rng.random_range(0..all.len()));
        let (gid, number, route) = (self.gid(), self.number(), self.number() as u32);
        let hello = self.world.raws[0].hello();
        match &mut message {
            LinkMessage::Hello(m) => {
                *m = hello;
                match self.rng.random_range(0..6) {
                    0 => m.domain = route,
                    1 => m.expects = Some(axon_shm::ids::DaemonId(gid.0)),
                    2 => m.replaces = Some(gid.0),
                    3 => m.daemon = self.world.hosts[self.rng.random_range(0..2)].daemon,
                    4 => m.routes = Some(route),
                    _ => {}
                }
            }
            LinkMessage::Elected(m) => {
                *m = Elected { link: gid.0, election: number, standby: None }
            }
            LinkMessage::Graph(m) => {
                (m.version, m.before) = (self.number(), if number == 1 { 0 } else { number });
                m.more = self.rng.random_bool(0.2);
                m.removed = vec![gid];
                let host = self.rng.random_range(0..2);
                // The peer also announces endpoints of other hosts as its own.
                let endpoints = self.world.hosts[host].rings.endpoints();
                for endpoint in endpoints.iter().take(self.rng.random_range(0..4)) {
                    let mut endpoint = (**endpoint).clone();
                    if self.rng.random_bool(0.7) {
                        endpoint.gid = self.gids[self.rng.random_range(0..self.gids.len())];
                    }
                    m.added.push(endpoint);
                }
            }
            LinkMessage::Subscribe(m) => {
                m.route = route;
                m.kind = self.rng.random_range(0..3);
                m.topic = if self.rng.random_bool(0.5) { "/scan".into() } else { "/t".into() };
                m.type_name = "T".into();
                m.subscribers.iter_mut().for_each(|s| s.gid = gid);
                m.last = vec![LastSeen { publisher: gid, sequence: number }];
            }
            LinkMessage::Unsubscribe(m) => m.route = route,
            LinkMessage::RouteRefused(m) => m.route = route,
            LinkMessage::RouteUnasked(m) => (m.topic, m.type_name) = ("/t".into(), "T".into()),
            LinkMessage::Denied(m) => {
                m.denied.iter_mut().for_each(|denied| denied.name = "/t".into())
            }
            LinkMessage::AccessCheck(m) => m.number = number,
            LinkMessage::AccessDecisions(m) => m.number = number,
            LinkMessage::RouteReady(m) => (m.route, m.publishers) = (route, vec![gid]),
            LinkMessage::Asserted(m) => m.publishers = vec![gid],
            LinkMessage::GraphResync(m) => m.version = number,
            LinkMessage::Received(m) => {
                for flow in &mut m.flows {
                    (flow.route, flow.publisher) = (route, gid);
                    (flow.sequence, flow.dropped) = (number, number);
                }
            }
            _ => {}
        }
        message
    }

    /// Returns the frame of a message, whole or altered.
    fn frame(&mut self) -> Bytes {
        let mut frame = self.message().to_frame().unwrap();
        match self.rng.random_range(0..8) {
            0 => {
                let at = self.rng.random_range(0..frame.len());
                frame[at] ^= 1 << self.rng.random_range(0..8);
            }
            1 => frame.truncate(self.rng.random_range(0..frame.len())),
            2 => {
                let length = self.number() as u32;
                frame[..4].copy_from_slice(&length.to_be_bytes());
            }
            // Another type, as if compressed, or of none that there is.
            3 => frame[4] = self.rng.random(),
            4 => return self.last.clone(),
            _ => {}
        }
        frame.into()
    }

    /// Returns the possible beginning of a data stream.
    fn data(&mut self) -> Bytes {
        let header = StreamHeader {
            of: self.gid(),
            route: self.number() as u32,
            reliable: self.rng.random_bool(0.7),
            copy: self.rng.random_bool(0.2),
            short: self.rng.random_bool(0.3),
            acknowledged: self.rng.random_bool(0.3),
        };
        let mut bytes = header.encode().to_vec();
        if self.rng.random_bool(0.1) {
            let at = self.rng.random_range(0..4);
            bytes[at] = self.rng.random();
        }
        let length = [0, 3, 40, 64, 2000, 70_000][self.rng.random_range(0..6)];
        let said = match self.rng.random_range(0..4) {
            0 => self.number() as u32,
            _ => length as u32,
        };
        bytes.extend_from_slice(&said.to_be_bytes());
        let mut body = vec![0; length];
        if self.rng.random_bool(0.5) {
            self.rng.fill_bytes(&mut body);
        } else if let Some(first) = body.first_chunk_mut::<16>() {
            // The header of a message begins with its publisher.
            *first = header.of.0;
        }
        bytes.extend_from_slice(&body);
        bytes.truncate(self.rng.random_range(1..=bytes.len()));
        bytes.into()
    }

    fn act(&mut self) {
        let to = self.world.hosts[self.rng.random_range(0..2)].address;
        let links = &self.world.raws[0].links;
        let live = |number: &usize| links[*number].closed.is_none() && links[*number].connected;
        let live: Vec<usize> = (0..links.len()).filter(live).collect();
        let choice = self.rng.random_range(0..100);
        if live.is_empty() || choice < 8 && live.len() < CONNECTIONS {
            self.world.with_raw(0, |raw, now| raw.dial(to, now));
            return self.world.run_for(millis(5));
        }
        let on = live[self.rng.random_range(0..live.len())];
        match choice {
            // Honest, so that later states are reached.
            ..25 => {
                let greeted = links[on].is_greeted();
                self.world.with_raw(0, |raw, _| honest(raw, on, greeted));
            }
            25..60 => {
                let frame = self.frame();
                self.last = frame.clone();
                self.world.with_raw(0, |raw, _| raw.links[on].say_bytes(frame));
            }
            60..65 => {
                let mut noise = vec![0; self.rng.random_range(1..9000)];
                self.rng.fill_bytes(&mut noise);
                self.world.with_raw(0, |raw, _| raw.links[on].say_bytes(noise.into()));
            }
            65..85 => {
                let data = self.data();
                let stream = self.world.with_raw(0, |raw, _| raw.links[on].open(data));
                self.streams.extend(stream.map(|stream| (on, stream)));
            }
            85..95 if !self.streams.is_empty() => {
                let (on, stream) = self.streams[self.rng.random_range(0..self.streams.len())];
                let (data, what) = (self.data(), self.rng.random_range(0..3));
                self.world.with_raw(0, |raw, _| match what {
                    0 => raw.links[on].write_to(stream, data),
                    1 => raw.links[on].finish(stream),
                    _ => raw.links[on].reset(stream, 0),
                });
            }
            95..97 => self.world.with_raw(0, |raw, _| {
                let link = &mut raw.links[on];
                link.opened.clone().into_iter().for_each(|stream| drop(link.read(stream)));
            }),
            97 => {
                let now = self.world.now;
                self.world.with_raw(0, |raw, _| raw.close(on, now));
            }
            _ => {}
        }
    }

    fn run(mut self, seed: u64) {
        let mut published = 0;
        for _ in 0..ACTS {
            self.act();
            if self.rng.random_bool(0.3) {
                published += u64::from(self.world.publish(self.pair, 200));
            }
            let wait = self.rng.random_range(0..60);
            self.world.run_for(millis(wait * wait / 20));
        }
        self.world.run_for(secs(5));
        let expected: Vec<u64> = (1..=published).collect();
        let received = self.world.received(self.pair);
        assert_eq!(received, expected, "seed {seed}: {}", self.world.describe());
        for link in &self.world.raws[0].links {
            // The end of a link has a close code, and is no defect of the host.
            if let Some((code, text)) = &link.closed {
                assert_ne!(*code, Some(CloseCode::Internal), "seed {seed}: {text}");
                assert!(code.is_some() || !text.contains("closed by peer"), "seed {seed}: {text}");
            }
        }
    }
}

fn honest(raw: &mut Raw, on: usize, greeted: bool) {
    if !greeted || raw.links[on].messages.len() == 1 && raw.daemon == HIGHEST {
        return raw.say_hello(on);
    }
    let hello = LinkHello { replaces: Some([1; 16]), ..raw.hello() };
    match raw.daemon {
        LOWEST => raw.links[on].say(&LinkMessage::Elected(Elected {
            link: [1; 16],
            election: 1,
            standby: None,
        })),
        _ => raw.links[on].say(&LinkMessage::Hello(hello)),
    }
}

#[test]
fn anything_that_a_peer_says_in_any_state_harms_no_other_link() {
    let seeds = if all_cases() { 2000 } else { 30 };
    let (first, seeds) = (setting("SIMULATE_FIRST", 1), setting("SIMULATE_TORTURE", seeds));
    for seed in first..first + seeds {
        Torture::new(seed).run(seed);
    }
}
