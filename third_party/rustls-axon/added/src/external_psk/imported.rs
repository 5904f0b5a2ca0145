//! The importer of [RFC 9258]: external PSKs bound to a protocol, a KDF and a context.
//!
//! [RFC 9258]: https://datatracker.ietf.org/doc/html/rfc9258

use alloc::vec;
use alloc::vec::Vec;

use zeroize::Zeroizing;

use super::ExternalPsk;
use crate::crypto::hash::HashAlgorithm;
use crate::error::Error;
use crate::sync::Arc;
use crate::tls13::Tls13CipherSuite;
use crate::tls13::key_schedule::hkdf_expand_label_slice;

/// An external PSK imported for TLS 1.3 and one hash function ([RFC 9258]).
///
/// Turn it into an [`ExternalPsk`] to offer it or to return it from a resolver.  Its identity on
/// the wire is an encoded [`ImportedIdentity`], and its binder is made under `imp binder`, so it
/// is never taken for a PSK that was not imported.
///
/// A base key that is imported must not be used for anything else: import it once for each hash
/// function of the configured cipher suites, and do not make an [`ExternalPsk`] of it directly.
///
/// The derived secret is zeroized on drop.  The type is neither `Clone` nor `Debug`.
///
/// [RFC 9258]: https://datatracker.ietf.org/doc/html/rfc9258
pub struct ImportedPsk(ExternalPsk);

impl ImportedPsk {
    /// Imports `base_key`, which both ends know under `identity`'s external identity.
    ///
    /// `suite` names the hash function associated with the base key: any cipher suite that uses
    /// it.  RFC 9258 wants SHA-256 if there is no such association.  It does not have to be the
    /// hash function the PSK is imported for, which `identity` says.
    ///
    /// Fails if `base_key` is shorter than [`ExternalPsk::MIN_SECRET_LEN`], or if the encoded
    /// identity is longer than a ClientHello can carry.
    pub fn new(
        identity: ImportedIdentity<'_>,
        base_key: &Zeroizing<Vec<u8>>,
        suite: &'static Tls13CipherSuite,
    ) -> Result<Self, Error> {
        if base_key.len() < ExternalPsk::MIN_SECRET_LEN {
            return Err(Error::General(
                "imported PSK: base key must have at least 16 bytes".into(),
            ));
        }
        let encoded = identity.encode()?;
        let (_, len) = kdf(identity.target_hash)?;

        let context = suite
            .common
            .hash_provider
            .hash(&encoded);
        let expander = suite
            .hkdf_provider
            .extract_from_secret(None, base_key);
        let mut secret = Zeroizing::new(vec![0; len]);
        hkdf_expand_label_slice(
            expander.as_ref(),
            b"derived psk",
            context.as_ref(),
            &mut secret,
        )
        .map_err(|_| Error::General("imported PSK: the KDF refused the output length".into()))?;

        let mut psk = ExternalPsk::new(encoded, secret, identity.target_hash)?;
        psk.imported = true;
        Ok(Self(psk))
    }

    /// The encoded [`ImportedIdentity`], as it is sent.
    pub fn identity(&self) -> &[u8] {
        self.0.identity()
    }

    /// The hash function this PSK was imported for.
    pub fn hash(&self) -> HashAlgorithm {
        self.0.hash()
    }
}

impl From<ImportedPsk> for ExternalPsk {
    fn from(imported: ImportedPsk) -> Self {
        imported.0
    }
}

impl From<ImportedPsk> for Arc<ExternalPsk> {
    fn from(imported: ImportedPsk) -> Self {
        Self::new(imported.0)
    }
}

/// What an imported PSK is bound to ([RFC 9258 section 5.1]), other than TLS 1.3 itself.
///
/// [RFC 9258 section 5.1]: https://datatracker.ietf.org/doc/html/rfc9258#section-5.1
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImportedIdentity<'a> {
    external_identity: &'a [u8],
    context: &'a [u8],
    target_hash: HashAlgorithm,
}

impl<'a> ImportedIdentity<'a> {
    /// Names a PSK imported for `target_hash`, which must be SHA-256 or SHA-384.
    ///
    /// `context` must say how the base key came about, and should name both ends in their roles:
    /// then a reflected ClientHello finds no key ([RFC 9257 section 4.1]).  It may be empty.
    ///
    /// Both are sent in the clear, so neither may hold anything that is secret.
    ///
    /// [RFC 9257 section 4.1]: https://datatracker.ietf.org/doc/html/rfc9257#section-4.1
    pub fn new(
        external_identity: &'a [u8],
        context: &'a [u8],
        target_hash: HashAlgorithm,
    ) -> Result<Self, Error> {
        kdf(target_hash)?;
        if external_identity.is_empty() {
            return Err(Error::General(
                "imported PSK: the external identity is empty".into(),
            ));
        }
        Ok(Self {
            external_identity,
            context,
            target_hash,
        })
    }

    /// Reads an identity that a client offered.
    ///
    /// `None` if it is not exactly the encoding of one for TLS 1.3 and SHA-256 or SHA-384.
    pub fn decode(encoded: &'a [u8]) -> Option<Self> {
        let (external_identity, rest) = split_prefixed(encoded)?;
        let (context, rest) = split_prefixed(rest)?;
        let target_hash = match rest {
            [0x03, 0x04, 0x00, 0x01] => HashAlgorithm::SHA256,
            [0x03, 0x04, 0x00, 0x02] => HashAlgorithm::SHA384,
            _ => return None,
        };
        Self::new(external_identity, context, target_hash).ok()
    }

    /// The identity of the base key.
    pub fn external_identity(&self) -> &'a [u8] {
        self.external_identity
    }

    /// The context the base key was imported in.
    pub fn context(&self) -> &'a [u8] {
        self.context
    }

    /// The hash function the PSK is for.
    pub fn target_hash(&self) -> HashAlgorithm {
        self.target_hash
    }

    fn encode(&self) -> Result<Vec<u8>, Error> {
        let mut encoded = Vec::new();
        for part in [self.external_identity, self.context] {
            let len = u16::try_from(part.len())
                .map_err(|_| Error::General("imported PSK: the identity is too long".into()))?;
            encoded.extend(len.to_be_bytes());
            encoded.extend(part);
        }
        encoded.extend([0x03, 0x04]);
        encoded.extend(kdf(self.target_hash)?.0.to_be_bytes());
        Ok(encoded)
    }
}

/// The TLS KDF identifier of a hash function, and its output length.
fn kdf(hash: HashAlgorithm) -> Result<(u16, usize), Error> {
    match hash {
        HashAlgorithm::SHA256 => Ok((1, 32)),
        HashAlgorithm::SHA384 => Ok((2, 48)),
        _ => Err(Error::General(
            "imported PSK: hash must be SHA-256 or SHA-384".into(),
        )),
    }
}

/// Takes `opaque part<0..2^16-1>` off the front.
fn split_prefixed(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (len, rest) = bytes.split_first_chunk::<2>()?;
    rest.split_at_checked(usize::from(u16::from_be_bytes(*len)))
}
