//! What a link's QUIC connection measures and what waits for it: why a link is slow.

use std::time::Duration;

use axon_transport::status::{CompressedStatus, LinkStatus, StandbyStatus, WaitingStatus};

use super::{dash, nanoseconds};
use crate::text::{self, TextTable, grouped};

/// A row for each link.
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

/// The address of the link that stands by, and its round trip.
fn second_path(standby: Option<&StandbyStatus>) -> String {
    standby.map_or_else(dash, |standby| {
        format!("{}, {}", standby.address, text::duration(nanoseconds(standby.rtt)))
    })
}

/// How many samples were compressed, and their bytes before and after.
fn compressed(compressed: &CompressedStatus) -> String {
    let CompressedStatus { samples, bytes, bytes_sent, .. } = *compressed;
    if samples == 0 {
        return dash();
    }
    format!("{}: {} to {}", grouped(samples), text::bytes(bytes), text::bytes(bytes_sent))
}

/// The classes of which something waits, in the order in which they are served.
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
