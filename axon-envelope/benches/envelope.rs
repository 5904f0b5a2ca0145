//! What the envelope costs over its bare AEAD, at several sizes and for both back ends.
//!
//! `cargo bench -p axon-envelope --all-features`; compare `seal` with `bare seal` and `open` with
//! `bare open` of one library and size. Each open is of a new message under a key of its own
//! opener, as replay refusal wants it; that set-up is outside the measurement.

use std::hint::black_box;
use std::time::Duration;

use axon_envelope::aead::Aead;
use axon_envelope::{
    Channel, Delivery, KeyId, Kind, KmeKey, Limits, MESSAGES_PER_KEY, Opener, Route, Sealer,
    TopicHash,
};
use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};

const SIZES: [usize; 4] = [64, 4 << 10, 64 << 10, 8 << 20];
const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };
const NOW: Duration = Duration::ZERO;

fn channel() -> Channel {
    Channel::new("sae-robot-a", "sae-robot-b", [1; 32]).unwrap()
}

fn key_id() -> KeyId {
    KeyId::new("bc490419-7d60-487f-adc1-4ddcc177c139").unwrap()
}

fn sealer<A: Aead>() -> Sealer<A> {
    Sealer::with_aead(&channel(), key_id(), KmeKey::take(&mut [9; 32])).unwrap()
}

fn opener<A: Aead>() -> Opener<A> {
    let mut opener = Opener::with_limits(channel(), Limits::default()).unwrap();
    opener.add_key(key_id(), KmeKey::take(&mut [9; 32])).unwrap();
    opener
}

/// Ten messages a turn: a whole key.
fn bench<A: Aead>(c: &mut Criterion) {
    for size in SIZES {
        let mut group = c.benchmark_group(format!("{}/{size}", A::NAME));
        group.throughput(Throughput::Bytes((size * usize::from(MESSAGES_PER_KEY)) as u64));
        if size > 1 << 20 {
            group.sample_size(10);
        }
        let header_len = sealer::<A>().header_len();
        let mut frame = vec![0x5a; header_len + size + 16];

        let bare = A::new(&[9; 32]);
        let aad = vec![0; header_len];
        group.bench_function("bare seal", |b| {
            b.iter(|| {
                for index in 0..MESSAGES_PER_KEY {
                    let nonce = [index; 12];
                    let body = &mut frame[header_len..][..size];
                    black_box(bare.seal_in_place(&nonce, &aad, body).unwrap());
                }
            });
        });
        group.bench_function("seal", |b| {
            let run = |sealer: &mut Sealer<A>| {
                for _ in 0..MESSAGES_PER_KEY {
                    let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
                    slot.seal_in_place(ROUTE, &mut frame).unwrap();
                }
            };
            b.iter_batched_ref(sealer::<A>, run, BatchSize::PerIteration);
        });

        let mut sealed = sealer::<A>();
        let envelopes: Vec<Vec<u8>> = (0..MESSAGES_PER_KEY)
            .map(|_| {
                let mut frame = vec![0x5a; header_len + size + 16];
                let slot = sealed.slot(NOW, Delivery::Reliable).unwrap();
                slot.seal_in_place(ROUTE, &mut frame).unwrap();
                frame
            })
            .collect();
        let mut out = vec![0; size];
        let messages: Vec<(Vec<u8>, [u8; 16])> = (0..MESSAGES_PER_KEY)
            .map(|index| {
                let mut body = vec![0x5a; size];
                let tag = bare.seal_in_place(&[index; 12], &aad, &mut body).unwrap();
                (body, tag)
            })
            .collect();
        group.bench_function("bare open", |b| {
            b.iter(|| {
                for (index, (body, tag)) in (0..).zip(&messages) {
                    bare.open_apart(&[index; 12], &aad, body, tag, &mut out).unwrap();
                }
            });
        });
        group.bench_function("open", |b| {
            let run = |opener: &mut Opener<A>| {
                for envelope in &envelopes {
                    black_box(opener.open_into(NOW, ROUTE, envelope, &mut out).unwrap());
                }
            };
            b.iter_batched_ref(opener::<A>, run, BatchSize::PerIteration);
        });
        group.bench_function("key set-up", |b| b.iter(|| black_box(sealer::<A>())));
        group.finish();
    }
}

fn all(c: &mut Criterion) {
    #[cfg(feature = "aws-lc-rs")]
    bench::<axon_envelope::aead::AwsLc>(c);
    #[cfg(feature = "rust-crypto")]
    bench::<axon_envelope::aead::RustCrypto>(c);
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1))
        .without_plots();
    targets = all
}
criterion_main!(benches);
