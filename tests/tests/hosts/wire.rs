//! What lies between two hosts: passes datagrams on, remembers them, and can be cut.

use std::{
    net::{SocketAddr, UdpSocket},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

/// Datagrams that are remembered.
const MOST: usize = 1000;

/// Passes datagrams on between one client and one server.
pub(crate) struct Wire {
    /// Where the client finds the server.
    pub(crate) address: SocketAddr,
    /// What speaks to the server.
    pub(crate) towards: Arc<UdpSocket>,
    /// What the client said.
    pub(crate) said: Arc<Mutex<Vec<Vec<u8>>>>,
    cut: Arc<AtomicBool>,
    over: Arc<AtomicBool>,
}

impl Wire {
    /// A wire to `server` that begins at `near` and comes out of an address `far`.
    pub(crate) fn between(near: SocketAddr, far: SocketAddr, server: SocketAddr) -> Self {
        let [near, towards] = [near, far].map(|address| {
            let socket = UdpSocket::bind(address).unwrap();
            socket.set_read_timeout(Some(Duration::from_millis(10))).unwrap();
            Arc::new(socket)
        });
        let wire = Self {
            address: near.local_addr().unwrap(),
            towards: Arc::clone(&towards),
            said: Arc::default(),
            cut: Arc::default(),
            over: Arc::default(),
        };
        let client = Arc::new(Mutex::new(None));
        let (from, over, said) = (client.clone(), wire.over.clone(), wire.said.clone());
        let (back, out, cut) = (Arc::clone(&near), Arc::clone(&towards), Arc::clone(&wire.cut));
        thread::spawn(move || {
            let mut bytes = [0; 65_536];
            while !over.load(Ordering::Relaxed) {
                let Ok((length, address)) = near.recv_from(&mut bytes) else { continue };
                *from.lock().unwrap() = Some(address);
                if cut.load(Ordering::Relaxed) {
                    continue;
                }
                let mut said = said.lock().unwrap();
                if said.len() < MOST {
                    said.push(bytes[..length].to_vec());
                }
                drop(said);
                let _ = out.send_to(&bytes[..length], server);
            }
        });
        let (over, cut) = (Arc::clone(&wire.over), Arc::clone(&wire.cut));
        thread::spawn(move || {
            let mut bytes = [0; 65_536];
            while !over.load(Ordering::Relaxed) {
                let Ok((length, _)) = towards.recv_from(&mut bytes) else { continue };
                if let (Some(address), false) =
                    (*client.lock().unwrap(), cut.load(Ordering::Relaxed))
                {
                    let _ = back.send_to(&bytes[..length], address);
                }
            }
        });
        wire
    }

    /// From now on nothing gets through, or all does again.
    pub(crate) fn cut(&self, cut: bool) {
        self.cut.store(cut, Ordering::Relaxed);
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}
