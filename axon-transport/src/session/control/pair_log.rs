//! Logs the life of each pair at `debug`: its grant, and the reason for its end. A test can keep all lines and print
//! the history of a pair that lost samples.

use crate::wire::session::Pair;

/// The target of the log lines.
const TARGET: &str = "axon_transport::pairs";

/// Writer: a reader is served from position `first` on.
pub(super) fn granted(pair: &Pair, generation: u64, first: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, generation, first, "granted");
}

/// Reader: the writer's ring is mapped and read from position `first` on.
pub(super) fn accepted(pair: &Pair, generation: u64, first: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, generation, first, "accepted");
}

/// Reader: the writer granted again, because it had forgotten the reader.
pub(super) fn forgotten(pair: &Pair) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, "the writer had forgotten the reader");
}

/// Reader: the writer ended, and its grant never arrived.
pub(super) fn unmet(pair: &Pair, samples: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, samples, "unmet");
}

/// Reader or writer: the pair was removed.
pub(super) fn over(pair: &Pair, why: &str) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, why, "over");
}
