//! Logs the life of each pair at `debug`: its grant, and the reason for its end. A test can keep all lines and print
//! the history of a pair that lost samples.

use crate::wire::session::Pair;

/// The target of the log lines.
const TARGET: &str = "axon_transport::pairs";

/// Logs for a writer that it serves a reader from position `first` on.
pub(super) fn granted(pair: &Pair, generation: u64, first: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, generation, first, "granted");
}

/// Logs for a reader that it mapped the writer's ring and reads from position `first` on.
pub(super) fn accepted(pair: &Pair, generation: u64, first: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, generation, first, "accepted");
}

/// Logs for a reader that the writer granted again, because the writer had forgotten it.
pub(super) fn forgotten(pair: &Pair) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, "the writer had forgotten the reader");
}

/// Logs for a reader that the writer ended, and that its grant never arrived.
pub(super) fn unmet(pair: &Pair, samples: u64) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, samples, "unmet");
}

/// Logs for a reader or writer that the pair was removed.
pub(super) fn over(pair: &Pair, why: &str) {
    let Pair { reader, writer } = pair;
    tracing::debug!(target: TARGET, %reader, %writer, why, "over");
}
