//! Ending the builder with external PSKs.

use alloc::vec::Vec;
use core::marker::PhantomData;

use pki_types::{CertificateDer, ServerName, UnixTime};

use super::{Resumption, WantsClientCert};
use crate::builder::{ConfigBuilder, WantsVersions};
use crate::client::ClientConfig;
use crate::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use crate::enums::SignatureScheme;
use crate::error::{Error, PeerMisbehaved};
use crate::external_psk::{
    ClientExternalPsks, ExternalPsk, ExternalPskSource, FixedExternalPsks, PskKeyExchangeMode,
    check_provider,
};
use crate::sync::Arc;
use crate::verify::DigitallySignedStruct;
use crate::versions::{EnabledVersions, TLS13};

impl ConfigBuilder<ClientConfig, WantsVersions> {
    /// Ends the builder with a list of external PSKs, most preferred first.
    ///
    /// Every connection offers all of them and completes on one of them, or fails.  See
    /// [`crate::external_psk`].
    pub fn with_external_psks(
        self,
        psks: Vec<Arc<ExternalPsk>>,
        mode: PskKeyExchangeMode,
    ) -> Result<ClientConfig, Error> {
        if psks.is_empty() {
            return Err(Error::General("external PSK: the list is empty".into()));
        }
        self.with_external_psk_source(Arc::new(FixedExternalPsks(psks)), mode)
    }

    /// Ends the builder with a source that is asked for external PSKs for each connection.
    ///
    /// Every connection completes on one of the PSKs it gets, or fails.  See
    /// [`crate::external_psk`].
    pub fn with_external_psk_source(
        self,
        source: Arc<dyn ExternalPskSource>,
        mode: PskKeyExchangeMode,
    ) -> Result<ClientConfig, Error> {
        check_provider(&self.provider, mode)?;

        let mut config = ConfigBuilder::<ClientConfig, _> {
            state: WantsClientCert {
                versions: EnabledVersions::new(&[&TLS13]),
                verifier: Arc::new(RefusesCertificates),
                client_ech_mode: None,
            },
            provider: self.provider,
            time_provider: self.time_provider,
            side: PhantomData,
        }
        .with_no_client_auth();

        config.resumption = Resumption::disabled();
        config.external_psks = Some(ClientExternalPsks { source, mode });
        Ok(config)
    }
}

/// Stands where a certificate verifier would: no certificate is ever accepted.
#[derive(Debug)]
struct RefusesCertificates;

impl RefusesCertificates {
    const ERROR: Error = Error::PeerMisbehaved(PeerMisbehaved::ServerIgnoredExternalPsks);
}

impl ServerCertVerifier for RefusesCertificates {
    fn verify_server_cert(
        &self,
        _end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Err(Self::ERROR)
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Self::ERROR)
    }

    fn verify_tls13_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Self::ERROR)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        Vec::new()
    }
}
