//! Inputs at and beyond the limits.

use super::*;

#[test]
fn loss_of_1000_per_mille_delivers_nothing() {
    let mut network = network(1, 2);
    network.set_default_path(Path { loss: 1.0, duplicate: 1.0, ..Path::default() });
    for number in 0..1_000 {
        send(&mut network, START, 0, 1, number);
    }
    assert_eq!(drain(&mut network), []);
    assert_eq!(network.counters(0).dropped(Cause::Loss), 1_000);
    assert_eq!(network.poll_timeout(), None);
    assert_conserved(&network);
}

#[test]
fn rate_of_zero_delivers_nothing() {
    let mut network = network(1, 2);
    let rate = Some(Rate::new(0, Duration::MAX));
    network.set_path(0, 1, Some(Path { rate, ..Path::default() }));
    send(&mut network, START, 0, 1, 1);
    send(&mut network, START, 1, 0, 2);
    assert_eq!(numbers(&drain(&mut network)), [2]);
    assert_eq!(network.counters(0).dropped(Cause::Queue), 1);
}

#[test]
fn tiny_rate_delivers_its_queue_and_drops_the_rest() {
    let mut network = network(1, 2);
    let limit = QueueLimit::Bytes(320);
    let rate = Some(Rate { bytes_per_second: 1, limit, mark_after: None });
    network.set_default_path(Path { rate, delay: ms(0), ..Path::default() });
    for number in 0..1_000 {
        send(&mut network, START, 0, 1, number);
    }
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), (0..10).collect::<Vec<_>>());
    let times: Vec<u64> = deliveries.iter().map(|(at, _)| at.as_secs()).collect();
    assert_eq!(times, (1..=10).map(|n| n * 32).collect::<Vec<_>>());
    assert_eq!(network.counters(0).dropped(Cause::Queue), 990);
    assert_conserved(&network);
}

#[test]
fn host_reaches_itself_despite_total_loss_and_partition() {
    let mut network = network(1, 2);
    network.set_default_path(Path { loss: 1.0, ..Path::default() });
    network.partition(&[0], None);
    send(&mut network, START, 0, 0, 5);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [5]);
    assert!(deliveries[0].0 > START, "time passes, or a host that answers itself never stops");
    assert_eq!((deliveries[0].1.at, deliveries[0].1.from), (socket(0), socket(0)));
}

#[test]
fn unknown_addresses_are_counted() {
    let mut network = network(1, 1);
    let nobody = SocketAddr::from(([10, 9, 9, 9], 1));
    let v6 = "[2001:db8::1]:1".parse().unwrap();
    network.send(START, socket(0), nobody, None, &[0; 2_500], Some(1_000));
    network.send(START, socket(0), v6, None, &[], None);
    network.send(START, nobody, socket(0), None, &[0; 2_500], Some(1_000));
    network.send(START, v6, socket(0), None, &[], None);
    network.send_multicast(START, nobody, 1, &[]);
    assert_eq!(drain(&mut network), []);
    assert_eq!(network.counters(0).dropped(Cause::Unreachable), 4);
    assert_eq!(network.unknown_source(), 5);
    assert_conserved(&network);
}

#[test]
fn mapped_v6_addresses_are_v4() {
    let mut network = network(1, 2);
    let mapped = SocketAddr::from((ip(1).to_ipv6_mapped(), 7_400));
    network.send(START, socket(0), mapped, None, b"abc", None);
    assert_eq!(drain(&mut network)[0].1.at, socket(1));
}

#[test]
fn empty_datagram_arrives() {
    let mut network = network(1, 2);
    for segment in [None, Some(0), Some(1_200)] {
        network.send(START, socket(0), socket(1), None, &[], segment);
    }
    let deliveries = drain(&mut network);
    assert_eq!(deliveries.len(), 3);
    assert!(deliveries.iter().all(|(_, delivery)| delivery.bytes.is_empty()));
    assert_eq!((network.counters(1).received, network.counters(1).received_bytes), (3, 0));
}

#[test]
fn bursts_are_split_into_segments() {
    let mut network = network(1, 2);
    let bytes: Vec<u8> = (0..1_000_000_u32).map(|n| (n % 251) as u8).collect();
    for (segment, datagrams) in
        [(1, 1_000_000), (1_200, 834), (999_999, 2), (1_000_000, 1), (usize::MAX, 1)]
    {
        network.set_default_path(Path { mtu: usize::MAX, ..Path::default() });
        network.send(START, socket(0), socket(1), None, &bytes, Some(segment));
        let deliveries = drain(&mut network);
        assert_eq!(deliveries.len(), datagrams);
        let joined: Vec<u8> = deliveries.iter().flat_map(|(_, d)| d.bytes.to_vec()).collect();
        assert!(joined == bytes, "segments of {segment} changed the bytes");
    }
    assert_eq!(network.counters(0).sent, 1_000_838);
    assert_eq!(network.counters(0).sent_bytes, 5_000_000);
}

#[test]
fn in_flight_limits_hold_and_free_their_memory() {
    let mut network = network(1, 2);
    network.set_in_flight_limit(10, usize::MAX);
    for round in 0..3 {
        for number in 0..100 {
            send(&mut network, ms(round * 100), 0, 1, number);
        }
        assert_eq!(network.in_flight(), 10);
        assert_conserved(&network);
        assert_eq!(numbers(&drain(&mut network)), (0..10).collect::<Vec<_>>());
        assert_eq!(network.in_flight(), 0);
    }
    assert_eq!(network.packets.len(), 10, "slots are used again");
    network.set_in_flight_limit(usize::MAX, 30);
    network.send(START, socket(0), socket(1), None, &[0; 100], Some(9));
    assert_eq!((network.in_flight(), network.bytes_in_flight), (4, 28));
    assert_eq!(network.counters(0).dropped(Cause::InFlightLimit), 270 + 8);
    assert_conserved(&network);
}

#[test]
fn multicast_of_1000_hosts_reaches_each_other_host_once() {
    const HOSTS: usize = 1_000;
    let mut network = network(1, HOSTS);
    for host in 0..HOSTS {
        network.send_multicast(START, socket(host), 7_399, &(host as u32).to_be_bytes());
    }
    assert_eq!(network.in_flight(), HOSTS * (HOSTS - 1));
    let mut heard = vec![0_u32; HOSTS];
    let mut said = vec![0_u32; HOSTS];
    while let Some(delivery) = network.poll_delivery(ms(1)) {
        assert_eq!(delivery.at, SocketAddr::from((ip(delivery.host), 7_399)));
        let from = u32::from_be_bytes((&*delivery.bytes).try_into().unwrap()) as usize;
        assert_eq!(delivery.from, socket(from));
        assert_ne!(delivery.host, from);
        heard[delivery.host] += 1;
        said[from] += 1;
    }
    assert!(heard.iter().chain(&said).all(|count| *count == HOSTS as u32 - 1));
    assert_eq!((network.counters(3).sent, network.counters(3).copies), (1, HOSTS as u64 - 2));
    assert_conserved(&network);
}

#[test]
fn multicast_without_a_receiver_is_counted() {
    let mut network = network(1, 2);
    network.set_segment(ip(1), 4);
    network.send_multicast(START, socket(0), 1, b"beacon");
    assert_eq!(network.counters(0).dropped(Cause::Unreachable), 1);
    network.set_interface_up(ip(0), false);
    network.send_multicast(START, socket(0), 1, b"beacon");
    assert_eq!(network.counters(0).dropped(Cause::InterfaceDown), 1);
    assert_conserved(&network);
}

#[test]
fn longest_times_do_not_overflow() {
    let mut network = network(1, 2);
    let rate = Some(Rate::new(1, Duration::MAX));
    let path = Path {
        delay: Duration::MAX,
        jitter: Duration::MAX,
        reorder: 0.5,
        reorder_delay: Duration::MAX,
        duplicate: 1.0,
        rate,
        ..Path::default()
    };
    network.set_default_path(path);
    for number in 0..10 {
        send(&mut network, Duration::MAX, 0, 1, number);
    }
    assert_eq!(drain(&mut network).len(), 20);
    assert_conserved(&network);
}

#[test]
#[should_panic(expected = "probability outside 0..=1")]
fn path_with_an_impossible_probability_is_refused() {
    network(1, 2).set_path(0, 1, Some(Path { loss: f64::NAN, ..Path::default() }));
}

#[test]
#[should_panic(expected = "is in use")]
fn address_in_use_is_refused() {
    network(1, 2).move_host(ip(0), ip(1));
}
