//! The nonces of envelopes, as somebody who recorded the packets of a connection can read them.

use std::collections::BTreeMap;

use axon_envelope::Header;
use axon_tls::Cipher;

use super::{Connection, packets::Opens};
use crate::wire::Wire;

/// The nonces that were read so far.
#[derive(Default)]
pub(crate) struct Nonces {
    /// By the key_ID: what the nonces of the key begin with.
    prefixes: BTreeMap<String, [u8; 8]>,
    /// How many datagrams of the wire were read.
    read: usize,
    /// Of each end of each connection: what opens its packets before and after key updates, and the number that is expected
    /// next. QUIC updates the keys of a connection early on, after a random number of packets.
    ends: Vec<([Opens; 3], u64)>,
    /// How many connections these are of.
    connections: usize,
}

impl Nonces {
    /// Reads what the wire has seen since the last time. Envelopes whose headers are in two packets are not read: their
    /// keys have others. `connections` are as many as the last time, or more.
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

    /// What the nonces of this key begin with, if envelopes under it were read.
    pub(crate) fn prefix(&self, key_id: &str) -> Option<[u8; 8]> {
        self.prefixes.get(key_id).copied()
    }
}
