//! Delay, loss, order, rate, MTU and ECN of a path.

use super::*;

fn run(path: Path, packets: u32, spacing: Duration) -> (Network, Vec<(Duration, Delivery)>) {
    let mut network = network(7, 2);
    network.set_default_path(path);
    for number in 0..packets {
        send(&mut network, spacing * number, 0, 1, number);
    }
    let deliveries = drain(&mut network);
    assert_conserved(&network);
    (network, deliveries)
}

#[test]
fn packets_arrive_after_the_delay_in_order() {
    let path = Path { delay: ms(20), ..Path::default() };
    let (_, deliveries) = run(path, 100, ms(1));
    for (n, (at, delivery)) in deliveries.iter().enumerate() {
        assert_eq!(*at, ms(20 + n as u64));
        assert_eq!((delivery.host, delivery.at, delivery.from), (1, socket(1), socket(0)));
    }
    assert_eq!(numbers(&deliveries), (0..100).collect::<Vec<_>>());
}

#[test]
fn packets_sent_at_one_time_arrive_in_order() {
    let (_, deliveries) = run(Path::default(), 10_000, Duration::ZERO);
    assert_eq!(numbers(&deliveries), (0..10_000).collect::<Vec<_>>());
}

#[test]
fn jitter_varies_the_delay_and_keeps_the_order() {
    let path = Path { delay: ms(20), jitter: ms(10), ..Path::default() };
    let (_, deliveries) = run(path, 1_000, ms(2));
    assert_eq!(numbers(&deliveries), (0..1_000).collect::<Vec<_>>());
    let delays: Vec<Duration> =
        deliveries.iter().enumerate().map(|(n, (at, _))| *at - ms(2 * n as u64)).collect();
    let (least, most) = (delays.iter().min().unwrap(), delays.iter().max().unwrap());
    assert!(ms(20) <= *least && *least < ms(22), "{least:?}");
    assert!(ms(28) < *most && *most <= ms(30), "{most:?}");
}

#[test]
fn reordering_delays_the_expected_share_of_packets() {
    let path = Path { reorder: 0.1, reorder_delay: ms(20), ..Path::default() };
    let (_, deliveries) = run(path, 10_000, ms(1));
    let numbers = numbers(&deliveries);
    assert_eq!(numbers.len(), 10_000);
    let late = numbers.windows(2).filter(|pair| pair[1] < pair[0]).count();
    assert!((600..1_100).contains(&late), "{late} packets arrived behind later ones");
    let furthest = numbers.iter().enumerate().map(|(n, number)| n.abs_diff(*number as usize));
    assert!(furthest.max().unwrap() <= 20);
}

#[test]
fn loss_and_duplication_have_their_probability() {
    let (network, deliveries) = run(Path { loss: 0.4, ..Path::default() }, 100_000, START);
    assert!((59_000..61_000).contains(&deliveries.len()), "{}", deliveries.len());
    assert_eq!(network.counters(0).dropped(Cause::Loss), 100_000 - deliveries.len() as u64);

    let (network, deliveries) = run(Path { duplicate: 0.25, ..Path::default() }, 100_000, START);
    assert!((124_000..126_000).contains(&deliveries.len()), "{}", deliveries.len());
    assert_eq!(network.counters(0).copies, deliveries.len() as u64 - 100_000);
}

#[test]
fn burst_loss_comes_in_bursts() {
    let burst = BurstLoss { good_to_bad: 0.01, bad_to_good: 0.1, loss_in_bad: 1.0 };
    let path = Path { burst_loss: Some(burst), ..Path::default() };
    let (_, deliveries) = run(path, 100_000, START);
    // The bad state holds 0.01 / (0.01 + 0.1) of the time, and each burst 10 packets on average.
    let lost = 100_000 - deliveries.len();
    assert!((8_000..10_200).contains(&lost), "{lost}");
    let bursts = numbers(&deliveries).windows(2).filter(|pair| pair[1] != pair[0] + 1).count();
    assert!((8..12).contains(&(lost / bursts)), "{lost} lost in {bursts} bursts");
}

#[test]
fn rate_holds_within_a_packet() {
    // The path carries 1,000 bytes and their headers every 1,028 us, independent of the bursts.
    let rate = Some(Rate::new(1_000_000, Duration::from_secs(10)));
    let mut network = network(7, 2);
    network.set_default_path(Path { rate, delay: ms(5), ..Path::default() });
    for burst in 0..50 {
        network.send(ms(burst), socket(0), socket(1), None, &[0; 20_000], Some(1_000));
    }
    for (n, (at, _)) in drain(&mut network).iter().enumerate() {
        assert_eq!(*at, ms(5) + Duration::from_micros(1_028) * (n as u32 + 1));
    }
    assert_eq!(network.counters(1).received, 1_000);
}

#[test]
fn idle_path_does_not_save_up_its_rate() {
    let rate = Some(Rate::new(1_028, Duration::from_secs(10)));
    let mut network = network(7, 2);
    network.set_default_path(Path { rate, delay: ms(0), ..Path::default() });
    let now = Duration::from_secs(100);
    network.send(now, socket(0), socket(1), None, &[0; 2_000], Some(1_000));
    let times: Vec<u64> = drain(&mut network).iter().map(|(at, _)| at.as_secs()).collect();
    assert_eq!(times, [101, 102]);
}

#[test]
fn rates_of_one_direction_leave_the_other_alone() {
    let mut network = network(7, 2);
    let rate = Some(Rate::new(32, Duration::from_secs(10)));
    network.set_path(0, 1, Some(Path { rate, ..Path::default() }));
    send(&mut network, START, 0, 1, 1);
    send(&mut network, START, 1, 0, 2);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [2, 1]);
    assert!(deliveries[0].0 < ms(1) && deliveries[1].0 > ms(999));
}

#[test]
fn interface_rates_hold_over_all_paths_together() {
    let rate = || Some(Rate::new(3_200, Duration::from_secs(10)));
    for (egress, ingress) in [(rate(), None), (None, rate())] {
        let is_egress = egress.is_some();
        let mut network = network(7, 4);
        network.set_interface_rates(ip(0), egress, ingress);
        for number in 0..100 {
            for peer in 1..4 {
                let (from, to) = if is_egress { (0, peer) } else { (peer, 0) };
                send(&mut network, START, from, to, number);
            }
        }
        let deliveries = drain(&mut network);
        assert_eq!(deliveries.len(), 300);
        let last = deliveries.last().unwrap().0;
        assert_eq!(last, Duration::from_secs(3) + Path::default().delay, "{is_egress}");
        assert_conserved(&network);
    }
}

#[test]
fn full_ingress_queue_drops() {
    let mut network = network(7, 3);
    network.set_interface_rates(ip(0), None, Some(Rate::new(3_200, ms(50))));
    for from in [1, 2] {
        for number in 0..100 {
            send(&mut network, START, from, 0, number);
        }
    }
    // One at work, five in 50 ms.
    assert_eq!(drain(&mut network).len(), 6);
    let dropped = [1, 2].map(|host| network.counters(host).dropped(Cause::Queue));
    assert_eq!(dropped.iter().sum::<u64>(), 194);
    assert_conserved(&network);
}

#[test]
fn mtu_counts_the_headers() {
    let mut network = network(7, 2);
    for bytes in [1_472, 1_473] {
        network.send(START, socket(0), socket(1), None, &vec![0; bytes], None);
    }
    let lengths: Vec<usize> = drain(&mut network).iter().map(|(_, d)| d.bytes.len()).collect();
    assert_eq!(lengths, [1_472]);
    assert_eq!(network.counters(0).dropped(Cause::Mtu), 1);
}

#[test]
fn ecn_is_kept_marked_or_bleached() {
    use EcnCodepoint::{Ce, Ect0, Ect1};
    let sent = [None, Some(Ect0), Some(Ect1), Some(Ce)];
    let received = |path: Path| -> Vec<_> {
        let mut network = network(7, 2);
        network.set_default_path(path);
        for ecn in sent {
            network.send(START, socket(0), socket(1), ecn, b"abcd", None);
        }
        drain(&mut network).into_iter().map(|(_, delivery)| delivery.ecn).collect()
    };
    assert_eq!(received(Path::default()), sent);
    assert_eq!(received(Path { bleach_ecn: true, ..Path::default() }), [None; 4]);
    let rate = |mark_after| Rate { mark_after, ..Rate::new(32, Duration::MAX) };
    let marking = |after| Path { rate: Some(rate(Some(after))), ..Path::default() };
    assert_eq!(received(marking(START)), [None, Some(Ce), Some(Ce), Some(Ce)]);
    // The third packet is the first that waits for two seconds.
    assert_eq!(received(marking(ms(2_000))), [None, Some(Ect0), Some(Ce), Some(Ce)]);
}

#[test]
fn shorter_delay_takes_effect_behind_the_packets_in_flight() {
    let mut network = network(7, 2);
    network.set_path(0, 1, Some(Path { delay: ms(100), ..Path::default() }));
    send(&mut network, START, 0, 1, 1);
    let shorter = Path { delay: ms(1), ..network.path(0, 1).clone() };
    network.set_path(0, 1, Some(shorter));
    send(&mut network, START, 0, 1, 2);
    send(&mut network, ms(200), 0, 1, 3);
    let deliveries = drain(&mut network);
    assert_eq!(numbers(&deliveries), [1, 2, 3]);
    assert_eq!([deliveries[0].0, deliveries[1].0, deliveries[2].0], [ms(100), ms(100), ms(201)]);
    network.set_path(0, 1, None);
    assert_eq!(*network.path(0, 1), Path::default());
    assert_eq!(*network.path(1, 0), Path::default());
}

#[test]
fn late_poll_returns_packets_in_order_of_arrival() {
    let mut network = network(7, 3);
    network.set_path(0, 1, Some(Path { delay: ms(30), ..Path::default() }));
    network.set_path(2, 1, Some(Path { delay: ms(10), ..Path::default() }));
    send(&mut network, START, 0, 1, 1);
    send(&mut network, ms(5), 2, 1, 2);
    assert_eq!(network.poll_timeout(), Some(ms(15)));
    assert_eq!(network.poll_delivery(ms(14)), None);
    let first = network.poll_delivery(ms(1_000)).unwrap();
    let second = network.poll_delivery(ms(1_000)).unwrap();
    assert_eq!((first.from, second.from), (socket(2), socket(0)));
}
