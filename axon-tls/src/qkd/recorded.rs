//! Whole psk_ke handshakes with OpenSSL, recorded once and replayed: known answers for everything
//! from the binder to the keys of application data, on machines without OpenSSL.
//!
//! `recorded/openssl.json` says how it was recorded; `record` in `recorded/record.rs` did it.
//! OpenSSL accepted what our end had sent, and printed the exporter's value. With the same random
//! bytes our end must send the same again, byte for byte, and take OpenSSL's part as then.

use std::io::{Read, Write};
use std::sync::Arc;

use rustls_axon::crypto::{CryptoProvider, GetRandomFailed, SecureRandom};
use rustls_axon::{ClientConnection, ConnectionCommon, ServerConnection, SideData};
use serde_json::Value;

use super::{Psk, PskResolver, derive_psk, negotiated};
use crate::psk::config::{client_config_with, provider, server_config_with};
use crate::{Cipher, KeyExchange, PskKex};

mod record;

const KEY: [u8; 32] = {
    let mut key = [0; 32];
    let mut at = 0;
    while at < 32 {
        key[at] = at as u8;
        at += 1;
    }
    key
};
const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
const LABEL: &str = "EXPORTER-axon-test";
const FROM_US: &[u8] = b"from axon\n";
const FROM_OPENSSL: &[u8] = b"from openssl\n";

/// Our part's random bytes, the same for every call.
#[derive(Debug)]
struct Fixed;

impl SecureRandom for Fixed {
    fn fill(&self, buf: &mut [u8]) -> Result<(), GetRandomFailed> {
        for (at, byte) in buf.iter_mut().enumerate() {
            *byte = 0x40 + at as u8;
        }
        Ok(())
    }
}

#[derive(Debug)]
struct OneKey(Cipher);

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        Some(psk(self.0)).filter(|psk| psk.identity() == identity)
    }
}

fn psk(cipher: Cipher) -> Arc<Psk> {
    Arc::new(derive_psk(&KEY, KEY_ID, "sae-client", "sae-server", cipher).unwrap())
}

fn fixed(cipher: Cipher) -> CryptoProvider {
    CryptoProvider { secure_random: &Fixed, ..provider(cipher, PskKex::PskKe) }
}

fn client(cipher: Cipher) -> ClientConnection {
    let config = client_config_with(fixed(cipher), vec![psk(cipher)], PskKex::PskKe, b"").unwrap();
    ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
}

fn server(cipher: Cipher) -> ServerConnection {
    let resolver = Arc::new(OneKey(cipher));
    let config = server_config_with(fixed(cipher), resolver, cipher, PskKex::PskKe, b"").unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

/// One recorded connection: who sent what, in turns.
struct Recording {
    cipher: Cipher,
    our_role: String,
    exporter: Vec<u8>,
    flights: Vec<(bool, Vec<u8>)>,
}

fn recordings() -> Vec<Recording> {
    let file: Value = serde_json::from_str(include_str!("recorded/openssl.json")).unwrap();
    let of = |recording: &Value| Recording {
        cipher: Cipher::ALL
            .into_iter()
            .find(|cipher| recording["cipher"] == format!("{cipher:?}"))
            .unwrap(),
        our_role: recording["our_role"].as_str().unwrap().to_owned(),
        exporter: from_hex(&recording["exporter"]),
        flights: recording["flights"]
            .as_array()
            .unwrap()
            .iter()
            .map(|flight| (flight["from"] == "axon", from_hex(&flight["bytes"])))
            .collect(),
    };
    file["recordings"].as_array().unwrap().iter().map(of).collect()
}

fn from_hex(text: &Value) -> Vec<u8> {
    let text = text.as_str().unwrap();
    let byte = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
    (0..text.len()).step_by(2).map(byte).collect()
}

/// What our end sends to the recorded bytes of OpenSSL, and what it made of the connection.
///
/// `Err` has the flight at which it gave up.
fn replay<S: SideData>(
    conn: &mut ConnectionCommon<S>,
    flights: &[(bool, Vec<u8>)],
) -> Result<Replayed, (usize, rustls_axon::Error)> {
    let mut replayed = Replayed { sent: Vec::new(), read: Vec::new() };
    let mut said = false;
    for (at, (ours, bytes)) in flights.iter().enumerate() {
        if *ours {
            if !conn.is_handshaking() && !said {
                conn.writer().write_all(FROM_US).unwrap();
                said = true;
            }
            let mut sent = Vec::new();
            while conn.wants_write() {
                conn.write_tls(&mut sent).unwrap();
            }
            replayed.sent.push(sent);
        } else {
            let mut bytes = &bytes[..];
            while !bytes.is_empty() {
                conn.read_tls(&mut bytes).unwrap();
                let state = conn.process_new_packets().map_err(|err| (at, err))?;
                let old = replayed.read.len();
                replayed.read.resize(old + state.plaintext_bytes_to_read(), 0);
                conn.reader().read_exact(&mut replayed.read[old..]).unwrap();
            }
        }
    }
    Ok(replayed)
}

struct Replayed {
    /// A flight of ours each.
    sent: Vec<Vec<u8>>,
    /// Application data.
    read: Vec<u8>,
}

fn is_as_recorded<S: SideData>(
    mut conn: impl std::ops::DerefMut<Target = ConnectionCommon<S>>,
    recording: &Recording,
) {
    let replayed = replay(&mut conn, &recording.flights).unwrap();
    let recorded = recording.flights.iter().filter(|(ours, _)| *ours).map(|(_, bytes)| bytes);
    assert!(replayed.sent.iter().eq(recorded), "our flights are not the recorded ones");
    assert_eq!(replayed.read, FROM_OPENSSL);

    let exported = conn.export_keying_material([0; 32], LABEL.as_bytes(), None).unwrap();
    assert_eq!(exported.to_vec(), recording.exporter);
    let negotiated = negotiated(&conn).unwrap();
    assert_eq!(negotiated.key_exchange, KeyExchange::PskKe);
    assert_eq!(negotiated.cipher, recording.cipher);
    assert_eq!(negotiated.psk_identity.as_deref(), Some(psk(recording.cipher).identity()));
}

#[test]
fn openssl_recordings_replay_byte_for_byte() {
    let recordings = recordings();
    // both roles on both ciphers: SHA-256 and SHA-384
    assert_eq!(recordings.len(), 4);
    for recording in &recordings {
        match &*recording.our_role {
            "client" => is_as_recorded(client(recording.cipher), recording),
            "server" => is_as_recorded(server(recording.cipher), recording),
            other => panic!("{other}"),
        }
    }
}

/// What OpenSSL sent counts to the last bit: with any byte of its handshake changed, ours either
/// refuses it or (in what the protocol ignores) ends where it ended.
#[test]
fn a_changed_recording_never_completes_in_another_way() {
    for recording in recordings() {
        let handshake = match &*recording.our_role {
            "client" => 1,
            _ => 2,
        };
        let (ours, bytes) = &recording.flights[handshake];
        assert!(!ours);
        let mut refused = 0;
        for at in 0..bytes.len() {
            let mut flights: Vec<_> =
                recording.flights.iter().take(handshake + 1).cloned().collect();
            flights[handshake].1[at] ^= 1;
            let complete = match &*recording.our_role {
                "client" => {
                    let mut conn = client(recording.cipher);
                    replay(&mut conn, &flights).is_ok() && negotiated(&conn).is_some()
                }
                _ => {
                    let mut conn = server(recording.cipher);
                    replay(&mut conn, &flights).is_ok() && negotiated(&conn).is_some()
                }
            };
            refused += usize::from(!complete);
            // what the header of a protected record says for type and version can only be one
            // thing, and rustls authenticates that rather than what came
            assert!(!complete || is_type_or_version(bytes, at), "byte {at} changed, and accepted");
        }
        assert!(refused > 0);
    }
}

/// Whether the byte at `at` is in the type or version of a record's header.
fn is_type_or_version(records: &[u8], at: usize) -> bool {
    let mut start = 0;
    while start < records.len() {
        if (start..start + 3).contains(&at) {
            return true;
        }
        let len = u16::from_be_bytes([records[start + 3], records[start + 4]]);
        start += 5 + usize::from(len);
    }
    false
}
