//! The client's handshake on an external PSK.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use pki_types::ServerName;

use super::{
    ExpectFinished, emit_fake_ccs, hs, validate_encrypted_extensions, validate_server_hello,
};
use crate::NoKeyLog;
use crate::client::ClientConfig;
use crate::client::ClientConnectionData;
use crate::client::common::ClientHelloDetails;
use crate::client::hs::{ClientContext, ClientHelloInput};
use crate::common_state::{CommonState, HandshakeKind, Protocol, State};
use crate::conn::ConnectionRandoms;
use crate::crypto::hash::HashAlgorithm;
use crate::crypto::{ActiveKeyExchange, SharedSecret};
use crate::enums::{AlertDescription, CipherSuite, HandshakeType};
use crate::error::{Error, PeerMisbehaved};
use crate::external_psk::{ExternalPsk, NegotiatedExternalPsk, PskKeyExchangeMode};
use crate::hash_hs::{HandshakeHash, HandshakeHashBuffer};
use crate::msgs::codec::Codec;
use crate::msgs::enums::NamedGroup;
use crate::msgs::handshake::{
    ClientExtensions, HandshakeMessagePayload, HandshakePayload, PresharedKeyBinder,
    PresharedKeyIdentity, PresharedKeyOffer, PskKeyExchangeModes, ServerHelloPayload,
};
use crate::msgs::message::{Message, MessagePayload};
use crate::sync::Arc;
use crate::tls13::Tls13CipherSuite;
use crate::tls13::key_schedule::{KeyScheduleEarly, KeyScheduleHandshake, KeySchedulePreHandshake};
use crate::verify::{HandshakeSignatureValid, ServerCertVerified};

/// The external PSKs that one connection offers.
pub(in crate::client) struct OfferedExternalPsks {
    psks: Vec<Arc<ExternalPsk>>,
    /// Those of all PSKs at first.  A HelloRetryRequest leaves only PSKs of one hash, but it must
    /// not change the cipher suites, which these decide (RFC 8446 4.1.2).
    hashes: Vec<HashAlgorithm>,
    mode: PskKeyExchangeMode,
}

impl OfferedExternalPsks {
    /// Asks the config for the PSKs of a connection to `server_name`.
    ///
    /// Gives `None` if the config has no external PSKs, and an error if it has but there is
    /// nothing to offer.
    pub(in crate::client) fn new(
        config: &ClientConfig,
        server_name: &ServerName<'_>,
        protocol: Protocol,
    ) -> Result<Option<Self>, Error> {
        let Some(configured) = &config.external_psks else {
            return Ok(None);
        };

        let psks = configured
            .source
            .external_psks(server_name);
        if psks.is_empty() {
            return Err(Error::General(
                "external PSK: there is none for this connection".into(),
            ));
        }

        // The server names a PSK by its identity: twice the same would leave open which is meant.
        let twice = |(at, psk): (usize, &Arc<ExternalPsk>)| {
            psks[..at]
                .iter()
                .any(|before| before.identity() == psk.identity())
        };
        if psks.iter().enumerate().any(twice) {
            return Err(Error::General(
                "external PSK: the same identity twice in one offer".into(),
            ));
        }

        for psk in &psks {
            if suite_for(config, psk.hash(), protocol).is_none() {
                return Err(Error::General(
                    "external PSK: no configured cipher suite has the hash of the PSK".into(),
                ));
            }
        }

        Ok(Some(Self {
            hashes: psks
                .iter()
                .map(|psk| psk.hash())
                .collect(),
            psks,
            mode: configured.mode,
        }))
    }

    /// Makes a ClientHello offer these PSKs and nothing else.
    ///
    /// Fails if that does not fit into one.
    pub(in crate::client) fn prepare(
        &self,
        config: &ClientConfig,
        common: &mut CommonState,
        exts: &mut ClientExtensions<'_>,
        cipher_suites: &mut Vec<CipherSuite>,
    ) -> Result<(), Error> {
        cipher_suites.retain(|suite| {
            config
                .find_cipher_suite(*suite, common.protocol)
                .and_then(|suite| suite.tls13())
                .is_some_and(|suite| {
                    self.hashes
                        .contains(&suite.common.hash_provider.algorithm())
                })
        });

        if self.mode == PskKeyExchangeMode::PskKe {
            exts.named_groups = None;
            exts.key_shares = None;
        }

        // rustls lets a hybrid share be followed by its component as a share of its own.  RFC 8446
        // 4.2.8 wants shares made independently, and `complete_key_exchange()` knows one.
        if let Some(shares) = &mut exts.key_shares {
            shares.truncate(1);
        }

        // All of these ask for a certificate, a ticket, or TLS 1.2.
        exts.signature_schemes = None;
        exts.certificate_status_request = None;
        exts.certificate_authority_names = None;
        exts.certificate_compression_algorithms = None;
        exts.client_certificate_types = None;
        exts.server_certificate_types = None;
        exts.extended_master_secret_request = None;
        exts.ec_point_formats = None;
        exts.ticket_request = None;

        exts.preshared_key_modes = Some(PskKeyExchangeModes {
            psk: self.mode == PskKeyExchangeMode::PskKe,
            psk_dhe: self.mode == PskKeyExchangeMode::PskDheKe,
        });

        let len = FIXED_CLIENT_HELLO_LEN
            + 2 * cipher_suites.len()
            + extensions_len(exts)
            + self.offer_len();
        if len > MAX_CLIENT_HELLO_LEN {
            return Err(common.send_fatal_alert(
                AlertDescription::InternalError,
                Error::General("external PSK: the offer does not fit into a ClientHello".into()),
            ));
        }

        // "For identities established externally, an obfuscated_ticket_age of 0 SHOULD be used"
        // -- RFC 8446 4.2.11.
        exts.preshared_key_offer = Some(PresharedKeyOffer {
            identities: self
                .psks
                .iter()
                .map(|psk| PresharedKeyIdentity::new(psk.identity().to_vec(), 0))
                .collect(),
            binders: self
                .psks
                .iter()
                .map(|psk| PresharedKeyBinder::from(vec![0; hash_len(psk.hash())]))
                .collect(),
        });
        Ok(())
    }

    /// The bytes that these PSKs take in a ClientHello: type and length of the extension, the two
    /// lists with their lengths.
    fn offer_len(&self) -> usize {
        let entries: usize = self
            .psks
            .iter()
            .map(|psk| psk.offered_identity_len() + 1 + hash_len(psk.hash()))
            .sum();
        4 + 2 + 2 + entries
    }

    /// Fills in the binders of a ClientHello made with `prepare()`.
    ///
    /// `transcript` is what precedes this ClientHello: nothing, or the first ClientHello (as its
    /// hash) and the HelloRetryRequest.
    pub(in crate::client) fn fill_in_binders(
        &self,
        config: &ClientConfig,
        protocol: Protocol,
        transcript: &HandshakeHashBuffer,
        hmp: &mut HandshakeMessagePayload<'_>,
    ) {
        let truncated_hello = hmp.encoding_for_binder_signing();

        let HandshakePayload::ClientHello(hello) = &mut hmp.0 else {
            return;
        };
        let Some(offer) = &mut hello.preshared_key_offer else {
            return;
        };

        for (psk, binder) in self
            .psks
            .iter()
            .zip(offer.binders.iter_mut())
        {
            let suite = suite_for(config, psk.hash(), protocol).expect("checked in new()");
            let hash = transcript.hash_given(suite.common.hash_provider, &truncated_hello);
            let tag = KeyScheduleEarly::new(suite, psk.secret())
                .external_psk_binder_key_and_sign_verify_data(psk.is_imported(), &hash);
            *binder = PresharedKeyBinder::from(tag.as_ref().to_vec());
        }
    }

    /// Drops the PSKs that cannot be used with the suite a HelloRetryRequest selected.
    ///
    /// Gives `false` if that leaves none.
    pub(in crate::client) fn retain_for_retry(&mut self, hash: HashAlgorithm) -> bool {
        self.psks
            .retain(|psk| psk.hash() == hash);
        !self.psks.is_empty()
    }

    fn selected(
        &self,
        cx: &mut ClientContext<'_>,
        selected: Option<u16>,
        suite: &'static Tls13CipherSuite,
    ) -> Result<&ExternalPsk, Error> {
        let Some(index) = selected else {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::HandshakeFailure,
                PeerMisbehaved::ServerIgnoredExternalPsks,
            ));
        };

        let Some(psk) = self.psks.get(usize::from(index)) else {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::IllegalParameter,
                PeerMisbehaved::SelectedInvalidPsk,
            ));
        };

        if !psk.usable_with(suite) {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::IllegalParameter,
                PeerMisbehaved::SelectedExternalPskWithIncompatibleCipherSuite,
            ));
        }

        Ok(psk)
    }
}

/// Handles the ServerHello of a connection that offered external PSKs.
pub(in crate::client) fn handle_server_hello(
    cx: &mut ClientContext<'_>,
    server_hello: &ServerHelloPayload,
    randoms: ConnectionRandoms,
    suite: &'static Tls13CipherSuite,
    transcript: HandshakeHash,
    our_key_share: Option<Box<dyn ActiveKeyExchange>>,
    offered: OfferedExternalPsks,
    mut input: ClientHelloInput,
) -> hs::NextStateOrError<'static> {
    validate_server_hello(cx.common, server_hello)?;

    // "A client which receives a legacy_session_id_echo field that does not match what it sent in
    //  the ClientHello MUST abort the handshake with an "illegal_parameter" alert." - RFC8446 4.1.3
    if server_hello.session_id != input.session_id {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::ServerHelloWithWrongSessionId,
        ));
    }

    let psk = offered.selected(cx, server_hello.preshared_key, suite)?;
    let shared_secret = complete_key_exchange(cx, server_hello, our_key_share)?;

    let key_schedule = KeySchedulePreHandshake::from(KeyScheduleEarly::new(suite, psk.secret()));
    let key_schedule = match shared_secret {
        Some(shared_secret) => key_schedule.into_handshake(shared_secret),
        None => key_schedule.into_handshake_without_shared_secret(),
    };

    // If we change keying when a subsequent handshake message is being joined,
    // the two halves will have different record layer protections.  Disallow this.
    cx.common.check_aligned_handshake()?;

    let key_schedule = key_schedule.derive_client_handshake_secrets(
        false,
        transcript.current_hash(),
        suite,
        &NoKeyLog,
        &randoms.client,
        cx.common,
    );

    cx.common.external_psk = Some(NegotiatedExternalPsk {
        identity: psk.identity().to_vec(),
        mode: offered.mode,
    });

    emit_fake_ccs(&mut input.sent_tls13_fake_ccs, cx.common);

    Ok(Box::new(ExpectEncryptedExtensions {
        config: input.config,
        server_name: input.server_name,
        randoms,
        suite,
        transcript,
        key_schedule,
        hello: input.hello,
    }))
}

/// Combines the key shares.  Gives `None` in psk_ke, where there are none.
fn complete_key_exchange(
    cx: &mut ClientContext<'_>,
    server_hello: &ServerHelloPayload,
    our_key_share: Option<Box<dyn ActiveKeyExchange>>,
) -> Result<Option<SharedSecret>, Error> {
    let (ours, theirs) = match (our_key_share, &server_hello.key_share) {
        (None, None) => return Ok(None),
        (Some(ours), Some(theirs)) => (ours, theirs),
        (Some(_), None) => {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::IllegalParameter,
                PeerMisbehaved::MissingKeyShare,
            ));
        }
        // An extension that was not offered was refused already; this keeps the match honest.
        (None, Some(_)) => {
            return Err(cx.common.send_fatal_alert(
                AlertDescription::UnsupportedExtension,
                PeerMisbehaved::UnsolicitedServerHelloExtension,
            ));
        }
    };

    if ours.group() != theirs.group {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::WrongGroupForKeyShare,
        ));
    }

    cx.common.kx_state.complete();
    ours.complete(&theirs.payload.0)
        .map(Some)
        .map_err(|err| {
            cx.common
                .send_fatal_alert(AlertDescription::IllegalParameter, err)
        })
}

struct ExpectEncryptedExtensions {
    config: Arc<ClientConfig>,
    server_name: ServerName<'static>,
    randoms: ConnectionRandoms,
    suite: &'static Tls13CipherSuite,
    transcript: HandshakeHash,
    key_schedule: KeyScheduleHandshake,
    hello: ClientHelloDetails,
}

impl State<ClientConnectionData> for ExpectEncryptedExtensions {
    fn handle<'m>(
        mut self: Box<Self>,
        cx: &mut ClientContext<'_>,
        m: Message<'m>,
    ) -> hs::NextStateOrError<'m>
    where
        Self: 'm,
    {
        let exts = require_handshake_msg!(
            m,
            HandshakeType::EncryptedExtensions,
            HandshakePayload::EncryptedExtensions
        )?;
        self.transcript.add_message(&m);

        // This refuses early data and certificate types too: neither was offered.
        validate_encrypted_extensions(cx.common, &self.hello, exts)?;
        hs::process_alpn_protocol(
            cx.common,
            &self.hello.alpn_protocols,
            exts.selected_protocol
                .as_ref()
                .map(|protocol| protocol.as_ref()),
            self.config.check_selected_alpn,
        )?;

        if cx.common.is_quic() {
            match exts
                .transport_parameters
                .as_ref()
                .or(exts.transport_parameters_draft.as_ref())
            {
                Some(params) => cx.common.quic.params = Some(params.clone().into_vec()),
                None => {
                    return Err(cx
                        .common
                        .missing_extension(PeerMisbehaved::MissingQuicTransportParameters));
                }
            }
        }

        cx.common
            .handshake_kind
            .get_or_insert(HandshakeKind::Full);

        // The PSK authenticates the server, through the Finished that must come next: a
        // CertificateRequest or Certificate is an unexpected message there.
        Ok(Box::new(ExpectFinished {
            config: self.config,
            server_name: self.server_name,
            randoms: self.randoms,
            suite: self.suite,
            transcript: self.transcript,
            key_schedule: self.key_schedule,
            // Only a hint for the next connection, which external PSKs do not keep.
            kx_group: NamedGroup::from(0),
            client_auth: None,
            cert_verified: ServerCertVerified::assertion(),
            sig_verified: HandshakeSignatureValid::assertion(),
            ech_retry_configs: None,
        }))
    }

    fn into_owned(self: Box<Self>) -> hs::NextState<'static> {
        self
    }
}

/// The bytes that `exts` take, without an offer.
///
/// The cookie of a HelloRetryRequest is counted by itself: with it, even this could be more than
/// the extensions of one message can be.
fn extensions_len(exts: &mut ClientExtensions<'_>) -> usize {
    let cookie = exts.cookie.take();
    let without_cookie = exts.get_encoding().len();
    let cookie_len = cookie
        .as_ref()
        .map_or(0, |cookie| 4 + 2 + cookie.0.len());
    exts.cookie = cookie;
    without_cookie + cookie_len
}

/// A configured suite that uses `hash`.  Binders are the same for all of them.
fn suite_for(
    config: &ClientConfig,
    hash: HashAlgorithm,
    protocol: Protocol,
) -> Option<&'static Tls13CipherSuite> {
    config
        .provider
        .cipher_suites
        .iter()
        .filter(|suite| suite.usable_for_protocol(protocol))
        .filter_map(|suite| suite.tls13())
        .find(|suite| suite.common.hash_provider.algorithm() == hash)
}

/// The longest handshake message that rustls takes from a peer, without its header.
///
/// It is less than what the lengths in a ClientHello can say.
const MAX_CLIENT_HELLO_LEN: usize = 0xffff;

/// Version, random, session ID, the length of the suites, compression.
const FIXED_CLIENT_HELLO_LEN: usize = 2 + 32 + (1 + 32) + 2 + 2;

fn hash_len(hash: HashAlgorithm) -> usize {
    match hash {
        HashAlgorithm::SHA384 => 48,
        _ => 32,
    }
}
