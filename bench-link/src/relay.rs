//! Carries IP packets between the devices of two hosts, over one [`Path`] for each direction.

use std::{
    io,
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{self, Receiver, Sender},
    },
    thread,
    time::Instant,
};

use rand::{SeedableRng, rngs::StdRng};
use tun::Device;

use crate::path::{Counters, Path, Settings};

/// The longest IP packet.
const LONGEST: usize = 65_535;

/// A packet, and when it is at the other end.
type Due = (Instant, Vec<u8>);

/// Both directions. Its threads end with the process: the devices cannot be waited for otherwise.
pub(crate) struct Relay {
    directions: [Arc<Mutex<Path>>; 2],
}

impl Relay {
    /// Carries packets from now on. `seed` decides which are lost.
    pub(crate) fn start(devices: [Arc<Device>; 2], settings: Settings, seed: u64) -> Self {
        let directions = [0, 1].map(|from| {
            let random = StdRng::seed_from_u64(seed.wrapping_mul(2) + from as u64);
            let path = Arc::new(Mutex::new(Path::new(settings, random, Instant::now())));
            let (sender, receiver) = mpsc::channel();
            let (near, far) = (Arc::clone(&devices[from]), Arc::clone(&devices[1 - from]));
            let of_reader = Arc::clone(&path);
            thread::spawn(move || take(&near, &of_reader, &sender));
            thread::spawn(move || deliver(&far, &receiver));
            path
        });
        Self { directions }
    }

    /// Changes both directions.
    pub(crate) fn set(&self, change: impl Fn(&mut Settings)) {
        for direction in &self.directions {
            change(&mut direction.lock().unwrap_or_else(PoisonError::into_inner).settings);
        }
    }

    /// What it does to packets now.
    pub(crate) fn settings(&self) -> Settings {
        self.directions[0].lock().unwrap_or_else(PoisonError::into_inner).settings
    }

    /// What became of the packets from the first host to the second so far.
    pub(crate) fn counters(&self) -> Counters {
        self.counters_both_ways()[0]
    }

    /// The same from each host to the other one.
    pub(crate) fn counters_both_ways(&self) -> [Counters; 2] {
        self.directions
            .each_ref()
            .map(|direction| direction.lock().unwrap_or_else(PoisonError::into_inner).counters)
    }
}

fn take(device: &Device, path: &Mutex<Path>, sender: &Sender<Due>) {
    let mut bytes = vec![0; LONGEST];
    loop {
        let length = match device.recv(&mut bytes) {
            Ok(length) => length,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => return,
        };
        let mut path = path.lock().unwrap_or_else(PoisonError::into_inner);
        let at = path.handle_packet(Instant::now(), length);
        drop(path);
        if let Some(at) = at
            && sender.send((at, bytes[..length].to_vec())).is_err()
        {
            return;
        }
    }
}

fn deliver(device: &Device, receiver: &Receiver<Due>) {
    while let Ok((at, packet)) = receiver.recv() {
        thread::sleep(at.saturating_duration_since(Instant::now()));
        // A device whose queue is full drops it, as a host does.
        let _ = device.send(&packet);
    }
}
