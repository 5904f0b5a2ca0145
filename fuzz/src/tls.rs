//! What the TLS layer reads: the identity a client offers, and the operator's pins.

use std::time::SystemTime;

use axon_tls::{
    identity::{SpkiDigest, TrustFile},
    qkd::PskIdentity,
};

/// What parses is the one spelling of its two names; and any two names that make an identity come
/// back from it.
pub fn psk_identity(data: &[u8]) -> bool {
    let mut accepted = false;
    if let Ok(identity) = PskIdentity::parse(data) {
        assert_eq!(identity.to_bytes(), data);
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

/// Plain names, and names that are percent-encoded.
pub fn psk_identity_seeds() -> Vec<Vec<u8>> {
    [("sae-a", "bc490419-7d60-487f-adc1-4ddcc177c139"), ("robot 7:\u{f6}", "a/b=="), ("s", "k")]
        .into_iter()
        .map(|(sae, key_id)| PskIdentity::new(sae, key_id).unwrap().to_bytes())
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
