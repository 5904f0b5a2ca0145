//! External PSKs over another provider than aws-lc-rs: nothing here needs a feature but `std`.
//!
//! The hash is SHA-256 of RustCrypto. What stands for an AEAD only authenticates, and what stands
//! for a key exchange is none: they are here so that all of the handshake runs where no C code
//! can, under Miri for one.

use std::fmt;
use std::io::{Read, Write};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::Arc;

use ::hmac::{Hmac as HmacOf, KeyInit, Mac};
use rustls_axon::crypto::cipher::{
    AeadKey, InboundOpaqueMessage, InboundPlainMessage, Iv, MessageDecrypter, MessageEncrypter,
    OutboundOpaqueMessage, OutboundPlainMessage, PrefixedPayload, Tls13AeadAlgorithm,
    UnsupportedOperationError,
};
use rustls_axon::crypto::hash::{Context, Hash, HashAlgorithm, Output};
use rustls_axon::crypto::tls13::HkdfUsingHmac;
use rustls_axon::crypto::{
    hmac, ActiveKeyExchange, CipherSuiteCommon, CryptoProvider, GetRandomFailed, KeyProvider,
    SecureRandom, SharedSecret, SupportedKxGroup, WebPkiSupportedAlgorithms,
};
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, ImportedIdentity, ImportedPsk, PskKeyExchangeMode,
    ResolvesExternalPsk,
};
use rustls_axon::pki_types::PrivateKeyDer;
use rustls_axon::sign::SigningKey;
use rustls_axon::{
    CipherSuite, ClientConfig, ClientConnection, ConnectionCommon, ConnectionTrafficSecrets,
    ContentType, Error, HandshakeKind, NamedGroup, PeerIncompatible, PeerMisbehaved,
    ProtocolVersion, ServerConfig, ServerConnection, SupportedCipherSuite, Tls13CipherSuite,
};
use sha2::{Digest, Sha256};
use zeroize::Zeroizing;

static SUITE: Tls13CipherSuite = Tls13CipherSuite {
    common: CipherSuiteCommon {
        suite: CipherSuite::TLS13_CHACHA20_POLY1305_SHA256,
        hash_provider: &HashOfSha256,
        confidentiality_limit: u64::MAX,
    },
    hkdf_provider: &HkdfUsingHmac(&HmacOfSha256),
    aead_alg: &TagOnly,
    quic: None,
};

struct HashOfSha256;

impl Hash for HashOfSha256 {
    fn start(&self) -> Box<dyn Context> {
        Box::new(Transcript(Sha256::new()))
    }

    fn hash(&self, data: &[u8]) -> Output {
        Output::new(&Sha256::digest(data))
    }

    fn output_len(&self) -> usize {
        32
    }

    fn algorithm(&self) -> HashAlgorithm {
        HashAlgorithm::SHA256
    }
}

struct Transcript(Sha256);

impl Context for Transcript {
    fn fork_finish(&self) -> Output {
        Output::new(&self.0.clone().finalize())
    }

    fn fork(&self) -> Box<dyn Context> {
        Box::new(Self(self.0.clone()))
    }

    fn finish(self: Box<Self>) -> Output {
        Output::new(&self.0.finalize())
    }

    fn update(&mut self, data: &[u8]) {
        self.0.update(data);
    }
}

struct HmacOfSha256;

impl hmac::Hmac for HmacOfSha256 {
    fn with_key(&self, key: &[u8]) -> Box<dyn hmac::Key> {
        Box::new(MacKey(HmacOf::new_from_slice(key).unwrap()))
    }

    fn hash_output_len(&self) -> usize {
        32
    }
}

struct MacKey(HmacOf<Sha256>);

impl hmac::Key for MacKey {
    fn sign_concat(&self, first: &[u8], middle: &[&[u8]], last: &[u8]) -> hmac::Tag {
        let mut mac = self.0.clone();
        mac.update(first);
        middle.iter().for_each(|part| mac.update(part));
        mac.update(last);
        hmac::Tag::new(&mac.finalize().into_bytes())
    }

    fn tag_len(&self) -> usize {
        32
    }
}

/// Sends what it should encrypt as it is, with a tag.
struct TagOnly;

impl Tls13AeadAlgorithm for TagOnly {
    fn encrypter(&self, key: AeadKey, _: Iv) -> Box<dyn MessageEncrypter> {
        Box::new(Tagger(HmacOf::new_from_slice(key.as_ref()).unwrap()))
    }

    fn decrypter(&self, key: AeadKey, _: Iv) -> Box<dyn MessageDecrypter> {
        Box::new(Tagger(HmacOf::new_from_slice(key.as_ref()).unwrap()))
    }

    fn key_len(&self) -> usize {
        32
    }

    fn extract_keys(
        &self,
        _: AeadKey,
        _: Iv,
    ) -> Result<ConnectionTrafficSecrets, UnsupportedOperationError> {
        Err(UnsupportedOperationError)
    }
}

struct Tagger(HmacOf<Sha256>);

impl Tagger {
    fn tag(&self, sequence: u64, content: &[u8]) -> Vec<u8> {
        let mut mac = self.0.clone();
        mac.update(&sequence.to_be_bytes());
        mac.update(content);
        mac.finalize().into_bytes().to_vec()
    }
}

impl MessageEncrypter for Tagger {
    fn encrypt(
        &mut self,
        message: OutboundPlainMessage<'_>,
        sequence: u64,
    ) -> Result<OutboundOpaqueMessage, Error> {
        let len = self.encrypted_payload_len(message.payload.len());
        let mut payload = PrefixedPayload::with_capacity(len);
        payload.extend_from_chunks(&message.payload);
        payload.extend_from_slice(&message.typ.to_array());
        let tag = self.tag(sequence, payload.as_ref());
        payload.extend_from_slice(&tag);
        let (kind, version) = (ContentType::ApplicationData, ProtocolVersion::TLSv1_2);
        Ok(OutboundOpaqueMessage::new(kind, version, payload))
    }

    fn encrypted_payload_len(&self, payload_len: usize) -> usize {
        payload_len + 1 + 32
    }
}

impl MessageDecrypter for Tagger {
    fn decrypt<'a>(
        &mut self,
        mut message: InboundOpaqueMessage<'a>,
        sequence: u64,
    ) -> Result<InboundPlainMessage<'a>, Error> {
        let content = message.payload.len().checked_sub(32).ok_or(Error::DecryptError)?;
        if self.tag(sequence, &message.payload[..content]) != message.payload[content..] {
            return Err(Error::DecryptError);
        }
        message.payload.truncate(content);
        message.into_tls13_unpadded_message()
    }
}

/// A group by name alone: what both ends end up with is known to everybody.
#[derive(Debug)]
struct NoSecret(u16);

impl SupportedKxGroup for NoSecret {
    fn start(&self) -> Result<Box<dyn ActiveKeyExchange>, Error> {
        Ok(Box::new(Self(self.0)))
    }

    fn name(&self) -> NamedGroup {
        NamedGroup::from(self.0)
    }
}

impl ActiveKeyExchange for NoSecret {
    fn complete(self: Box<Self>, theirs: &[u8]) -> Result<SharedSecret, Error> {
        match theirs == self.pub_key() {
            true => Ok(SharedSecret::from(theirs)),
            false => Err(PeerMisbehaved::InvalidKeyShare.into()),
        }
    }

    fn pub_key(&self) -> &[u8] {
        b"not secret"
    }

    fn group(&self) -> NamedGroup {
        self.name()
    }
}

const GROUPS: [&dyn SupportedKxGroup; 2] = [&NoSecret(0xfe00), &NoSecret(0xfe01)];

/// Never the same byte twice in a row, which is all that these tests ask for.
#[derive(Debug)]
struct Counter(AtomicU8);

impl SecureRandom for Counter {
    fn fill(&self, bytes: &mut [u8]) -> Result<(), GetRandomFailed> {
        bytes.fill_with(|| self.0.fetch_add(1, Ordering::Relaxed));
        Ok(())
    }
}

static COUNTER: Counter = Counter(AtomicU8::new(0));

#[derive(Debug)]
struct NoKeys;

impl KeyProvider for NoKeys {
    fn load_private_key(&self, _: PrivateKeyDer<'static>) -> Result<Arc<dyn SigningKey>, Error> {
        Err(Error::General("there are no certificates here".into()))
    }
}

fn provider(groups: &[&'static dyn SupportedKxGroup]) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider {
        cipher_suites: vec![SupportedCipherSuite::Tls13(&SUITE)],
        kx_groups: groups.to_vec(),
        signature_verification_algorithms: WebPkiSupportedAlgorithms { all: &[], mapping: &[] },
        secure_random: &COUNTER,
        key_provider: &NoKeys,
    })
}

fn plain(identity: &str, secret: u8) -> Arc<ExternalPsk> {
    let secret = Zeroizing::new(vec![secret; 32]);
    Arc::new(ExternalPsk::new(identity, secret, HashAlgorithm::SHA256).unwrap())
}

fn imported() -> Arc<ExternalPsk> {
    let identity = ImportedIdentity::new(b"name", b"context", HashAlgorithm::SHA256).unwrap();
    ImportedPsk::new(identity, &Zeroizing::new(vec![3; 32]), &SUITE).unwrap().into()
}

struct Known(Vec<Arc<ExternalPsk>>);

impl fmt::Debug for Known {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Known")
    }
}

impl ResolvesExternalPsk for Known {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        let known = |offered: &[u8]| self.0.iter().find(|psk| psk.identity() == offered).cloned();
        offer.identities().find_map(known)
    }
}

type Groups = [&'static dyn SupportedKxGroup];

fn mode_of(groups: &Groups) -> PskKeyExchangeMode {
    match groups {
        [] => PskKeyExchangeMode::PskKe,
        _ => PskKeyExchangeMode::PskDheKe,
    }
}

fn client(psks: Vec<Arc<ExternalPsk>>, groups: &Groups) -> ClientConnection {
    let config = ClientConfig::builder_with_provider(provider(groups))
        .with_external_psks(psks, mode_of(groups))
        .unwrap();
    ClientConnection::new(Arc::new(config), "example.com".try_into().unwrap()).unwrap()
}

fn server(psks: Vec<Arc<ExternalPsk>>, groups: &Groups) -> ServerConnection {
    let config = ServerConfig::builder_with_provider(provider(groups))
        .with_external_psk_resolver(Arc::new(Known(psks)), mode_of(groups))
        .unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

fn pass<F, T>(from: &mut ConnectionCommon<F>, to: &mut ConnectionCommon<T>) -> Result<(), Error> {
    let mut bytes = Vec::new();
    while from.wants_write() {
        from.write_tls(&mut bytes).unwrap();
    }
    let mut bytes = &bytes[..];
    while !bytes.is_empty() {
        to.read_tls(&mut bytes).unwrap();
        to.process_new_packets()?;
    }
    Ok(())
}

#[test]
fn a_peer_that_does_not_know_the_psk_is_refused() {
    for (offered, known, error) in [
        (plain("a", 2), plain("a", 1), Error::from(PeerMisbehaved::IncorrectBinder)),
        (plain("b", 1), plain("a", 1), PeerIncompatible::UnknownExternalPskIdentity.into()),
        (imported(), plain("a", 1), PeerIncompatible::UnknownExternalPskIdentity.into()),
    ] {
        let mut client = client(vec![offered], &[]);
        let mut server = server(vec![known], &[]);
        assert_eq!(pass(&mut client, &mut server), Err(error));
        assert!(matches!(pass(&mut server, &mut client), Err(Error::AlertReceived(_))));
        assert!(client.external_psk().is_none() && server.external_psk().is_none());
    }
}

#[test]
fn identities_that_are_not_exactly_imported_ones_are_not_decoded() {
    let encoded = imported().identity().to_vec();
    assert!(ImportedIdentity::decode(&encoded).is_some());
    for end in 0..encoded.len() {
        assert_eq!(ImportedIdentity::decode(&encoded[..end]), None);
    }
}

#[test]
fn handshakes_work() {
    let [first, second] = GROUPS;
    for (groups_of_client, groups_of_server, kind) in [
        (&[][..], &[][..], HandshakeKind::Full),
        (&[first], &[first], HandshakeKind::Full),
        (&[first, second], &[second], HandshakeKind::FullWithHelloRetryRequest),
    ] {
        let mut client = client(vec![plain("a", 1), imported()], groups_of_client);
        let mut server = server(vec![imported()], groups_of_server);
        for _ in 0..3 {
            pass(&mut client, &mut server).unwrap();
            pass(&mut server, &mut client).unwrap();
        }
        for used in [client.external_psk(), server.external_psk()] {
            assert_eq!(used.unwrap().identity(), imported().identity());
            assert_eq!(used.unwrap().mode(), mode_of(groups_of_client));
        }
        assert_eq!(client.handshake_kind(), Some(kind));

        client.writer().write_all(b"data").unwrap();
        pass(&mut client, &mut server).unwrap();
        let mut received = [0; 4];
        server.reader().read_exact(&mut received).unwrap();
        assert_eq!(&received, b"data");
    }
}
