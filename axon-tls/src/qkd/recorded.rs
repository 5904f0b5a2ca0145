//! Replays complete psk_ke handshakes with OpenSSL that were recorded once. They are known answers
//! for all steps from the binder to the keys of application data, on machines without OpenSSL.
//!
//! `recorded/openssl.json` describes how it was recorded; `record` in `recorded/record.rs` recorded
//! it. OpenSSL accepted what our end had sent, and printed the exporter's value. With the same
//! random bytes our end must send the same again, byte for byte, and must accept OpenSSL's part
//! again.

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

/// The random bytes of our end, which are the same for every call.
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

/// One recorded connection: its flights in order, each with its sender.
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

/// Replays the recorded bytes of OpenSSL. Returns what our end sends and the data that it reads.
///
/// An error holds the index of the flight at which our end gave up.
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
    /// The bytes of each flight that our end sent.
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
    // the recordings have both roles with both ciphers, and so SHA-256 and SHA-384
    assert_eq!(recordings.len(), 4);
    for recording in &recordings {
        match &*recording.our_role {
            "client" => is_as_recorded(client(recording.cipher), recording),
            "server" => is_as_recorded(server(recording.cipher), recording),
            other => panic!("{other}"),
        }
    }
}

/// Every bit that OpenSSL sent counts. If a byte of its handshake is changed, our end refuses it,
/// except for bytes that the protocol ignores.
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
            // the type and version in the header of a protected record have only one valid value,
            // and rustls authenticates that value instead of the received one
            assert!(!complete || is_type_or_version(bytes, at), "byte {at} changed, and accepted");
        }
        assert!(refused > 0);
    }
}

/// Returns whether the byte at `at` is in the type or version of a record's header.
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
