//! The sending end: splits samples into pieces, as far as there is credit.

use std::collections::{BTreeMap, VecDeque};

use axon_shm::Meta;

use super::{FlowChannel, OVERHEAD, OutboundSample, PIECE, SampleContent};
use crate::wire::session::{Credit, SampleFragment, SampleHeader};

/// The sending end.
#[derive(Debug)]
pub struct OutgoingFlow<S> {
    channels: BTreeMap<FlowChannel, SendingSample<S>>,
    /// Channels that may send a piece, in the order of their turns.
    turns: VecDeque<FlowChannel>,
}

#[derive(Debug)]
struct SendingSample<S> {
    /// Number of MATCHED messages that this end had sent when it opened its end.
    since: u64,
    /// Bytes that may still be sent; `None` until the receiver opened its end.
    credit: Option<u64>,
    /// The credit when the receiver opened its end. All of it is back when nothing is in flight.
    window: u64,
    /// The sample that is sent piece by piece, and the number of bytes sent; `None` before its first piece.
    current: Option<(OutboundSample<S>, Option<usize>)>,
    in_turn: bool,
}

impl<S> Default for OutgoingFlow<S> {
    fn default() -> Self {
        Self { channels: BTreeMap::new(), turns: VecDeque::new() }
    }
}

impl<S: SampleContent> OutgoingFlow<S> {
    /// Opens a channel. `since` is the number of MATCHED messages sent until now. The channel waits for a receiver that
    /// has received as many: a receiver that has received fewer means an earlier channel of the same name.
    pub fn open(&mut self, channel: FlowChannel, since: u64) {
        let closed =
            SendingSample { since, credit: None, window: 0, current: None, in_turn: false };
        self.channels.entry(channel).or_insert(closed);
    }

    /// Closes the channels that `keep` rejects. The rest of a sample that is in flight is not sent.
    pub fn retain(&mut self, keep: impl Fn(&FlowChannel) -> bool) {
        self.channels.retain(|channel, _| keep(channel));
        let channels = &self.channels;
        self.turns.retain(|channel| channels.contains_key(channel));
    }

    /// Closes a channel.
    pub fn close(&mut self, channel: &FlowChannel) {
        self.channels.remove(channel);
        self.turns.retain(|other| other != channel);
    }

    /// Handles a credit message of a channel's receiver.
    pub fn credit(&mut self, credit: &Credit) {
        let Credit { publisher, bytes, opens, client, .. } = *credit;
        let name = FlowChannel { writer: publisher, client };
        let Some(channel) = self.channels.get_mut(&name) else { return };
        match (&mut channel.credit, opens) {
            (none @ None, Some(heard)) if heard >= channel.since => {
                *none = Some(bytes);
                channel.window = bytes;
            }
            (Some(credit), None) => *credit = credit.saturating_add(bytes),
            // The message is for an earlier channel of the same name.
            (None, _) | (Some(_), Some(_)) => {}
        }
        self.enqueue(name);
    }

    /// Returns whether all samples that were sent on a channel have reached their destination.
    pub fn is_idle(&self, channel: &FlowChannel) -> bool {
        self.channels.get(channel).is_none_or(|channel| {
            channel.current.is_none()
                && channel.credit.is_none_or(|credit| credit == channel.window)
        })
    }

    /// Takes the next sample of each channel that has none in flight and may send one. Returns whether there was any.
    pub fn fill(
        &mut self,
        mut take: impl FnMut(&FlowChannel) -> Option<OutboundSample<S>>,
    ) -> bool {
        let mut found = Vec::new();
        for (name, channel) in &mut self.channels {
            if channel.current.is_none() && channel.credit >= Some(OVERHEAD) {
                channel.current = take(name).map(|sample| (sample, None));
                found.extend(channel.current.is_some().then_some(*name));
            }
        }
        found.iter().for_each(|name| self.enqueue(*name));
        !found.is_empty()
    }

    /// Returns the next piece, of the channel whose turn it is.
    pub fn next_piece(&mut self) -> Option<SampleFragment> {
        loop {
            let name = self.turns.pop_front()?;
            let Some(channel) = self.channels.get_mut(&name) else { continue };
            channel.in_turn = false;
            let (Some((sample, at)), Some(credit)) = (&mut channel.current, &mut channel.credit)
            else {
                continue;
            };
            let mut cost = 0;
            let mut head = None;
            let from = match at {
                Some(at) => *at,
                None if *credit < OVERHEAD => continue,
                None => {
                    cost = OVERHEAD;
                    let Meta { sequence, source_nanos, published_nanos, .. } = sample.meta;
                    let (source_timestamp, published) = (source_nanos, published_nanos);
                    // No sample is longer than AXON_MAX_MESSAGE_MB allows, which is below 4 GiB.
                    let length = u32::try_from(sample.content.len()).unwrap_or(u32::MAX);
                    let lost = sample.lost;
                    head =
                        Some(SampleHeader { length, sequence, source_timestamp, lost, published });
                    0
                }
            };
            let left = sample.content.len() - from;
            let may = usize::try_from(*credit - cost).unwrap_or(usize::MAX);
            let mut bytes = vec![0; left.min(PIECE).min(may)];
            if bytes.is_empty() && head.is_none() {
                // The channel waits for credit.
                continue;
            }
            sample.content.read_at(from, &mut bytes);
            cost += bytes.len() as u64;
            *credit -= cost;
            *at = Some(from + bytes.len());
            if bytes.len() == left {
                channel.current = None;
            } else {
                self.enqueue(name);
            }
            let FlowChannel { writer: publisher, client } = name;
            return Some(SampleFragment { publisher, head, bytes, client });
        }
    }

    fn enqueue(&mut self, name: FlowChannel) {
        if let Some(channel) = self.channels.get_mut(&name)
            && channel.current.is_some()
            && !std::mem::replace(&mut channel.in_turn, true)
        {
            self.turns.push_back(name);
        }
    }
}
