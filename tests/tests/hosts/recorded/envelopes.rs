//! The nonces of envelopes, as an eavesdropper can read them from the recorded packets of a connection.

use std::collections::BTreeMap;

use axon_envelope::Header;
use axon_tls::Cipher;

use super::{Connection, packets::Opens};
use crate::wire::Wire;

/// The nonces that were read so far.
#[derive(Default)]
pub(crate) struct Nonces {
    /// The prefix of a key's nonces, by the key_ID.
    prefixes: BTreeMap<String, [u8; 8]>,
    /// Number of datagrams of the wire that were read.
    read: usize,
    /// For each end of each connection: the keys of its packets before and after key updates, and the next expected
    /// packet number. QUIC updates the keys of a connection early, after a random number of packets.
    ends: Vec<([Opens; 3], u64)>,
    /// Number of these connections.
    connections: usize,
}

impl Nonces {
    /// Reads the datagrams that the wire has recorded since the last time. Envelopes whose headers are in two packets
    /// are not read: other envelopes have the same keys. `connections` are as many as the last time, or more.
    pub(crate) fn read(&mut self, wire: &Wire, cipher: Cipher, connections: &[Connection]) {
        for connection in &connections[self.connections.min(connections.len())..] {
            let ends = connection.traffic.each_ref();
            self.ends.extend(ends.map(|secrets| {
                let first = &secrets[0];
                (secrets.each_ref().map(|later| Opens::updated(cipher, first, later)), 0)
            }));
        }
        self.connections = connections.len();
        let datagrams: Vec<_> = wire.data.lock().unwrap()[self.read..].to_vec();
        self.read += datagrams.len();
        for datagram in &datagrams {
            let frames = self.ends.iter_mut().find_map(|(opens, next)| {
                let mut opened = opens.iter().map(|opens| opens.open_short(datagram, *next));
                let (number, frames) = opened.find_map(|opened| opened)?;
                *next = (*next).max(number + 1);
                Some(frames)
            });
            let Some(frames) = frames else { continue };
            for at in 0..frames.len() {
                let Ok((header, _)) = Header::parse(&frames[at..]) else { continue };
                let key_id = String::from_utf8_lossy(header.key_id).into_owned();
                let prefix = header.nonce.first_chunk().expect("a nonce is longer");
                self.prefixes.insert(key_id, *prefix);
            }
        }
    }

    /// Returns the prefix of this key's nonces, if envelopes under the key were read.
    pub(crate) fn prefix(&self, key_id: &str) -> Option<[u8; 8]> {
        self.prefixes.get(key_id).copied()
    }
}
