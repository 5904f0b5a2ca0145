//! Which of the offered PSKs a server takes.

use alloc::vec::Vec;

use subtle::ConstantTimeEq;

use crate::enums::AlertDescription;
use crate::error::{Error, PeerIncompatible};
use crate::external_psk::{ExternalPsk, ExternalPskOffer, ResolvesExternalPsk};
use crate::hash_hs::HandshakeHash;
use crate::msgs::handshake::PresharedKeyOffer;
use crate::msgs::message::{Message, MessagePayload};
use crate::server::hs::ServerContext;
use crate::sync::Arc;
use crate::tls13::Tls13CipherSuite;
use crate::tls13::key_schedule::KeyScheduleEarly;

/// A PSK that the client offered and the server knows, and the suite to use it with.
pub(super) struct Selected {
    /// The place of the PSK in the offer.
    pub(super) index: usize,
    pub(super) psk: Arc<ExternalPsk>,
    pub(super) suite: &'static Tls13CipherSuite,
}

/// Asks the resolver for a PSK that goes with one of `suites`, in order of preference.
///
/// A PSK of another hash does not end the search: RFC 9258 has a client offer one PSK for each
/// hash, and only one of them may go with a suite of this server.
pub(super) fn select(
    cx: &mut ServerContext<'_>,
    offer: &PresharedKeyOffer,
    resolver: &dyn ResolvesExternalPsk,
    suites: &[&'static Tls13CipherSuite],
) -> Result<Selected, Error> {
    let mut identities: Vec<&[u8]> = offer
        .identities
        .iter()
        .map(|id| id.identity.0.as_slice())
        .collect();

    for passed_over in 0..=MAX_PASSED_OVER {
        let resolved = resolver.resolve(ExternalPskOffer {
            identities: &identities,
            suites,
            server_name: cx.data.sni.as_ref(),
        });
        let Some(psk) = resolved else {
            if passed_over > 0 {
                break;
            }
            return Err(cx.common.send_fatal_alert(
                AlertDescription::UnknownPSKIdentity,
                PeerIncompatible::UnknownExternalPskIdentity,
            ));
        };

        let Some(index) = offer
            .identities
            .iter()
            .position(|id| id.identity.0 == psk.identity())
        else {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::InternalError,
                Error::General("external PSK: resolver returned a PSK that was not offered".into()),
            ));
        };

        let usable = |suite: &&&'static Tls13CipherSuite| psk.usable_with(suite);
        if let Some(suite) = suites.iter().find(usable).copied() {
            return Ok(Selected { index, psk, suite });
        }

        identities.retain(|identity| *identity != psk.identity());
        if identities.is_empty() {
            break;
        }
    }

    Err(cx.common.send_fatal_alert(
        AlertDescription::HandshakeFailure,
        PeerIncompatible::NoCipherSuitesInCommon,
    ))
}

/// How many PSKs of a wrong hash are passed over in one offer.
///
/// This bounds the look-ups that one ClientHello can cause.
const MAX_PASSED_OVER: usize = 8;

/// Whether `binder` is the one of `selected` for this ClientHello.  The comparison takes the same
/// time wherever the binders differ.
pub(super) fn binder_is_correct(
    selected: &Selected,
    transcript: &HandshakeHash,
    client_hello: &Message<'_>,
    binder: &[u8],
) -> bool {
    let MessagePayload::Handshake { parsed, encoded } = &client_hello.payload else {
        return false;
    };
    let encoded = encoded.bytes();
    let truncated_hello = &encoded[..encoded
        .len()
        .saturating_sub(parsed.total_binder_length())];

    let expected = KeyScheduleEarly::new(selected.suite, selected.psk.secret())
        .external_psk_binder_key_and_sign_verify_data(
            selected.psk.is_imported(),
            &transcript.hash_given(truncated_hello),
        );
    ConstantTimeEq::ct_eq(expected.as_ref(), binder).into()
}
