//! Configs: which are refused, and what is ignored in the others.

use std::fmt;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;

use rustls_axon::client::Resumption;
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::crypto::SupportedKxGroup;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, ExternalPskSource, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::pki_types::ServerName;
use rustls_axon::server::ServerSessionMemoryCache;
use rustls_axon::{
    ClientConfig, ClientConnection, Error, HandshakeKind, KeyLog, PeerIncompatible, PeerMisbehaved,
    ServerConnection, SupportedCipherSuite,
};
use zeroize::Zeroizing;

use crate::common::*;
use crate::peer::{ext, plaintext, records, server_hello, HANDSHAKE};
use crate::resumption::{stock_client, Unchecked};

#[test]
fn configs_that_cannot_work_are_refused() {
    let secret = || Zeroizing::new(vec![1; 32]);
    assert!(ExternalPsk::new("", secret(), HashAlgorithm::SHA256).is_err());
    assert!(ExternalPsk::new(vec![b'a'; 65_530], secret(), HashAlgorithm::SHA256).is_err());
    assert!(ExternalPsk::new("a", secret(), HashAlgorithm::SHA512).is_err());
    assert!(ExternalPsk::new("a", Zeroizing::new(vec![1; 15]), HashAlgorithm::SHA256).is_err());

    let build = |suites: &[_], groups: &[_], psks, mode| {
        ClientConfig::builder_with_provider(provider(suites, groups)).with_external_psks(psks, mode)
    };
    let [psk_ke, psk_dhe_ke] = MODES;
    let one = || vec![psk("a", 1, SHA256)];
    assert!(build(&[SHA256], &[], vec![], psk_ke).is_err(), "no PSK");
    assert!(build(&[], &[], one(), psk_ke).is_err(), "no suite");
    assert!(build(&[SHA256], &[], one(), psk_dhe_ke).is_err(), "no group");

    // only with an external PSK may the list of groups be empty
    assert!(ClientConfig::builder_with_provider(provider(&[SHA256], &[]))
        .with_safe_default_protocol_versions()
        .is_err());

    // a suite for the PSK is looked for when a connection is made, as a source may have any PSK
    let config = build(&[SHA384], &[], one(), psk_ke).unwrap();
    let name = "example.com".try_into().unwrap();
    assert!(ClientConnection::new(Arc::new(config), name).is_err());
}

/// Does as it is told, for each connection anew.
struct Source<F>(F);

impl<F> fmt::Debug for Source<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Source")
    }
}

impl<F> ExternalPskSource for Source<F>
where
    F: Fn(&ServerName<'_>) -> Vec<Arc<ExternalPsk>> + Send + Sync,
{
    fn external_psks(&self, server_name: &ServerName<'_>) -> Vec<Arc<ExternalPsk>> {
        (self.0)(server_name)
    }
}

fn sourced<F>(source: F, groups: &[&'static dyn SupportedKxGroup]) -> ClientConfig
where
    F: Fn(&ServerName<'_>) -> Vec<Arc<ExternalPsk>> + Send + Sync + 'static,
{
    let mode = match groups {
        [] => PskKeyExchangeMode::PskKe,
        _ => PskKeyExchangeMode::PskDheKe,
    };
    ClientConfig::builder_with_provider(provider(&[SHA256, SHA384], groups))
        .with_external_psk_source(Arc::new(Source(source)), mode)
        .unwrap()
}

fn connect(config: &Arc<ClientConfig>) -> Result<ClientConnection, Error> {
    ClientConnection::new(config.clone(), "example.com".try_into().unwrap())
}

#[test]
fn a_source_is_asked_for_every_connection() {
    let asked = Arc::new(AtomicUsize::new(0));
    let counter = asked.clone();
    let config = Arc::new(sourced(
        move |name| {
            assert_eq!(name.to_str(), "example.com");
            match counter.fetch_add(1, Ordering::Relaxed) {
                0 => vec![psk("first", 1, SHA256)],
                1 => vec![],
                2 => vec![psk("third", 3, SHA384)],
                _ => panic!("a source that fails"),
            }
        },
        &[],
    ));
    let server = || {
        let psks = vec![psk("first", 1, SHA256), psk("third", 3, SHA384)];
        server(server_config(&[SHA256, SHA384], Known::new(psks), PskKeyExchangeMode::PskKe))
    };

    let mut first = connect(&config).unwrap();
    handshake(&mut first, &mut server()).unwrap();
    assert_eq!(first.external_psk().unwrap().identity(), b"first");
    // nothing to offer: there is no connection that could send anything
    assert!(connect(&config).is_err());
    // another hash than before, and so another suite
    let mut third = connect(&config).unwrap();
    handshake(&mut third, &mut server()).unwrap();
    assert_eq!(third.negotiated_cipher_suite(), Some(SHA384));
    // a panic is the caller's, and the config is as good as before
    assert!(catch_unwind(AssertUnwindSafe(|| connect(&config).err())).is_err());
    assert_eq!(asked.load(Ordering::Relaxed), 4);
}

/// An offer has to fit into a ClientHello, with all else that is in there.
#[test]
fn offers_that_do_not_fit_are_refused() {
    let long = |len, name: u8| {
        let secret = Zeroizing::new(vec![1; 32]);
        Arc::new(ExternalPsk::new(vec![name; len], secret, HashAlgorithm::SHA256).unwrap())
    };
    let many = |number: u32| -> Vec<_> {
        let name = |at: u32| psk(&format!("{at:04}"), 1, SHA256);
        (0..number).map(name).collect()
    };
    for groups in [&[][..], &[HYBRID]] {
        for psks in [
            vec![long(65_529, b'a')],
            vec![long(65_400, b'a')],
            vec![long(40_000, b'a'), long(40_000, b'b')],
            // the identities alone would fit, their binders do not
            many(1_900),
            many(6_000),
        ] {
            let config = Arc::new(sourced(move |_| psks.clone(), groups));
            assert!(connect(&config).is_err());
        }
        for psks in [vec![long(60_000, b'a')], many(1_000)] {
            let psks_of_server = psks.clone();
            let config = Arc::new(sourced(move |_| psks.clone(), groups));
            let mut client = connect(&config).unwrap();
            let mode = match groups {
                [] => PskKeyExchangeMode::PskKe,
                _ => PskKeyExchangeMode::PskDheKe,
            };
            let last = psks_of_server.last().unwrap().clone();
            let resolver = Known::new(vec![last.clone()]);
            let mut server = server(server_config(&[SHA256], resolver, mode));
            handshake(&mut client, &mut server).unwrap();
            assert_eq!(client.external_psk().unwrap().identity(), last.identity());
        }
    }

    // what else is in a ClientHello counts
    let mut config = sourced(move |_| vec![long(40_000, b'a')], &[]);
    config.alpn_protocols = (0..200).map(|at: u8| vec![at; 200]).collect();
    assert!(connect(&Arc::new(config)).is_err());
}

/// Gives whatever it has, asked for or not.
struct Stubborn(Option<Arc<ExternalPsk>>);

impl fmt::Debug for Stubborn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Stubborn")
    }
}

impl ResolvesExternalPsk for Stubborn {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        assert_eq!(offer.server_name(), Some("example.com"));
        assert_eq!(offer.identities().next(), Some(&b"a"[..]));
        Some(self.0.clone().expect("a resolver that fails"))
    }
}

#[test]
fn a_resolver_that_is_wrong_ends_the_handshake() {
    let to = |resolved, suites: &[SupportedCipherSuite]| {
        let mode = PskKeyExchangeMode::PskKe;
        let mut client = client(client_config(&[SHA256, SHA384], vec![psk("a", 1, SHA256)], mode));
        let server = server_config_over(suites, &[], Arc::new(Stubborn(resolved)), mode);
        (written(&mut client), self::server(server))
    };
    for (resolved, alert) in [
        // one that was not offered
        (psk("b", 1, SHA256), 80),
        // one that goes with no suite of both ends
        (psk("a", 1, SHA384), 40),
    ] {
        let (hello, mut server) = to(Some(resolved), &[SHA256, SHA384]);
        assert!(feed(&mut server, &hello).is_err());
        assert_eq!(written(&mut server).last(), Some(&alert));
    }

    // a panic is the caller's; the connection stays unusable
    let (hello, mut server) = to(None, &[SHA256]);
    assert!(catch_unwind(AssertUnwindSafe(|| feed(&mut server, &hello).is_err())).is_err());
    assert!(server.is_handshaking() && server.external_psk().is_none());
    assert!(!server.wants_write());
}

/// A verifier and certificates can be put into a config that is built. They are not used.
#[test]
fn certificates_set_in_a_built_config_are_not_used() {
    for mode in MODES {
        let mut config = client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode);
        config.dangerous().set_certificate_verifier(Unchecked::new());
        let mut client = client(config);
        let hello = plaintext(&written(&mut client));
        // a ServerHello that a certificate would follow
        let answer = server_hello(&hello, 0x1303, [7; 32], &[ext(43, &[3, 4])]);
        let error = feed(&mut client, &records(HANDSHAKE, &answer)).unwrap_err();
        assert_eq!(error, PeerMisbehaved::ServerIgnoredExternalPsks.into());
        assert_eq!(written(&mut client).last(), Some(&40));

        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut config = server_config(&[SHA256], resolver, mode);
        config.cert_resolver = Unchecked::new();
        let mut server = server(config);
        let mut client = self::client(stock_client());
        let error = pass(&mut client, &mut server).unwrap_err();
        assert_eq!(error, PeerIncompatible::ExternalPskRequired.into());
        assert_eq!(written(&mut server).last(), Some(&109));
    }
}

#[derive(Debug)]
struct NoLogging;

impl KeyLog for NoLogging {
    fn will_log(&self, _label: &str) -> bool {
        panic!("the key log must not be asked");
    }

    fn log(&self, _label: &str, _client_random: &[u8], _secret: &[u8]) {
        panic!("nothing must be logged");
    }
}

/// Whatever the public fields of the configs are set to afterwards.
#[test]
fn nothing_is_kept_or_logged_or_sent_early() {
    for mode in MODES {
        let mut client_config = client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode);
        client_config.key_log = Arc::new(NoLogging);
        client_config.resumption = Resumption::in_memory_sessions(8);
        client_config.enable_early_data = true;
        let client_config = Arc::new(client_config);

        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut server_config = server_config(&[SHA256], resolver.clone(), mode);
        server_config.key_log = Arc::new(NoLogging);
        server_config.session_storage = ServerSessionMemoryCache::new(8);
        server_config.send_tls13_tickets = 4;
        server_config.max_early_data_size = 1_000;
        server_config.send_half_rtt_data = true;
        let server_config = Arc::new(server_config);

        for connection in 1..=2 {
            let name = "example.com".try_into().unwrap();
            let mut client = ClientConnection::new(client_config.clone(), name).unwrap();
            let mut server = ServerConnection::new(server_config.clone()).unwrap();
            assert!(client.early_data().is_none());

            pass(&mut client, &mut server).unwrap();
            assert!(server.external_psk().is_none(), "the client's Finished is still to come");
            assert!(client.external_psk().is_none());
            pass(&mut server, &mut client).unwrap();
            assert!(client.external_psk().is_some());
            assert!(server.external_psk().is_none());
            pass(&mut client, &mut server).unwrap();
            assert!(server.external_psk().is_some());
            assert!(!server.wants_write(), "no tickets");

            assert_eq!(client.tls13_tickets_received(), 0);
            assert_eq!(client.handshake_kind(), Some(HandshakeKind::Full));
            assert_eq!(server.handshake_kind(), Some(HandshakeKind::Full));
            assert_eq!(resolver.asked.load(Ordering::Relaxed), connection, "asked every time");
        }
    }
}
