//! Keys of copies over a connection that stands by.

use std::collections::HashSet;

use axon_envelope::{Delivery, KeyId, OpenError};

use super::{Pair, ROUTE, exporters, id, ms};
use crate::keys::{KeyMessage, NoKey};

/// The number of the connection that stands by, in every test.
const STANDBY: u64 = 77;

impl Pair {
    /// Returns a pair whose messages and copies have keys.
    fn with_copies() -> Self {
        let mut pair = Self::new();
        pair.stand_by(STANDBY);
        pair.seal_copy().unwrap_err();
        pair.run();
        pair
    }

    /// Attaches a connection that stands by.
    fn stand_by(&mut self, conn: u64) {
        self.receiver.attach(self.now, conn, &exporters(conn)).unwrap();
        self.sender.attach_standby(self.now, conn, &exporters(conn)).unwrap();
        self.standby = Some(conn);
    }

    /// Puts the connection that stands by in use. Returns the messages owed on the one before.
    fn take_over(&mut self) -> Vec<(u64, KeyMessage)> {
        let conn = self.standby.take().expect("a connection stands by");
        let owed = self.sender.attach(self.now, conn, &exporters(conn)).unwrap();
        self.receiver.elect(conn);
        self.conn = conn;
        owed
    }

    fn seal_copy(&mut self) -> Result<Vec<u8>, NoKey> {
        self.sender.demand_copies(self.now, 1);
        let mut out = vec![0; 400];
        let slot = self.sender.copy_slot(self.now, self.standby.unwrap_or(STANDBY))?;
        let len = slot.seal_into(ROUTE, &[b"hello"], &mut out).unwrap();
        out.truncate(len);
        Ok(out)
    }

    fn open_on(&mut self, conn: u64, mut envelope: Vec<u8>) -> Result<(), OpenError> {
        let opener = self.receiver.opener(conn).expect("attached");
        opener.open_in_place(self.now, ROUTE, &mut envelope).map(|text| assert_eq!(text, b"hello"))
    }

    /// Returns the keys that were announced since a position in the log.
    fn announced_since(&self, position: usize) -> Vec<KeyId> {
        let ids = |message: &KeyMessage| match message {
            KeyMessage::Announce(key_ids) => key_ids.clone(),
            _ => Vec::new(),
        };
        self.log[position..].iter().flat_map(ids).collect()
    }
}

#[test]
fn copies_draw_no_key_before_the_first_one_and_open_on_their_connection_alone() {
    let mut pair = Pair::new();
    pair.run();
    let drawn = pair.kmes.issued;
    pair.stand_by(STANDBY);
    pair.run();
    assert_eq!(pair.kmes.issued, drawn, "no copies were sent");
    assert_eq!(pair.seal_copy(), Err(NoKey::None), "the first copy has no key");
    pair.run();
    assert!(pair.kmes.issued > drawn);
    let copy = pair.seal_copy().unwrap();
    assert!(pair.open(copy.clone()).is_err(), "a copy opens on no other connection");
    pair.open_on(STANDBY, copy.clone()).unwrap();
    assert!(pair.open_on(STANDBY, copy).is_err(), "a copy opens once");
    let message = pair.seal(Delivery::Reliable).unwrap();
    assert!(pair.open_on(STANDBY, message.clone()).is_err());
    pair.open(message).unwrap();
}

#[test]
fn no_key_seals_on_two_connections_or_more_than_ten_times() {
    let mut pair = Pair::with_copies();
    for round in 0..200 {
        pair.now += ms(10);
        let (message, copy) = (pair.seal(Delivery::Reliable), pair.seal_copy());
        pair.sender.demand(pair.now, 1);
        pair.run();
        if let Ok(message) = message {
            pair.open_on(pair.conn, message).unwrap_or_else(|e| panic!("{round}: {e}"));
        }
        if let Ok(copy) = copy {
            pair.open_on(STANDBY, copy).unwrap_or_else(|e| panic!("{round}: {e}"));
        }
    }
    let statistics = pair.sender.statistics(pair.now);
    let announced = pair.announced_since(0);
    let ids: HashSet<_> = announced.iter().collect();
    assert_eq!(ids.len(), announced.len(), "each key was announced on one connection");
    assert!(statistics.sealed >= 360 && statistics.retired >= 36, "{statistics:?}");
}

#[test]
fn connection_that_takes_over_keeps_its_keys_and_needs_no_announcement() {
    let mut pair = Pair::with_copies();
    let copy = pair.seal_copy().unwrap();
    pair.seal(Delivery::Reliable).unwrap();
    let owed = pair.take_over();
    let retired = |(conn, message): &(u64, KeyMessage)| {
        *conn == 1 && matches!(message, KeyMessage::Retire { used, .. } if used.len() == 1)
    };
    assert!(owed.len() == 1 && owed.iter().all(retired), "{owed:?}");
    // Before anything else happens, a message leaves under a key of the copies.
    let message = pair.seal(Delivery::Reliable).unwrap();
    pair.open_on(STANDBY, message).unwrap();
    pair.open_on(STANDBY, copy).unwrap();
    assert_eq!(pair.seal_copy(), Err(NoKey::Detached), "nothing stands by");
    pair.run();
    // The unused keys of the connection before serve this one.
    for _ in 0..60 {
        let message = pair.seal(Delivery::Reliable).unwrap();
        pair.open_on(STANDBY, message).unwrap();
        pair.run();
    }
    assert_eq!(pair.failures(), 0);
}

#[test]
fn unused_keys_of_a_connection_that_stood_by_serve_the_one_in_use() {
    let mut pair = Pair::with_copies();
    pair.seal_copy().unwrap();
    let (drawn, before) = (pair.kmes.issued, pair.log.len());
    pair.standby = None;
    pair.close(STANDBY);
    pair.run();
    let again = pair.announced_since(before);
    assert!(!again.is_empty(), "its unused keys are announced on the connection in use");
    for _ in 0..20 {
        let message = pair.seal(Delivery::Reliable).unwrap();
        pair.open(message).unwrap();
    }
    pair.run();
    assert!(pair.kmes.issued <= drawn + 2, "{} of {drawn} drawn keys", pair.kmes.issued);
    assert_eq!((pair.failures(), pair.sender.statistics(pair.now).failed), (0, 0));
}

#[test]
fn keys_that_may_have_been_announced_before_are_not_announced_for_copies() {
    let mut pair = Pair::new();
    // The keys of a connection that stood by leave more than the messages need.
    pair.stand_by(STANDBY - 1);
    pair.seal_copy().unwrap_err();
    pair.run();
    pair.close(STANDBY - 1);
    pair.run();
    let first: HashSet<KeyId> = pair.announced_since(0).into_iter().collect();
    assert_eq!(first.len(), 8);
    pair.connect();
    pair.stand_by(STANDBY);
    pair.seal_copy().unwrap_err();
    for round in 0..20 {
        pair.now += ms(100);
        while let Some((conn, message)) = pair.sender.poll_message(pair.now) {
            if let (STANDBY, KeyMessage::Announce(key_ids)) = (conn, &message) {
                assert!(key_ids.iter().all(|id| !first.contains(id)), "round {round}: {key_ids:?}");
            }
            pair.receiver.handle_message(pair.now, conn, &message).unwrap();
        }
        pair.run();
        let _ = pair.seal_copy();
    }
    assert!(pair.seal_copy().is_ok(), "copies get new keys");
}

/// The copies of one topic hold few keys, while other topics send much.
#[test]
fn keys_of_copies_leave_a_low_stock_to_the_messages() {
    let mut pair = Pair::new();
    pair.kmes.stock = 100;
    pair.stand_by(STANDBY);
    let _ = pair.seal_copy();
    pair.run();
    pair.kmes.stock = 12;
    let mut refused = 0;
    for round in 0..2000 {
        pair.now += ms(10);
        if round % 100 == 0 {
            let _ = pair.seal_copy();
        }
        pair.sender.demand(pair.now, 1);
        refused += usize::from(pair.seal(Delivery::Reliable).is_err());
        pair.run();
    }
    assert!(refused <= 20, "{refused} of 2,000 messages had no key");
}

#[test]
fn unused_keys_of_copies_serve_the_messages_once_the_kme_gives_none() {
    let mut pair = Pair::with_copies();
    let keys = pair.sender.statistics(pair.now).ready;
    assert_eq!(keys, 8, "four for messages, four for copies");
    pair.kmes.left = Some(0);
    let mut sealed = 0;
    for _ in 0..400 {
        pair.now += ms(10);
        pair.sender.demand(pair.now, 1);
        if let Ok(message) = pair.seal(Delivery::Reliable) {
            pair.open(message).unwrap();
            sealed += 1;
        }
        pair.run();
    }
    assert_eq!(sealed, 80);
    assert_eq!(pair.failures(), 0);
}

#[test]
fn keys_of_copies_on_a_silent_path_are_not_lost() {
    let mut pair = Pair::new();
    pair.run();
    pair.stand_by(STANDBY);
    // Nothing that is sent over the second connection arrives.
    pair.standby = None;
    for _ in 0..30 {
        pair.now += ms(500);
        let _ = pair.seal_copy();
        pair.run();
    }
    for _ in 0..14 {
        pair.now += ms(5_000);
        pair.run();
    }
    let statistics = pair.sender.statistics(pair.now);
    assert_eq!(statistics.failed, 0, "{statistics:?}");
    assert_eq!(pair.failures(), 0);
}

#[test]
fn key_that_moves_to_another_connection_and_back_is_readied_again() {
    let mut pair = Pair::with_copies();
    // Its keys move to the connection in use, whose path is cut: the announcement does not arrive.
    pair.now += ms(60_000);
    let moved = pair.sender.poll_message(pair.now);
    assert!(matches!(moved, Some((1, KeyMessage::Announce(_)))), "{moved:?}");
    pair.take_over();
    pair.run();
    assert_eq!(pair.failures(), 0);
    let message = pair.seal(Delivery::Reliable).unwrap();
    pair.open_on(STANDBY, message).unwrap();
}

/// The peer announces and retires keys that do not exist, again and again.
#[test]
fn announced_and_retired_keys_count_until_their_fetch_ends() {
    let mut pair = Pair::new();
    let mut fetched = 0;
    for round in 0..1000 {
        let ids: Vec<KeyId> = (0..16).map(|n| id(&format!("made-up-{round}-{n}"))).collect();
        let announce = KeyMessage::Announce(ids.clone());
        pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
        for key_id in ids {
            let (used, reliable) = Default::default();
            let retire = KeyMessage::Retire { key_id, used, reliable };
            pair.receiver.handle_message(pair.now, 1, &retire).unwrap();
        }
        fetched = pair.receiver.statistics().fetching;
    }
    assert_eq!(fetched, 4096, "further keys are refused");
}

#[test]
fn copies_starve_before_messages_do() {
    let mut pair = Pair::new();
    pair.run();
    pair.stand_by(STANDBY);
    // The KME has few keys: the messages use them up before a copy gets one.
    pair.kmes.left = Some(3);
    let mut sealed = 0;
    for _ in 0..100 {
        pair.now += ms(10);
        pair.sender.demand(pair.now, 1);
        let _ = pair.seal_copy();
        sealed += usize::from(pair.seal(Delivery::Reliable).is_ok());
        pair.run();
    }
    assert!(sealed >= 60, "{sealed} messages, and at most seven keys");
}

#[test]
fn keys_of_copies_that_are_no_longer_sent_do_not_count_for_messages() {
    let mut pair = Pair::new();
    pair.stand_by(STANDBY);
    for _ in 0..400 {
        pair.now += ms(1);
        let _ = pair.seal_copy();
        pair.run();
    }
    pair.now += ms(20_000);
    pair.run();
    for _ in 0..200 {
        pair.now += ms(2);
        pair.sender.demand(pair.now, 1);
        pair.seal(Delivery::Reliable).expect("keys come though those of the copies are unused");
        pair.run();
    }
}

#[test]
fn connection_that_ends_while_another_stands_by_leaves_that_one_its_keys() {
    let mut pair = Pair::with_copies();
    pair.close(1);
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::Detached));
    let copy = pair.seal_copy().unwrap();
    pair.open_on(STANDBY, copy).unwrap();
    assert!(pair.take_over().is_empty());
    let message = pair.seal(Delivery::Reliable).unwrap();
    pair.open_on(STANDBY, message).unwrap();
}

#[test]
fn second_connection_that_stands_by_replaces_the_first() {
    let mut pair = Pair::with_copies();
    pair.stand_by(STANDBY + 1);
    assert_eq!(pair.sender.copy_slot(pair.now, STANDBY).err(), Some(NoKey::Detached));
    // Another READY of the first one concerns no key.
    pair.now += ms(1000);
    let _ = pair.seal_copy();
    pair.run();
    let copy = pair.seal_copy().unwrap();
    pair.open_on(STANDBY + 1, copy).unwrap();
}
