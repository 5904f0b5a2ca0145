//! What a message costs whatever its length, and of what parts.

use std::hint::black_box;

use axon_envelope::aead::{Aead, AeadError};
use axon_envelope::{
    Delivery, Header, KeyId, KmeKey, Limits, NONCE_LEN, Opener, Sealer, TAG_LEN, inner,
};

use crate::Effort;
use crate::bed::{
    AEAD_KEY, HEADER_LEN, NOW, PER_KEY, ROUTE, channel, envelopes, least, median, opener, repeat,
    sealer, time,
};

/// Keys, and so sealers or openers, that a batch goes through.
const KEYS: usize = 50;

/// Nanoseconds of one of `count` pieces of work, the least and the median of all rounds. What `make`
/// does is not measured.
fn each<T>(
    effort: Effort,
    count: usize,
    mut make: impl FnMut() -> T,
    mut work: impl FnMut(&mut T),
) -> String {
    let nanos = repeat(effort, |_| {
        let mut prepared = make();
        time(|| work(&mut prepared)).as_nanos() as f64 / count as f64
    });
    format!("{:.1} | {:.1}", least(&nanos), median(nanos))
}

/// Repeats a piece of work that needs nothing prepared.
fn plain<T>(effort: Effort, mut work: impl FnMut() -> T) -> String {
    let batch = |(): &mut ()| (0..KEYS * PER_KEY).for_each(|_| drop(black_box(work())));
    each(effort, KEYS * PER_KEY, || (), batch)
}

fn row(part: &str, nanos: &str) {
    println!("| {part} | {nanos} |");
}

fn head(title: &str) {
    println!("\n{title}\n\n| | ns, minimum | ns, median |\n| --- | --: | --: |");
}

/// Prints what the AEAD takes for a message without any plaintext, and for a key.
pub(crate) fn aead_table<A: Aead>(effort: Effort) {
    head(&format!("{}, in any message", A::NAME));
    let bare = A::new(&AEAD_KEY);
    let nothing =
        |aad: &[u8]| bare.seal_in_place(black_box(&[5; NONCE_LEN]), black_box(aad), &mut []);
    row("empty message without associated data", &plain(effort, || nothing(&[])));
    row("with the header as associated data", &plain(effort, || nothing(&[7; HEADER_LEN])));
    row("a sealer made and dropped, once a key", &plain(effort, sealer::<A>));
}

/// An AEAD that does nothing, so that the remaining time is the envelope's own.
struct Nothing;

impl Aead for Nothing {
    const NAME: &'static str = "nothing";

    fn new(_: &[u8; 32]) -> Self {
        Self
    }

    fn seal_in_place(
        &self,
        _: &[u8; NONCE_LEN],
        _: &[u8],
        _: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        Ok([0; TAG_LEN])
    }

    fn seal_apart(
        &self,
        _: &[u8; NONCE_LEN],
        _: &[u8],
        _: &[u8],
        _: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        Ok([0; TAG_LEN])
    }

    fn open_in_place(
        &self,
        _: &[u8; NONCE_LEN],
        _: &[u8],
        _: &mut [u8],
        _: &[u8; TAG_LEN],
    ) -> Result<(), AeadError> {
        Ok(())
    }

    fn open_apart(
        &self,
        _: &[u8; NONCE_LEN],
        _: &[u8],
        _: &[u8],
        _: &[u8; TAG_LEN],
        _: &mut [u8],
    ) -> Result<(), AeadError> {
        Ok(())
    }
}

/// Prints what the envelope itself takes, with an AEAD that does nothing.
pub(crate) fn envelope_table(effort: Effort) {
    head("The envelope without an AEAD");
    let count = KEYS * PER_KEY;
    let sealers = || -> Vec<Sealer<Nothing>> { (0..KEYS).map(|_| sealer()).collect() };
    let slots = |sealers: &mut Vec<Sealer<Nothing>>| {
        for sealer in sealers {
            for _ in 0..PER_KEY {
                black_box(sealer.slot(black_box(NOW), Delivery::Reliable).unwrap());
            }
        }
    };
    let mut frame = vec![0x5a; HEADER_LEN + 64 + TAG_LEN];
    let seal = |sealers: &mut Vec<Sealer<Nothing>>| {
        for sealer in sealers {
            for _ in 0..PER_KEY {
                let slot = sealer.slot(black_box(NOW), Delivery::Reliable).unwrap();
                slot.seal_in_place(ROUTE, black_box(&mut frame)).unwrap();
            }
        }
    };
    row("sealing, in all", &each(effort, count, sealers, seal));
    row("of it: a slot (count and age)", &each(effort, count, sealers, slots));

    let ours = envelopes::<Nothing>(PER_KEY, 64);
    let mut out = vec![0; 64];
    let openers = || -> Vec<Opener<Nothing>> { (0..KEYS).map(|_| opener()).collect() };
    let open = |openers: &mut Vec<Opener<Nothing>>| {
        for opener in openers {
            for envelope in &ours {
                opener.open_into(NOW, ROUTE, black_box(envelope), &mut out).unwrap();
            }
        }
    };
    row("opening, in all, one key held", &each(effort, count, openers, open));
    row(
        "of it: the header read once",
        &plain(effort, || Header::parse(black_box(&ours[0])).unwrap()),
    );
    many_keys(effort);

    let header = inner::Header {
        gid: [1; 16],
        sequence: 2,
        source_timestamp: 3,
        request_id: inner::RequestId::default(),
        compressed: false,
        age_ms: 4,
        uncompressed_len: 0,
    };
    let encoded = header.encode();
    row("inner header written", &plain(effort, || black_box(&header).encode()));
    row(
        "inner header read",
        &plain(effort, || inner::Header::decode(black_box(&encoded)).unwrap()),
    );
}

/// Opening while as many keys are held as may be, key after key.
fn many_keys(effort: Effort) {
    let ids: Vec<KeyId> = (0..Limits::default().max_keys)
        .map(|number| KeyId::new(format!("bc490419-7d60-487f-adc1-{number:012}")).unwrap())
        .collect();
    let key = || KmeKey::take(&mut [9; 32]);
    let used = ids.iter().step_by(ids.len() / KEYS);
    let mut envelopes = Vec::new();
    for id in used {
        let mut sealer = Sealer::<Nothing>::with_aead(&channel(), id.clone(), key()).unwrap();
        for _ in 0..PER_KEY {
            let mut envelope = vec![0; HEADER_LEN + 64 + TAG_LEN];
            let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
            slot.seal_in_place(ROUTE, &mut envelope).unwrap();
            envelopes.push(envelope);
        }
    }
    let opener = || {
        let mut opener = Opener::<Nothing>::with_limits(channel(), Limits::default()).unwrap();
        ids.iter().for_each(|id| opener.add_key(id.clone(), key()).unwrap());
        opener
    };
    let mut out = vec![0; 64];
    let open = |opener: &mut Opener<Nothing>| {
        for envelope in &envelopes {
            opener.open_into(NOW, ROUTE, black_box(envelope), &mut out).unwrap();
        }
    };
    row("opening, in all, 4,096 keys held", &each(effort, envelopes.len(), opener, open));
}
