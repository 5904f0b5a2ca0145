//! The QUIC settings of endpoints and links.

use std::{sync::Arc, time::Duration};

use aws_lc_rs::hmac;
use axon_transport::config::Config;
use quinn_proto::{
    EndpointConfig, HashedConnectionIdGenerator, IdleTimeout, MtuDiscoveryConfig, TransportConfig,
    VarInt,
    congestion::CubicConfig,
    crypto::{CryptoError, HmacKey},
};

use super::marks::CountingFactory;

/// A silent peer is given up after this.
const IDLE_TIMEOUT_MS: u32 = 20_000;

/// Data streams a peer may open before its HELLO is checked; quinn allocates each of them.
const STREAMS_BEFORE_HELLO: u32 = 128;

/// Data streams of an open link: one per publisher and route, and best-effort messages in flight.
pub(crate) const STREAMS_OPEN: u32 = 4096;

const SEND_WINDOW: u64 = 16 << 20;

const STREAM_WINDOW: (u64, u64) = (1 << 20, 4 << 20);

/// What a link may have under way before it is elected, and each link has then beside its share of what
/// its peer may have.
pub(crate) const LINK_WINDOW: u32 = 1 << 20;

/// The key of stateless resets. quinn-proto takes aws-lc's own type only while no crate in the program
/// enables its feature `ring`.
struct ResetKey(hmac::Key);

impl HmacKey for ResetKey {
    fn sign(&self, data: &[u8], signature_out: &mut [u8]) {
        signature_out.copy_from_slice(hmac::sign(&self.0, data).as_ref());
    }

    fn signature_len(&self) -> usize {
        hmac::HMAC_SHA256.digest_algorithm().output_len()
    }

    fn verify(&self, data: &[u8], signature: &[u8]) -> Result<(), CryptoError> {
        hmac::verify(&self.0, data, signature).map_err(|_| CryptoError)
    }
}

pub(crate) fn endpoint_config(reset_key: &[u8; 32]) -> EndpointConfig {
    let key = hmac::Key::new(hmac::HMAC_SHA256, reset_key);
    // Connection ids are checked before a stateless reset is sent, so those of the predecessor must
    // pass: their key is derived from the one that is kept.
    let tag = hmac::sign(&key, b"connection ids");
    let mut config = EndpointConfig::new(Arc::new(ResetKey(key)));
    let mut seed = [0; 8];
    seed.copy_from_slice(&tag.as_ref()[..8]);
    let seed = u64::from_be_bytes(seed);
    config.cid_generator(move || Box::new(HashedConnectionIdGenerator::from_key(seed)));
    // The first two bits tell QUIC from discovery, so the fixed bit stays what it is.
    config.grease_quic_bit(false);
    config.supported_versions(vec![1]);
    config
}

/// The transport settings of a link, for either end.
pub(crate) fn transport(config: &Config) -> TransportConfig {
    let mut transport = TransportConfig::default();
    let window = (config.max_message * 2).clamp(STREAM_WINDOW.0, STREAM_WINDOW.1);
    let mut mtu = MtuDiscoveryConfig::default();
    mtu.upper_bound(config.link.mtu);
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(STREAMS_BEFORE_HELLO))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE_TIMEOUT_MS))))
        .keep_alive_interval(Some(Duration::from_secs(4)))
        .stream_receive_window(VarInt::from_u64(window).unwrap_or(VarInt::MAX))
        .receive_window(VarInt::from_u32(LINK_WINDOW))
        .send_window(SEND_WINDOW)
        .congestion_controller_factory(Arc::new(CountingFactory(Arc::new(CubicConfig::default()))))
        .initial_mtu(1200)
        .mtu_discovery_config(Some(mtu));
    transport
}
