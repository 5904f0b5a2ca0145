//! Asks the compressor for the next samples of one flow, if the link is so slow that compression pays.

use std::time::Duration;

use bytes::Bytes;

use super::info::FlowInfo;
use crate::engine::{
    compression::{CompressionReply, PeerCompression, SampleName},
    counters::Counters,
    outbound::queue::Queue,
    quic::connection::Carrier,
};

/// Maximum bytes and number of samples of a flow that are compressed before the link takes them.
const AHEAD: (usize, usize) = (256 << 10, 256);
/// Number of samples that are sent uncompressed after one that did not become shorter.
const PASSED: u32 = 64;

/// The results of compressing the samples of a flow.
#[derive(Debug, Default)]
pub(super) struct Compressing {
    /// Number of samples still to be sent uncompressed, because an earlier one did not become shorter.
    passed: u32,
    /// True if the last sample became shorter. If not, one at a time is tried.
    is_worth_it: bool,
}

impl Compressing {
    /// Asks the compressor for the next samples.
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

    /// Handles the answer for a waiting sample of this length: it became this frame, or does not become shorter.
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
