//! Shows the measurements of a link's QUIC connection and its waiting data, which explain why a
//! link is slow.

use std::time::Duration;

use axon_transport::status::{CompressedStatus, LinkStatus, StandbyStatus, WaitingStatus};

use super::{dash, nanoseconds};
use crate::text::{self, TextTable, grouped};

/// Returns a row for each link.
pub(super) fn paths(links: &[LinkStatus]) -> TextTable {
    let mut table = TextTable::new(&[
        "host",
        ">rtt",
        ">shortest",
        ">window",
        ">packet",
        ">sent",
        ">lost",
        ">marked in",
        ">marked out",
        "compressed",
        "waiting",
        ">oldest",
        "second path",
    ]);
    for link in links {
        let time = |time: Duration| text::duration(nanoseconds(time));
        table.row([
            link.host.clone(),
            time(link.rtt),
            time(link.rtt_min),
            text::bytes(link.congestion_window),
            text::bytes(link.mtu),
            grouped(link.packets_sent),
            format!("{} ({})", grouped(link.packets_lost), text::bytes(link.bytes_lost)),
            grouped(link.ecn_marks_in),
            grouped(link.ecn_marks_out),
            compressed(&link.compressed),
            waiting(&link.waiting),
            time(link.oldest_waits),
            second_path(link.standby.as_ref()),
        ]);
    }
    table
}

/// Returns the address of the standby link and its round-trip time.
fn second_path(standby: Option<&StandbyStatus>) -> String {
    standby.map_or_else(dash, |standby| {
        format!("{}, {}", standby.address, text::duration(nanoseconds(standby.rtt)))
    })
}

/// Returns how many samples were compressed, and their bytes before and after compression.
fn compressed(compressed: &CompressedStatus) -> String {
    let CompressedStatus { samples, bytes, bytes_sent, .. } = *compressed;
    if samples == 0 {
        return dash();
    }
    format!("{}: {} to {}", grouped(samples), text::bytes(bytes), text::bytes(bytes_sent))
}

/// Returns the classes with waiting data, in the order in which they are served.
fn waiting(waiting: &WaitingStatus) -> String {
    let WaitingStatus { control, services, small_reliable, small_best_effort, bulk, .. } = *waiting;
    let classes = [
        (control, "control"),
        (services, "services"),
        (small_reliable, "small"),
        (small_best_effort, "small best effort"),
        (bulk, "bulk"),
    ];
    let classes = classes.iter().filter(|(bytes, _)| *bytes > 0);
    let classes: Vec<String> =
        classes.map(|(bytes, class)| format!("{} {class}", text::bytes(*bytes))).collect();
    if classes.is_empty() { dash() } else { classes.join(", ") }
}
