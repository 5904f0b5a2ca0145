mod hostile;
mod paths;
mod random;
mod topology;

use super::*;

const START: Duration = Duration::ZERO;

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Returns the first address of a host in [`network`].
fn ip(host: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 0, (host / 250) as u8, (host % 250) as u8 + 1)
}

fn socket(host: usize) -> SocketAddr {
    SocketAddr::from((ip(host), 7_400))
}

/// Returns `hosts` hosts on one segment with the default path.
fn network(seed: u64, hosts: usize) -> Network {
    let mut network = Network::new(seed);
    for host in 0..hosts {
        assert_eq!(network.add_host(&[ip(host)]), host);
    }
    network
}

/// Delivers everything, with the times of arrival.
fn drain(network: &mut Network) -> Vec<(Duration, Delivery)> {
    drain_until(network, Duration::MAX)
}

fn drain_until(network: &mut Network, end: Duration) -> Vec<(Duration, Delivery)> {
    let mut all = Vec::new();
    while let Some(at) = network.poll_timeout().filter(|at| *at <= end) {
        while let Some(delivery) = network.poll_delivery(at) {
            all.push((at, delivery));
        }
    }
    all
}

/// Sends a datagram of 4 bytes with a number from one host to another.
fn send(network: &mut Network, now: Duration, from: usize, to: usize, number: u32) {
    network.send(now, socket(from), socket(to), None, &number.to_be_bytes(), None);
}

fn numbers(deliveries: &[(Duration, Delivery)]) -> Vec<u32> {
    let number = |bytes: &[u8]| u32::from_be_bytes(bytes.try_into().unwrap());
    deliveries.iter().map(|(_, delivery)| number(&delivery.bytes)).collect()
}

/// Checks that each packet was received, dropped for a cause or is in flight.
fn assert_conserved(network: &Network) {
    let all: Vec<&Counters> = (0..network.hosts.len()).map(|host| network.counters(host)).collect();
    let made: u64 = all.iter().map(|counters| counters.sent + counters.copies).sum();
    let ended: u64 = all.iter().map(|counters| counters.received + counters.all_dropped()).sum();
    assert_eq!(made, ended + network.in_flight() as u64, "{all:?}");
    let waiting = network.hosts.iter().flat_map(|host| &host.buffered);
    let held: Vec<usize> =
        network.packets.iter().flatten().chain(waiting).map(|packet| packet.bytes.len()).collect();
    assert_eq!(held.len(), network.in_flight());
    assert_eq!(held.iter().sum::<usize>(), network.bytes_in_flight);
}
