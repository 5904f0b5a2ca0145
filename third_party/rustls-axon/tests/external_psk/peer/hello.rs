//! ClientHello and ServerHello, well formed or not.

use super::record::message;
use super::schedule::{digest, Early};

/// An extension.
pub(crate) fn ext(kind: u16, data: &[u8]) -> (u16, Vec<u8>) {
    (kind, data.to_vec())
}

/// `opaque list<0..2^8-1>`
pub(crate) fn list8(data: &[u8]) -> Vec<u8> {
    [&[u8::try_from(data.len()).unwrap()], data].concat()
}

/// `opaque list<0..2^16-1>`
pub(crate) fn list16(data: &[u8]) -> Vec<u8> {
    [&u16::try_from(data.len()).unwrap().to_be_bytes(), data].concat()
}

fn extensions(list: &[(u16, Vec<u8>)]) -> Vec<u8> {
    let encode = |(kind, data): &(u16, Vec<u8>)| [&kind.to_be_bytes()[..], &list16(data)].concat();
    list16(&list.iter().flat_map(encode).collect::<Vec<_>>())
}

/// A ServerHello that echoes the session ID of `client_hello`, a handshake message.
pub(crate) fn server_hello(
    client_hello: &[u8],
    suite: u16,
    random: [u8; 32],
    list: &[(u16, Vec<u8>)],
) -> Vec<u8> {
    // handshake header 4, version 2, random 32, then the session ID
    let session_id = &client_hello[38..39 + usize::from(client_hello[38])];
    let suite = suite.to_be_bytes();
    message(2, &[&[3, 3], &random[..], session_id, &suite, &[0], &extensions(list)].concat())
}

/// One entry of a `pre_shared_key` extension.
#[derive(Clone)]
pub(crate) struct Offer {
    pub(crate) identity: Vec<u8>,
    pub(crate) secret: Vec<u8>,
    pub(crate) label: &'static str,
    pub(crate) age: u32,
}

impl Offer {
    pub(crate) fn new(identity: impl Into<Vec<u8>>, secret: &[u8]) -> Self {
        let (identity, secret) = (identity.into(), secret.to_vec());
        Self { identity, secret, label: "ext binder", age: 0 }
    }
}

/// A ClientHello: what a test does not change makes an honest offer in psk_ke.
#[derive(Clone)]
pub(crate) struct ClientHello {
    pub(crate) legacy_version: u16,
    pub(crate) random: [u8; 32],
    pub(crate) session_id: Vec<u8>,
    pub(crate) suites: Vec<u16>,
    pub(crate) compression: Vec<u8>,
    /// All but `pre_shared_key`.
    pub(crate) extensions: Vec<(u16, Vec<u8>)>,
    pub(crate) offers: Vec<Offer>,
    /// What the binders are instead of right ones.
    pub(crate) binders: Option<Vec<Vec<u8>>>,
    /// What the transcript has in front: after a HelloRetryRequest.
    pub(crate) before: Vec<u8>,
}

impl ClientHello {
    pub(crate) fn new(offers: Vec<Offer>) -> Self {
        Self {
            legacy_version: 0x0303,
            random: [3; 32],
            session_id: vec![5; 32],
            suites: vec![0x1303],
            compression: vec![0],
            extensions: vec![ext(43, &[2, 3, 4]), ext(45, &[1, 0])],
            offers,
            binders: None,
            before: Vec::new(),
        }
    }

    /// Takes an extension out, if it is there, and puts in another of its type.
    pub(crate) fn with(mut self, kind: u16, data: &[u8]) -> Self {
        self = self.without(kind);
        self.extensions.push(ext(kind, data));
        self
    }

    pub(crate) fn without(mut self, kind: u16) -> Self {
        self.extensions.retain(|(other, _)| *other != kind);
        self
    }

    /// The same offer in psk_dhe_ke, with one key share.
    pub(crate) fn in_psk_dhe_ke(self, group: u16, share: &[u8]) -> Self {
        let group = group.to_be_bytes();
        self.with(45, &[1, 1])
            .with(10, &list16(&group))
            .with(51, &list16(&[&group[..], &list16(share)].concat()))
    }

    /// The handshake message.
    pub(crate) fn encode(&self) -> Vec<u8> {
        if self.offers.is_empty() {
            return self.encode_with(&self.extensions);
        }
        let mut identities = Vec::new();
        for offer in &self.offers {
            identities.extend(list16(&offer.identity));
            identities.extend(offer.age.to_be_bytes());
        }
        let zeros = vec![vec![0; 32]; self.offers.len()];
        let with_binders = |binders: &[Vec<u8>]| {
            let binders: Vec<u8> = binders.iter().flat_map(|binder| list8(binder)).collect();
            let binders = list16(&binders);
            let offer = [list16(&identities), binders.clone()].concat();
            let all = [&self.extensions[..], &[(41, offer)]].concat();
            (self.encode_with(&all), binders.len())
        };

        let binders = self.binders.clone().unwrap_or_else(|| {
            let (unbound, binders_len) = with_binders(&zeros);
            let truncated = &unbound[..unbound.len() - binders_len];
            let hash = digest(&[&self.before, truncated].concat());
            let binder =
                |offer: &Offer| Early::new(Some(&offer.secret)).binder(offer.label, &hash).to_vec();
            self.offers.iter().map(binder).collect()
        });
        with_binders(&binders).0
    }

    fn encode_with(&self, list: &[(u16, Vec<u8>)]) -> Vec<u8> {
        let suites: Vec<u8> = self.suites.iter().flat_map(|suite| suite.to_be_bytes()).collect();
        let session_id = list8(&self.session_id);
        message(
            1,
            &[
                &self.legacy_version.to_be_bytes(),
                &self.random[..],
                &session_id,
                &list16(&suites),
                &list8(&self.compression),
                &extensions(list),
            ]
            .concat(),
        )
    }
}
