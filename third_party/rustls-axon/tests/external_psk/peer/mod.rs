//! A TLS 1.3 peer that knows the PSK and keeps to no rule.
//!
//! It writes and reads bytes: records, messages and the key schedule of RFC 8446 are made here,
//! from HMAC and an AEAD, and share no code with what they are aimed at. It speaks
//! TLS_CHACHA20_POLY1305_SHA256 alone.

mod hello;
mod record;
mod schedule;

pub(crate) use hello::{ext, list16, list8, server_hello, ClientHello, Offer};
pub(crate) use record::{message, plaintext, records, Protection, APPLICATION_DATA, HANDSHAKE};
pub(crate) use schedule::{derive, digest, finished, resumption_psk, Early, Secret};

/// Which end this peer plays.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    Client,
    Server,
}

/// Bytes that depend on how far the peer got.
pub(crate) type Made<'a> = &'a dyn Fn(&Peer) -> Vec<u8>;

/// A connection past the two hellos.
pub(crate) struct Peer {
    pub(crate) transcript: Vec<u8>,
    handshake: schedule::Handshake,
    role: Role,
    application: Option<schedule::Application>,
    pub(crate) write: Protection,
    pub(crate) read: Protection,
}

impl Peer {
    /// `transcript` is every handshake message up to the ServerHello.
    pub(crate) fn new(
        role: Role,
        psk: Option<&[u8]>,
        shared_secret: Option<&[u8]>,
        transcript: Vec<u8>,
    ) -> Self {
        let handshake = Early::new(psk).handshake(shared_secret, &digest(&transcript));
        let (ours, theirs) = match role {
            Role::Client => (&handshake.client, &handshake.server),
            Role::Server => (&handshake.server, &handshake.client),
        };
        let (write, read) = (Protection::new(ours), Protection::new(theirs));
        Self { transcript, handshake, role, application: None, write, read }
    }

    /// Answers the ClientHello in `flight` with a ServerHello: the start of every hostile server.
    ///
    /// Gives what to send.
    pub(crate) fn answer(
        flight: &[u8],
        psk: &[u8],
        shared_secret: Option<&[u8]>,
        extensions: &[(u16, Vec<u8>)],
    ) -> (Self, Vec<u8>) {
        let client_hello = plaintext(flight);
        let hello = server_hello(&client_hello, 0x1303, [7; 32], extensions);
        let sent = records(HANDSHAKE, &hello);
        let transcript = [client_hello, hello].concat();
        (Self::new(Role::Server, Some(psk), shared_secret, transcript), sent)
    }

    /// A message that the transcript takes in, as it is: what QUIC protects by itself.
    pub(crate) fn add(&mut self, kind: u8, body: &[u8]) -> Vec<u8> {
        let message = message(kind, body);
        self.transcript.extend(&message);
        message
    }

    /// The same under the keys of the moment, in a record.
    pub(crate) fn say(&mut self, kind: u8, body: &[u8]) -> Vec<u8> {
        let message = self.add(kind, body);
        self.write.seal(HANDSHAKE, &message)
    }

    /// What this end's Finished has to say by now.
    pub(crate) fn verify_data(&self) -> Secret {
        self.verify_data_of(self.role)
    }

    /// What an end's Finished would have to say by now.
    pub(crate) fn verify_data_of(&self, role: Role) -> Secret {
        let base = match role {
            Role::Client => &self.handshake.client,
            Role::Server => &self.handshake.server,
        };
        finished(base, &digest(&self.transcript))
    }

    /// The right Finished.
    pub(crate) fn finish(&mut self) -> Vec<u8> {
        let sent = self.say(20, &self.verify_data());
        self.finished_was_said(self.role);
        sent
    }

    /// EncryptedExtensions and Finished, as an honest server sends them.
    pub(crate) fn finish_flight(&mut self) -> Vec<u8> {
        let mut flight = self.say(8, &[0, 0]);
        flight.extend(self.finish());
        flight
    }

    /// Reads the other end's flight up to its Finished, which must be right.
    ///
    /// Gives the messages in front of it.
    pub(crate) fn expect_finished(&mut self, flight: &[u8]) -> Vec<u8> {
        let other = match self.role {
            Role::Client => Role::Server,
            Role::Server => Role::Client,
        };
        let messages: Vec<u8> = self
            .read
            .open_all(flight)
            .into_iter()
            .inspect(|(kind, _)| assert_eq!(*kind, HANDSHAKE))
            .flat_map(|(_, content)| content)
            .collect();
        let (before, finished) = messages.split_at(messages.len() - 36);
        self.transcript.extend(before);
        assert_eq!(finished, message(20, &self.verify_data_of(other)));
        self.transcript.extend(finished);
        self.finished_was_said(other);
        before.to_vec()
    }

    /// The keys change: for both directions at the server's Finished, but a client's own still
    /// protect its Finished.
    fn finished_was_said(&mut self, by: Role) {
        if by == Role::Server {
            self.application = Some(self.handshake.application(&digest(&self.transcript)));
        }
        let application = self.application.as_ref().expect("the server's Finished is first");
        let traffic = match by {
            Role::Client => &application.client,
            Role::Server => &application.server,
        };
        match by == self.role {
            true => self.write = Protection::new(traffic),
            false => self.read = Protection::new(traffic),
        }
    }

    /// `resumption_master_secret`, after both Finished.
    pub(crate) fn resumption_master(&self) -> Secret {
        let application = self.application.as_ref().expect("after the handshake");
        derive(&application.master, "res master", &digest(&self.transcript))
    }

    /// The alert that ends `flight`: records in the clear first, then under the other's keys.
    pub(crate) fn alert_in(&mut self, flight: &[u8]) -> Option<u8> {
        match self.read.open_all(flight).last() {
            Some((21, alert)) => Some(alert[1]),
            _ => None,
        }
    }
}
