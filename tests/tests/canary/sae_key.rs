//! The private key of the SAE, from where it was read to where aws-lc has it.

use etsi_qkd014::{Client, ClientBuilder, Error};
use rustls::pki_types::PrivateKeyDer;
use rustls::pki_types::pem::PemObject;

use crate::kmes::Kmes;
use crate::search::Needles;
use crate::{judge, quarantine};

/// Returns the position of the secret number in a key of P-256 (RFC 5915): after version and tag.
fn secret(der: &[u8]) -> usize {
    let before = [0x02, 0x01, 0x01, 0x04, 0x20];
    der.windows(5).position(|window| window == before).unwrap() + 5
}

/// Returns the secret's bytes whose base64 text, in a PEM file of `der`, encodes no other byte.
fn needle(der: &[u8]) -> Vec<u8> {
    let begin = secret(der).next_multiple_of(3);
    let end = (secret(der) + 32) / 3 * 3;
    der[begin..end].to_vec()
}

fn pem(label: &str, der: &[u8]) -> Vec<u8> {
    use base64::Engine;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    format!("-----BEGIN {label}-----\n{text}\n-----END {label}-----\n").into_bytes()
}

#[test]
fn the_private_key_in_every_form() {
    let _turn = quarantine::turn();
    let kmes = Kmes::start();
    let file = kmes.file("sae-a.key");
    let pkcs8 = PrivateKeyDer::from_pem_file(&file).unwrap().secret_der().to_vec();
    // The key of RFC 5915 is the last element of that of RFC 5208.
    let sec1 = pkcs8[secret(&pkcs8) - 7..].to_vec();
    let kept = kmes.file("sae.form");
    let forms = [
        ("PKCS#8, PEM", pem("PRIVATE KEY", &pkcs8), &pkcs8),
        ("PKCS#8, DER", pkcs8.clone(), &pkcs8),
        ("SEC1, PEM", pem("EC PRIVATE KEY", &sec1), &sec1),
        ("SEC1, DER", sec1.clone(), &sec1),
    ];
    for (name, text, der) in &forms {
        std::fs::write(&kept, text).unwrap();
        assert!(Needles::of([&*needle(der)]).count(text) > 8, "{name}: it would be seen");
        let call = async |client: &Client| {
            client.enc_keys("sae-b").send().await.unwrap();
        };
        let needles = |&(): &()| vec![needle(der), needle(&pkcs8)];
        let from_file = || kmes.simulated("sae-a").sae_key_file(&kept);
        judge(&format!("private key, {name}, from a file"), from_file, call, needles);
        let from_bytes = || kmes.simulated("sae-a").sae_key(text.clone());
        judge(&format!("private key, {name}, from bytes"), from_bytes, call, needles);
        // The client is made, and another one is not.
        let refused = |settings: ClientBuilder| {
            let other = settings.sae_cert_file(kmes.file("sae-b.crt")).build();
            assert!(matches!(other, Err(Error::Config { setting: "sae_key", .. })));
            kmes.simulated("sae-a")
        };
        let settings = || refused(kmes.simulated("sae-a").sae_key(text.clone()));
        judge(&format!("private key, {name}, refused"), settings, call, needles);
        let cut = &text[..text.len() * 2 / 3];
        let settings = || refused(kmes.simulated("sae-a").sae_key(cut.to_vec()));
        judge(&format!("private key, {name}, cut"), settings, call, needles);
    }
}
