//! Superseded links: kept open until what was sent over them has arrived.
//!
//! Nothing new goes over a link that has a successor. Each side ends its control stream there once the
//! other has acknowledged all that it sent, and closes the connection once both have: what was
//! acknowledged is read to its end even then (`docs/formats.md`, section 6). A reader that takes nothing
//! holds a superseded link open, as it holds its publisher back; but no link outlives the age of its key.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::DaemonId;
use tokio::sync::watch;

use super::{Hub, Link, Summary};
use crate::{
    gateway::{establish::close, keyring::Keyring, silence::Traffic, status::Who},
    link::{CloseCode, Elected, LinkClosed, Side},
};

/// A superseded link always has so long; and so long is a peer waited for that has nothing under way and
/// does not say so.
const HAND_OVER: Duration = Duration::from_secs(5);
/// Superseded links of one peer; the oldest is closed for one more.
const MAX_LEAVING: usize = 8;
const SUPERSEDED: &str = "a successor took over";

/// A superseded link, as long as its connection stands or what came over it is read.
pub(super) struct Leaving {
    connection: quinn::Connection,
    established: Summary,
    side: Side,
    /// Its name.
    elected: Option<Elected>,
    news: watch::Sender<News>,
}

/// What the hub hears that a superseded link waits for.
#[derive(Clone, Copy, Default)]
struct News {
    /// The peer, too, has turned to a successor.
    succeeded: bool,
    /// The peer has nothing under way any more.
    ended: bool,
    /// The peer has closed the connection, though its QUIC may not say so.
    closed: bool,
    /// It must go now.
    enough: bool,
}

impl Leaving {
    /// Whose it is, unless it is gone.
    pub(super) fn who(&self) -> Option<&Who> {
        (!self.is_gone()).then_some(&self.established.who)
    }

    fn is_gone(&self) -> bool {
        self.news.is_closed()
    }

    fn tell(&self, what: impl FnOnce(&mut News)) {
        self.news.send_modify(what);
    }
}

impl Hub {
    /// The connection has a successor: it ends once all that is under way on it has arrived, or at once
    /// where it is silent. Then the result is what to say of it to the peer.
    pub(super) fn hand_over(&mut self, old: u64) -> Option<LinkClosed> {
        let mut link = self.links.remove(&old)?;
        // An acknowledgement may have come since it was looked at.
        link.silent &= !Traffic::of(&link.connection).answered_since(link.traffic);
        tracing::debug!(link = old, silent = link.silent, "the link is superseded");
        self.leaving.retain(|_, leaving| !leaving.is_gone());
        let who = &link.established.who;
        let others = self.leaving.iter().filter(|(_, leaving)| leaving.established.who.is(who));
        let others: Vec<u64> = others.map(|(number, _)| *number).collect();
        if let (true, Some(oldest)) = (others.len() >= MAX_LEAVING, others.iter().min()) {
            self.leaving[oldest].tell(|news| news.enough = true);
        }
        // Who elects has turned to the successor before the other hears of it.
        let succeeded = self.context.hello.daemon > link.established.hello.daemon;
        let (news, heard) = watch::channel(News { succeeded, ..News::default() });
        let leaving = Leaving {
            connection: link.connection.clone(),
            established: link.established.clone(),
            side: link.candidate.side,
            elected: link.elected,
            news,
        };
        self.leaving.insert(old, leaving);
        // QUIC may not say it: quinn holds a CONNECTION_CLOSE back, as all else, where its congestion
        // window is full of what nobody acknowledged.
        let closed = link.elected.filter(|_| link.silent).map(|e| LinkClosed { link: e.link });
        tokio::spawn(leave(old, link, heard, self.context.keyring.clone()));
        closed
    }

    /// The peer has closed a link that was silent.
    pub(super) fn closed_by_peer(&self, daemon: DaemonId, closed: LinkClosed) {
        let names = |leaving: &Leaving| leaving.elected.is_some_and(|e| e.link == closed.link);
        let of_peer = |leaving: &&Leaving| leaving.established.hello.daemon == daemon;
        let its = self.leaving.values().filter(of_peer).filter(|leaving| names(leaving));
        its.for_each(|leaving| leaving.tell(|news| news.closed = true));
    }

    /// The peer spoke as it does on a link that it turned to.
    pub(super) fn succeeded(&self, daemon: DaemonId) {
        self.tell_leaving(daemon, |news| news.succeeded = true);
    }

    /// There is no peer any more for whom a superseded link would be of use.
    pub(super) fn abandon_leaving(&self, daemon: DaemonId) {
        self.tell_leaving(daemon, |news| news.enough = true);
    }

    fn tell_leaving(&self, daemon: DaemonId, what: impl Fn(&mut News)) {
        let of_peer = |leaving: &&Leaving| leaving.established.hello.daemon == daemon;
        self.leaving.values().filter(of_peer).for_each(|leaving| leaving.tell(&what));
    }

    /// The control stream of a superseded link ended.
    pub(super) fn leaving_ended(&self, number: u64) {
        if let Some(leaving) = self.leaving.get(&number) {
            leaving.tell(|news| news.ended = true);
        }
    }

    /// Closes those whose peer would not be let in now under the identity that it proved there.
    pub(super) fn close_untrusted_leaving(&self, certificates: bool) {
        for leaving in self.leaving.values() {
            let Leaving { connection, established, side, .. } = leaving;
            let negotiated = &established.negotiated;
            if self.context.distrust(connection, negotiated, *side, certificates).is_some() {
                leaving.tell(|news| news.enough = true);
            }
        }
    }
}

async fn leave(
    number: u64,
    link: Link,
    mut news: watch::Receiver<News>,
    keyring: Option<Arc<Keyring>>,
) {
    let Link { connection, outbox, carrier, carrying, reading, until, silent, .. } = link;
    drop(carrier);
    let least = Instant::now() + HAND_OVER;
    let until = until.map(|until| until.max(least));
    let (mut last, mut told) = (news.clone(), news.clone());
    let arrived = async {
        // What a silent one has under way is sent again over its successor.
        if !silent {
            carrying.closed().await;
        }
        // Who has not heard of the successor would take the end of the control stream for the link's.
        let _ = news.wait_for(|news| news.succeeded).await;
        if silent {
            return;
        }
        outbox.end();
        while tokio::time::timeout(HAND_OVER, news.wait_for(|n| n.ended)).await.is_err() {
            // What accepts streams holds one, each that is read another.
            if reading.receiver_count() <= 1 {
                break;
            }
        }
    };
    let read = async {
        tokio::select! {
            () = arrived => {}
            _ = connection.closed() => {}
            Ok(_) = told.wait_for(|news| news.closed) => {}
        }
        close(&connection, CloseCode::Replaced, SUPERSEDED);
        reading.closed().await;
    };
    tokio::select! {
        () = read => {}
        // An error: the hub is gone.
        _ = last.wait_for(|news| news.enough) => {}
        () = at(until) => {}
    }
    tracing::debug!(link = number, "the superseded link ends");
    // Closing what is closed already changes nothing.
    close(&connection, CloseCode::Replaced, SUPERSEDED);
    if let Some(keyring) = keyring {
        keyring.forget_connection(number);
    }
}

/// Waits until then; without a time for ever.
async fn at(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}
