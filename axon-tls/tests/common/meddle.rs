//! A server whose handshake somebody meddles with: what TLS reads and writes in CRYPTO frames, inside
//! of the packets' protection.
#![allow(dead_code, reason = "each file that includes this one uses its own part")]

use std::any::Any;
use std::sync::{Arc, Mutex};

use quinn_proto::crypto::{
    ExportKeyingMaterialError, HeaderKey, KeyPair, Keys, PacketKey, ServerConfig, Session,
    UnsupportedVersion,
};
use quinn_proto::transport_parameters::TransportParameters;
use quinn_proto::{ConnectionId, Side, TransportError};

/// A man in the middle, who changes data.
pub(crate) trait Meddler: Send + 'static {
    /// Changes what the client has written, before the server reads it.
    fn read(&mut self, _bytes: &mut Vec<u8>) {}

    /// Changes what the server has written, before the client gets it.
    fn written(&mut self, _bytes: &mut Vec<u8>) {}

    /// Keys for after a key update are made ready.
    fn next_keys(&mut self) {}
}

/// Puts `meddler` into the handshakes of `server`.
pub(crate) fn meddle<M: Meddler>(server: &mut quinn_proto::ServerConfig, meddler: Arc<Mutex<M>>) {
    let inner = Arc::clone(&server.crypto);
    server.crypto = Arc::new(Meddled { inner, meddler });
}

struct Meddled<T, M> {
    inner: T,
    meddler: Arc<Mutex<M>>,
}

impl<M: Meddler> ServerConfig for Meddled<Arc<dyn ServerConfig>, M> {
    fn initial_keys(
        &self,
        version: u32,
        dst_cid: &ConnectionId,
    ) -> Result<Keys, UnsupportedVersion> {
        self.inner.initial_keys(version, dst_cid)
    }

    fn retry_tag(&self, version: u32, orig_dst_cid: &ConnectionId, packet: &[u8]) -> [u8; 16] {
        self.inner.retry_tag(version, orig_dst_cid, packet)
    }

    fn start_session(
        self: Arc<Self>,
        version: u32,
        params: &TransportParameters,
    ) -> Box<dyn Session> {
        let inner = Arc::clone(&self.inner).start_session(version, params);
        Box::new(Meddled { inner, meddler: Arc::clone(&self.meddler) })
    }
}

impl<M: Meddler> Session for Meddled<Box<dyn Session>, M> {
    fn initial_keys(&self, dst_cid: &ConnectionId, side: Side) -> Keys {
        self.inner.initial_keys(dst_cid, side)
    }

    fn handshake_data(&self) -> Option<Box<dyn Any>> {
        self.inner.handshake_data()
    }

    fn peer_identity(&self) -> Option<Box<dyn Any>> {
        self.inner.peer_identity()
    }

    fn early_crypto(&self) -> Option<(Box<dyn HeaderKey>, Box<dyn PacketKey>)> {
        self.inner.early_crypto()
    }

    fn early_data_accepted(&self) -> Option<bool> {
        self.inner.early_data_accepted()
    }

    fn is_handshaking(&self) -> bool {
        self.inner.is_handshaking()
    }

    fn read_handshake(&mut self, buf: &[u8]) -> Result<bool, TransportError> {
        let mut bytes = buf.to_vec();
        self.meddler.lock().unwrap().read(&mut bytes);
        self.inner.read_handshake(&bytes)
    }

    fn transport_parameters(&self) -> Result<Option<TransportParameters>, TransportError> {
        self.inner.transport_parameters()
    }

    fn write_handshake(&mut self, buf: &mut Vec<u8>) -> Option<Keys> {
        let mut bytes = Vec::new();
        let keys = self.inner.write_handshake(&mut bytes);
        if !bytes.is_empty() {
            self.meddler.lock().unwrap().written(&mut bytes);
        }
        buf.extend_from_slice(&bytes);
        keys
    }

    fn next_1rtt_keys(&mut self) -> Option<KeyPair<Box<dyn PacketKey>>> {
        self.meddler.lock().unwrap().next_keys();
        self.inner.next_1rtt_keys()
    }

    fn is_valid_retry(&self, orig_dst_cid: &ConnectionId, header: &[u8], payload: &[u8]) -> bool {
        self.inner.is_valid_retry(orig_dst_cid, header, payload)
    }

    fn export_keying_material(
        &self,
        output: &mut [u8],
        label: &[u8],
        context: &[u8],
    ) -> Result<(), ExportKeyingMaterialError> {
        self.inner.export_keying_material(output, label, context)
    }
}
