//! Asks whether the next samples of one flow become shorter, while the link is so slow that it pays.

use std::time::Duration;

use bytes::Bytes;

use super::info::FlowInfo;
use crate::engine::{
    compression::{CompressionReply, PeerCompression, SampleName},
    counters::Counters,
    outbound::queue::Queue,
    quic::connection::Carrier,
};

/// Bytes of samples of a flow, and samples, that are compressed before the link takes them.
const AHEAD: (usize, usize) = (256 << 10, 256);
/// After a sample that does not become shorter so many are sent as they are.
const PASSED: u32 = 64;

/// What is known of the samples of a flow.
#[derive(Debug, Default)]
pub(super) struct Compressing {
    /// Samples that are sent as they are, since one before them did not become shorter.
    passed: u32,
    /// Whether the last one became shorter. If not, one at a time is tried.
    is_worth_it: bool,
}

impl Compressing {
    /// Asks for the next samples.
    pub(super) fn ask(
        &mut self,
        info: &FlowInfo,
        queue: &mut Queue,
        carrier: &Carrier<'_>,
        compression: &PeerCompression,
        counters: &Counters,
        now: Duration,
    ) {
        let Some(rate) = carrier.rate.filter(|_| info.compressed) else { return };
        let next = queue.next_ones(AHEAD.0, now).take(AHEAD.1);
        for sample in next {
            if sample.is_asked() && !self.is_worth_it {
                return;
            }
            if !sample.is_undecided() || !compression.pays(sample.length(), rate, now) {
                continue;
            }
            if self.passed > 0 {
                self.passed -= 1;
                sample.set_compressed(None);
                continue;
            }
            // Responses of several servers have the same numbers.
            let name = (!info.is_service()).then(|| SampleName {
                topic: info.route.topic,
                publisher: info.of,
                sequence: sample.info.sequence,
                length: sample.length(),
            });
            match compression.ask(carrier.flow, name, &sample.payload) {
                Some(CompressionReply::Later(order)) => {
                    sample.set_asked(order);
                    if !self.is_worth_it {
                        return;
                    }
                }
                Some(CompressionReply::Known(frame)) => {
                    self.handle_answer(frame.as_ref(), sample.length(), counters);
                    sample.set_compressed(frame);
                }
                None => return,
            }
        }
    }

    /// A sample of this length that waits became this frame, or does not become shorter.
    pub(super) fn handle_answer(
        &mut self,
        frame: Option<&Bytes>,
        length: usize,
        counters: &Counters,
    ) {
        self.is_worth_it = frame.is_some();
        match frame {
            Some(frame) => counters.compressed(length, frame.len()),
            None => self.passed = PASSED,
        }
    }
}
