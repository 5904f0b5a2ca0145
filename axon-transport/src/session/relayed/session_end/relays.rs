//! Relays for the application's publishers. Each relay reads a publisher's ring for the remote readers that the
//! daemon matched with the publisher. Every reader that the publisher counts receives its samples.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::internal::holds;

use super::RelayConnection;
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::{Durability, History, Liveliness, Qos, Reliability},
    session::{
        endpoints::{EndpointFactory, Subscription},
        options::EndpointSpec,
        relayed::{
            MAX_MATCHED,
            flow::{FlowChannel, OutboundSample, SamplePayload},
        },
    },
};

pub(super) struct SessionRelay {
    subscription: Subscription,
    /// The relay's publisher, which may have ended.
    publisher: Arc<Endpoint>,
    stands_for: BTreeSet<Gid>,
    /// Samples that it has lost, as far as the daemon knows.
    lost: u64,
    /// Set for a relay from an earlier connection, which sends nothing until its readers are matched again or the time
    /// is over.
    awaits: Option<Awaits>,
    /// True if its publisher had ended when it was announced to this daemon.
    revived: bool,
}

/// The readers that a relay waits for, and the end of the wait. They would lose samples that are sent before they are
/// matched.
struct Awaits {
    readers: BTreeSet<Gid>,
    until: Instant,
}

/// Time for which unconfirmed samples are kept for their readers after their daemon is gone.
pub(super) const ABSENCE: Duration = Duration::from_secs(10);

impl SessionRelay {
    /// Returns when its publisher was last alive, if the publisher has a lease.
    pub(super) fn assertions(&self) -> Vec<(Gid, u64)> {
        self.subscription.assertions()
    }

    /// Returns its publisher.
    pub(super) fn publisher(&self) -> &Endpoint {
        &self.publisher
    }

    /// Returns its publisher, which has ended, so that it is announced for the samples that it left.
    pub(super) fn resume(&mut self) -> Arc<Endpoint> {
        self.revived = true;
        Arc::clone(&self.publisher)
    }

    /// Records that the publisher's samples up to this number are delivered.
    pub(super) fn acknowledge(&self, sequence: u64) {
        self.subscription.acknowledge_of(&self.publisher.gid, sequence);
    }

    /// Gives up `samples` samples of the publisher, which the daemon reported as undeliverable.
    pub(super) fn lose(&self, samples: u64) {
        self.subscription.give_up(self.publisher.gid, samples);
    }

    /// Returns how long the relay still waits at most for the readers that it had with the last daemon.
    pub(super) fn waits_for(&self) -> Option<Duration> {
        let until = self.awaits.as_ref()?.until;
        Some(until.saturating_duration_since(Instant::now())).filter(|left| !left.is_zero())
    }

    /// Returns whether the relay waits for its earlier readers.
    fn waits(&self) -> bool {
        self.waits_for().is_some()
    }

    /// Returns whether the relay comes from an earlier connection, and still waits for its readers or for the decision
    /// how to go on.
    pub(super) fn is_carried_over(&self) -> bool {
        self.awaits.is_some()
    }

    /// Returns the number of samples that are not confirmed.
    pub(super) fn unconfirmed(&self) -> u64 {
        self.subscription.unacknowledged().remove(&self.publisher.gid).unwrap_or(0)
    }

    /// Gives up the unconfirmed samples, because the readers did not come back and no other reader exists. Tells the
    /// publisher, and logs the loss.
    pub(super) fn give_up(&self) {
        let samples = self.unconfirmed();
        if samples > 0 {
            let Endpoint { gid, topic, .. } = &*self.publisher;
            self.subscription.give_up(*gid, samples);
            tracing::warn!(topic, publisher = %gid, samples, "gave up samples: no daemon confirmed them");
        }
    }

    /// Takes the next sample of its publisher.
    pub(super) fn take(&mut self) -> Option<OutboundSample<SamplePayload>> {
        if self.is_carried_over() {
            return None;
        }
        let (content, now) = self.subscription.take_from(&self.publisher.gid)?;
        let before = std::mem::replace(&mut self.lost, now);
        // If the publisher has granted anew, the count starts from 0.
        let lost = now.checked_sub(before).unwrap_or(now);
        Some(OutboundSample { meta: content.meta(), lost, content: SamplePayload::Ring(content) })
    }

    /// Takes back the unconfirmed samples, to send them through the next daemon. Returns whether the relay is kept for
    /// that. The publisher waits for the relay as before, and counts none of its readers meanwhile.
    fn outlive_connection(&mut self) -> bool {
        let readers = match self.awaits.take() {
            Some(awaits) if awaits.until > Instant::now() => awaits.readers,
            _ => std::mem::take(&mut self.stands_for),
        };
        if !holds(&self.publisher.qos) || readers.is_empty() {
            return false;
        }
        self.subscription.take_back();
        self.subscription.set_stands_for(Vec::new());
        self.stands_for = BTreeSet::new();
        self.awaits = Some(Awaits { readers, until: Instant::now() + ABSENCE });
        true
    }
}

/// Removes the relays that waited for too long while there is no daemon.
pub(super) fn drop_overdue(kept: &mut BTreeMap<Gid, SessionRelay>) {
    kept.retain(|_, relay| {
        let waits = relay.waits();
        if !waits {
            relay.give_up();
        }
        waits
    });
}

impl RelayConnection<'_> {
    /// Returns the relays that outlive the connection.
    pub(super) fn keep_relays(&mut self) -> BTreeMap<Gid, SessionRelay> {
        let mut relays = std::mem::take(&mut self.relays);
        relays.retain(|_, relay| relay.outlive_connection());
        relays
    }

    pub(super) fn update_relays(&mut self) {
        let mut wanted: BTreeMap<Gid, BTreeSet<Gid>> = BTreeMap::new();
        for publisher in self.own.values().filter(|e| e.kind == EndpointKind::Publisher) {
            let gid = publisher.gid;
            let readers = self.matched.get(&gid).cloned().unwrap_or_default();
            // History goes ahead of the readers that will ask for it; the rest of an ending publisher's samples
            // is carried to its end.
            let history = publisher.qos.durability == Durability::TransientLocal;
            let known = self.relays.get(&gid);
            let rest =
                self.ending.contains_key(&gid) && known.is_some_and(|r| !r.is_carried_over());
            if history || rest || known.is_some_and(SessionRelay::waits) || !readers.is_empty() {
                wanted.insert(gid, readers);
            }
        }
        self.relays.retain(|publisher, relay| {
            let is_wanted = wanted.contains_key(publisher);
            if !is_wanted && relay.is_carried_over() {
                relay.give_up();
            }
            is_wanted
        });
        for (publisher, stands_for) in wanted {
            let gids: Vec<Gid> = stands_for.iter().take(MAX_MATCHED).copied().collect();
            if let Some(relay) = self.relays.get_mut(&publisher) {
                if relay.stands_for != stands_for {
                    relay.subscription.set_stands_for(gids);
                    relay.stands_for = stands_for;
                }
                let there = &relay.stands_for;
                relay.awaits.take_if(|awaits| {
                    awaits.readers.is_subset(there) || awaits.until <= Instant::now()
                });
                continue;
            }
            let endpoint = Arc::clone(&self.own[&publisher]);
            let Endpoint { topic, type_name, qos, .. } = &*endpoint;
            let spec = EndpointSpec::new(&**topic, &**type_name, requested(qos));
            let outside = &self.common.outside;
            let factory = EndpointFactory(outside);
            match factory.create_relay(spec, Some(publisher), gids, holds(qos)) {
                Ok(subscription) => {
                    let relay = SessionRelay {
                        subscription,
                        publisher: endpoint,
                        stands_for,
                        lost: 0,
                        awaits: None,
                        revived: false,
                    };
                    self.relays.insert(publisher, relay);
                }
                Err(error) => tracing::error!(topic, %error, "nothing is relayed"),
            }
        }
    }

    /// Returns whether all samples of a publisher are delivered.
    pub(super) fn is_published(&self, publisher: &Gid) -> bool {
        let relay = self.relays.get(publisher);
        relay.is_none_or(|relay| relay.unconfirmed() == 0)
            && self.pipe.outgoing.is_idle(&FlowChannel::of(*publisher))
    }

    /// Returns whether a publisher was announced to the daemon after it had ended.
    pub(super) fn is_revived(&self, publisher: &Gid) -> bool {
        self.relays.get(publisher).is_some_and(|relay| relay.revived)
    }
}

/// Returns the QoS with which a relay requests all that its publisher offers. The publisher's QoS decides, as always,
/// whether it waits for the relay.
fn requested(offered: &Qos) -> Qos {
    let newest =
        offered.reliability == Reliability::BestEffort && offered.history == History::KeepLast;
    offered
        .with_history(if newest { History::KeepLast } else { History::KeepAll })
        .with_deadline(None)
        .with_lifespan(None)
        .with_liveliness(Liveliness::Automatic, None)
}
