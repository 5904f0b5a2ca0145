//! The server's handshake on an external PSK.

use alloc::boxed::Box;
use alloc::vec::Vec;

use super::{emit_fake_ccs, emit_finished_tls13, emit_hello_retry_request, max_early_data_size};
use crate::NoKeyLog;
use crate::common_state::{HandshakeFlightTls13, HandshakeKind, KxState};
use crate::conn::ConnectionRandoms;
use crate::crypto::SupportedKxGroup;
use crate::enums::{AlertDescription, CipherSuite, ProtocolVersion};
use crate::error::{Error, PeerIncompatible, PeerMisbehaved};
use crate::external_psk::{NegotiatedExternalPsk, PskKeyExchangeMode, ServerExternalPsks};
use crate::hash_hs::HandshakeHash;
use crate::msgs::enums::Compression;
use crate::msgs::handshake::{
    ClientHelloPayload, HandshakeMessagePayload, HandshakePayload, KeyShareEntry,
    PresharedKeyOffer, Random, ServerExtensions, ServerHelloPayload, SessionId,
};
use crate::msgs::message::{Message, MessagePayload};
use crate::server::ServerConfig;
use crate::server::hs::{
    self, ExpectClientHello, HandshakeHashOrBuffer, PreviousClientHello, ServerContext,
};
use crate::server::tls13::{ExpectAndSkipRejectedEarlyData, ExpectFinished};
use crate::suites::SupportedCipherSuite;
use crate::sync::Arc;
use crate::tls13::Tls13CipherSuite;
use crate::tls13::key_schedule::{KeyScheduleEarly, KeyScheduleHandshake, KeySchedulePreHandshake};

mod retry;
mod select;

pub(in crate::server) use retry::RepeatedParts;
use retry::check_second_hello;
use select::{Selected, binder_is_correct, select};

/// Handles a ClientHello under a config that has external PSKs, up to our Finished.
pub(in crate::server) fn handle_client_hello(
    st: ExpectClientHello,
    external_psks: &ServerExternalPsks,
    cx: &mut ServerContext<'_>,
    chm: &Message<'_>,
    client_hello: &ClientHelloPayload,
) -> hs::NextStateOrError<'static> {
    let ExpectClientHello {
        config,
        extra_exts,
        transcript,
        previous_hello,
        ..
    } = st;
    let mode = external_psks.mode;
    let early_data_requested = client_hello
        .early_data_request
        .is_some();

    check_offer_is_well_formed(cx, client_hello, previous_hello.as_ref())?;
    let offer = offer_in_mode(cx, client_hello, mode)?;
    if let Some(before) = &previous_hello {
        check_second_hello(cx.common, before, chm, client_hello, offer)?;
    }

    // Before the resolver: what cannot be answered must not cost a look-up.
    let suites = common_suites(&config, cx, client_hello);
    if suites.is_empty() {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::HandshakeFailure,
            PeerIncompatible::NoCipherSuitesInCommon,
        ));
    }

    let selected = select(cx, offer, &*external_psks.resolver, &suites)?;
    let suite = selected.suite;
    if previous_hello
        .as_ref()
        .is_some_and(|before| before.suite != suite.common.suite)
    {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::CipherSuiteDifferedOnRetry,
        ));
    }
    cx.common.suite = Some(suite.into());

    let mut transcript = match transcript {
        HandshakeHashOrBuffer::Buffer(buffer) => buffer.start_hash(suite.common.hash_provider),
        // The suite is the one of the first ClientHello, and so is the hash.
        HandshakeHashOrBuffer::Hash(hash) => hash,
    };

    let binder = offer.binders[selected.index].as_ref();
    if !binder_is_correct(&selected, &transcript, chm, binder) {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::DecryptError,
            PeerMisbehaved::IncorrectBinder,
        ));
    }

    let share = match mode {
        PskKeyExchangeMode::PskKe => None,
        PskKeyExchangeMode::PskDheKe => {
            let group = choose_group(&config, cx, client_hello)?;
            cx.common.kx_state = KxState::Start(group);
            match share_for(client_hello, group) {
                Some(share) => Some((group, share)),
                None if previous_hello.is_some() => {
                    return Err(cx.common.send_fatal_alert(
                        AlertDescription::IllegalParameter,
                        PeerMisbehaved::RefusedToFollowHelloRetryRequest,
                    ));
                }
                None => {
                    transcript.add_message(chm);
                    emit_hello_retry_request(
                        &mut transcript,
                        suite,
                        client_hello.session_id,
                        cx.common,
                        group.name(),
                    );
                    emit_fake_ccs(cx.common);

                    let next = Box::new(ExpectClientHello {
                        config,
                        extra_exts,
                        transcript: HandshakeHashOrBuffer::Hash(transcript),
                        #[cfg(feature = "tls12")]
                        session_id: SessionId::empty(),
                        #[cfg(feature = "tls12")]
                        using_ems: false,
                        previous_hello: Some(PreviousClientHello {
                            offered_psk: true,
                            suite: suite.common.suite,
                            group: group.name(),
                            repeated: Some(RepeatedParts::new(suite, chm, offer)),
                        }),
                        send_tickets: 0,
                    });
                    return Ok(match early_data_requested {
                        true => Box::new(ExpectAndSkipRejectedEarlyData {
                            skip_data_left: max_early_data_size(0),
                            next,
                        }),
                        false => next,
                    });
                }
            }
        }
    };

    let randoms = ConnectionRandoms::new(
        client_hello.random,
        Random::new(config.provider.secure_random)?,
    );
    transcript.add_message(chm);
    let key_schedule = emit_server_hello(
        cx,
        &mut transcript,
        &randoms,
        &client_hello.session_id,
        &selected,
        share,
    )?;
    if previous_hello.is_none() {
        emit_fake_ccs(cx.common);
    }
    cx.common
        .handshake_kind
        .get_or_insert(HandshakeKind::Full);
    cx.common.external_psk = Some(NegotiatedExternalPsk {
        identity: selected.psk.identity().to_vec(),
        mode,
    });

    let mut flight = HandshakeFlightTls13::new(&mut transcript);
    let mut extensions = hs::ExtensionProcessing::new(extra_exts);
    extensions.process_common(&config, cx, &mut None, client_hello, None)?;
    flight.add(HandshakeMessagePayload(
        HandshakePayload::EncryptedExtensions(extensions.extensions),
    ));

    // Early data is refused by not acknowledging it: over TCP its records then have to be skipped.
    key_schedule.set_handshake_decrypter(
        early_data_requested.then(|| max_early_data_size(0)),
        cx.common,
    );
    cx.data.early_data.reject();

    cx.common.check_aligned_handshake()?;
    let key_schedule = emit_finished_tls13(flight, &randoms, cx, key_schedule, &config);

    Ok(Box::new(ExpectFinished {
        config,
        transcript,
        suite,
        key_schedule,
        send_tickets: 0,
    }))
}

/// Checks of a ClientHello that hold whatever the PSK turns out to be.
fn check_offer_is_well_formed(
    cx: &mut ServerContext<'_>,
    client_hello: &ClientHelloPayload,
    previous_hello: Option<&PreviousClientHello>,
) -> Result<(), Error> {
    if client_hello.compression_methods.len() != 1 {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::OfferedIncorrectCompressions,
        ));
    }

    // "If containing a "supported_groups" extension, it MUST also contain a "key_share" extension,
    //  and vice versa." - RFC8446 9.2, whatever the mode
    if client_hello.named_groups.is_some() != client_hello.key_shares.is_some() {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::MissingExtension,
            PeerIncompatible::KeyShareExtensionRequired,
        ));
    }

    if client_hello.has_keyshare_extension_with_duplicates() {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::OfferedDuplicateKeyShares,
        ));
    }

    if previous_hello.is_some()
        && client_hello
            .early_data_request
            .is_some()
    {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::EarlyDataAttemptedInSecondClientHello,
        ));
    }

    Ok(())
}

/// The offer of PSKs, if there is one for `mode`.
fn offer_in_mode<'a>(
    cx: &mut ServerContext<'_>,
    client_hello: &'a ClientHelloPayload,
    mode: PskKeyExchangeMode,
) -> Result<&'a PresharedKeyOffer, Error> {
    let Some(offer) = &client_hello.preshared_key_offer else {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::MissingExtension,
            PeerIncompatible::ExternalPskRequired,
        ));
    };

    // "If clients offer "pre_shared_key" without a "psk_key_exchange_modes" extension, servers
    //  MUST abort the handshake." - RFC8446 4.2.9
    let Some(modes) = &client_hello.preshared_key_modes else {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::MissingExtension,
            PeerMisbehaved::MissingPskModesExtension,
        ));
    };

    if offer.binders.len() != offer.identities.len() {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::IllegalParameter,
            PeerMisbehaved::PskExtensionWithMismatchedIdsAndBinders,
        ));
    }

    let willing = match mode {
        PskKeyExchangeMode::PskKe => modes.psk,
        PskKeyExchangeMode::PskDheKe => modes.psk_dhe,
    };
    if !willing {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::HandshakeFailure,
            PeerIncompatible::NoPskKeyExchangeModesInCommon,
        ));
    }

    Ok(offer)
}

/// The suites both ends support, in the order of preference that the config asks for.
fn common_suites(
    config: &ServerConfig,
    cx: &ServerContext<'_>,
    client_hello: &ClientHelloPayload,
) -> Vec<&'static Tls13CipherSuite> {
    let protocol = cx.common.protocol;
    let ours = || {
        config
            .provider
            .cipher_suites
            .iter()
            .filter(move |suite| suite.usable_for_protocol(protocol))
            .filter_map(SupportedCipherSuite::tls13)
    };

    if config.ignore_client_order {
        ours()
            .filter(|suite| {
                client_hello
                    .cipher_suites
                    .contains(&suite.common.suite)
            })
            .collect()
    } else {
        let find = |theirs: &CipherSuite| ours().find(|suite| suite.common.suite == *theirs);
        client_hello
            .cipher_suites
            .iter()
            .filter_map(find)
            .collect()
    }
}

/// The group to use: one that needs no further round trip if there is one.
fn choose_group(
    config: &ServerConfig,
    cx: &mut ServerContext<'_>,
    client_hello: &ClientHelloPayload,
) -> Result<&'static dyn SupportedKxGroup, Error> {
    let (Some(offered), Some(_)) = (&client_hello.named_groups, &client_hello.key_shares) else {
        return Err(cx.common.send_fatal_alert(
            AlertDescription::MissingExtension,
            PeerIncompatible::KeyShareExtensionRequired,
        ));
    };

    let common = || {
        config
            .provider
            .kx_groups
            .iter()
            .copied()
            .filter(|group| {
                group.usable_for_version(ProtocolVersion::TLSv1_3)
                    && offered.contains(&group.name())
            })
    };

    common()
        .find(|group| share_for(client_hello, *group).is_some())
        .or_else(|| common().next())
        .ok_or_else(|| {
            cx.common.send_fatal_alert(
                AlertDescription::HandshakeFailure,
                PeerIncompatible::NoKxGroupsInCommon,
            )
        })
}

fn share_for<'a>(
    client_hello: &'a ClientHelloPayload,
    group: &'static dyn SupportedKxGroup,
) -> Option<&'a KeyShareEntry> {
    client_hello
        .key_shares
        .iter()
        .flatten()
        .find(|share| share.group == group.name())
}

fn emit_server_hello(
    cx: &mut ServerContext<'_>,
    transcript: &mut HandshakeHash,
    randoms: &ConnectionRandoms,
    session_id: &SessionId,
    selected: &Selected,
    share: Option<(&'static dyn SupportedKxGroup, &KeyShareEntry)>,
) -> Result<KeyScheduleHandshake, Error> {
    let exchanged = match share {
        None => None,
        Some((group, share)) => {
            let completed = group
                .start_and_complete(&share.payload.0)
                .map_err(|err| {
                    cx.common
                        .send_fatal_alert(AlertDescription::IllegalParameter, err)
                })?;
            cx.common.kx_state.complete();
            Some(completed)
        }
    };

    let (key_share, shared_secret) = match exchanged {
        None => (None, None),
        Some(completed) => (
            Some(KeyShareEntry::new(completed.group, completed.pub_key)),
            Some(completed.secret),
        ),
    };

    let sh = Message {
        version: ProtocolVersion::TLSv1_2,
        payload: MessagePayload::handshake(HandshakeMessagePayload(HandshakePayload::ServerHello(
            ServerHelloPayload {
                legacy_version: ProtocolVersion::TLSv1_2,
                random: Random::from(randoms.server),
                session_id: *session_id,
                cipher_suite: selected.suite.common.suite,
                compression_method: Compression::Null,
                extensions: Box::new(ServerExtensions {
                    key_share,
                    selected_version: Some(ProtocolVersion::TLSv1_3),
                    // at most 2^16 / 7 identities fit into an offer
                    preshared_key: Some(selected.index as u16),
                    ..Default::default()
                }),
            },
        ))),
    };

    cx.common.check_aligned_handshake()?;
    transcript.add_message(&sh);
    cx.common.send_msg(sh, false);

    let key_schedule = KeySchedulePreHandshake::from(KeyScheduleEarly::new(
        selected.suite,
        selected.psk.secret(),
    ));
    let key_schedule = match shared_secret {
        Some(shared_secret) => key_schedule.into_handshake(shared_secret),
        None => key_schedule.into_handshake_without_shared_secret(),
    };

    Ok(key_schedule.derive_server_handshake_secrets(
        transcript.current_hash(),
        &NoKeyLog,
        &randoms.client,
        cx.common,
    ))
}
