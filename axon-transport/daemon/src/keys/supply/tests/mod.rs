//! Tests a [`KeySender`] and a [`KeyReceiver`] with two KMEs between them, and a clock that only the test moves.

mod any_order;
mod drawing;
mod receiving;
mod sending;
mod standby;

use std::{collections::HashMap, time::Duration};

use axon_envelope::{Delivery, IndexMask, KeyId, Kind, KmeKey, OpenError, Route, TopicHash};

use super::{KeyReceiver, KeySender, NoKey};
use crate::keys::{
    Exporters, KeyMessage,
    request::{Answer, FailureKind, Fetched, KmeRequest, RequestFailure, Stock},
};

const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

/// Returns the exporters of connection `conn`, which are the same at both ends.
fn exporters(conn: u64) -> Exporters {
    Exporters::new([conn as u8; 32], [!conn as u8; 32])
}

/// Two KMEs with one store between them. A key is given to the slave once, as most KMEs do.
#[derive(Default)]
struct Kmes {
    issued: u32,
    stored: HashMap<KeyId, [u8; 32]>,
    stock: u64,
    /// The number of keys left to give; `None`: any number.
    left: Option<u32>,
    /// The failures of the next calls, the last one first.
    failures: Vec<FailureKind>,
}

impl Kmes {
    fn answer(&mut self, request: KmeRequest) -> Answer {
        let failure = |kind| Err(RequestFailure::new(kind, format!("{kind:?}")));
        let outcome = match (&request, self.failures.pop()) {
            (_, Some(kind)) => failure(kind),
            (KmeRequest::Status { .. }, _) => {
                Ok(Fetched::Stock(Stock { stored_key_count: self.stock, max_key_per_request: 128 }))
            }
            (KmeRequest::Enc { number, .. }, _) => {
                if self.left.is_some_and(|left| left < *number) {
                    failure(FailureKind::Unavailable)
                } else {
                    self.left = self.left.map(|left| left - number);
                    Ok(Fetched::Keys((0..*number).map(|_| self.issue()).collect()))
                }
            }
            (KmeRequest::Dec { key_ids, .. }, _) => {
                if key_ids.iter().all(|id| self.stored.contains_key(id)) {
                    let take = |id: &KeyId| {
                        let bytes = self.stored.remove(id).unwrap();
                        (id.clone(), KmeKey::from_slice(&bytes).unwrap())
                    };
                    Ok(Fetched::Keys(key_ids.iter().map(take).collect()))
                } else {
                    failure(FailureKind::Refused)
                }
            }
        };
        Answer { request, took: ms(10), outcome }
    }

    fn issue(&mut self) -> (KeyId, KmeKey) {
        self.issued += 1;
        let mut bytes = [0; 32];
        bytes[..4].copy_from_slice(&self.issued.to_be_bytes());
        let key_id = id(&format!("key-{}", self.issued));
        self.stored.insert(key_id.clone(), bytes);
        (key_id, KmeKey::take(&mut bytes))
    }
}

struct Pair {
    now: Duration,
    kmes: Kmes,
    sender: KeySender,
    receiver: KeyReceiver,
    conn: u64,
    /// The connection that stands by.
    standby: Option<u64>,
    /// The messages in both directions.
    log: Vec<KeyMessage>,
}

impl Pair {
    /// Answers the requests of the receiver to its KME.
    fn fetch(&mut self) {
        while let Some(request) = self.receiver.poll_request(self.now) {
            let answer = self.kmes.answer(request);
            self.receiver.handle_answer(self.now, answer);
        }
    }

    fn new() -> Self {
        let mut pair = Self {
            now: ms(0),
            kmes: Kmes::default(),
            // Every pause has its full length.
            sender: KeySender::with_jitter("sae-a", "sae-b", || 255).unwrap(),
            receiver: KeyReceiver::new("sae-b", "sae-a").unwrap(),
            conn: 0,
            standby: None,
            log: Vec::new(),
        };
        pair.connect();
        pair
    }

    /// Attaches the next connection; the one before stays open until it is [closed](Self::close).
    fn connect(&mut self) {
        self.conn += 1;
        let owed = self.sender.attach(self.now, self.conn, &exporters(self.conn)).unwrap();
        self.receiver.attach(self.now, self.conn, &exporters(self.conn)).unwrap();
        self.receiver.elect(self.conn);
        for (conn, message) in owed {
            assert_eq!(conn, self.conn - 1, "owed where it was announced");
            self.receiver.handle_message(self.now, conn, &message).unwrap();
            self.log.push(message);
        }
    }

    fn close(&mut self, conn: u64) {
        self.sender.detach(self.now, conn);
        self.receiver.detach(self.now, conn);
    }

    /// Answers the sender's calls until it makes no more.
    fn draw(&mut self) {
        while let Some(request) = self.sender.poll_request(self.now) {
            let answer = self.kmes.answer(request);
            self.sender.handle_answer(self.now, answer);
        }
    }

    /// Performs everything that can happen at this time.
    fn run(&mut self) {
        loop {
            if let Some(request) = self.sender.poll_request(self.now) {
                if let KmeRequest::Enc { number, .. } = request {
                    assert!(number <= 8, "a lost call loses at most eight keys");
                }
                let answer = self.kmes.answer(request);
                self.sender.handle_answer(self.now, answer);
            } else if let Some(request) = self.receiver.poll_request(self.now) {
                let answer = self.kmes.answer(request);
                self.receiver.handle_answer(self.now, answer);
            } else if let Some((conn, message)) = self.sender.poll_message(self.now) {
                if conn == self.conn || Some(conn) == self.standby {
                    self.receiver.handle_message(self.now, conn, &message).unwrap();
                }
                self.log.push(message);
            } else if let Some((conn, message)) = self.receiver.poll_message() {
                self.sender.handle_message(self.now, conn, &message).unwrap();
                self.log.push(message);
            } else {
                return;
            }
        }
    }

    fn seal(&mut self, delivery: Delivery) -> Result<Vec<u8>, NoKey> {
        let mut out = vec![0; 5 + self.sender.overhead()];
        let slot = self.sender.slot(self.now, delivery)?;
        let len = slot.seal_into(ROUTE, &[b"hello"], &mut out).unwrap();
        out.truncate(len);
        Ok(out)
    }

    fn open(&mut self, mut envelope: Vec<u8>) -> Result<(), OpenError> {
        let opener = self.receiver.opener(self.conn).expect("attached");
        opener.open_in_place(self.now, ROUTE, &mut envelope).map(|text| assert_eq!(text, b"hello"))
    }

    fn announced(&self) -> usize {
        let count = |m: &KeyMessage| match m {
            KeyMessage::Announce(key_ids) => key_ids.len(),
            _ => 0,
        };
        self.log.iter().map(count).sum()
    }

    fn failures(&self) -> usize {
        self.log.iter().filter(|m| matches!(m, KeyMessage::Failed { .. })).count()
    }
}

fn retire(key_id: &str, used: u16, reliable: u16) -> KeyMessage {
    let mask = |bits| IndexMask::from_bits(bits).unwrap();
    KeyMessage::Retire { key_id: id(key_id), used: mask(used), reliable: mask(reliable) }
}
