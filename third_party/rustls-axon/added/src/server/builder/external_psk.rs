//! Ending the builder with an external PSK resolver.

use core::marker::PhantomData;

use super::WantsServerCert;
use crate::builder::{ConfigBuilder, WantsVersions};
use crate::error::Error;
use crate::external_psk::{
    PskKeyExchangeMode, ResolvesExternalPsk, ServerExternalPsks, check_provider,
};
use crate::server::handy::NoServerSessionStorage;
use crate::server::{ClientHello, ResolvesServerCert, ServerConfig};
use crate::sign::CertifiedKey;
use crate::sync::Arc;
use crate::verify::NoClientAuth;
use crate::versions::{EnabledVersions, TLS13};

impl ConfigBuilder<ServerConfig, WantsVersions> {
    /// Ends the builder with a resolver of external PSKs.
    ///
    /// Every connection completes on a PSK that the resolver returned, or fails.  See
    /// [`crate::external_psk`].
    pub fn with_external_psk_resolver(
        self,
        resolver: Arc<dyn ResolvesExternalPsk>,
        mode: PskKeyExchangeMode,
    ) -> Result<ServerConfig, Error> {
        check_provider(&self.provider, mode)?;

        let mut config = ConfigBuilder::<ServerConfig, _> {
            state: WantsServerCert {
                versions: EnabledVersions::new(&[&TLS13]),
                verifier: Arc::new(NoClientAuth),
            },
            provider: self.provider,
            time_provider: self.time_provider,
            side: PhantomData,
        }
        .with_cert_resolver(Arc::new(HasNoCertificate));

        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        config.external_psks = Some(ServerExternalPsks { resolver, mode });
        Ok(config)
    }
}

/// Stands where a certificate resolver would.
#[derive(Debug)]
struct HasNoCertificate;

impl ResolvesServerCert for HasNoCertificate {
    fn resolve(&self, _client_hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        None
    }
}
