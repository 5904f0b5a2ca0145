//! The control stream: whole, bounded messages over quinn's byte streams.

use std::sync::{
    Arc, OnceLock,
    atomic::{AtomicUsize, Ordering},
};

use axon_transport::graph::Endpoint;
use quinn::{Connection, RecvStream, SendStream};
use tokio::sync::mpsc;

use super::{
    account::{Account, Charge, Meter, Unpacked, cost, cost_of_frame},
    establish::close,
};
use crate::link::{
    CloseCode, FrameError, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED, Message, is_known,
    read_length, unpacked_length,
};

/// Why no further message came.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum ControlError {
    /// The peer sent what is not of the protocol.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The connection or the stream ended.
    #[error("the control stream ended: {0}")]
    Ended(String),
}

impl ControlError {
    /// The code to close with, when it is this side that closes.
    pub(crate) fn code(&self) -> Option<CloseCode> {
        match self {
            Self::Frame(FrameError::TooLarge { .. }) => Some(CloseCode::TooLarge),
            Self::Frame(_) => Some(CloseCode::Malformed),
            Self::Ended(_) => None,
        }
    }
}

/// Reads messages.
#[derive(Debug)]
pub(super) struct ControlReader {
    stream: RecvStream,
    limit: usize,
    inflated: usize,
}

impl ControlReader {
    pub(super) fn new(stream: RecvStream) -> Self {
        Self { stream, limit: MAX_FRAME_BEFORE_HELLO, inflated: MAX_FRAME_BEFORE_HELLO }
    }

    /// Both HELLOs were checked: larger frames are allowed from now on.
    pub(super) fn hello_checked(&mut self) {
        self.limit = MAX_FRAME;
    }

    /// The peer is who it says. Until then nothing is paced, so nothing long is decompressed.
    pub(super) fn proven(&mut self) {
        self.inflated = MAX_INFLATED;
    }

    /// The next message of a known type. Not cancel safe: a cancelled read loses its place.
    pub(super) async fn next(&mut self) -> Result<Message, ControlError> {
        loop {
            let length = self.length().await?;
            let frame = self.frame(length).await?;
            if let Some(message) = Message::from_frame(&frame, self.inflated)? {
                return Ok(message);
            }
        }
    }

    /// As [`next`](Self::next), once the peer's account has room for the frame, and then for what
    /// becomes of it: until the message is handled, and what comes with it here is dropped. `pace` waits
    /// for as long as this costs: before a frame is decompressed, also one that is passed over, and for
    /// what its message costs beyond that.
    pub(super) async fn next_within<P: Future<Output = ()>>(
        &mut self,
        account: &Account,
        pace: impl Fn(u32) -> P,
    ) -> Result<(Message, Unpacked), ControlError> {
        loop {
            let length = self.length().await?;
            let reading = account.reading(length).await;
            let frame = self.frame(length).await?;
            let paid = cost_of_frame(&frame);
            pace(paid).await;
            if !is_known(&frame) {
                continue;
            }
            // What is too long for anybody is refused before it waits.
            let unpacked = account.unpacked(unpacked_length(&frame).min(self.inflated)).await;
            let message = Message::from_frame(&frame, self.inflated)?;
            drop((frame, reading));
            if let Some(message) = message {
                match cost(&message).saturating_sub(paid) {
                    0 => {}
                    more => pace(more).await,
                }
                return Ok((message, unpacked));
            }
        }
    }

    async fn length(&mut self) -> Result<usize, ControlError> {
        let mut prefix = [0; 4];
        self.stream.read_exact(&mut prefix).await.map_err(ended)?;
        Ok(read_length(prefix, self.limit)?)
    }

    async fn frame(&mut self, length: usize) -> Result<Vec<u8>, ControlError> {
        let mut frame = vec![0; length];
        self.stream.read_exact(&mut frame).await.map_err(ended)?;
        Ok(frame)
    }
}

fn ended(error: quinn::ReadExactError) -> ControlError {
    ControlError::Ended(error.to_string())
}

/// Bytes that may wait for a peer that does not read, by [`weight`].
const MAX_QUEUED: usize = 64 << 20;

/// Where control messages wait to be written. Cheap to clone.
#[derive(Clone, Debug)]
pub(super) struct Outbox {
    messages: mpsc::UnboundedSender<Option<(Message, Option<Charge>)>>,
    queued: Arc<AtomicUsize>,
    /// What the peer's identity may leave unread, over all of its links, once that is known.
    identity: Arc<OnceLock<Arc<Meter>>>,
    connection: Connection,
}

impl Outbox {
    /// Writes what is sent until the connection ends, or the last outbox, or one is told to.
    pub(super) fn spawn(connection: Connection, mut writer: ControlWriter) -> Self {
        let (messages, mut receiver) = mpsc::unbounded_channel();
        let (queued, identity) = (Arc::new(AtomicUsize::new(0)), Arc::default());
        let outbox = Self {
            messages,
            queued: Arc::clone(&queued),
            identity,
            connection: connection.clone(),
        };
        tokio::spawn(async move {
            // The charge is held until its message is written.
            while let Some(Some((message, _charge))) = receiver.recv().await {
                let result = writer.send(&message).await;
                // Relaxed here and in `send`: a bound, not a hand-over.
                queued.fetch_sub(weight(&message), Ordering::Relaxed);
                if let Err(error) = result {
                    if let Some(code) = error.code() {
                        tracing::error!(%error, "a control message could not be sent");
                        close(&connection, code, &error.to_string());
                    }
                    return;
                }
            }
        });
        outbox
    }

    /// From now on what waits counts for this identity's links together, too.
    pub(super) fn charge_to(&self, identity: Arc<Meter>) {
        // An error: it is known already, and an outbox has one peer.
        let _ = self.identity.set(identity);
    }

    /// Queues a message; one that comes too late is lost with the link. Closes the link when the
    /// peer does not read what it is sent.
    pub(super) fn send(&self, message: Message) {
        let weight = weight(&message);
        let charge = self.identity.get().map(|identity| identity.charge(weight));
        let is_full = matches!(charge, Some(None));
        if self.queued.fetch_add(weight, Ordering::Relaxed) > MAX_QUEUED || is_full {
            return close(&self.connection, CloseCode::TooLarge, "control messages are not read");
        }
        let _ = self.messages.send(Some((message, charge.flatten())));
    }

    /// Ends the control stream behind what was queued. What others queue now is lost.
    pub(super) fn end(&self) {
        let _ = self.messages.send(None);
    }
}

/// Bytes that a message counts for in the queue.
fn weight(message: &Message) -> usize {
    size_of::<Message>()
        + match message {
            Message::Graph(graph) => {
                let added: usize = graph.added.iter().map(Endpoint::bytes).sum();
                let ranges = [&graph.localhost, &graph.listing].into_iter().flatten();
                let ranges: usize = ranges.map(|gids| size_of_val(&**gids)).sum();
                added + ranges + size_of_val(&*graph.removed)
            }
            Message::Subscribe(subscribe) => subscribe.bytes(),
            Message::RouteReady(ready) => size_of_val(&*ready.publishers),
            Message::Asserted(asserted) => size_of_val(&*asserted.publishers),
            Message::Received(received) => size_of_val(&*received.flows),
            Message::RouteRefused(refused) => refused.reason.len(),
            Message::Owners(owners) => size_of_val(&*owners.proofs),
            _ => 0,
        }
}

/// Writes messages.
#[derive(Debug)]
pub(super) struct ControlWriter {
    stream: SendStream,
}

impl ControlWriter {
    pub(super) fn new(stream: SendStream) -> Self {
        // Above every data stream: the graph and keys go on while a bulk topic fills the link.
        let _ = stream.set_priority(i32::MAX);
        Self { stream }
    }

    pub(super) async fn send(&mut self, message: &Message) -> Result<(), ControlError> {
        let frame = message.to_frame()?;
        self.stream.write_all(&frame).await.map_err(|e| ControlError::Ended(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        gateway::{
            account::Accounts,
            played::{Pair, block_on},
        },
        link::{RouteReady, RouteRefused},
    };
    use axon_shm::ids::Gid;

    const LENGTH: usize = 64 << 10;

    fn long() -> Message {
        let reason = "r".repeat(LENGTH);
        Message::RouteRefused(RouteRefused { route: 1, reason, retry_s: None })
    }

    async fn outbox(pair: &Pair, identity: &Arc<Meter>) -> Outbox {
        let (stream, _) = pair.here.open_bi().await.unwrap();
        let outbox = Outbox::spawn(pair.here.clone(), ControlWriter::new(stream));
        outbox.charge_to(Arc::clone(identity));
        outbox
    }

    #[test]
    fn each_frame_is_paced_before_it_is_decompressed_also_one_that_is_skipped() {
        block_on(async {
            let pair = Pair::new().await;
            let (mut send, _) = pair.here.open_bi().await.unwrap();
            let frame = |kind: u8, unpacked: u32, body: &[u8]| {
                let frame = [&[kind][..], &unpacked.to_be_bytes(), body].concat();
                [&(frame.len() as u32).to_be_bytes()[..], &frame].concat()
            };
            // Of unknown type, a GRAPH that is no zstd frame, and messages of few and many elements.
            let gids = |count| vec![Gid::default(); count];
            let ready =
                |count| Message::RouteReady(RouteReady { route: 1, publishers: gids(count) });
            send.write_all(&frame(0xff, 4 << 20, &[0x5a; 9_000])).await.unwrap();
            send.write_all(&ready(1).to_frame().unwrap()).await.unwrap();
            send.write_all(&ready(65_536).to_frame().unwrap()).await.unwrap();
            send.write_all(&frame(0x83, 4 << 20, b"no zstd frame")).await.unwrap();
            let (_, receive) = pair.there.accept_bi().await.unwrap();
            let mut reader = ControlReader::new(receive);
            reader.hello_checked();
            reader.proven();
            let account = Accounts::new(0).of("a");
            let paced = std::cell::RefCell::new(Vec::new());
            let pace = |cost| {
                paced.borrow_mut().push(cost);
                std::future::ready(())
            };
            for count in [1, 65_536] {
                let (message, _) = reader.next_within(&account, pace).await.unwrap();
                assert_eq!(message, ready(count));
            }
            assert_eq!(paced.borrow()[..2], [3, 1]);
            assert_eq!(paced.borrow()[2..].iter().sum::<u32>(), 2049);
            assert_eq!(paced.borrow().len(), 4, "{paced:?}");
            assert!(reader.next_within(&account, pace).await.is_err());
            assert_eq!(paced.borrow()[4..], [1025]);
        });
    }

    #[test]
    fn nothing_long_is_decompressed_for_a_peer_that_proved_nothing() {
        block_on(async {
            let pair = Pair::new().await;
            let (mut send, _) = pair.here.open_bi().await.unwrap();
            let publishers = vec![Gid::default(); 1000];
            let ready = Message::RouteReady(RouteReady { route: 1, publishers });
            for _ in 0..2 {
                send.write_all(&ready.to_frame().unwrap()).await.unwrap();
            }
            let (_, receive) = pair.there.accept_bi().await.unwrap();
            let mut reader = ControlReader::new(receive);
            reader.hello_checked();
            assert!(reader.next().await.is_err());
            reader.proven();
            assert_eq!(reader.next().await.unwrap(), ready);
        });
    }

    #[test]
    fn what_an_identity_leaves_unread_is_bounded_over_its_links_and_given_back() {
        block_on(async {
            // None of them reads.
            let pairs = [Pair::new().await, Pair::new().await];
            let identity = Meter::new(4 << 20);
            let [one, other] =
                [outbox(&pairs[0], &identity).await, outbox(&pairs[1], &identity).await];
            for _ in 0..(4 << 20) / LENGTH / 2 {
                one.send(long());
            }
            assert!(pairs[0].here.close_reason().is_none(), "it is within the bound");
            for _ in 0..(4 << 20) / LENGTH {
                other.send(long());
            }
            assert!(pairs[1].here.close_reason().is_some());
            assert!(pairs[0].here.close_reason().is_none(), "the other link stands");
            assert!(identity.held() <= identity.most());
            drop((one, other));
            pairs[0].here.close(0_u32.into(), b"");
            while identity.held() > 0 {
                tokio::task::yield_now().await;
            }
        });
    }
}
