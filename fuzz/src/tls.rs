//! Checks the parsers of the TLS layer: hellos, the identity that a client offers, and the operator's pins.

use std::{sync::Arc, time::SystemTime};

use axon_tls::{
    Cipher, PskKex,
    identity::{SpkiDigest, TrustFile},
    qkd::{self, ImportedIdentity, Psk, PskIdentity, PskResolver},
};
use rustls_axon::{ClientConnection, ServerConnection};

/// Checks PSK identities. An identity that parses, of either form, is the one spelling of its names; and any two names
/// that make an identity are read back from it.
pub fn psk_identity(data: &[u8]) -> bool {
    let mut accepted = false;
    if let Ok(identity) = PskIdentity::parse(data) {
        assert_eq!(identity.to_bytes(), data);
        accepted = true;
    }
    if let Ok(identity) = ImportedIdentity::parse(data) {
        let names = (identity.key_id(), identity.client_sae(), identity.server_sae());
        let psk = qkd::import_psk(&[7; 32], names.0, names.1, names.2, identity.cipher()).unwrap();
        assert_eq!(psk.identity(), data, "an identity with a second spelling");
        accepted = true;
    }
    let Ok(text) = std::str::from_utf8(data) else { return accepted };
    let (sae, key_id) = text.split_once('\0').unwrap_or((text, "key"));
    if let Ok(identity) = PskIdentity::new(sae, key_id) {
        let bytes = identity.to_bytes();
        assert!(bytes.len() <= PskIdentity::MAX_LEN && bytes.iter().all(u8::is_ascii_graphic));
        assert_eq!(PskIdentity::parse(&bytes).expect("what was made parses"), identity);
        assert_eq!((identity.client_sae(), identity.key_id()), (sae, key_id));
    }
    accepted
}

/// In a file that parses every line pins its own key to its own name, and no line is dropped.
pub fn trust_file(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else { return false };
    let Ok(file) = TrustFile::parse(text) else { return false };
    let mut pins = 0;
    for line in text.lines() {
        let content = line.split('#').next().unwrap_or_default();
        let mut fields = content.split_ascii_whitespace();
        let Some(name) = fields.next() else { continue };
        let digest = fields.next().expect("a line without a key was accepted");
        let key: SpkiDigest = digest.parse().expect("a key that is none was accepted");
        assert_eq!(key.to_string(), digest, "a second spelling of a key");
        // No pin ends before 1970 does.
        assert_eq!(file.name_of(&key, SystemTime::UNIX_EPOCH), Some(name));
        pins += 1;
    }
    assert_eq!(file.is_empty(), pins == 0);
    true
}

pub(crate) fn psk(cipher: Cipher) -> Arc<Psk> {
    Arc::new(qkd::derive_psk(&[7; 32], "key", "sae-a", "sae-b", cipher).unwrap())
}

#[derive(Debug)]
pub(crate) struct OneKey(pub(crate) Cipher);

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        Some(psk(self.0)).filter(|psk| psk.identity() == identity)
    }
}

/// A byte chooses between the four configurations.
fn mode(byte: u8) -> (Cipher, PskKex) {
    (Cipher::ALL[usize::from(byte & 1)], PskKex::ALL[usize::from(byte >> 1 & 1)])
}

fn client(byte: u8) -> (ClientConnection, Vec<u8>) {
    let (cipher, kex) = mode(byte);
    let config = qkd::client_config(psk(cipher), kex, b"fuzz").unwrap();
    let mut conn = ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap();
    let mut hello = Vec::new();
    conn.write_tls(&mut hello).unwrap();
    (conn, hello)
}

fn server(byte: u8) -> ServerConnection {
    let (cipher, kex) = mode(byte);
    let config = qkd::server_config(Arc::new(OneKey(cipher)), cipher, kex, b"fuzz").unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

/// After a first flight a server has agreed on nothing, and what it refuses it does not answer but
/// with an alert.
pub fn client_hello(data: &[u8]) -> bool {
    let Some((&byte, records)) = data.split_first() else { return false };
    let mut conn = server(byte);
    let Ok(read) = conn.read_tls(&mut &records[..]) else { return false };
    let processed = conn.process_new_packets();
    assert!(qkd::negotiated(&conn).is_none(), "agreed on without a Finished");
    assert!(conn.is_handshaking());
    let mut answer = Vec::new();
    while conn.wants_write() {
        conn.write_tls(&mut answer).unwrap();
    }
    let said_hello = answer.first() == Some(&22);
    assert!(processed.is_ok() || !said_hello, "an answer to what was refused");
    read != 0 && said_hello
}

/// A client takes a ServerHello in plaintext and is then still not finished. Every connection has
/// another session ID, which the server has to echo: it is put in, so that inputs get past it.
pub fn server_hello(data: &[u8]) -> bool {
    const SESSION_ID: std::ops::Range<usize> = 44..76;
    let Some((&byte, record)) = data.split_first() else { return false };
    let (mut conn, hello) = client(byte);
    let mut record = record.to_vec();
    if let Some(echoed) = record.get_mut(SESSION_ID) {
        echoed.copy_from_slice(&hello[SESSION_ID]);
    }
    let Ok(read) = conn.read_tls(&mut &record[..]) else { return false };
    let processed = conn.process_new_packets().is_ok();
    assert!(qkd::negotiated(&conn).is_none(), "agreed on without a Finished");
    assert!(conn.is_handshaking());
    read != 0 && processed
}

/// A ClientHello of each configuration.
pub fn client_hello_seeds() -> Vec<Vec<u8>> {
    (0..4).map(|byte| [vec![byte], client(byte).1].concat()).collect()
}

/// The ServerHello to each of them, in its record.
pub fn server_hello_seeds() -> Vec<Vec<u8>> {
    (0..4)
        .map(|byte| {
            let mut conn = server(byte);
            conn.read_tls(&mut &client(byte).1[..]).unwrap();
            conn.process_new_packets().unwrap();
            let mut answer = vec![byte];
            conn.write_tls(&mut answer).unwrap();
            let len = usize::from(u16::from_be_bytes([answer[4], answer[5]]));
            answer.truncate(1 + 5 + len);
            answer
        })
        .collect()
}

/// Plain names, names that are percent-encoded, and imported ones.
pub fn psk_identity_seeds() -> Vec<Vec<u8>> {
    let imported = Cipher::ALL.map(|cipher| {
        let psk = qkd::import_psk(&[7; 32], "key", "sae-a", "sae-b", cipher).unwrap();
        psk.identity().to_vec()
    });
    [("sae-a", "bc490419-7d60-487f-adc1-4ddcc177c139"), ("robot 7:\u{f6}", "a/b=="), ("s", "k")]
        .into_iter()
        .map(|(sae, key_id)| PskIdentity::new(sae, key_id).unwrap().to_bytes())
        .chain(imported)
        .collect()
}

/// Comments, a name with two keys, last days.
pub fn trust_file_seeds() -> Vec<Vec<u8>> {
    let pin = |byte| SpkiDigest([byte; 32]);
    let file = format!(
        "# the arms\narm {} 2028-02-29\narm\t{}\r\n\nbase {} # always\n",
        pin(0),
        pin(1),
        pin(0xff)
    );
    vec![file.into_bytes(), format!("a {}", pin(2)).into_bytes(), b"#\n".to_vec()]
}
