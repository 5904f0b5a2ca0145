//! The QUIC settings of endpoints and links.

use std::{net::IpAddr, sync::Arc, time::Duration};

use aws_lc_rs::hmac;
use axon_transport::config::{Config, Congestion};
use quinn_proto::{
    AckFrequencyConfig, EndpointConfig, HashedConnectionIdGenerator, IdleTimeout,
    MtuDiscoveryConfig, QlogStream, TransportConfig, VarInt,
    congestion::{BbrConfig, ControllerFactory, CubicConfig},
    crypto::{CryptoError, HmacKey},
};

use crate::engine::congestion::DelayConfig;
use crate::engine::congestion::marks::EcnCountingFactory;

/// A link whose peer is silent ends after this time. Until then its flows and routes stay, and a successor takes them
/// over.
const IDLE_TIMEOUT_MS: u32 = 120_000;

/// Most data streams that a peer may open before its HELLO is checked; quinn allocates each of them.
const STREAMS_BEFORE_HELLO: u32 = 128;

/// Most data streams of an open link: one per publisher and route, and best-effort messages in flight.
pub(crate) const STREAMS_OPEN: u32 = 4096;

const SEND_WINDOW: u64 = 16 << 20;

/// The least and the greatest window of one stream, in bytes.
pub(crate) const STREAM_WINDOW: (u64, u64) = (1 << 20, 4 << 20);

/// Bytes that a link may have in flight before it is elected. After that each link has them in addition to its share of
/// the peer's window.
pub(crate) const LINK_WINDOW: u32 = 1 << 20;

/// The part of a connection's window that long samples leave to others: a quarter.
const RESERVED: u64 = 4;

/// Returns the bytes of long samples that a peer may have in flight, if `unread` bytes may be unread.
pub(crate) fn window_credit(unread: u64) -> u64 {
    unread - unread / RESERVED
}

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
    // Connection ids are checked before a stateless reset is sent, so the predecessor's connection ids must be
    // accepted: their key is derived from the key that is kept.
    let tag = hmac::sign(&key, b"connection ids");
    let mut config = EndpointConfig::new(Arc::new(ResetKey(key)));
    let mut seed = [0; 8];
    seed.copy_from_slice(&tag.as_ref()[..8]);
    let seed = u64::from_be_bytes(seed);
    config.cid_generator(move || Box::new(HashedConnectionIdGenerator::from_key(seed)));
    // The first two bits separate QUIC from discovery, so the fixed bit must keep its value.
    config.grease_quic_bit(false);
    config.supported_versions(vec![1]);
    config
}

/// The longest time for which a peer may delay the acknowledgement of a lone packet. QUIC's default of 25 ms would be
/// most of a round trip on a local path, and the retransmit timeout grows with it.
const ACK_DELAY: Duration = Duration::from_millis(2);
/// Most ack-eliciting packets that a peer may receive without an immediate acknowledgement: with 1, the usual value, it
/// acknowledges every second one at once. Under heavy loss each acknowledgement counts.
const ACK_THRESHOLD: u32 = 1;
/// The round trip that is assumed for a private path until one was measured. QUIC's default of 333 ms is for the
/// Internet: with it, the loss of a first packet delays the link by a second.
const PRIVATE_RTT: Duration = Duration::from_millis(50);

/// The transport settings of links, which depend on the peer's address.
pub(crate) struct Transports {
    /// Settings for private and link-local addresses.
    private: Arc<TransportConfig>,
    /// Settings for all other addresses.
    other: Arc<TransportConfig>,
}

impl Transports {
    /// Returns the settings of `config`.
    pub(crate) fn new(config: &Config) -> Self {
        Self {
            private: Arc::new(transport(config, true)),
            other: Arc::new(transport(config, false)),
        }
    }

    /// Returns the settings of a link to this address.
    pub(crate) fn towards(&self, address: IpAddr) -> Arc<TransportConfig> {
        Arc::clone(if is_private(address) { &self.private } else { &self.other })
    }

    /// Returns the settings of one link to this address, which writes its events to `stream`.
    pub(crate) fn logged(
        config: &Config,
        stream: QlogStream,
        address: IpAddr,
    ) -> Arc<TransportConfig> {
        let mut transport = transport(config, is_private(address));
        transport.qlog_stream(Some(stream));
        Arc::new(transport)
    }
}

/// Returns whether an address belongs to a robot's own networks. Loopback does not: it loses no packet that its
/// receiver has room for, and has no queue but the receiver's.
fn is_private(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(v4) => v4.is_private() || v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_unique_local() || v6.is_unicast_link_local(),
    }
}

fn transport(config: &Config, is_private: bool) -> TransportConfig {
    let mut transport = TransportConfig::default();
    let window = (config.max_message * 2).clamp(STREAM_WINDOW.0, STREAM_WINDOW.1);
    let mut mtu = MtuDiscoveryConfig::default();
    mtu.upper_bound(config.link.mtu);
    let mut acks = AckFrequencyConfig::default();
    acks.max_ack_delay(Some(ACK_DELAY)).ack_eliciting_threshold(VarInt::from_u32(ACK_THRESHOLD));
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(STREAMS_BEFORE_HELLO))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE_TIMEOUT_MS))))
        .keep_alive_interval(Some(Duration::from_secs(4)))
        .stream_receive_window(VarInt::from_u64(window).unwrap_or(VarInt::MAX))
        .receive_window(VarInt::from_u32(LINK_WINDOW))
        .send_window(SEND_WINDOW)
        .ack_frequency_config(Some(acks))
        .initial_mtu(1200)
        .mtu_discovery_config(Some(mtu));
    if is_private {
        transport.initial_rtt(PRIVATE_RTT);
    }
    match config.link.congestion {
        Congestion::Auto if !is_private => control(&mut transport, CubicConfig::default()),
        Congestion::Auto | Congestion::Delay => control(&mut transport, DelayConfig),
        Congestion::Cubic => control(&mut transport, CubicConfig::default()),
        Congestion::Bbr => control(&mut transport, BbrConfig::default()),
    }
    transport
}

/// Sets the congestion controller of a link.
fn control<F>(transport: &mut TransportConfig, factory: F)
where
    F: ControllerFactory + Send + Sync + 'static,
{
    transport.congestion_controller_factory(Arc::new(EcnCountingFactory(Arc::new(factory))));
}

#[cfg(test)]
mod tests {
    use super::is_private;

    #[test]
    fn a_robots_own_networks_are_private_and_loopback_is_not() {
        for address in
            ["10.1.2.3", "172.16.0.1", "192.168.7.7", "169.254.1.1", "fd00::1", "fe80::1"]
        {
            assert!(is_private(address.parse().unwrap()), "{address}");
        }
        for address in ["127.0.0.1", "::1", "8.8.8.8", "100.64.0.1", "2001:db8::1", "172.32.0.1"] {
            assert!(!is_private(address.parse().unwrap()), "{address}");
        }
        assert!(is_private("::ffff:192.168.1.1".parse().unwrap()));
    }
}
