//! What ties keys to the one TLS connection they were announced on.

use zeroize::Zeroizing;

/// Label of the TLS exporter that READY proofs cover (docs/formats.md, section 2). Empty context,
/// 32 bytes.
pub const READY_EXPORTER: &[u8] = b"EXPORTER-axon-ready";

/// Label of the TLS exporter that is the envelope's context (docs/formats.md, section 3). Empty
/// context, 32 bytes.
pub const ENVELOPE_EXPORTER: &[u8] = b"EXPORTER-AXQKD001";

/// The two TLS exporters of one connection (RFC 8446, 7.5). Erased on drop.
pub struct Exporters {
    envelope: Zeroizing<[u8; 32]>,
    ready: Zeroizing<[u8; 32]>,
}

impl Exporters {
    /// From the exporters labelled [`ENVELOPE_EXPORTER`] and [`READY_EXPORTER`].
    pub fn new(envelope: [u8; 32], ready: [u8; 32]) -> Self {
        Self { envelope: Zeroizing::new(envelope), ready: Zeroizing::new(ready) }
    }

    /// Asks `export(out, label)` for both.
    ///
    /// # Errors
    /// The first error of `export`.
    pub fn derive<E>(mut export: impl FnMut(&mut [u8], &[u8]) -> Result<(), E>) -> Result<Self, E> {
        let mut exporters = Self::new([0; 32], [0; 32]);
        export(&mut exporters.envelope[..], ENVELOPE_EXPORTER)?;
        export(&mut exporters.ready[..], READY_EXPORTER)?;
        Ok(exporters)
    }

    pub(super) fn envelope(&self) -> &[u8; 32] {
        &self.envelope
    }

    pub(super) fn ready(&self) -> &[u8; 32] {
        &self.ready
    }
}
