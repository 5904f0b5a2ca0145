//! A simulated wire between two hosts: forwards datagrams, records them, and can be cut.

use std::{
    net::{SocketAddr, UdpSocket},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU8, Ordering},
    },
    thread,
    time::Duration,
};

/// Datagrams that are remembered.
const MOST: usize = 1000;
/// Datagrams of handshakes that are remembered.
const MOST_OF_HANDSHAKES: usize = 10_000;
/// Other datagrams that are remembered, if they are.
const MOST_OF_DATA: usize = 200_000;

const ALL: u8 = 0;
const NOTHING: u8 = 1;
const NEWCOMERS: u8 = 2;
const LOSSY: u8 = 3;
/// Values of ECN in the TOS byte: a packet that may be marked, and one that is.
const ECN_CAPABLE: u8 = 2;
const CONGESTION_EXPERIENCED: u8 = 3;
/// A lossy wire drops one datagram in this many.
const ONE_IN: u64 = 8;

/// Returns whether the datagram of this number, with this first byte, gets through.
fn pass(passes: &AtomicU8, first: u8, number: u64) -> bool {
    match passes.load(Ordering::Relaxed) {
        ALL => true,
        NOTHING => false,
        LOSSY => !number.is_multiple_of(ONE_IN),
        // A long header: a handshake.
        _ if first & 0x80 != 0 => {
            passes.store(ALL, Ordering::Relaxed);
            true
        }
        // Discovery, and no short header.
        _ => first & 0xc0 == 0,
    }
}

/// The recorded datagrams of both ends.
#[derive(Clone, Default)]
struct Notes {
    handshakes: Arc<Mutex<Vec<Vec<u8>>>>,
    data: Arc<Mutex<Vec<Vec<u8>>>>,
    of_data: Arc<AtomicBool>,
}

impl Notes {
    fn note(&self, datagram: &[u8]) {
        // A long header, which discovery's messages have not.
        let is_handshake = datagram.first().is_some_and(|first| first & 0x80 != 0);
        let (notes, most) = match is_handshake {
            true => (&self.handshakes, MOST_OF_HANDSHAKES),
            false => (&self.data, MOST_OF_DATA),
        };
        // Relaxed: the flag orders nothing else.
        if is_handshake || self.of_data.load(Ordering::Relaxed) {
            let mut notes = notes.lock().unwrap();
            if notes.len() < most {
                notes.push(datagram.to_vec());
            }
        }
    }
}

/// Passes datagrams on between one client and one server.
pub(crate) struct Wire {
    /// The address at which the client finds the server.
    pub(crate) address: SocketAddr,
    /// The socket that sends to the server.
    pub(crate) towards: Arc<UdpSocket>,
    /// The datagrams of the client.
    pub(crate) said: Arc<Mutex<Vec<Vec<u8>>>>,
    /// The datagrams of both that begin with a packet of a handshake.
    pub(crate) handshakes: Arc<Mutex<Vec<Vec<u8>>>>,
    /// The other ones, from when they are [remembered](Self::remember_data) on.
    pub(crate) data: Arc<Mutex<Vec<Vec<u8>>>>,
    notes: Notes,
    passes: Arc<AtomicU8>,
    over: Arc<AtomicBool>,
}

impl Wire {
    /// Starts a wire to `server` that begins at `near` and sends from an address `far`.
    pub(crate) fn between(near: SocketAddr, far: SocketAddr, server: SocketAddr) -> Self {
        let [near, towards] = [near, far].map(|address| {
            let socket = UdpSocket::bind(address).unwrap();
            socket.set_read_timeout(Some(Duration::from_millis(10))).unwrap();
            rustix::net::sockopt::set_ip_tos(&socket, ECN_CAPABLE).unwrap();
            Arc::new(socket)
        });
        let notes = Notes::default();
        let wire = Self {
            address: near.local_addr().unwrap(),
            towards: Arc::clone(&towards),
            said: Arc::default(),
            handshakes: notes.handshakes.clone(),
            data: notes.data.clone(),
            notes,
            passes: Arc::default(),
            over: Arc::default(),
        };
        let client = Arc::new(Mutex::new(None));
        let (from, over, said) = (client.clone(), wire.over.clone(), wire.said.clone());
        let [of_client, of_server] = [0, 1].map(|_| wire.notes.clone());
        let (back, out, passes) =
            (Arc::clone(&near), Arc::clone(&towards), Arc::clone(&wire.passes));
        thread::spawn(move || {
            let (mut bytes, mut number) = ([0; 65_536], 0);
            while !over.load(Ordering::Relaxed) {
                let Ok((length, address)) = near.recv_from(&mut bytes) else { continue };
                *from.lock().unwrap() = Some(address);
                number += 1;
                if !pass(&passes, bytes[0], number) {
                    continue;
                }
                let mut said = said.lock().unwrap();
                if said.len() < MOST {
                    said.push(bytes[..length].to_vec());
                }
                drop(said);
                of_client.note(&bytes[..length]);
                let _ = out.send_to(&bytes[..length], server);
            }
        });
        let (over, passes) = (Arc::clone(&wire.over), Arc::clone(&wire.passes));
        thread::spawn(move || {
            let (mut bytes, mut number) = ([0; 65_536], 0);
            while !over.load(Ordering::Relaxed) {
                let Ok((length, _)) = towards.recv_from(&mut bytes) else { continue };
                number += 1;
                of_server.note(&bytes[..length]);
                if let Some(address) = *client.lock().unwrap()
                    && pass(&passes, bytes[0], number)
                {
                    let _ = back.send_to(&bytes[..length], address);
                }
            }
        });
        wire
    }

    /// Records from now on also datagrams that are not of a handshake.
    pub(crate) fn remember_data(&self) {
        self.notes.of_data.store(true, Ordering::Relaxed);
    }

    /// Drops all datagrams from now on.
    pub(crate) fn cut(&self) {
        self.passes.store(NOTHING, Ordering::Relaxed);
    }

    /// Drops some datagrams from now on.
    pub(crate) fn lose(&self) {
        self.passes.store(LOSSY, Ordering::Relaxed);
    }

    /// Marks the client's packets as a congested router does.
    pub(crate) fn mark(&self) {
        rustix::net::sockopt::set_ip_tos(&self.towards, CONGESTION_EXPERIENCED).unwrap();
    }

    /// Lets all datagrams through again.
    pub(crate) fn mend(&self) {
        self.passes.store(ALL, Ordering::Relaxed);
    }

    /// Lets discovery and new connections through again. Connections from before the cut stay silent until there is a
    /// new one, as QUIC is in its longest pause.
    pub(crate) fn mend_for_newcomers(&self) {
        self.passes.store(NEWCOMERS, Ordering::Relaxed);
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}
