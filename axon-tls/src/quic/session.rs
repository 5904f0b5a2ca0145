//! quinn's crypto traits on a rustls, which is the `tls` of the including module.

use std::any::Any;
use std::io::Cursor;
use std::sync::Arc;

use bytes::BytesMut;
use quinn_proto::crypto::{
    self, CryptoError, ExportKeyingMaterialError, KeyPair, Keys, UnsupportedVersion,
};
use quinn_proto::transport_parameters::TransportParameters;
use quinn_proto::{ConnectError, ConnectionId, Side, TransportError, TransportErrorCode};

use super::tls::crypto::aws_lc_rs::cipher_suite::TLS13_AES_128_GCM_SHA256;
use super::tls::pki_types::ServerName;
use super::tls::quic::{
    ClientConnection, Connection, DirectionalKeys, HeaderProtectionKey, KeyChange, Keys as TlsKeys,
    PacketKey, Secrets, ServerConnection, Suite, Version,
};
use super::tls::{self, ClientConfig, ServerConfig};
use crate::erase::{erasing_stack, erasing_stack_of_packet};
use crate::quic::protection;

/// The client side of quinn's configuration.
pub(in crate::quic) struct Client {
    tls: Arc<ClientConfig>,
}

impl Client {
    pub(in crate::quic) fn new(tls: ClientConfig) -> Self {
        Self { tls: Arc::new(tls) }
    }
}

impl crypto::ClientConfig for Client {
    fn start_session(
        self: Arc<Self>,
        version: u32,
        server_name: &str,
        params: &TransportParameters,
    ) -> Result<Box<dyn crypto::Session>, ConnectError> {
        let version = supported(version)?;
        let invalid_name = || ConnectError::InvalidServerName(server_name.into());
        let name = ServerName::try_from(server_name).map_err(|_| invalid_name())?.to_owned();
        // the ClientHello has a binder, which is computed with the pre-shared key
        erasing_stack(|| {
            let conn = ClientConnection::new(Arc::clone(&self.tls), version, name, encoded(params))
                .map_err(|_| ConnectError::EndpointStopping)?;
            Ok(Box::new(Session::new(Ok(conn.into()), Side::Client)) as Box<dyn crypto::Session>)
        })
    }
}

/// The server side of quinn's configuration.
pub(in crate::quic) struct Server {
    tls: Arc<ServerConfig>,
}

impl Server {
    pub(in crate::quic) fn new(tls: ServerConfig) -> Self {
        Self { tls: Arc::new(tls) }
    }
}

impl crypto::ServerConfig for Server {
    fn initial_keys(
        &self,
        version: u32,
        dst_cid: &ConnectionId,
    ) -> Result<Keys, UnsupportedVersion> {
        supported(version).map(|version| initial_keys(version, dst_cid, Side::Server))
    }

    fn retry_tag(&self, _version: u32, orig_dst_cid: &ConnectionId, packet: &[u8]) -> [u8; 16] {
        protection::retry_tag(orig_dst_cid, packet)
    }

    fn start_session(
        self: Arc<Self>,
        _version: u32,
        params: &TransportParameters,
    ) -> Box<dyn crypto::Session> {
        // quinn called `initial_keys()` with the version before, which accepts only this one
        let conn = ServerConnection::new(Arc::clone(&self.tls), VERSION, encoded(params));
        Box::new(Session::new(conn.map(Into::into), Side::Server))
    }
}

/// A TLS handshake inside a QUIC connection, and the resulting keys.
struct Session {
    side: Side,
    /// The connection, or the error with which TLS refused to begin. quinn can report that error only at the first
    /// read.
    conn: Result<Connection, tls::Error>,
    told_of_handshake_data: bool,
    /// A server's 1-RTT keys. TLS has them before the client has been authenticated.
    withheld: Option<Keys>,
    next_secrets: Option<Box<Secrets>>,
}

impl Session {
    fn new(conn: Result<Connection, tls::Error>, side: Side) -> Self {
        Self { side, conn, told_of_handshake_data: false, withheld: None, next_secrets: None }
    }
}

impl crypto::Session for Session {
    fn initial_keys(&self, dst_cid: &ConnectionId, side: Side) -> Keys {
        initial_keys(VERSION, dst_cid, side)
    }

    fn handshake_data(&self) -> Option<Box<dyn Any>> {
        let negotiated = super::negotiated(self.conn.as_ref().ok()?)?;
        Some(Box::new(negotiated))
    }

    fn peer_identity(&self) -> Option<Box<dyn Any>> {
        let certificates = self.conn.as_ref().ok()?.peer_certificates()?;
        Some(Box::new(certificates.to_vec()))
    }

    fn early_crypto(&self) -> Option<(Box<dyn crypto::HeaderKey>, Box<dyn crypto::PacketKey>)> {
        None
    }

    fn early_data_accepted(&self) -> Option<bool> {
        self.side.is_client().then_some(false)
    }

    fn is_handshaking(&self) -> bool {
        self.conn.as_ref().map_or(true, |conn| conn.is_handshaking())
    }

    fn read_handshake(&mut self, buf: &[u8]) -> Result<bool, TransportError> {
        let conn = self.conn.as_mut().map_err(|err| transport_error(None, err))?;
        erasing_stack(|| conn.read_hs(buf)).map_err(|err| transport_error(conn.alert(), &err))?;

        let first_time = !self.told_of_handshake_data && !conn.is_handshaking();
        self.told_of_handshake_data |= first_time;
        Ok(first_time)
    }

    fn transport_parameters(&self) -> Result<Option<TransportParameters>, TransportError> {
        let Some(encoded) =
            self.conn.as_ref().ok().and_then(|conn| conn.quic_transport_parameters())
        else {
            return Ok(None);
        };
        let params = TransportParameters::read(self.side, &mut Cursor::new(encoded))?;
        Ok(Some(params))
    }

    fn write_handshake(&mut self, buf: &mut Vec<u8>) -> Option<Keys> {
        let handshaking = self.is_handshaking();
        let conn = self.conn.as_mut().ok()?;
        match erasing_stack(|| change_of_keys(conn, buf)) {
            Some((keys, None)) => Some(keys),
            Some((keys, next)) => {
                self.next_secrets = next;
                if self.side.is_server() && handshaking {
                    self.withheld = Some(keys);
                    return None;
                }
                Some(keys)
            }
            None if handshaking => None,
            None => self.withheld.take(),
        }
    }

    fn next_1rtt_keys(&mut self) -> Option<KeyPair<Box<dyn crypto::PacketKey>>> {
        let next = self.next_secrets.as_mut()?;
        let keys = erasing_stack(|| next.next_packet_keys());
        Some(KeyPair {
            local: Box::new(PacketProtection(keys.local)),
            remote: Box::new(PacketProtection(keys.remote)),
        })
    }

    fn is_valid_retry(&self, orig_dst_cid: &ConnectionId, header: &[u8], payload: &[u8]) -> bool {
        protection::is_valid_retry(orig_dst_cid, header, payload)
    }

    fn export_keying_material(
        &self,
        output: &mut [u8],
        label: &[u8],
        context: &[u8],
    ) -> Result<(), ExportKeyingMaterialError> {
        let conn = self.conn.as_ref().map_err(|_| ExportKeyingMaterialError)?;
        erasing_stack(|| conn.export_keying_material(output, label, Some(context)).map(|_| ()))
            .map_err(|_| ExportKeyingMaterialError)
    }
}

/// Returns the next keys, if the handshake has reached them. For 1-RTT keys it also returns the secrets of later keys,
/// in a box, so that moves do not copy them.
fn change_of_keys(
    conn: &mut Connection,
    buf: &mut Vec<u8>,
) -> Option<(Keys, Option<Box<Secrets>>)> {
    match conn.write_hs(buf)? {
        KeyChange::Handshake { keys } => Some((quinn_keys(keys), None)),
        KeyChange::OneRtt { keys, next } => Some((quinn_keys(keys), Some(Box::new(next)))),
    }
}

/// The protection of packet payloads.
struct PacketProtection(Box<dyn PacketKey>);

impl crypto::PacketKey for PacketProtection {
    fn encrypt(&self, packet: u64, buf: &mut [u8], header_len: usize) {
        let (header, rest) = buf.split_at_mut(header_len);
        let (payload, tag_out) = rest.split_at_mut(rest.len() - self.0.tag_len());
        let tag = erasing_stack_of_packet(|| self.0.encrypt_in_place(packet, header, payload))
            .expect("a QUIC packet is within the limits of the AEAD");
        tag_out.copy_from_slice(tag.as_ref());
    }

    fn decrypt(
        &self,
        packet: u64,
        header: &[u8],
        payload: &mut BytesMut,
    ) -> Result<(), CryptoError> {
        let open = || self.0.decrypt_in_place(packet, header, payload).map(|plain| plain.len());
        let len = erasing_stack_of_packet(open).map_err(|_| CryptoError)?;
        payload.truncate(len);
        Ok(())
    }

    fn tag_len(&self) -> usize {
        self.0.tag_len()
    }

    fn confidentiality_limit(&self) -> u64 {
        self.0.confidentiality_limit()
    }

    fn integrity_limit(&self) -> u64 {
        self.0.integrity_limit()
    }
}

/// The protection of packet headers.
struct HeaderProtection(Box<dyn HeaderProtectionKey>);

impl HeaderProtection {
    /// Returns the sample, the first byte, and the four bytes that a packet number may occupy.
    fn parts<'a>(
        &self,
        pn_offset: usize,
        packet: &'a mut [u8],
    ) -> (&'a [u8], &'a mut u8, &'a mut [u8]) {
        let (header, sample) = packet.split_at_mut(pn_offset + 4);
        let (first, rest) = header.split_at_mut(1);
        (&sample[..self.0.sample_len()], &mut first[0], &mut rest[pn_offset - 1..])
    }
}

impl crypto::HeaderKey for HeaderProtection {
    fn decrypt(&self, pn_offset: usize, packet: &mut [u8]) {
        let (sample, first, packet_number) = self.parts(pn_offset, packet);
        erasing_stack_of_packet(|| self.0.decrypt_in_place(sample, first, packet_number))
            .expect("the sample has its length");
    }

    fn encrypt(&self, pn_offset: usize, packet: &mut [u8]) {
        let (sample, first, packet_number) = self.parts(pn_offset, packet);
        // only as many of these bytes change as the first byte gives for the packet number's length
        erasing_stack_of_packet(|| self.0.encrypt_in_place(sample, first, packet_number))
            .expect("the sample has its length");
    }

    fn sample_size(&self) -> usize {
        self.0.sample_len()
    }
}

const VERSION: Version = Version::V1;

/// Accepts QUIC version 1 (RFC 9000), and not the drafts that quinn also knows.
fn supported(version: u32) -> Result<Version, UnsupportedVersion> {
    if version == 1 { Ok(VERSION) } else { Err(UnsupportedVersion) }
}

/// Returns the keys of Initial packets. They are derived from a public connection ID (RFC 9001 section 5.2).
fn initial_keys(version: Version, dst_cid: &ConnectionId, side: Side) -> Keys {
    let suite: Suite = TLS13_AES_128_GCM_SHA256
        .tls13()
        .and_then(|suite| suite.quic_suite())
        .expect("the provider has AES-128-GCM for QUIC");
    let side = match side {
        Side::Client => tls::Side::Client,
        Side::Server => tls::Side::Server,
    };
    quinn_keys(suite.keys(dst_cid, side, version))
}

fn quinn_keys(keys: TlsKeys) -> Keys {
    fn split(keys: DirectionalKeys) -> (Box<dyn crypto::HeaderKey>, Box<dyn crypto::PacketKey>) {
        (Box::new(HeaderProtection(keys.header)), Box::new(PacketProtection(keys.packet)))
    }

    let (local_header, local_packet) = split(keys.local);
    let (remote_header, remote_packet) = split(keys.remote);
    Keys {
        header: KeyPair { local: local_header, remote: remote_header },
        packet: KeyPair { local: local_packet, remote: remote_packet },
    }
}

fn encoded(params: &TransportParameters) -> Vec<u8> {
    let mut encoded = Vec::new();
    params.write(&mut encoded);
    encoded
}

fn transport_error(alert: Option<tls::AlertDescription>, err: &tls::Error) -> TransportError {
    let code = match alert {
        Some(alert) => TransportErrorCode::crypto(alert.into()),
        None => TransportErrorCode::PROTOCOL_VIOLATION,
    };
    TransportError { code, frame: None, reason: err.to_string() }
}

#[cfg(test)]
#[path = "rfc9001.rs"]
mod rfc9001;
