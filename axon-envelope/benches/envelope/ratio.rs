//! Sealing and opening at several sizes, each as a ratio to the bare AEAD.
//!
//! The bare AEAD has the same key, nonces, associated data and buffers. It writes no header, looks
//! up no key and remembers no index.

use std::hint::black_box;
use std::time::Duration;

use axon_envelope::Delivery;
use axon_envelope::aead::Aead;

use crate::Effort;
use crate::bed::{
    AEAD_KEY, HEADER_LEN, NOW, PER_KEY, ROUTE, envelopes, least, median, nonce, opener, repeat,
    sealer, time,
};

const SIZES: [usize; 7] = [64, 1 << 10, 4 << 10, 16 << 10, 64 << 10, 1 << 20, 8 << 20];

#[derive(Clone, Copy, PartialEq)]
enum Way {
    SealInPlace,
    SealInto,
    OpenInPlace,
    OpenInto,
}

struct Bed<A> {
    bare: A,
    size: usize,
    /// One buffer for each message of a batch.
    frames: Vec<Vec<u8>>,
    /// What a sealer makes of its first messages.
    envelopes: Vec<Vec<u8>>,
    plaintext: Vec<u8>,
    out: Vec<u8>,
}

impl<A: Aead> Bed<A> {
    fn new(size: usize) -> Self {
        // A batch takes some microseconds at least, and a message of a mebibyte is its own batch.
        let batch = ((256 << 10) / size).clamp(1, 50) * if size < 1 << 20 { PER_KEY } else { 1 };
        Self {
            bare: A::new(&AEAD_KEY),
            size,
            frames: vec![vec![0x5a; HEADER_LEN + size + 16]; batch],
            envelopes: envelopes::<A>(batch.min(PER_KEY), size),
            plaintext: vec![0x5a; size],
            out: vec![0; size],
        }
    }

    /// Each batch of opening in place finds its buffers as they came off the wire.
    fn refill(&mut self, way: Way) {
        if way == Way::OpenInPlace {
            let envelopes = self.envelopes.iter().cycle();
            self.frames.iter_mut().zip(envelopes).for_each(|(to, from)| to.copy_from_slice(from));
        }
    }

    fn bare(&mut self, way: Way) -> Duration {
        self.refill(way);
        let Self { bare, size, frames, envelopes, plaintext, out } = self;
        time(|| {
            for (frame, envelope) in frames.iter_mut().zip(envelopes.iter().cycle()) {
                let (header, rest) = envelope.split_at(HEADER_LEN);
                let (ciphertext, tag) = rest.split_at(*size);
                let (nonce, tag) = (nonce(header), tag.try_into().unwrap());
                let body = &mut frame[HEADER_LEN..][..*size];
                match way {
                    Way::SealInPlace => {
                        black_box(bare.seal_in_place(nonce, header, body).unwrap());
                    }
                    Way::SealInto => {
                        black_box(bare.seal_apart(nonce, header, plaintext, body).unwrap());
                    }
                    Way::OpenInPlace => bare.open_in_place(nonce, header, body, tag).unwrap(),
                    Way::OpenInto => bare.open_apart(nonce, header, ciphertext, tag, out).unwrap(),
                }
            }
        })
    }

    /// The same with envelopes, ten to a key. Preparing the keys is not part of it.
    fn envelope(&mut self, way: Way) -> Duration {
        self.refill(way);
        let Self { frames, envelopes, plaintext, out, .. } = self;
        let keys = frames.len().div_ceil(PER_KEY);
        let mut sealers: Vec<_> = (0..keys).map(|_| sealer::<A>()).collect();
        let mut openers: Vec<_> = (0..keys).map(|_| opener::<A>()).collect();
        time(|| {
            let ends = sealers.iter_mut().zip(&mut openers);
            for (frames, (sealer, opener)) in frames.chunks_mut(PER_KEY).zip(ends) {
                for (frame, envelope) in frames.iter_mut().zip(envelopes.iter()) {
                    match way {
                        Way::SealInPlace => {
                            let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
                            slot.seal_in_place(ROUTE, frame).unwrap();
                        }
                        Way::SealInto => {
                            let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
                            slot.seal_into(ROUTE, &[plaintext], frame).unwrap();
                        }
                        Way::OpenInPlace => {
                            black_box(opener.open_in_place(NOW, ROUTE, frame).unwrap());
                        }
                        Way::OpenInto => {
                            opener.open_into(NOW, ROUTE, envelope, out).unwrap();
                        }
                    }
                }
            }
        })
    }

    /// Nanoseconds a message with the bare AEAD and with the envelope, the least of all rounds
    /// each; their ratio; and the median of the rounds' ratios.
    fn measure(&mut self, way: Way, effort: Effort) -> [f64; 4] {
        let messages = self.frames.len() as f64;
        // Each goes first in every second round.
        let rounds = repeat(effort, |round| {
            if round.is_multiple_of(2) {
                let bare = self.bare(way);
                (bare, self.envelope(way))
            } else {
                let envelope = self.envelope(way);
                (self.bare(way), envelope)
            }
        });
        let nanos = |time: Duration| time.as_nanos() as f64 / messages;
        let (bare, envelope): (Vec<f64>, Vec<f64>) =
            rounds.into_iter().map(|(bare, envelope)| (nanos(bare), nanos(envelope))).unzip();
        let ratios = bare.iter().zip(&envelope).map(|(bare, envelope)| envelope / bare).collect();
        let (bare, envelope) = (least(&bare), least(&envelope));
        [bare, envelope, envelope / bare, median(ratios)]
    }
}

/// Prints the ratios of both directions, in place and from buffer to buffer.
pub(crate) fn table<A: Aead>(effort: Effort) {
    for (title, ways) in [
        ("seal", [("in place", Way::SealInPlace), ("into a buffer", Way::SealInto)]),
        ("open", [("in place", Way::OpenInPlace), ("into a buffer", Way::OpenInto)]),
    ] {
        println!("\n{}, {title}\n", A::NAME);
        print!("| bytes ");
        for (name, _) in ways {
            print!("| {name}: bare, ns | envelope, ns | ratio of minima | median ratio ");
        }
        println!("|\n|{}", " --: |".repeat(1 + 4 * ways.len()));
        for size in SIZES {
            let mut bed = Bed::<A>::new(size);
            print!("| {size} ");
            for (_, way) in ways {
                let [bare, envelope, ratio, median] = bed.measure(way, effort);
                print!("| {bare:.0} | {envelope:.0} | {ratio:.3} | {median:.3} ");
            }
            println!("|");
        }
    }
}
