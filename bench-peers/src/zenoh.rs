//! zenoh: peers over a unix socket, which carries the positions of messages in shared memory.

use std::{cell::OnceCell, env, process, thread, time::Duration};

use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    handlers::{FifoChannel, FifoChannelHandler},
    pubsub::{Publisher, Subscriber},
    qos::CongestionControl,
    sample::Sample,
    shm::{BlockOn, GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder},
};

use crate::harness::{self, Channel, End, Error, Load, Medium, Motion, Side, Wake, agree, stamp};

/// Below this many bytes zenoh does not use shared memory by itself, and is faster without.
const SHARED_FROM: usize = 3072;
/// Number of additional messages for which there is memory, beside those in flight: zenoh finds freed memory only when
/// there is no other.
const SPARE: usize = 6;

/// zenoh between two peers.
#[derive(Default)]
pub(crate) struct Zenoh {
    session: OnceCell<Session>,
}

impl Zenoh {
    fn session(&self, side: Side, channel: &Channel) -> harness::Result<&Session> {
        if let Some(session) = self.session.get() {
            return Ok(session);
        }
        let id: u32 = match side {
            Side::Near => process::id(),
            Side::Far => channel.hear()?,
        };
        let path = env::temp_dir().join(format!("bench-peers-{id}"));
        let endpoint = format!("[\"unixsock-stream/{}\"]", path.display());
        let ours = match side {
            Side::Near => "listen/endpoints",
            Side::Far => "connect/endpoints",
        };
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", "\"peer\""),
            ("scouting/multicast/enabled", "false"),
            ("listen/endpoints", "[]"),
            ("transport/shared_memory/mode", "\"init\""),
            (ours, endpoint.as_str()),
        ] {
            config.insert_json5(key, value).map_err(Error::from)?;
        }
        let session = zenoh::open(config).wait().map_err(Error::from)?;
        if side == Side::Near {
            channel.tell(&process::id())?;
        }
        Ok(self.session.get_or_init(|| session))
    }
}

impl Medium for Zenoh {
    fn name(&self) -> &'static str {
        "zenoh"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> harness::Result<Box<dyn End>> {
        let session = self.session(side, channel)?;
        let [out, into] = match side {
            Side::Near => ["there", "back"],
            Side::Far => ["back", "there"],
        };
        let key = |way: &str| format!("bench-peers/{}/{way}", load.size);
        let subscriber = session
            .declare_subscriber(key(into))
            .with(FifoChannel::new(load.window.max(2)))
            .wait()
            .map_err(Error::from)?;
        let publisher = session
            .declare_publisher(key(out))
            .congestion_control(CongestionControl::Block)
            // A single message is sent at once, because it waits for no other one. A stream profits from batches.
            .express(!load.is_stream())
            .wait()
            .map_err(Error::from)?;
        while !publisher.matching_status().wait().map_err(Error::from)?.matching() {
            thread::sleep(Duration::from_millis(1));
        }
        let provider = if load.size < SHARED_FROM {
            None
        } else {
            let bytes = (load.window + SPARE) * load.size.next_multiple_of(4096);
            Some(ShmProviderBuilder::default_backend(bytes).wait().map_err(Error::from)?)
        };
        channel.tell(&())?;
        channel.hear::<()>()?;
        Ok(Box::new(ZenohEnd {
            publisher,
            subscriber,
            provider,
            load: *load,
            bytes: vec![0x5a; load.size],
        }))
    }
}

struct ZenohEnd {
    publisher: Publisher<'static>,
    subscriber: Subscriber<FifoChannelHandler<Sample>>,
    provider: Option<ShmProvider<PosixShmProviderBackend>>,
    load: Load,
    bytes: Vec<u8>,
}

impl End for ZenohEnd {
    fn send(&mut self, number: u64) -> harness::Result<()> {
        let payload = match &self.provider {
            None => {
                stamp(&mut self.bytes, number);
                ZBytes::from(&self.bytes)
            }
            Some(provider) => {
                let loan = provider.alloc(self.load.size);
                let mut loan = loan
                    .with_policy::<BlockOn<GarbageCollect>>()
                    .wait()
                    .map_err(|error| format!("no memory: {error:?}"))?;
                if self.load.motion == Motion::Touch {
                    stamp(&mut loan, number);
                } else {
                    stamp(&mut self.bytes, number);
                    loan.copy_from_slice(&self.bytes);
                }
                ZBytes::from(loan)
            }
        };
        self.publisher.put(payload).wait().map_err(Error::from)
    }

    fn receive(&mut self) -> harness::Result<u64> {
        let sample = match self.load.wake {
            Wake::Event | Wake::EventOneCpu => self.subscriber.recv().map_err(Error::from)?,
            Wake::Poll => loop {
                if let Some(sample) = self.subscriber.try_recv().map_err(Error::from)? {
                    break sample;
                }
                // zenoh's own threads need a CPU to receive on.
                thread::yield_now();
            },
        };
        let payload = sample.payload().to_bytes();
        let bytes = if self.load.motion == Motion::Copy {
            self.bytes.copy_from_slice(&payload);
            &self.bytes[..]
        } else {
            &payload
        };
        let [first, last] = [bytes.first_chunk(), bytes.last_chunk()];
        agree(*first.ok_or("too short")?, *last.ok_or("too short")?)
    }
}
