//! AXQKD001: the clear header, the inner header, and opening under a held key.

use std::time::Duration;

use axon_envelope::{
    Channel, Delivery, Header, KeyId, Kind, KmeKey, MAGIC, Opener, RefusalCause, Route, Sealer,
    TopicHash, inner,
};

const NOW: Duration = Duration::from_secs(1);
const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([9; 16]) };
const PREFIX: [u8; 8] = [5; 8];

fn channel() -> Channel {
    Channel::new("robot-a", "robot-b", [7; 32]).unwrap()
}

fn key() -> (KeyId, KmeKey) {
    (KeyId::new("key-1").unwrap(), KmeKey::take(&mut [0x42; 32]))
}

fn opener() -> Opener {
    let (key_id, key) = key();
    let mut opener = Opener::new(channel()).unwrap();
    opener.add_key(key_id, key).unwrap();
    opener
}

/// The envelope that the sender makes of `plaintext` as its message number `index`.
fn sealed(prefix: [u8; 8], index: u8, plaintext: &[u8]) -> Vec<u8> {
    let (key_id, key) = key();
    let mut sealer: Sealer = Sealer::with_nonce_prefix(&channel(), key_id, key, prefix);
    let mut envelope = vec![0; sealer.overhead() + plaintext.len()];
    for _ in 0..=index {
        let slot = sealer.slot(NOW, Delivery::Reliable).expect("an index below ten");
        slot.seal_into(ROUTE, &[plaintext], &mut envelope).expect("the buffer fits");
    }
    envelope
}

/// Checks that a header that parses equals the encoding of its fields, byte for byte.
pub fn header(data: &[u8]) -> bool {
    let Ok((header, length)) = Header::parse(data) else { return false };
    let mut spelled = MAGIC.to_vec();
    spelled.extend([header.route.kind as u8, 0, header.index]);
    spelled.extend(header.route.topic.0);
    for id in [header.sender, header.key_id] {
        spelled.push(u8::try_from(id.len()).expect("an ID has at most 255 bytes"));
        spelled.extend(id);
    }
    spelled.extend(header.nonce);
    assert_eq!(spelled, data[..length]);
    true
}

/// Checks that a header that decodes encodes to the same bytes.
pub fn inner(data: &[u8]) -> bool {
    let Ok((header, payload)) = inner::Header::decode(data) else { return false };
    assert_eq!([&header.encode()[..], payload].concat(), data);
    true
}

/// Checks that only bytes that the sender sealed open, and that nothing opens twice.
pub fn open(data: &[u8]) -> bool {
    let (mut envelope, mut apart) = (data.to_vec(), vec![0; data.len()]);
    let mut opener = opener();
    let into = self::opener().open_into(NOW, ROUTE, data, &mut apart);
    let plaintext = match opener.open_in_place(NOW, ROUTE, &mut envelope) {
        Ok(plaintext) => plaintext.to_vec(),
        Err(error) => {
            assert_eq!(into.expect_err("the two ways to open differ").cause(), error.cause());
            return false;
        }
    };
    assert_eq!(apart[..into.expect("the two ways to open differ")], plaintext);

    let twice = opener.open_into(NOW, ROUTE, data, &mut apart).expect_err("opened twice");
    assert_eq!(twice.cause(), Some(RefusalCause::Replayed));

    let (header, _) = Header::parse(data).expect("what opens has a header");
    let prefix = *header.nonce.first_chunk().expect("a nonce has 12 bytes");
    assert_eq!(sealed(prefix, header.index, &plaintext), data, "opened what nobody sealed");
    true
}

/// The input says which byte of an envelope to change, how, the index, and the plaintext. A changed
/// envelope is refused and costs nothing: the true one opens afterwards.
pub fn tamper(data: &[u8]) -> bool {
    let Some((&[high, low, change, index], plaintext)) = data.split_first_chunk() else {
        return false;
    };
    let envelope = sealed(PREFIX, index % 10, plaintext);
    let mut forged = envelope.clone();
    let at = usize::from(u16::from_be_bytes([high, low])) % forged.len();
    forged[at] ^= change;
    let mut opener = opener();
    let mut room = vec![0; envelope.len()];
    if change != 0 {
        let opened = opener.open_into(NOW, ROUTE, &forged, &mut room);
        assert!(opened.is_err(), "opened with byte {at} changed by {change:#04x}");
    }
    let length = opener.open_into(NOW, ROUTE, &envelope, &mut room).expect("the true one opens");
    assert_eq!(&room[..length], plaintext);
    true
}

/// Envelopes under the held key.
pub fn open_seeds() -> Vec<Vec<u8>> {
    vec![sealed(PREFIX, 0, b""), sealed(PREFIX, 9, b"hello"), sealed([6; 8], 3, &[0; 100])]
}

/// One with and one without a payload.
pub fn inner_seeds() -> Vec<Vec<u8>> {
    let header = |compressed, length| inner::Header {
        gid: [1; 16],
        sequence: 2,
        source_timestamp: -3,
        request_id: inner::RequestId { client: [4; 16], sequence: -5 },
        compressed,
        age_ms: 6,
        uncompressed_len: length,
    };
    vec![
        header(false, 0).encode().to_vec(),
        [&header(false, 5).encode()[..], b"hello"].concat(),
        [&header(true, 1000).encode()[..], b"zstd"].concat(),
    ]
}

/// Changes in the header, the body and the tag, and none.
pub fn tamper_seeds() -> Vec<Vec<u8>> {
    [(0_u16, 0), (3, 1), (10, 1), (30, 0x80), (60, 1), (70, 0xff)]
        .into_iter()
        .map(|(at, change)| [&at.to_be_bytes()[..], &[change, 4], b"hello, robot"].concat())
        .collect()
}
