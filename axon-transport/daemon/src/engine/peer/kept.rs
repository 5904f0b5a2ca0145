//! KEEP_ALL relays of peers whose daemon was killed or restarted. They hold what the peer did not acknowledge, until
//! the next daemon there asks for the topic for the same subscriptions.

use std::{rc::Rc, time::Duration};

use super::{Peer, routes::RelaySpec};
use crate::engine::{outbound::Source, peer::routes::RouteKey, rings::RingReader};

/// A relay is kept for so long.
const PATIENCE: Duration = Duration::from_secs(10);
/// Relays that are kept. What further ones hold is given up at once.
const MOST: usize = 1024;

/// The relays that are kept.
#[derive(Default)]
pub(crate) struct KeptRelays(Vec<Kept>);

struct Kept {
    /// The identity that the peer proved.
    identity: String,
    key: RouteKey,
    spec: RelaySpec,
    reader: Rc<dyn RingReader>,
    until: Duration,
}

impl KeptRelays {
    /// Takes the KEEP_ALL relays of a peer that is gone.
    pub(crate) fn add(&mut self, peer: &mut Peer, now: Duration) {
        for (number, served) in &peer.served {
            let room = MOST.saturating_sub(self.0.len());
            for source in peer.outbound.take_kept(*number, room) {
                let Source::Relay(spec, reader) = source else { continue };
                let identity = peer.identity.clone();
                let (key, until) = (served.key.clone(), now + PATIENCE);
                self.0.push(Kept { identity, key, spec, reader, until });
            }
        }
    }

    /// The relay that was kept, of a peer with this identity, for one of the subscriptions for which a new one is to
    /// stand. It begins with what was not acknowledged.
    pub(super) fn adopt(
        &mut self,
        key: &RouteKey,
        spec: &RelaySpec,
        identity: &str,
    ) -> Option<Rc<dyn RingReader>> {
        let fits = |kept: &Kept| {
            let same = |gid| kept.spec.stands_for.contains(gid);
            let is_same_topic = kept.key == *key && kept.spec.is(spec);
            is_same_topic && kept.identity == identity && spec.stands_for.iter().any(same)
        };
        let at = self.0.iter().position(fits)?;
        let Kept { reader, .. } = self.0.swap_remove(at);
        reader.take_back();
        reader.set_stands_for(spec.stands_for.clone());
        Some(reader)
    }

    /// When [`give_up`](Self::give_up) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        self.0.iter().map(|kept| kept.until).min()
    }

    /// Gives up what relays hold that were kept until now. Returns the samples, by topic.
    pub(crate) fn give_up(&mut self, now: Duration) -> Vec<(String, u64)> {
        let mut lost = Vec::new();
        for Kept { key, reader, .. } in self.0.extract_if(.., |kept| kept.until <= now) {
            let mut all = 0;
            for (publisher, samples) in reader.unacknowledged() {
                reader.give_up(publisher, samples);
                all += samples;
            }
            if all > 0 {
                lost.push((key.topic, all));
            }
        }
        lost
    }
}
