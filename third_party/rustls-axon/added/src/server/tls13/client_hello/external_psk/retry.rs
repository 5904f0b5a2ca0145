//! What a second ClientHello has to repeat of the first.

use alloc::vec::Vec;

use crate::common_state::CommonState;
use crate::crypto::hash::{self, Hash};
use crate::enums::AlertDescription;
use crate::error::{Error, PeerMisbehaved};
use crate::msgs::handshake::{ClientHelloPayload, PresharedKeyOffer};
use crate::msgs::message::{Message, MessagePayload};
use crate::server::hs::PreviousClientHello;
use crate::tls13::Tls13CipherSuite;

/// The parts of a ClientHello that the client must repeat after a HelloRetryRequest
/// (RFC 8446 4.1.2).
pub(in crate::server) struct RepeatedParts {
    hash_provider: &'static dyn Hash,
    digest: hash::Output,
    identities: Vec<Vec<u8>>,
}

impl RepeatedParts {
    /// Takes them from the first ClientHello.
    pub(super) fn new(
        suite: &'static Tls13CipherSuite,
        client_hello: &Message<'_>,
        offer: &PresharedKeyOffer,
    ) -> Self {
        let hash_provider = suite.common.hash_provider;
        let identities = offer
            .identities
            .iter()
            .map(|id| id.identity.0.clone())
            .collect();
        Self {
            hash_provider,
            digest: hash_provider.hash(&repeated_bytes(client_hello)),
            identities,
        }
    }

    /// Whether a second ClientHello has the same bytes, and offers PSKs of the first in their
    /// order.
    fn are_in(&self, client_hello: &Message<'_>, offer: &PresharedKeyOffer) -> bool {
        let digest = self
            .hash_provider
            .hash(&repeated_bytes(client_hello));
        let mut before = self.identities.iter();
        digest.as_ref() == self.digest.as_ref()
            && offer
                .identities
                .iter()
                .all(|id| before.any(|known| *known == id.identity.0))
    }
}

/// Refuses a second ClientHello that is not what the HelloRetryRequest asked for.
pub(super) fn check_second_hello(
    common: &mut CommonState,
    before: &PreviousClientHello,
    message: &Message<'_>,
    client_hello: &ClientHelloPayload,
    offer: &PresharedKeyOffer,
) -> Result<(), Error> {
    // "...replacing the list of shares with a list containing a single KeyShareEntry from the
    //  indicated group." - RFC8446 4.1.2
    let shares = client_hello
        .key_shares
        .as_deref()
        .unwrap_or_default();
    if !before.asked_for(shares) {
        return Err(common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::RefusedToFollowHelloRetryRequest,
        ));
    }

    // "...the client MUST send the same ClientHello without modification, except as follows"
    // - RFC8446 4.1.2
    if !before
        .repeated
        .as_ref()
        .is_some_and(|parts| parts.are_in(message, offer))
    {
        return Err(common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::ClientHelloDifferedOnRetry,
        ));
    }
    Ok(())
}

/// The fields of a ClientHello and the extensions that a second one has to repeat.
fn repeated_bytes(client_hello: &Message<'_>) -> Vec<u8> {
    let MessagePayload::Handshake { encoded, .. } = &client_hello.payload else {
        return Vec::new();
    };
    // The message was decoded, so it has all of its parts: the whole is a fallback that no second
    // ClientHello equals by chance.
    repeated_parts(encoded.bytes()).unwrap_or_else(|| encoded.bytes().to_vec())
}

fn repeated_parts(encoded: &[u8]) -> Option<Vec<u8>> {
    let (_header, hello) = encoded.split_at_checked(4)?;
    let (_version_and_random, rest) = hello.split_at_checked(2 + 32)?;
    let (_session_id, rest) = split_prefixed::<1>(rest)?;
    let (_cipher_suites, rest) = split_prefixed::<2>(rest)?;
    let (_compression_methods, rest) = split_prefixed::<1>(rest)?;
    let (fields, _) = hello.split_at_checked(hello.len() - rest.len())?;
    let (mut extensions, _) = split_prefixed::<2>(rest)?;

    let mut repeated = fields.to_vec();
    while let Some((kind, after_kind)) = extensions.split_first_chunk::<2>() {
        let (_, after) = split_prefixed::<2>(after_kind)?;
        let (extension, _) = extensions.split_at_checked(extensions.len() - after.len())?;
        if !MAY_CHANGE.contains(&u16::from_be_bytes(*kind)) {
            repeated.extend_from_slice(extension);
        }
        extensions = after;
    }
    Some(repeated)
}

/// The extensions that RFC 8446 4.1.2 lets a client add, change or leave out, and
/// `encrypted_client_hello`, which is sealed anew.
///
/// `cookie` is missing: no HelloRetryRequest of this server has one to return.
const MAY_CHANGE: [u16; 5] = [
    PADDING,
    PRE_SHARED_KEY,
    EARLY_DATA,
    KEY_SHARE,
    ENCRYPTED_CLIENT_HELLO,
];
const PADDING: u16 = 21;
const PRE_SHARED_KEY: u16 = 41;
const EARLY_DATA: u16 = 42;
const KEY_SHARE: u16 = 51;
const ENCRYPTED_CLIENT_HELLO: u16 = 0xfe0d;

/// Takes a vector with a length of `N` bytes off the front.
fn split_prefixed<const N: usize>(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (prefix, rest) = bytes.split_first_chunk::<N>()?;
    let len = prefix
        .iter()
        .fold(0, |len, byte| len << 8 | usize::from(*byte));
    rest.split_at_checked(len)
}
