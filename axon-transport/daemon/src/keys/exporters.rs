//! The TLS exporters of a connection, which bind keys to it.

use std::sync::Arc;

use zeroize::Zeroizing;

/// Label of the TLS exporter that READY proofs cover (docs/formats.md, section 2). Empty context,
/// 32 bytes.
pub const READY_EXPORTER: &[u8] = b"EXPORTER-axon-ready";

/// Label of the TLS exporter that is the envelope's context (docs/formats.md, section 3). Empty
/// context, 32 bytes.
pub const ENVELOPE_EXPORTER: &[u8] = b"EXPORTER-AXQKD001";

/// One exporter. It stays where it was written: a move of it by value would leave a copy behind.
pub(super) type Exporter = Arc<Zeroizing<[u8; 32]>>;

/// The two TLS exporters of one connection (RFC 8446, 7.5). Erased when the last owner lets go.
pub struct Exporters {
    envelope: Exporter,
    ready: Exporter,
}

impl Exporters {
    /// Makes exporters from the secrets labelled [`ENVELOPE_EXPORTER`] and [`READY_EXPORTER`].
    #[cfg(test)]
    pub(crate) fn new(envelope: [u8; 32], ready: [u8; 32]) -> Self {
        let exporter = |bytes| Arc::new(Zeroizing::new(bytes));
        Self { envelope: exporter(envelope), ready: exporter(ready) }
    }

    /// Asks `export(out, label)` for both.
    ///
    /// # Errors
    /// The first error of `export`.
    pub fn derive<E>(mut export: impl FnMut(&mut [u8], &[u8]) -> Result<(), E>) -> Result<Self, E> {
        let mut exporter = |label: &[u8]| {
            let mut exporter = Exporter::default();
            // No clone shares it yet, so `make_mut` copies nothing.
            export(&mut Arc::make_mut(&mut exporter)[..], label)?;
            Ok::<_, E>(exporter)
        };
        Ok(Self { envelope: exporter(ENVELOPE_EXPORTER)?, ready: exporter(READY_EXPORTER)? })
    }

    pub(super) fn envelope(&self) -> &[u8; 32] {
        &self.envelope
    }

    pub(super) fn ready(&self) -> &Exporter {
        &self.ready
    }
}

#[cfg(test)]
mod tests {
    use std::{convert::Infallible, hint::black_box, time::Duration};

    use super::*;
    use crate::{
        keys::{ClientProof, KeyReceiver, KeySender, ProofResponder},
        residue::left_on_the_stack,
    };

    /// Writes the exporter to `out`, and to no other place.
    fn export(out: &mut [u8], label: &[u8]) -> Result<(), Infallible> {
        for (at, byte) in out.iter_mut().enumerate() {
            *byte = black_box(at as u8).wrapping_mul(151) ^ label[9];
        }
        Ok(())
    }

    #[test]
    fn exporters_do_not_lie_on_the_stack() {
        let work = || {
            let Ok(exporters) = Exporters::derive(export);
            let now = Duration::ZERO;
            let mut sender = KeySender::new("sae-a", "sae-b").unwrap();
            sender.attach(now, 1, &exporters).unwrap();
            let mut receiver = KeyReceiver::new("sae-a", "sae-b").unwrap();
            receiver.attach(now, 1, &exporters).unwrap();
            receiver.elect(1);
            let proofs = (
                ClientProof::new(now, "sae-a", &exporters),
                ProofResponder::new("sae-b", &exporters),
            );
            Box::new((exporters, sender, receiver, proofs))
        };
        let left = left_on_the_stack(work, |_| {
            let mut secrets = vec![vec![0; 32]; 2];
            let Ok(()) = export(&mut secrets[0], READY_EXPORTER);
            let Ok(()) = export(&mut secrets[1], ENVELOPE_EXPORTER);
            secrets
        });
        assert_eq!(left, [0_usize; 0]);
    }
}
