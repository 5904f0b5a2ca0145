//! Partitions, addresses, NATs, and hosts that are down or paused.

use std::net::IpAddr;

use super::*;

#[test]
fn partition_holds_in_both_directions_and_in_flight() {
    let mut network = network(1, 4);
    send(&mut network, START, 0, 2, 1);
    let cut = network.partition(&[0, 1], None);
    for (number, (from, to)) in [(0, 3), (3, 1), (0, 1), (3, 2)].into_iter().enumerate() {
        send(&mut network, START, from, to, number as u32 + 10);
    }
    network.send_multicast(START, socket(0), 9, &99_u32.to_be_bytes());
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [12, 13, 99]);
    assert_eq!(network.counters(0).dropped(Cause::Cut), 4);
    network.heal(cut);
    network.heal(cut);
    send(&mut network, ms(1), 0, 3, 20);
    assert_eq!(numbers(&drain(&mut network)), [20]);
    assert_conserved(&network);
}

#[test]
fn one_way_cut_ends_by_itself() {
    let mut network = network(1, 2);
    network.cut(&[0], &[1], Some(ms(10)));
    for now in [ms(0), ms(9), ms(10)] {
        send(&mut network, now, 0, 1, now.as_millis() as u32);
        send(&mut network, now, 1, 0, 100);
    }
    assert_eq!(numbers(&drain(&mut network)), [100, 100, 10, 100]);
    assert_eq!(network.cuts.len(), 0, "ended cuts cost nothing");
}

#[test]
fn overlapping_partitions_heal_apart() {
    let mut network = network(1, 2);
    let one = network.partition(&[0], None);
    network.cut(&[0], &[1], None);
    network.heal(one);
    send(&mut network, START, 0, 1, 1);
    send(&mut network, START, 1, 0, 2);
    assert_eq!(numbers(&drain(&mut network)), [2]);
    network.heal_all();
    let late = network.add_host(&[ip(2)]);
    network.partition(&[1], None);
    send(&mut network, ms(1), 0, late, 3);
    assert_eq!(numbers(&drain(&mut network)), [3]);
}

#[test]
fn moved_host_gets_nothing_at_its_old_address() {
    let mut network = network(1, 2);
    let (old, new) = (socket(1), SocketAddr::from(([10, 7, 7, 7], 7_400)));
    send(&mut network, START, 0, 1, 1);
    network.move_host(ip(1), Ipv4Addr::new(10, 7, 7, 7));
    send(&mut network, START, 0, 1, 2);
    network.send(START, socket(0), new, None, &3_u32.to_be_bytes(), None);
    network.send(START, new, socket(0), None, &4_u32.to_be_bytes(), None);
    network.send(START, old, socket(0), None, &5_u32.to_be_bytes(), None);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [3, 4]);
    assert_eq!((deliveries[0].1.host, deliveries[0].1.at), (1, new));
    assert_eq!(network.counters(0).dropped(Cause::Unreachable), 2);
    assert_eq!(network.unknown_source(), 1);
    // Another host takes the address while a packet to the former owner is in flight.
    network.send(ms(1), socket(0), new, None, &6_u32.to_be_bytes(), None);
    network.move_host(Ipv4Addr::new(10, 7, 7, 7), ip(1));
    network.add_host(&[Ipv4Addr::new(10, 7, 7, 7)]);
    assert_eq!(drain(&mut network), []);
    assert_conserved(&network);
}

#[test]
fn interfaces_of_one_host_have_their_own_paths() {
    let mut network = network(1, 1);
    let (wifi, cell) = (Ipv4Addr::new(10, 1, 0, 1), Ipv4Addr::new(10, 2, 0, 1));
    let robot = network.add_host(&[wifi, cell]);
    network.set_path_between(ip(0), cell, Some(Path { delay: ms(40), ..Path::default() }));
    let send_both = |network: &mut Network, now| {
        for to in [cell, wifi] {
            network.send(now, socket(0), (to, 1).into(), None, b"abcd", None);
        }
    };
    send_both(&mut network, START);
    let deliveries = drain(&mut network);
    assert!(deliveries.iter().all(|(_, delivery)| delivery.host == robot));
    assert_eq!([deliveries[0].1.at.ip(), deliveries[1].1.at.ip()], [wifi, cell]);
    assert_eq!(deliveries[1].0, ms(40));

    send_both(&mut network, ms(100));
    network.set_interface_up(wifi, false);
    send_both(&mut network, ms(200));
    network.send(ms(200), (wifi, 1).into(), socket(0), None, b"abcd", None);
    let deliveries = drain(&mut network);
    assert!(deliveries.iter().all(|(_, delivery)| delivery.at.ip() == cell));
    assert_eq!(deliveries.len(), 2);
    assert_eq!(network.counters(0).dropped(Cause::InterfaceDown), 2);
    assert_eq!(network.counters(robot).dropped(Cause::InterfaceDown), 1);
    network.set_interface_up(wifi, true);
    send_both(&mut network, ms(300));
    assert_eq!(drain(&mut network).len(), 2);
    assert_eq!(network.addresses(robot).collect::<Vec<_>>(), [wifi, cell]);
}

const OUTER: Ipv4Addr = Ipv4Addr::new(203, 0, 113, 1);

/// Creates a network in which host 0 is public, and hosts 1 and 2 are behind one NAT.
fn behind_nat(filtering: Filtering, lifetime: Option<Duration>) -> (Network, NatId) {
    let mut network = network(1, 3);
    let nat = network.add_nat(OUTER, filtering, lifetime);
    for host in [1, 2] {
        network.put_behind(ip(host), nat);
        network.set_segment(ip(host), 1);
    }
    (network, nat)
}

fn reply(network: &mut Network, now: Duration, to: SocketAddr) -> Vec<(Duration, Delivery)> {
    network.send(now, socket(0), to, None, &7_u32.to_be_bytes(), None);
    drain(network)
}

#[test]
fn nat_rebind_drops_packets_to_the_old_address() {
    let (mut network, nat) = behind_nat(Filtering::EndpointIndependent, None);
    send(&mut network, START, 1, 0, 1);
    let old = drain(&mut network)[0].1.from;
    assert_eq!(old.ip(), OUTER);
    let back = reply(&mut network, ms(1), old);
    assert_eq!((back[0].1.host, back[0].1.at, back[0].1.from), (1, socket(1), socket(0)));

    // One packet is in flight when the port changes, one comes later.
    network.send(ms(2), socket(0), old, None, &8_u32.to_be_bytes(), None);
    network.rebind(nat, None);
    assert_eq!(reply(&mut network, ms(2), old), []);
    assert_eq!(network.counters(0).dropped(Cause::Nat), 2);
    send(&mut network, ms(3), 1, 0, 2);
    let new = drain(&mut network)[0].1.from;
    assert!(new.ip() == OUTER && new != old);
    assert_eq!(numbers(&reply(&mut network, ms(4), new)), [7]);

    let other = Ipv4Addr::new(203, 0, 113, 2);
    network.rebind(nat, Some(other));
    assert_eq!(reply(&mut network, ms(5), new), []);
    assert_eq!(network.counters(0).dropped(Cause::Unreachable), 1);
    send(&mut network, ms(6), 1, 0, 3);
    let newest = drain(&mut network)[0].1.from;
    assert_eq!(newest.ip(), other);
    assert_eq!(numbers(&reply(&mut network, ms(7), newest)), [7]);
    assert_conserved(&network);
}

#[test]
fn private_addresses_are_reached_from_behind_the_same_nat_only() {
    let (mut network, nat) = behind_nat(Filtering::AddressAndPortDependent, None);
    let other =
        network.add_nat(Ipv4Addr::new(203, 0, 113, 9), Filtering::EndpointIndependent, None);
    let far = network.add_host(&[ip(3)]);
    network.put_behind(ip(3), other);
    send(&mut network, START, 0, 1, 1);
    send(&mut network, START, far, 1, 2);
    send(&mut network, START, 2, 1, 3);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [3]);
    assert_eq!(deliveries[0].1.from, socket(2), "no translation inside");

    // A forwarded port is reached from outside, and by hairpin from inside.
    network.forward_port(nat, 7_400, SocketAddrV4::new(ip(1), 7_400));
    let outer = SocketAddr::from((OUTER, 7_400));
    assert_eq!(reply(&mut network, ms(1), outer)[0].1.host, 1);
    network.send(ms(2), socket(2), outer, None, &9_u32.to_be_bytes(), None);
    let hairpin = drain(&mut network);
    assert_eq!((hairpin[0].1.host, hairpin[0].1.from.ip()), (1, IpAddr::from(OUTER)));
    // Multicast stays in its segment.
    network.send_multicast(ms(3), socket(1), 1, b"abcd");
    let hosts: Vec<usize> = drain(&mut network).iter().map(|(_, d)| d.host).collect();
    assert_eq!(hosts, [2]);
}

#[test]
fn idle_mapping_expires() {
    let (mut network, _) = behind_nat(Filtering::EndpointIndependent, Some(ms(30_000)));
    send(&mut network, START, 1, 0, 1);
    let outer = drain(&mut network)[0].1.from;
    assert_eq!(reply(&mut network, ms(29_000), outer).len(), 1);
    assert_eq!(reply(&mut network, ms(31_000), outer), []);
    send(&mut network, ms(32_000), 1, 0, 2);
    assert_ne!(drain(&mut network)[0].1.from, outer);
}

#[test]
fn closed_host_gets_nothing() {
    let mut network = network(1, 2);
    send(&mut network, START, 0, 1, 1);
    network.set_listening(1, false);
    assert_eq!(drain(&mut network), []);
    assert_eq!(network.counters(0).dropped(Cause::NoSocket), 1);
    send(&mut network, ms(1), 0, 1, 2);
    network.set_listening(1, true);
    assert_eq!(numbers(&drain(&mut network)), [2], "a restarted daemon gets what is in flight");
}

#[test]
fn paused_host_gets_its_receive_buffer_afterwards() {
    let mut network = network(1, 3);
    network.pause(1);
    for number in 0..5 {
        send(&mut network, ms(number), 0, 1, number as u32);
    }
    send(&mut network, ms(3), 0, 2, 33);
    assert_eq!(numbers(&drain(&mut network)), [33]);
    assert_eq!((network.poll_timeout(), network.in_flight()), (None, 5));
    assert_conserved(&network);
    // A partition does not reach into the kernel's buffer.
    network.partition(&[1], None);
    network.resume(ms(100), 1);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [0, 1, 2, 3, 4]);
    assert!(deliveries.iter().all(|(at, _)| *at == ms(100)));
    assert_conserved(&network);
}

#[test]
fn receive_buffer_is_bounded_and_lost_with_its_host() {
    let mut network = network(1, 2);
    network.pause(1);
    for _ in 0..6_000 {
        network.send(START, socket(0), socket(1), None, &[0; 996], None);
    }
    assert_eq!(drain(&mut network), []);
    assert_eq!(network.in_flight(), RECEIVE_BUFFER / 1_024);
    assert_eq!(network.counters(0).dropped(Cause::ReceiveBuffer), 6_000 - 4_096);
    assert_conserved(&network);
    network.set_listening(1, false);
    network.resume(ms(1), 1);
    assert_eq!(drain(&mut network), []);
    assert_eq!(network.counters(0).dropped(Cause::NoSocket), 4_096);
    assert_eq!(network.in_flight(), 0);
    assert_conserved(&network);
}

#[test]
fn host_paused_again_before_its_buffer_is_read_loses_nothing() {
    let mut network = network(1, 2);
    network.pause(1);
    send(&mut network, START, 0, 1, 1);
    drain(&mut network);
    network.resume(ms(1), 1);
    network.pause(1);
    assert_eq!(drain(&mut network), []);
    network.resume(ms(2), 1);
    assert_eq!(numbers(&drain(&mut network)), [1]);
}
