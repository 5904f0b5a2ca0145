//! A peer without an engine that has two links.

use std::net::Ipv4Addr;

use axon_envelope::Kind;
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::config::Config;
use bytes::Bytes;

use super::copies::CopyStream;
use crate::{
    engine::sim::{
        network::Path,
        raw::RawLink,
        scenarios::hostile::{HIGHEST, LOWEST, asked, of_raw, publishes, samples, subscribe},
        tests::{millis, secs},
        world::{Pair, World},
    },
    link::{CloseCode, Elected, LinkHello, LinkMessage, ReceivedOf, ReceivedUpTo},
};

const IN_USE: [u8; 16] = [1; 16];

fn config() -> Config {
    let mut config = Config::default();
    config.link.paths = 2;
    config
}

fn elected(link: u8, election: u64, standby: Option<bool>) -> LinkMessage {
    LinkMessage::Elected(Elected { link: [link; 16], election, standby })
}

/// Two honest hosts with two paths, and raw peers.
struct RawLiar {
    world: World,
    /// Samples between the honest hosts.
    honest: [Pair; 2],
    published: u64,
    /// The addresses of the victim, host 0.
    addresses: [Ipv4Addr; 2],
}

impl RawLiar {
    fn new(seed: u64, raws: impl IntoIterator<Item = DaemonId>) -> Self {
        let mut world = World::new(seed, 2, |_| config());
        world.network.set_default_path(Path { delay: millis(2), ..Path::default() });
        for (raw, daemon) in raws.into_iter().enumerate() {
            world.add_raw(config(), daemon);
            world.add_second_interface_of_raw(raw);
        }
        let second = [0, 1].map(|host| world.add_second_interface(host));
        let honest = [(0, 1), (1, 0)]
            .map(|(from, to)| world.pair(from, to, &format!("/from_{from}"), Qos::keep_all()));
        let addresses = [world.hosts[0].address, second[0]];
        world.until(secs(5), World::is_whole);
        world.run_for(secs(1));
        Self { world, honest, published: 0, addresses }
    }

    /// Lets the honest hosts have two links.
    fn second_link(&mut self) {
        self.world.hear_all_addresses();
        let world = &mut self.world;
        world.until(secs(10), |world| Self::stands_by(world) == [true; 2]);
    }

    fn stands_by(world: &World) -> [bool; 2] {
        [0, 1].map(|host| {
            let links = world.hosts[host].links().unwrap();
            !links.with_daemon(world.hosts[1 - host].daemon)[1].is_empty()
        })
    }

    fn link(&self, link: usize) -> &RawLink {
        &self.world.raws[0].links[link]
    }

    /// Dials the victim over a path. Returns the connection once its handshake is complete.
    fn dial(&mut self, raw: usize, path: usize) -> usize {
        let to = self.addresses[path];
        let link = self.world.with_raw(raw, |raw, now| raw.dial(to, now));
        self.run_until(|world| {
            let link = &world.raws[raw].links[link];
            link.connected || link.closed.is_some()
        });
        link
    }

    /// Sends HELLO under a daemon id.
    fn hello(&mut self, raw: usize, on: usize, daemon: DaemonId, beside: Option<[u8; 16]>) {
        self.world.with_raw(raw, |raw, _| {
            let hello = LinkHello { daemon, beside, ..raw.hello() };
            raw.links[on].say(&LinkMessage::Hello(hello));
        });
    }

    fn say(&mut self, on: usize, message: &LinkMessage) {
        self.world.with_raw(0, |raw, _| raw.links[on].say(message));
    }

    fn open(&mut self, on: usize, bytes: impl Into<Bytes>) {
        self.world.with_raw(0, |raw, _| {
            if let Some(stream) = raw.links[on].open(bytes) {
                raw.links[on].finish(stream);
            }
        });
    }

    /// Makes the first peer elect a link, and another one beside it. Returns them.
    fn elects_two(&mut self) -> [usize; 2] {
        let first = self.dial(0, 0);
        self.hello(0, first, LOWEST, None);
        self.run(50);
        self.say(first, &elected(1, 1, None));
        self.run(50);
        let second = self.stands(2, 2);
        [first, second]
    }

    /// Makes the first peer elect a link that stands by.
    fn stands(&mut self, link: u8, election: u64) -> usize {
        let second = self.dial(0, 1);
        self.hello(0, second, LOWEST, Some(IN_USE));
        self.run(50);
        self.say(second, &elected(link, election, Some(true)));
        self.run(50);
        second
    }

    /// Runs for so many milliseconds, while the honest hosts publish.
    fn run(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds.div_ceil(10) {
            self.published += 1;
            for pair in self.honest {
                assert!(self.world.publish(pair, 100), "held up: {}", self.world.describe());
            }
            self.world.run_for(millis(10));
            for pair in self.honest {
                let received = self.world.received(pair);
                assert_eq!(received.len() as u64, self.published, "{}", self.world.describe());
            }
        }
    }

    fn run_until(&mut self, holds: impl Fn(&World) -> bool) {
        let end = self.world.now + secs(20);
        while !holds(&self.world) {
            assert!(self.world.now < end, "{}", self.world.describe());
            self.run(10);
        }
    }

    /// Checks that all samples of the honest hosts arrived, and that they never took each other for gone.
    fn ends(mut self) {
        self.run(100);
        for pair in self.honest {
            let all = self.world.received(pair).into_iter().eq(1..=self.published);
            assert!(all, "{}", self.world.describe());
        }
        let refusals = &self.world.hosts[1].refusals;
        let flaps =
            refusals.iter().filter(|(_, text)| text.starts_with("down") || text == "silent");
        assert_eq!(flaps.count(), 0, "{}", self.world.describe());
    }

    /// Returns the links with the daemon ids of raw peers that stand by, and those that do not.
    fn held(&self) -> (usize, usize) {
        let held = self.world.hosts[0].links().unwrap().held();
        (held.standby, held.links - held.standby)
    }

    fn closed(&self, link: usize) -> Option<CloseCode> {
        self.link(link).closed.as_ref().and_then(|(code, _)| *code)
    }
}

/// A raw peer with two links that publishes `/t`, and a subscription of its victim.
fn publisher(seed: u64) -> (RawLiar, [usize; 2], Gid, u32) {
    let mut liar = RawLiar::new(seed, [LOWEST]);
    liar.second_link();
    let subscription = liar.world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    liar.world.hosts[0].touch_graph();
    let links = liar.elects_two();
    liar.say(links[0], &publishes("/t", of_raw(1), Qos::keep_all()));
    let route = asked(&mut liar.world, links[0], "/t");
    (liar, links, subscription, route)
}

fn copy(route: u32, number: u64, after: u64) -> Bytes {
    CopyStream { after, ..CopyStream::new("/t", route, of_raw(1), number) }.encode()
}

#[test]
fn copies_with_any_number_keep_the_order_and_come_once() {
    let (mut liar, [first, second], subscription, route) = publisher(30);
    let received = |liar: &RawLiar| liar.world.hosts[0].rings.received(subscription, of_raw(1));
    // A copy whose predecessor never came waits, and is forgotten.
    liar.open(second, copy(route, 9, 8));
    liar.run(1500);
    assert!(received(&liar).is_empty());
    for _ in 0..3 {
        liar.open(second, copy(route, 1, 0));
    }
    liar.run(100);
    assert_eq!(received(&liar), [1]);
    // Thousands at once, of flows that never were too.
    for number in 0..3000 {
        liar.open(second, copy(route, 3 + number, 2 + number));
        liar.open(second, copy(route + number as u32, 3, 2));
        if number % 20 == 0 {
            liar.run(10);
        }
    }
    // Those that wait are forgotten after a second.
    liar.run(1500);
    assert_eq!(received(&liar), [1]);
    // A number that the publisher cannot have reached, and numbers that it had.
    liar.open(second, copy(route, u64::MAX, 1));
    liar.open(second, copy(route, 1 << 40, 1));
    liar.open(second, copy(route, 0, 1));
    liar.open(second, copy(route, 1, 1));
    liar.run(100);
    assert_eq!(received(&liar), [1]);
    // Copies come before the sample that they follow.
    liar.open(second, copy(route, 4, 3));
    liar.open(second, copy(route, 3, 2));
    liar.run(100);
    assert_eq!(received(&liar), [1]);
    liar.open(first, samples(route, "/t", of_raw(1), 1..=2));
    liar.run(100);
    assert_eq!(received(&liar), [1, 2, 3, 4]);
    // Over the link in use copies count, too. The samples themselves come later.
    liar.open(first, copy(route, 5, 4));
    liar.run(100);
    liar.open(first, samples(route, "/t", of_raw(1), 2..=6));
    liar.run(100);
    assert_eq!(received(&liar), [1, 2, 3, 4, 5, 6]);
    for link in [first, second] {
        assert!(liar.link(link).closed.is_none(), "{}", liar.world.describe());
    }
    liar.ends();
}

#[test]
fn copies_under_the_name_of_another_host_reach_no_subscription() {
    let (mut liar, [first, second], subscription, route) = publisher(31);
    let honest = liar.honest[1].publisher.1;
    let before = liar.world.received(liar.honest[1]).len();
    for on in [second, first] {
        for route in route.saturating_sub(3)..route + 3 {
            for writer in [honest, of_raw(1)] {
                let forged = CopyStream::new("/from_1", route, honest, before as u64 + 1000);
                liar.open(on, CopyStream { writer, after: 0, ..forged.clone() }.encode());
                let after = forged.number - 1;
                liar.open(on, CopyStream { writer, after, ..forged }.encode());
            }
        }
        liar.run(1500);
    }
    assert!(liar.world.hosts[0].rings.received(subscription, honest).is_empty());
    liar.ends();
}

#[test]
fn copy_that_breaks_the_format_ends_the_link_that_it_came_over() {
    // A payload of 4,096 bytes is the longest one: 24 bytes are before those of `length`.
    let long = |copy: CopyStream| CopyStream { length: 4097 - 24, ..copy }.encode();
    let longer = |copy: CopyStream| CopyStream { length: 5000, ..copy }.encode();
    let short = |copy: CopyStream| {
        let mut bytes = copy.encode().to_vec();
        bytes[1] |= 1;
        Bytes::from(bytes)
    };
    let other_writer = |copy: CopyStream| CopyStream { writer: of_raw(9), ..copy }.encode();
    let cases: [(CloseCode, &dyn Fn(CopyStream) -> Bytes); 4] = [
        (CloseCode::TooLarge, &long),
        (CloseCode::TooLarge, &longer),
        (CloseCode::Malformed, &short),
        (CloseCode::Malformed, &other_writer),
    ];
    for (code, make) in cases {
        let (mut liar, [first, second], subscription, route) = publisher(32);
        liar.open(second, make(CopyStream::new("/t", route, of_raw(1), 1)));
        liar.run(200);
        assert_eq!(liar.closed(second), Some(code), "{}", liar.world.describe());
        assert!(liar.link(first).closed.is_none());
        // The link in use goes on, and another second link may stand by.
        let third = liar.stands(3, 3);
        let longest =
            CopyStream { length: 4096 - 24, ..CopyStream::new("/t", route, of_raw(1), 1) };
        liar.open(third, longest.encode());
        liar.run(100);
        assert_eq!(liar.world.hosts[0].rings.received(subscription, of_raw(1)), [1]);
        liar.open(first, samples(route, "/t", of_raw(1), 1..=2));
        liar.run(200);
        let received = liar.world.hosts[0].rings.received(subscription, of_raw(1));
        assert_eq!(received, [1, 2], "{}", liar.world.describe());
        // Copies over a link that was given up reach nobody.
        liar.open(second, copy(route, 3, 2));
        liar.run(100);
        assert_eq!(liar.world.hosts[0].rings.received(subscription, of_raw(1)).len(), 2);
        liar.ends();
    }
}

#[test]
fn copies_that_are_cut_off_or_come_too_early_hold_bounded_memory() {
    let (mut liar, [_, second], subscription, route) = publisher(33);
    let whole = CopyStream { length: 1000, ..CopyStream::new("/t", route, of_raw(1), 1) };
    // Before HELLO, and before the election.
    let early = liar.dial(0, 0);
    for _ in 0..200 {
        liar.open(early, copy(route, 1, 0));
    }
    liar.run(100);
    liar.hello(0, early, LOWEST, Some(IN_USE));
    liar.run(100);
    assert!(liar.world.hosts[0].rings.received(subscription, of_raw(1)).is_empty());
    let length = whole.encode().len();
    for cut in (0..length).step_by(7) {
        let bytes = whole.encode().slice(..cut);
        // Half of the streams end, the others stay open.
        liar.world.with_raw(0, |raw, _| {
            let stream = raw.links[second].open(bytes);
            if let Some(stream) = stream.filter(|_| cut % 2 == 0) {
                raw.links[second].finish(stream);
            }
        });
        liar.run(10);
    }
    liar.run(2000);
    assert!(liar.world.hosts[0].rings.received(subscription, of_raw(1)).is_empty());
    liar.ends();
}

#[test]
fn second_links_beyond_one_end_and_those_without_an_election_do_not_stay() {
    let (mut liar, [first, second], ..) = publisher(34);
    let mut last = second;
    for election in 3..20 {
        let next = liar.stands(election as u8, election);
        assert_eq!(liar.closed(last), Some(CloseCode::Replaced), "{}", liar.world.describe());
        last = next;
    }
    assert_eq!(liar.held(), (2, 2), "{}", liar.world.describe());
    // An older election, and one beside a link that is another's, that ended or that never was.
    let older = liar.stands(21, 1);
    assert_eq!(liar.closed(older), Some(CloseCode::Replaced));
    let daemon = liar.world.hosts[1].daemon;
    let links = liar.world.hosts[0].links().unwrap();
    let of_other = links.name_of(links.with_daemon(daemon)[0][0]).unwrap();
    for beside in [of_other, [2; 16], [0x77; 16]] {
        let false_claim = liar.dial(0, 1);
        liar.hello(0, false_claim, LOWEST, Some(beside));
        liar.run(50);
        liar.say(false_claim, &elected(22, 40, Some(true)));
        liar.run(50);
        assert_eq!(liar.closed(false_claim), Some(CloseCode::Replaced));
    }
    // A connection that is to stand by is not put in use, and one that is not does not stand by.
    for (beside, standby) in [(Some(IN_USE), None), (None, Some(true))] {
        let other = liar.dial(0, 1);
        liar.hello(0, other, LOWEST, beside);
        liar.run(50);
        liar.say(other, &elected(23, 50, standby));
        liar.run(50);
        assert_eq!(liar.closed(other), Some(CloseCode::OutOfOrder));
    }
    assert_eq!(liar.held(), (2, 2), "{}", liar.world.describe());
    // Nobody elects these: an identity has sixteen connections of this kind at most, for ten seconds.
    for _ in 0..40 {
        let waits = liar.dial(0, 1);
        liar.hello(0, waits, LOWEST, Some(IN_USE));
        liar.run(20);
        assert!(liar.held().1 <= 17, "{:?}", liar.held());
    }
    liar.run(11_000);
    assert_eq!(liar.held(), (2, 2), "{}", liar.world.describe());
    for link in [first, last] {
        assert!(liar.link(link).closed.is_none(), "{}", liar.world.describe());
    }
    // The second link ends with the link in use.
    liar.world.with_raw(0, |raw, now| raw.close(first, now));
    liar.run(100);
    assert_eq!(liar.closed(last), Some(CloseCode::Replaced), "{}", liar.world.describe());
    assert_eq!(liar.held(), (1, 1), "{}", liar.world.describe());
    liar.ends();
}

/// Returns the ELECTED messages that came over a link.
fn elections(link: &RawLink) -> Vec<Elected> {
    let elected = link.messages.iter().filter_map(|message| match message {
        LinkMessage::Elected(elected) => Some(*elected),
        _ => None,
    });
    elected.collect()
}

/// Lets the victim elect two links of the first peer.
fn is_elected_twice(liar: &mut RawLiar) -> [usize; 2] {
    let first = liar.dial(0, 0);
    liar.hello(0, first, HIGHEST, None);
    liar.run_until(|world| world.raws[0].links[first].is_elected());
    let name = elections(liar.link(first))[0].link;
    let second = liar.dial(0, 1);
    liar.hello(0, second, HIGHEST, Some(name));
    liar.run_until(|world| world.raws[0].links[second].is_elected());
    [first, second]
}

#[test]
fn requests_for_a_switch_count_once() {
    let mut liar = RawLiar::new(35, [HIGHEST]);
    liar.second_link();
    let [first, second] = is_elected_twice(&mut liar);
    assert_eq!(elections(liar.link(second))[0].standby, Some(true));
    for on in [first, second, second] {
        (0..1000).for_each(|_| liar.say(on, &LinkMessage::SwitchOver));
        liar.run(200);
    }
    let of_second = elections(liar.link(second));
    assert_eq!(of_second.len(), 2, "{of_second:?}");
    assert_eq!((of_second[1].link, of_second[1].standby), (of_second[0].link, None));
    assert_eq!(elections(liar.link(first)).len(), 1);
    assert!(liar.link(second).closed.is_none());
    // The link before the switch may be asked for, too, and does not come back.
    (0..10).for_each(|_| liar.say(first, &LinkMessage::SwitchOver));
    liar.run(6000);
    assert_eq!(elections(liar.link(first)).len(), 1);
    // The side that does not elect is told off.
    liar.say(second, &elected(9, 1000, None));
    liar.run(100);
    assert_eq!(liar.closed(second), Some(CloseCode::OutOfOrder));
    liar.ends();
}

/// Publishes a topic for the peer, which reads the streams of one of its two links, or of none.
fn reads(
    seed: u64,
    samples: usize,
    reads: Option<usize>,
    acknowledges: bool,
) -> (RawLiar, u64, u64) {
    let mut liar = RawLiar::new(seed, [HIGHEST]);
    liar.second_link();
    let publisher = liar.world.hosts[0].rings.create_publisher("/unread", Qos::keep_all());
    liar.world.hosts[0].touch_graph();
    let links = is_elected_twice(&mut liar);
    liar.say(links[0], &subscribe(1, "/unread", Qos::keep_all()));
    liar.run(500);
    let mut published = 0;
    for _ in 0..samples {
        published += u64::from(liar.world.hosts[0].rings.publish(publisher, 2000));
        liar.world.hosts[0].ring();
        liar.run(10);
        liar.world.with_raw(0, |raw, _| {
            if let Some(reads) = reads {
                let link = &mut raw.links[links[reads]];
                for stream in link.opened.clone() {
                    link.read(stream);
                }
            }
            if acknowledges {
                let sequence = published;
                let of = ReceivedOf { route: 1, publisher, sequence, dropped: 0 };
                let message = LinkMessage::Received(ReceivedUpTo { flows: vec![of] });
                raw.links[links[0]].say(&message);
            }
        });
    }
    let given_up = liar.world.hosts[0].rings.given_up(publisher);
    (liar, published, given_up)
}

#[test]
fn peer_that_reads_one_link_alone_holds_up_its_own_samples_at_most() {
    // It reads the link in use. The copies fill the other one, and nothing waits for that.
    let (liar, published, given_up) = reads(36, 2000, Some(0), true);
    assert_eq!((published, given_up), (2000, 0), "{}", liar.world.describe());
    liar.ends();
    // It reads the copies, or nothing, and acknowledges no sample: it is given up as stalled.
    for reads_link in [Some(1), None] {
        let (liar, published, given_up) = reads(37, 6000, reads_link, false);
        assert!(published > 1000 && given_up > 0, "{published}, {given_up}");
        liar.ends();
    }
}

#[test]
fn peers_with_many_daemon_ids_leave_second_links_to_others() {
    for elects in [true, false] {
        // Peers of five identities, at five addresses, have sixteen daemon ids each.
        let mut liar = RawLiar::new(38, [HIGHEST; 5]);
        for raw in 0..5 {
            for id in 0..16 {
                let mut daemon = if elects { LOWEST } else { HIGHEST };
                (daemon.0[14], daemon.0[15]) = (raw as u8 + 1, id);
                let name = [raw as u8 * 16 + id + 1; 16];
                let [first, _] = [0, 1].map(|path| {
                    let link = liar.dial(raw, path);
                    let beside = (path == 1).then(|| match elects {
                        true => name,
                        false => {
                            let links = &liar.world.raws[raw].links;
                            elections(&links[links.len() - 2])[0].link
                        }
                    });
                    liar.hello(raw, link, daemon, beside);
                    liar.run(20);
                    if elects {
                        let election = u64::from(id) + 1 + path as u64 * 100;
                        let (link_name, standby) =
                            if path == 0 { (name, None) } else { ([0x80 | id; 16], Some(true)) };
                        let message = Elected { link: link_name, election, standby };
                        liar.world.with_raw(raw, |raw, _| {
                            raw.links[link].say(&LinkMessage::Elected(message));
                        });
                    }
                    liar.run(20);
                    link
                });
                assert!(
                    liar.world.raws[raw].links[first].closed.is_none(),
                    "{}",
                    liar.world.describe()
                );
            }
        }
        let (standby, others) = liar.held();
        assert!((60..=64).contains(&standby), "{elects}: {standby} of {others}");
        // The honest host comes last.
        liar.second_link();
        liar.run(5000);
        assert_eq!(RawLiar::stands_by(&liar.world), [true; 2], "{elects}");
        assert!(liar.held().0 <= 64, "{elects}: {:?}", liar.held());
        liar.ends();
    }
}

#[test]
fn copies_of_calls_with_any_number_reach_no_other_service() {
    let (mut liar, [first, second], _, route) = publisher(39);
    for on in [second, first] {
        for route in route.saturating_sub(2)..route + 4 {
            for kind in [Kind::Request, Kind::Response] {
                for number in [1, u64::MAX] {
                    let call = CopyStream::new("/t", route, of_raw(1), number);
                    liar.open(on, CopyStream { kind, after: 0, ..call }.encode());
                }
            }
        }
        liar.run(1500);
    }
    liar.ends();
}
