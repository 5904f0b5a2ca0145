//! Matches the endpoints of a relayed session in the daemon, and decides which remote samples are sent to
//! it. Runs on the session's thread `axon-relay`.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use axon_shm::{
    Sample,
    ids::Gid,
    qos::{Durability, History, Qos},
};
use axon_transport::{
    Subscription,
    graph::Endpoint,
    internal::{
        registry::parts,
        session::{
            RemoteWriter,
            merge::{Merge, MergedSample},
            relayed::{
                MAX_MATCHED,
                flow::{FlowChannel, OutboundSample, SamplePayload},
                pipe::End,
            },
        },
        wire::session::{GraphItem, RelayMatched, SessionMessage},
    },
};

use super::{ENDED, RelayedSession};

/// Maximum number of partners of a session's endpoints that are gone and whose last samples are kept until the session
/// takes them. Those samples are in memory of a process that may have ended.
const MAX_LEFT: usize = 256;

/// A publisher's samples on their way to the session: they cross once, whatever the number of subscriptions.
#[derive(Default)]
pub(super) struct RelayedSource {
    samples: Merge<Sample>,
    /// The number of samples of its history that have been requested.
    history: Option<u32>,
    /// The number up to which the session has confirmed them.
    pub(super) done: Option<u64>,
}

impl RelayedSource {
    /// Acknowledges to its publisher, through all subscriptions, the samples that the session has.
    pub(super) fn acknowledge(&self, to: &BTreeMap<Gid, Subscription>, writer: &Gid) {
        let Some(done) = self.done else { return };
        let readers = self.samples.readers().filter_map(|reader| to.get(reader));
        readers.for_each(|reader| reader.acknowledge_of(writer, done));
    }
}

impl RelayedSession {
    /// Sends the changes of the graph.
    pub(super) fn tell_graph(&mut self) -> Result<(), End> {
        let now = self.session.graph();
        let before = std::mem::replace(&mut self.graph, Arc::clone(&now));
        let same = |gid: &Gid| match (now.endpoints.get(gid), before.endpoints.get(gid)) {
            (Some(a), Some(b)) => a.daemon == b.daemon && a.endpoint == b.endpoint,
            _ => false,
        };
        let removed: Vec<Gid> = before.endpoints.keys().filter(|gid| !same(gid)).copied().collect();
        let added = now.endpoints.values().filter(|entry| !same(&entry.endpoint.gid));
        let added = added
            .map(|e| GraphItem {
                endpoint: Endpoint::clone(&e.endpoint),
                daemon: e.daemon,
                reach: None,
            })
            .collect::<Vec<_>>();
        if removed.is_empty() && added.is_empty() {
            return Ok(());
        }
        let all = parts(now.version, false, added.into_iter(), &removed, &BTreeSet::new(), false);
        all.into_iter().try_for_each(|part| self.pipe.say(&SessionMessage::Graph(part)))
    }

    /// Sends the matches of the session's endpoints, and decides through which endpoints remote messages are taken for
    /// the session.
    pub(super) fn match_up(&mut self) -> Result<(), End> {
        let mut matched: BTreeMap<Gid, BTreeSet<Gid>> = BTreeMap::new();
        let partners = self.writers.iter().map(|(gid, writer)| (gid, writer.partners()));
        matched.extend(partners.map(|(gid, others)| (*gid, others.into_iter().collect())));
        let readers = self.subscriptions.iter().map(|(gid, s)| (gid, s.attached()));
        matched.extend(readers.map(|(gid, others)| (*gid, others.into_iter().collect())));
        self.keep_what_is_left(&mut matched);
        for (gid, others) in matched {
            let others: BTreeSet<Gid> = others.into_iter().take(MAX_MATCHED).collect();
            if self.told.get(&gid) != Some(&others) {
                self.tell(gid, others)?;
            }
        }
        self.ask();
        let servers = self
            .told
            .iter()
            .filter(|(gid, _)| matches!(self.writers.get(gid), Some(RemoteWriter::Server(_))));
        self.calls.set(servers.flat_map(|(gid, all)| all.iter().map(|client| (*client, *gid))));
        let graph = &self.graph.endpoints;
        let sources = self.sources.keys().filter_map(|writer| graph.get(writer));
        self.alive.watch(sources.filter_map(|entry| entry.endpoint.qos.lease));
        Ok(())
    }

    /// Adds partners that are gone and have left messages to `matched`: these messages come first.
    fn keep_what_is_left(&mut self, matched: &mut BTreeMap<Gid, BTreeSet<Gid>>) {
        let mut rest = BTreeSet::new();
        for (gid, others) in matched.iter() {
            let before = self.told.get(gid).into_iter().flatten();
            let gone = before.filter(|other| !others.contains(other));
            rest.extend(gone.filter(|other| self.has_left(gid, other)).map(|other| (*gid, *other)));
        }
        self.left.retain(|pair| rest.remove(pair));
        self.left.extend(rest);
        while self.left.len() > MAX_LEFT
            && let Some((gid, other)) = self.left.pop_front()
        {
            self.discard(&gid, &other);
        }
        for (gid, other) in &self.left {
            matched.entry(*gid).or_default().insert(*other);
        }
    }

    /// Returns whether an endpoint of the session has not taken all messages of `other`.
    fn has_left(&self, gid: &Gid, other: &Gid) -> bool {
        if let Some(remote_writer) = self.writers.get(gid) {
            return remote_writer.has_from(other)
                || self.calls.holds(other, gid)
                || !self.pipe.outgoing.is_idle(&channel(remote_writer, *other));
        }
        self.subscriptions.get(gid).is_some_and(|subscription| subscription.has_from(other))
            || self.sources.get(other).is_some_and(|source| source.samples.holds(gid))
            || !self.pipe.outgoing.is_idle(&FlowChannel::of(*other))
    }

    /// Gives up the remaining messages of `other`, which is gone, because the session's endpoint does not take them.
    fn discard(&self, gid: &Gid, other: &Gid) {
        let take = || match self.writers.get(gid) {
            Some(remote_writer) => remote_writer.take_from(other),
            None => self.subscriptions.get(gid)?.take_from(other).map(|(sample, _)| sample),
        };
        let samples = std::iter::from_fn(take).count() as u64;
        self.tally.lost(samples);
        let endpoint = match self.writers.get(gid) {
            Some(remote_writer) => Some(remote_writer.endpoint()),
            None => self.subscriptions.get(gid).map(Subscription::endpoint),
        };
        let topic = endpoint.map_or("", |endpoint| endpoint.topic.as_str());
        if samples > 0 {
            self.losses.add(topic, ENDED, samples);
        }
        if let Some(writers) = self.given_up.count(self.begun.elapsed()) {
            let (session, limit) = (&self.id, MAX_LEFT);
            tracing::warn!(
                %session, %other, topic, writers, limit,
                "discarded samples of ended writers: the relayed session does not take them"
            );
        }
    }

    /// Sends the matches of an endpoint, and opens and closes its channels from here on, in the order in which the
    /// session receives the messages.
    fn tell(&mut self, gid: Gid, others: BTreeSet<Gid>) -> Result<(), End> {
        let shown = others.iter().copied().collect();
        self.pipe.say(&SessionMessage::Matched(RelayMatched { gid, others: shown }))?;
        let before = self.told.insert(gid, others);
        if before.is_some_and(|before| !before.is_subset(&self.told[&gid])) {
            self.close_unwanted();
        }
        for channel in self.channels(&gid, &self.told[&gid]) {
            self.pipe.open_out(channel);
        }
        Ok(())
    }

    /// Returns the channels on which the session gets the messages of `others` for one of its endpoints.
    fn channels(&self, gid: &Gid, others: &BTreeSet<Gid>) -> Vec<FlowChannel> {
        match self.writers.get(gid) {
            Some(RemoteWriter::Publisher(_)) => Vec::new(),
            Some(remote_writer) => {
                others.iter().map(|other| channel(remote_writer, *other)).collect()
            }
            None => others.iter().map(|writer| FlowChannel::of(*writer)).collect(),
        }
    }

    /// Returns the channels to the session, according to the matches that were sent to it.
    fn wanted(&self) -> BTreeSet<FlowChannel> {
        self.told.iter().flat_map(|(gid, others)| self.channels(gid, others)).collect()
    }

    pub(super) fn close_unwanted(&mut self) {
        let wanted = self.wanted();
        self.sources.retain(|writer, _| wanted.contains(&FlowChannel::of(*writer)));
        self.pipe.outgoing.retain(|channel| wanted.contains(channel));
    }

    /// Sets the subscriptions through which each publisher's samples are taken: all that are matched with it.
    fn ask(&mut self) {
        let mut asked: BTreeMap<Gid, (Vec<Gid>, Option<u32>)> = BTreeMap::new();
        for (gid, writers) in &self.told {
            let Some(subscription) = self.subscriptions.get(gid) else { continue };
            for writer in writers {
                let (readers, history) = asked.entry(*writer).or_default();
                readers.push(*gid);
                *history = history_of(&subscription.endpoint().qos).max(*history);
            }
        }
        self.sources.retain(|writer, _| asked.contains_key(writer));
        for (writer, (readers, history)) in asked {
            let source = self.sources.entry(writer).or_default();
            source.samples.set(readers);
            if history > source.history {
                source.history = history;
                source.samples.rewind();
            }
        }
    }

    /// Skips samples that the session already received through another subscription or server. Returns whether more
    /// remain.
    pub(super) fn pass_over(&mut self) -> bool {
        let mut more = self.calls.pass_over(|gid| self.writers.get(gid));
        for (writer, source) in &mut self.sources {
            more |= source.samples.pass_over(|reader| taken(&self.subscriptions, reader, writer));
            // The session already received skipped samples through another subscription.
            if source.samples.readers().nth(1).is_some() {
                source.acknowledge(&self.subscriptions, writer);
            }
        }
        more
    }
}

/// Returns the number of samples that a subscription requests from before its creation.
fn history_of(qos: &Qos) -> Option<u32> {
    let depth = if qos.history == History::KeepAll { u32::MAX } else { qos.depth };
    (qos.durability == Durability::TransientLocal).then_some(depth)
}

pub(super) fn take(
    source: &mut RelayedSource,
    subscriptions: &BTreeMap<Gid, Subscription>,
    writer: &Gid,
) -> Option<OutboundSample<SamplePayload>> {
    let waits = |reader: &Gid| {
        subscriptions.get(reader).is_some_and(|s| s.may_lose_nothing() && s.is_held_up(writer))
    };
    let next = source.samples.next(|reader| taken(subscriptions, reader, writer), waits);
    next.map(OutboundSample::from)
}

fn taken(
    subscriptions: &BTreeMap<Gid, Subscription>,
    reader: &Gid,
    writer: &Gid,
) -> Option<MergedSample<Sample>> {
    let (content, lost) = subscriptions.get(reader)?.take_from(writer)?;
    Some(MergedSample { number: content.meta().sequence, lost, content })
}

/// Returns the channel on which the session gets the messages of `other` for one of its clients or servers.
fn channel(of: &RemoteWriter, other: Gid) -> FlowChannel {
    match of {
        RemoteWriter::Client(client) => FlowChannel::between(other, client.gid()),
        RemoteWriter::Server(_) | RemoteWriter::Publisher(_) => FlowChannel::of(other),
    }
}
