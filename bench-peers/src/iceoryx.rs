//! iceoryx2: publish-subscribe for the bytes, and an event service to wake a receiver that sleeps.

use std::{cell::OnceCell, process};

use iceoryx2::{
    port::{
        backpressure_strategy::BackpressureStrategy, listener::Listener, notifier::Notifier,
        publisher::Publisher, subscriber::Subscriber,
    },
    prelude::*,
};

use crate::harness::{self, Channel, End, Load, Medium, Motion, Side, Wake, agree, stamp};

type Bytes = [u8];

/// iceoryx2 between processes.
#[derive(Default)]
pub(crate) struct Iceoryx2 {
    node: OnceCell<Node<ipc::Service>>,
}

impl Medium for Iceoryx2 {
    fn name(&self) -> &'static str {
        "iceoryx2"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> harness::Result<Box<dyn End>> {
        let node = match self.node.get() {
            Some(node) => node,
            None => {
                set_log_level(LogLevel::Error);
                let node = NodeBuilder::new().create::<ipc::Service>()?;
                self.node.get_or_init(|| node)
            }
        };
        // The measuring process names one pair of services. All loads use it one after the other, because the services
        // of the last load are gone with its ends.
        let id: u32 = match side {
            Side::Near => {
                channel.tell(&process::id())?;
                process::id()
            }
            Side::Far => channel.hear()?,
        };
        let [out, into] = match side {
            Side::Near => ["there", "back"],
            Side::Far => ["back", "there"],
        };
        let samples = |way: &str| {
            let name = ServiceName::new(&format!("bench-peers/{id}/{}/{way}", load.size))?;
            let service = node
                .service_builder(&name)
                .publish_subscribe::<Bytes>()
                .payload_alignment(Alignment::new(64).ok_or("no alignment")?)
                .subscriber_max_buffer_size(load.window.max(2))
                .history_size(0)
                .max_publishers(1)
                .max_subscribers(1)
                .open_or_create()?;
            Ok::<_, harness::Error>(service)
        };
        let events = |way: &str| {
            let name = ServiceName::new(&format!("bench-peers/{id}/{}/{way}", load.size))?;
            Ok::<_, harness::Error>(node.service_builder(&name).event().open_or_create()?)
        };
        let publisher = samples(out)?
            .publisher_builder()
            .initial_max_slice_len(load.size)
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
            .create()?;
        let subscriber = samples(into)?.subscriber_builder().create()?;
        let bell = match load.wake {
            Wake::Poll => None,
            Wake::Event | Wake::EventOneCpu => Some((
                events(out)?.notifier_builder().create()?,
                events(into)?.listener_builder().create()?,
            )),
        };
        // Both have all of theirs before either sends.
        channel.tell(&())?;
        channel.hear::<()>()?;
        Ok(Box::new(IceoryxEnd {
            publisher,
            subscriber,
            bell,
            load: *load,
            bytes: vec![0x5a; load.size],
        }))
    }
}

struct IceoryxEnd {
    publisher: Publisher<ipc::Service, Bytes, ()>,
    subscriber: Subscriber<ipc::Service, Bytes, ()>,
    bell: Option<(Notifier<ipc::Service>, Listener<ipc::Service>)>,
    load: Load,
    bytes: Vec<u8>,
}

impl End for IceoryxEnd {
    fn send(&mut self, number: u64) -> harness::Result<()> {
        let mut sample = self.publisher.loan_slice_uninit(self.load.size)?;
        let sample = match self.load.motion {
            Motion::Touch => {
                let bytes = sample.payload_mut();
                let end = bytes.len() - 8;
                for (at, byte) in number.to_ne_bytes().into_iter().enumerate() {
                    bytes[at].write(byte);
                    bytes[end + at].write(byte);
                }
                // SAFETY: the system or an earlier sample has initialised the memory of the bytes in between. The ends
                // contain everything that a merely touched message has to carry.
                unsafe { sample.assume_init() }
            }
            Motion::Fill | Motion::Copy => {
                stamp(&mut self.bytes, number);
                sample.write_from_slice(&self.bytes)
            }
        };
        sample.send()?;
        if let Some((notifier, _)) = &self.bell {
            notifier.notify()?;
        }
        Ok(())
    }

    fn receive(&mut self) -> harness::Result<u64> {
        loop {
            if let Some(sample) = self.subscriber.receive()? {
                let bytes = match self.load.motion {
                    Motion::Touch | Motion::Fill => sample.payload(),
                    Motion::Copy => {
                        self.bytes.copy_from_slice(sample.payload());
                        &self.bytes
                    }
                };
                let [first, last] = [bytes.first_chunk(), bytes.last_chunk()];
                return agree(*first.ok_or("too short")?, *last.ok_or("too short")?);
            }
            if let Some((_, listener)) = &self.bell {
                listener.blocking_wait(|_| {})?;
            }
        }
    }
}
