//! The sending end: splits samples into pieces, as far as there is credit.

use std::collections::{BTreeMap, VecDeque};

use axon_shm::Meta;

use super::{FlowChannel, OVERHEAD, OutboundSample, PIECE, SampleContent};
use crate::wire::session::{Credit, SampleFragment, SampleHeader};

/// The sending end.
#[derive(Debug)]
pub struct OutgoingFlow<S> {
    channels: BTreeMap<FlowChannel, SendingSample<S>>,
    /// Channels that may send a piece, in their order.
    turns: VecDeque<FlowChannel>,
}

#[derive(Debug)]
struct SendingSample<S> {
    /// MATCHED that this end had said when it opened its end.
    since: u64,
    /// Bytes that may still be sent; `None` until the receiver opened its end.
    credit: Option<u64>,
    /// What it was when the receiver opened its end: all of it is back when nothing is under way.
    window: u64,
    /// What is sent piece by piece, and how far.
    current: Option<(OutboundSample<S>, Option<usize>)>,
    in_turn: bool,
}

impl<S> Default for OutgoingFlow<S> {
    fn default() -> Self {
        Self { channels: BTreeMap::new(), turns: VecDeque::new() }
    }
}

impl<S: SampleContent> OutgoingFlow<S> {
    /// Opens a channel, which waits for a receiver that has heard as many MATCHED as were said when it
    /// was to be opened: one that has not means a channel of the same name that was closed since.
    pub fn open(&mut self, channel: FlowChannel, since: u64) {
        let closed =
            SendingSample { since, credit: None, window: 0, current: None, in_turn: false };
        self.channels.entry(channel).or_insert(closed);
    }

    /// Closes those channels that `keep` does not want; the rest of a sample that is under way is not
    /// sent.
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

    /// What the receiver of a channel says.
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
            // Of a channel that this one came after.
            (None, _) | (Some(_), Some(_)) => {}
        }
        self.enqueue(name);
    }

    /// Whether all that was sent on a channel has gone to where it belongs.
    pub fn is_idle(&self, channel: &FlowChannel) -> bool {
        self.channels.get(channel).is_none_or(|channel| {
            channel.current.is_none()
                && channel.credit.is_none_or(|credit| credit == channel.window)
        })
    }

    /// Asks for the next sample of each channel that has none under way and may send one. Whether
    /// there was any.
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

    /// The next piece, of the channel whose turn it is.
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
                // It waits for credit.
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
