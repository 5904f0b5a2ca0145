//! Random runs: determinism, conservation of packets, and independence of the paths' generators.

use rand::RngExt;

use super::*;
use crate::engine::sim::{
    rng::{Stream, stream},
    trace::Trace,
};

const HOSTS: usize = 12;

fn path(rng: &mut impl RngExt) -> Path {
    let mut probability = || if rng.random_bool(0.5) { 0.0 } else { rng.random_range(0.0..0.5) };
    let (loss, duplicate, reorder) = (probability(), probability(), probability());
    let burst_loss = Some(BurstLoss {
        good_to_bad: probability(),
        bad_to_good: probability(),
        loss_in_bad: probability(),
    });
    let rate = rng.random_bool(0.5).then(|| Rate::new(rng.random_range(0..100_000), ms(50)));
    let mut time = || ms(rng.random_range(0..50));
    let (delay, jitter, reorder_delay) = (time(), time(), time());
    Path {
        delay,
        jitter,
        loss,
        burst_loss,
        duplicate,
        reorder,
        reorder_delay,
        rate,
        ..Path::default()
    }
}

/// Runs random traffic through random faults. Each datagram contains its sender and its receiver.
fn run(seed: u64, calls: usize) -> Trace {
    let mut network = network(seed, HOSTS);
    let nat = network.add_nat([203, 0, 113, 1].into(), Filtering::AddressAndPortDependent, None);
    network.put_behind(ip(3), nat);
    network.set_in_flight_limit(300, 100_000);
    let mut rng = stream(seed, Stream::Workload { host: 0 });
    let (mut now, mut trace) = (START, Trace::new(16));
    let mut cuts = Vec::new();
    for _ in 0..calls {
        now += Duration::from_micros(rng.random_range(0..2_000));
        let [from, to] = [0, 0].map(|_| rng.random_range(0..HOSTS));
        match rng.random_range(0..30) {
            0 => network.set_path(from, to, Some(path(&mut rng))),
            1 => network.set_path(from, to, None),
            2 => cuts.push(network.cut(&[from], &[to], Some(now + ms(20)))),
            3 => cuts.push(network.partition(&[from], None)),
            4 => cuts.drain(..).for_each(|cut| network.heal(cut)),
            5 => network.pause(to),
            6 => network.resume(now, to),
            7 => network.set_listening(to, rng.random_bool(0.7)),
            8 => network.rebind(nat, None),
            9 => network.set_interface_up(ip(to), rng.random_bool(0.7)),
            10 => {
                let [egress, ingress] =
                    [0, 0].map(|_| rng.random_bool(0.3).then(|| Rate::new(200_000, ms(20))));
                network.set_interface_rates(ip(to), egress, ingress);
            }
            11..15 => network.send_multicast(now, socket(from), 7_400, &[from as u8]),
            _ => {
                let mut burst = vec![from as u8; rng.random_range(1..4_000)];
                burst.push(to as u8);
                network.send(now, socket(from), socket(to), None, &burst, Some(1_000));
            }
        }
        while let Some(delivery) = network.poll_delivery(now) {
            let from = usize::from(delivery.bytes[0]);
            assert!(from == 3 || delivery.from == socket(from) || delivery.bytes.len() == 1);
            assert_eq!(delivery.at, socket(delivery.host));
            let length = delivery.bytes.len() as u64;
            trace.event(now, delivery.host, "receive", [from as u64, length, 0]);
        }
        assert!(network.in_flight() <= 300 && network.bytes_in_flight <= 100_000);
        assert_conserved(&network);
    }
    trace
}

#[test]
fn one_seed_gives_one_trace_and_packets_are_conserved() {
    let mut hashes = std::collections::BTreeSet::new();
    let mut received = 0;
    for seed in 0..20 {
        let trace = run(seed, 2_000);
        received += trace.events();
        assert_eq!(run(seed, 2_000).hash(), trace.hash(), "seed {seed}");
        hashes.insert(trace.hash());
    }
    assert_eq!(hashes.len(), 20, "different seeds give different traces");
    assert!(received > 20_000, "{received}");
}

#[test]
fn only_the_seed_changes_which_packets_are_lost() {
    let lost = |seed| {
        let mut network = network(seed, 2);
        network.set_default_path(Path { loss: 0.5, ..Path::default() });
        for number in 0..100 {
            send(&mut network, START, 0, 1, number);
        }
        numbers(&drain(&mut network))
    };
    assert_eq!(lost(1), lost(1));
    assert_ne!(lost(1), lost(2));
}

#[test]
fn traffic_on_one_path_leaves_the_losses_of_others() {
    let received = |others: u32| {
        let mut network = network(5, 3);
        network.set_default_path(Path { loss: 0.5, ..Path::default() });
        for number in 0..100 {
            send(&mut network, START, 0, 1, number);
            for _ in 0..others {
                send(&mut network, START, 1, 0, number);
                send(&mut network, START, 0, 2, number);
            }
        }
        let mut deliveries = drain(&mut network);
        deliveries.retain(|(_, delivery)| delivery.host == 1);
        numbers(&deliveries)
    };
    assert_eq!(received(0), received(3));
}
