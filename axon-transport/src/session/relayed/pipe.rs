//! The socket of a relay, which both ends use. Control messages go before pieces of samples.

use std::{
    collections::{BTreeMap, VecDeque},
    os::fd::BorrowedFd,
    sync::Arc,
    time::Duration,
};

use axon_shm::{
    ExternalLeader, PublishError,
    internal::{MAX_GAP, descriptors::PassedFd},
};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    net::{Shutdown, shutdown},
};

use super::{
    flow::{
        FlowChannel, FlowViolation, InboundSample, IncomingFlow, OutboundSample, OutgoingFlow,
        SampleContent, SamplePayload,
    },
    response_log::ResponseLog,
};
use crate::{
    ids::Gid,
    log_limit::LogLimit,
    registry::RelayCounters,
    session::{
        clock,
        core::ChangeSignal,
        daemon::socket::{self, ReceivedMessage, SocketError},
        endpoints::{RemoteWriter, Written},
    },
    wire::session::{Credit, SessionMessage},
};

/// Bytes of control messages that may be queued for an end that does not read.
const MAX_WAITING: usize = 32 << 20;
/// Packets that are sent, or received, before the other direction has its turn.
const BATCH: usize = 64;

/// Time between checks for changes that nothing signals.
const NAP: Duration = Duration::from_millis(5);

/// The reason for the end of a relay.
#[derive(Debug, thiserror::Error)]
pub enum End {
    /// The socket failed.
    #[error("{0}")]
    Socket(#[from] SocketError),
    /// The other end broke the protocol of pieces and credit.
    #[error("the other end sent {0}")]
    Violation(#[from] FlowViolation),
    /// The other end sent descriptors, which no message of a relay has.
    #[error("the other end sent descriptors")]
    Descriptors,
    /// Too many control messages wait for the other end.
    #[error("the other end does not read")]
    Deaf,
    /// The session's process ended.
    #[error("its process ended")]
    Gone,
    /// Something else failed here.
    #[error("{0}")]
    Other(String),
}

/// Samples that are written and that may not have reached their destination.
struct Unacknowledged {
    /// The number up to which delivery was reported to the other end.
    said: u64,
    /// The number of the last written sample.
    last: u64,
    /// The number to report once the last sample is delivered: the number of the last sample that arrived, written or
    /// not.
    then: u64,
}

/// A report of lost samples.
#[derive(Clone, Copy, Debug)]
pub enum LossReport {
    /// Samples that did not arrive before the current one.
    Before {
        /// The number of samples.
        samples: u64,
        /// True if no sample of the channel arrived before.
        first: bool,
    },
    /// A sample that arrived and could not be written.
    Unwritten,
}

impl LossReport {
    /// Returns the number of lost samples.
    pub fn samples(self) -> u64 {
        match self {
            Self::Before { samples, .. } => samples,
            Self::Unwritten => 1,
        }
    }
}

/// Returns how many samples count as lost if the other end reports `lost` ones between the numbers `before`
/// and `number`. The report may come from another user's process, and the totals never shrink: so a report is
/// cut to the missing numbers, and one that is still above [`MAX_GAP`] counts as 0.
fn judge_loss(lost: u64, before: Option<u64>, number: u64) -> u64 {
    let missing = number.saturating_sub(before.unwrap_or(0)).saturating_sub(1);
    let lost = lost.min(missing);
    if lost > MAX_GAP { 0 } else { lost }
}

/// One end of a relay's connection: sends samples within the other end's credit, and publishes the samples
/// that arrive.
pub struct RelaySocket {
    socket: PassedFd,
    buffer: Vec<u8>,
    /// Packets that are sent before any piece of a sample.
    waiting: VecDeque<Vec<u8>>,
    waiting_bytes: usize,
    /// The samples that are being sent.
    pub outgoing: OutgoingFlow<SamplePayload>,
    pub(crate) incoming: IncomingFlow,
    /// Samples that arrived and are not published yet.
    arrived: BTreeMap<FlowChannel, VecDeque<InboundSample>>,
    /// Channels with a handled sample, each with the highest number that arrived.
    begun: BTreeMap<FlowChannel, u64>,
    /// True if an arrived sample waits for a reader to make room.
    blocked: bool,
    /// Channels whose samples are written and not all delivered.
    written: BTreeMap<FlowChannel, Unacknowledged>,
    /// Channels whose responses are written and not all delivered: the number of each response, in order of
    /// arrival.
    undelivered: BTreeMap<FlowChannel, VecDeque<u64>>,
    /// Written responses. The next daemon may send copies of them.
    pub(crate) response_log: Option<ResponseLog>,
    /// The MATCHED messages that this end has sent and received. With these counts both ends distinguish a
    /// channel from an earlier one of the same name.
    said: u64,
    heard: u64,
    /// The other end is gone, and nothing is sent to it any more.
    gone: bool,
    /// Everything that the other end had sent has been received.
    over: bool,
    tally: Arc<RelayCounters>,
    losses: LogLimit,
}

impl RelaySocket {
    /// Creates an end that has sent and received nothing.
    pub fn new(socket: PassedFd, incoming: IncomingFlow, tally: Arc<RelayCounters>) -> Self {
        Self {
            socket,
            buffer: Vec::new(),
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            outgoing: OutgoingFlow::default(),
            incoming,
            arrived: BTreeMap::new(),
            begun: BTreeMap::new(),
            blocked: false,
            written: BTreeMap::new(),
            undelivered: BTreeMap::new(),
            response_log: None,
            said: 0,
            heard: 0,
            gone: false,
            over: false,
            tally,
            losses: LogLimit::default(),
        }
    }

    /// Queues a control message.
    pub fn say(&mut self, message: &SessionMessage) -> Result<(), End> {
        if self.gone {
            return Ok(());
        }
        let packet = message.encode().map_err(|e| End::Other(e.to_string()))?;
        self.waiting_bytes += packet.len();
        self.waiting.push_back(packet);
        self.said += u64::from(matches!(message, SessionMessage::Matched(_)));
        if self.waiting_bytes > MAX_WAITING { Err(End::Deaf) } else { Ok(()) }
    }

    /// Returns whether packets wait for room in the socket.
    fn is_full(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Opens a channel for outgoing samples. The MATCHED message that announces the channel must be sent
    /// before.
    pub fn open_out(&mut self, channel: FlowChannel) {
        self.outgoing.open(channel, self.said);
    }

    /// Opens a channel for incoming samples.
    pub fn open_in(&mut self, channel: FlowChannel) -> Result<(), End> {
        match self.incoming.open(channel, self.heard) {
            Some(credit) => self.say(&SessionMessage::Credit(credit)),
            None => Ok(()),
        }
    }

    /// Closes the channels that `keep` rejects.
    pub fn retain(&mut self, keep: impl Fn(&FlowChannel) -> bool) {
        self.incoming.retain(&keep);
        self.arrived.retain(|channel, _| keep(channel));
        self.written.retain(|channel, _| keep(channel));
        self.undelivered.retain(|channel, _| keep(channel));
        self.begun.retain(|channel, _| keep(channel));
    }

    /// Returns whether a sample waits for a reader.
    pub fn is_blocked(&self) -> bool {
        self.blocked
    }

    /// Returns whether to wake this end when readers make progress.
    pub fn waits_for_readers(&self) -> bool {
        self.blocked || !self.written.is_empty() || !self.undelivered.is_empty()
    }

    /// Ends the connection to an end that is gone or counts as gone. Messages that it has sent are still
    /// received. Nothing is sent to it any more.
    pub fn hang_up(&mut self) {
        // Another process that holds the peer's end can then send no more, so reading comes to an end.
        let _ = shutdown(&self.socket, Shutdown::Both);
        self.gone = true;
        self.waiting.clear();
        self.waiting_bytes = 0;
    }

    /// Returns whether the other end is gone and everything that it had sent is received.
    pub fn is_over(&self) -> bool {
        self.over
    }

    /// Counts, for each writer, the samples that arrived in whole or in part and are not published.
    pub fn unpublished(&self) -> BTreeMap<Gid, u64> {
        let whole = self.arrived.iter().map(|(channel, samples)| (channel, samples.len() as u64));
        let parts = self.incoming.partial().map(|channel| (channel, 1));
        let mut samples = BTreeMap::new();
        for (channel, count) in whole.chain(parts) {
            *samples.entry(channel.writer).or_default() += count;
        }
        samples
    }

    /// Receives packets. Returns the messages other than pieces of samples, and whether more may be
    /// available.
    pub fn receive(&mut self) -> Result<(Vec<SessionMessage>, bool), End> {
        let mut messages = Vec::new();
        for _ in 0..BATCH {
            let message = match socket::receive(&self.socket, &mut self.buffer) {
                Ok(ReceivedMessage { message, descriptors }) if descriptors.is_empty() => message,
                Ok(_) => return Err(End::Descriptors),
                Err(SocketError::NotReady) => return Ok((messages, false)),
                Err(SocketError::Closed) => {
                    self.hang_up();
                    self.over = true;
                    return Ok((messages, false));
                }
                Err(error) => return Err(error.into()),
            };
            match message {
                SessionMessage::SampleFragment(piece) => {
                    if let Some(sample) = self.incoming.piece(piece)? {
                        self.arrived.entry(sample.channel).or_default().push_back(sample);
                    }
                }
                other => {
                    self.heard += u64::from(matches!(other, SessionMessage::Matched(_)));
                    messages.push(other);
                }
            }
        }
        Ok((messages, true))
    }

    /// Writes arrived samples as far as readers have room. Calls `lost` for lost samples. Returns the credit
    /// to [give back](Self::give_back) to the other end.
    pub fn write<'a>(
        &mut self,
        find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
        mut lost: impl FnMut(&Gid, LossReport),
    ) -> Vec<Credit> {
        self.blocked = false;
        let mut credits = Vec::new();
        for (channel, samples) in &mut self.arrived {
            let FlowChannel { writer: gid, client } = channel;
            while let Some(sample) = samples.front_mut() {
                let Some(remote_writer) = find(gid) else { break };
                let number = sample.meta.sequence;
                let before = self.begun.get(channel).copied();
                match judge_loss(std::mem::take(&mut sample.lost), before, number) {
                    0 => {}
                    samples => {
                        lost(gid, LossReport::Before { samples, first: before.is_none() });
                    }
                }
                self.begun.insert(*channel, before.map_or(number, |before| before.max(number)));
                let client = client.as_ref().unwrap_or(gid);
                let mut last = number;
                let repeated =
                    self.response_log.as_ref().is_some_and(|log| log.has(channel, &sample.meta));
                let written = if repeated {
                    Ok(Written::Nobody)
                } else {
                    remote_writer.try_write(client, sample.meta, &sample.payload)
                };
                match written {
                    Ok(Written::Yes) => {
                        self.tally.arrived(sample.payload.len());
                        if let Some(log) = &mut self.response_log {
                            log.add(channel, &sample.meta);
                        }
                    }
                    Ok(Written::Nobody) => {}
                    Err(PublishError::Blocked { .. }) => {
                        self.blocked = true;
                        break;
                    }
                    Err(error) => {
                        last = self.written.get(channel).map_or(0, |before| before.last);
                        lost(gid, LossReport::Unwritten);
                        if let Some(samples) =
                            self.losses.count(Duration::from_nanos(clock::monotonic()))
                        {
                            tracing::error!(%gid, %error, samples, "relayed samples are lost");
                        }
                    }
                }
                if let Some(sample) = samples.pop_front()
                    && let Some(mut credit) = self.incoming.done(&sample)
                {
                    // If other processes carry the sample on, it is only in this process's memory so far.
                    if let Some(over) = remote_writer.delivered_up_to().filter(|over| *over < last)
                    {
                        credit.done = Some(over);
                        self.written
                            .insert(*channel, Unacknowledged { said: over, last, then: number });
                    }
                    if channel.client.is_some() && remote_writer.undelivered(client) > 0 {
                        credit.done = None;
                        self.undelivered.entry(*channel).or_default().push_back(number);
                    }
                    credits.push(credit);
                }
            }
        }
        self.arrived.retain(|_, samples| !samples.is_empty());
        self.written.retain(|channel, Unacknowledged { said, last, then }| {
            let over =
                find(&channel.writer).and_then(RemoteWriter::delivered_up_to).unwrap_or(*last);
            let now = if over < *last { over } else { over.max(*then) };
            if now > *said {
                *said = now;
                credits.push(channel.done(now));
            }
            over < *last
        });
        self.undelivered.retain(|channel, numbers| {
            let client = channel.client.unwrap_or(channel.writer);
            let left = find(&channel.writer).map_or(0, |server| server.undelivered(&client));
            let left = usize::try_from(left).unwrap_or(usize::MAX).min(numbers.len());
            let done = numbers.drain(..numbers.len() - left).next_back();
            credits.extend(done.map(|number| channel.done(number)));
            !numbers.is_empty()
        });
        credits
    }

    /// Sends the other end its credit back, together with the numbers of its delivered samples.
    pub fn give_back(&mut self, credits: Vec<Credit>) -> Result<(), End> {
        credits.into_iter().try_for_each(|credit| self.say(&SessionMessage::Credit(credit)))
    }

    /// Sends samples as far as the socket has room. `take` returns the next sample of a channel that has
    /// credit. Returns whether anything was sent.
    pub fn send(
        &mut self,
        mut take: impl FnMut(&FlowChannel) -> Option<OutboundSample<SamplePayload>>,
    ) -> Result<bool, End> {
        if self.gone {
            return Ok(false);
        }
        for credit in self.incoming.grants() {
            self.say(&SessionMessage::Credit(credit))?;
        }
        let tally = Arc::clone(&self.tally);
        let mut take = |channel: &FlowChannel| {
            take(channel).inspect(|sample| tally.departed(sample.content.len()))
        };
        self.outgoing.fill(&mut take);
        let mut sent = false;
        for _ in 0..BATCH {
            if self.waiting.is_empty() {
                let piece = self.outgoing.next_piece().or_else(|| {
                    self.outgoing.fill(&mut take);
                    self.outgoing.next_piece()
                });
                let Some(piece) = piece else { break };
                self.say(&SessionMessage::SampleFragment(piece))?;
            }
            let Some(packet) = self.waiting.front() else { break };
            match socket::send(&self.socket, packet, &[]) {
                Ok(()) => {
                    sent = true;
                    self.waiting_bytes -= packet.len();
                    self.waiting.pop_front();
                }
                Err(SocketError::NotReady) => break,
                Err(SocketError::Closed) => {
                    self.hang_up();
                    break;
                }
                Err(error) => return Err(error.into()),
            }
        }
        Ok(sent)
    }
}

impl RelaySocket {
    /// Sleeps for at most `left`, until there is work. `end` is the other end's process, whose descriptor
    /// becomes readable when the process ends; the other end then counts as gone.
    pub fn sleep(
        &mut self,
        leader: &ExternalLeader,
        change_signal: &ChangeSignal,
        end: Option<BorrowedFd<'_>>,
        left: Option<Duration>,
    ) {
        let out = if self.is_full() { PollFlags::OUT } else { PollFlags::empty() };
        let mut fds =
            vec![PollFd::new(leader, PollFlags::IN), PollFd::new(change_signal, PollFlags::IN)];
        // A socket at its end of file stays readable for ever.
        if !self.over {
            fds.push(PollFd::new(&self.socket, PollFlags::IN | out));
        }
        let end = end.filter(|_| !self.gone);
        fds.extend(end.map(|end| PollFd::from_borrowed_fd(end, PollFlags::IN)));
        // No event signals that other connections have freed memory in the pool.
        let nap = self.incoming.is_short().then_some(NAP);
        let left = left.into_iter().chain(nap).min().and_then(|left| Timespec::try_from(left).ok());
        let _ = poll(&mut fds, left.as_ref());
        if end.is_some() && fds.pop().is_some_and(|end| !end.revents().is_empty()) {
            self.hang_up();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_losses_count_than_numbers_are_missing() {
        assert_eq!(judge_loss(7, None, 8), 7);
        assert_eq!(judge_loss(u64::MAX, None, 8), 7);
        assert_eq!(judge_loss(u64::MAX, Some(8), 12), 3);
        assert_eq!(judge_loss(2, Some(8), 12), 2, "a gap is not always a loss");
        for number in [0, 1, 8, 9] {
            assert_eq!(judge_loss(u64::MAX, Some(8), number), 0, "{number}");
        }
    }

    #[test]
    fn a_loss_that_no_publisher_can_have_had_does_not_count() {
        assert_eq!(judge_loss(MAX_GAP, None, u64::MAX), MAX_GAP);
        assert_eq!(judge_loss(MAX_GAP + 1, None, u64::MAX), 0);
        assert_eq!(judge_loss(u64::MAX, Some(8), u64::MAX), 0);
    }
}
