//! A gateway that carries the frames of a CAN bus to another machine over datagrams.
//!
//! `cargo run -p axon-envelope --example can_gateway`
//!
//! There is no key manager here: a batch of random keys was loaded into both gateways in the
//! workshop, each with a name. The crate does not ask where keys come from, as long as they are
//! random, 32 bytes, and used for one direction.
//!
//! A key carries ten messages, so frames are gathered: one message takes as many as fit a datagram.
#![allow(clippy::print_stdout, reason = "an example shows what it does")]

use std::collections::VecDeque;
use std::error::Error;
use std::time::Instant;

use axon_envelope::{
    Channel, Delivery, KeyId, KeySource, Kind, KmeKey, OpenError, Opener, Retirement,
    RotatingSealer, Route, TopicHash,
};

/// Frames a message: 13 bytes each, so that the datagram stays under 1,200 bytes.
const FRAMES_PER_MESSAGE: usize = 64;

/// A frame of classic CAN.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Frame {
    id: u32,
    len: u8,
    data: [u8; 8],
}

impl Frame {
    const BYTES: usize = 13;

    fn write(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.id.to_be_bytes());
        out.push(self.len);
        out.extend_from_slice(&self.data);
    }

    fn read(bytes: &[u8; Self::BYTES]) -> Option<Self> {
        let [a, b, c, d, len, data @ ..] = *bytes;
        (len <= 8).then_some(Self { id: u32::from_be_bytes([a, b, c, d]), len, data })
    }
}

/// Both gateways name the bus alike, so that a message for one bus never lands on another.
fn route(bus: &str) -> Result<Route, Box<dyn Error>> {
    Ok(Route { kind: Kind::Topic, topic: TopicHash::new(0, bus, "can/classic")? })
}

/// The keys of the workshop, in the order of the batch.
struct Loaded(VecDeque<(KeyId, KmeKey)>);

impl KeySource for Loaded {
    fn next_key(&mut self) -> Option<(KeyId, KmeKey)> {
        // Taken out: a key is in use once, and the store must not hold it any longer. A real store
        // also erases it on the disk before it hands it over.
        self.0.pop_front()
    }

    fn retired(&mut self, retirement: Retirement) {
        // Where there is a reliable channel to the other end, it is told here, and calls
        // `Opener::retire`. Without one its keys end after ten messages, or by their age.
        println!("key {} has sealed {} messages", retirement.key_id, retirement.used.len());
    }
}

/// The sending gateway: frames in, datagrams out.
struct Uplink {
    sealer: RotatingSealer<Loaded>,
    route: Route,
    started: Instant,
    waiting: Vec<u8>,
}

impl Uplink {
    fn new(channel: Channel, keys: Loaded, bus: &str) -> Result<Self, Box<dyn Error>> {
        Ok(Self {
            sealer: RotatingSealer::new(channel, keys),
            route: route(bus)?,
            started: Instant::now(),
            waiting: Vec::new(),
        })
    }

    /// Takes a frame; gives a datagram once enough frames are together. A gateway would also call
    /// [`Uplink::flush`] on a timer.
    fn frame(&mut self, frame: &Frame) -> Result<Option<Vec<u8>>, Box<dyn Error>> {
        frame.write(&mut self.waiting);
        if self.waiting.len() < FRAMES_PER_MESSAGE * Frame::BYTES {
            return Ok(None);
        }
        self.flush().map(Some)
    }

    fn flush(&mut self) -> Result<Vec<u8>, Box<dyn Error>> {
        // `NoKey` when the batch is used up: frames then stay off the air rather than go unsealed.
        let slot = self.sealer.slot(self.started.elapsed(), Delivery::BestEffort)?;
        let mut datagram = vec![0; slot.overhead() + self.waiting.len()];
        slot.seal_into(self.route, &[&self.waiting], &mut datagram)?;
        self.waiting.clear();
        Ok(datagram)
    }
}

/// The receiving gateway: datagrams in, frames out.
struct Downlink {
    opener: Opener,
    route: Route,
    started: Instant,
}

impl Downlink {
    fn new(channel: Channel, keys: Loaded, bus: &str) -> Result<Self, Box<dyn Error>> {
        let mut opener = Opener::new(channel)?;
        for (key_id, key) in keys.0 {
            opener.add_key(key_id, key)?;
        }
        Ok(Self { opener, route: route(bus)?, started: Instant::now() })
    }

    fn datagram(&mut self, datagram: &mut [u8]) -> Result<Vec<Frame>, OpenError> {
        let now = self.started.elapsed();
        let frames = self.opener.open_in_place(now, self.route, datagram)?;
        let (frames, _) = frames.as_chunks();
        Ok(frames.iter().filter_map(Frame::read).collect())
    }
}

/// What the workshop did: the same keys, under the same names, into both gateways.
fn load(count: usize) -> Result<(Loaded, Loaded), Box<dyn Error>> {
    let (mut here, mut there) = (VecDeque::new(), VecDeque::new());
    for number in 0..count {
        let key_id = KeyId::new(format!("truck-7/{number:04}"))?;
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        here.push_back((key_id.clone(), KmeKey::from_slice(&bytes)?));
        there.push_back((key_id, KmeKey::take(&mut bytes)));
    }
    Ok((Loaded(here), Loaded(there)))
}

fn main() -> Result<(), Box<dyn Error>> {
    let (tractor_keys, trailer_keys) = load(3)?;

    // Each gateway draws 16 random bytes when it starts and sends them to the other in the clear.
    // Together they are the context: what was recorded before a restart does not open after it.
    // An attacker who changes them on the way achieves that nothing opens.
    let mut context = [0; 32];
    getrandom::fill(&mut context)?;
    let channel = Channel::new("tractor", "trailer", context)?;
    let mut uplink = Uplink::new(channel.clone(), tractor_keys, "can0")?;
    let mut downlink = Downlink::new(channel, trailer_keys, "can0")?;

    // A second of a busy bus, and a network that loses, repeats and alters datagrams.
    let (mut datagrams, mut arrived, mut refused) = (0, 0, 0);
    for number in 0..FRAMES_PER_MESSAGE as u32 * 25 {
        let mut data = [0; 8];
        data[..4].copy_from_slice(&number.to_be_bytes());
        let Some(datagram) = uplink.frame(&Frame { id: 0x18f0_0400, len: 8, data })? else {
            continue;
        };
        datagrams += 1;
        let mut delivered = match datagrams {
            4 => vec![],
            8 => vec![datagram.clone(), datagram],
            12 => {
                let mut altered = datagram.clone();
                altered[200] ^= 1;
                vec![altered, datagram]
            }
            _ => vec![datagram],
        };
        for datagram in &mut delivered {
            match downlink.datagram(datagram) {
                Ok(frames) => arrived += frames.len(),
                // The cause is for this log. The sender hears nothing of it.
                Err(error) => {
                    refused += 1;
                    println!("datagram {datagrams}: {error} ({:?})", error.cause());
                }
            }
        }
    }
    println!("{datagrams} datagrams sealed, {arrived} frames on the other bus, {refused} refused");
    assert_eq!((datagrams, arrived, refused), (25, 24 * FRAMES_PER_MESSAGE, 2));

    // The batch has 30 messages. The 31st is not sealed, under no key and by no other means.
    let frame = Frame { id: 1, len: 0, data: [0; 8] };
    frame.write(&mut uplink.waiting);
    for _ in 25..30 {
        uplink.flush()?;
    }
    println!("and then: {}", uplink.flush().expect_err("a fourth key"));
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn it_runs() {
        super::main().unwrap();
    }
}
