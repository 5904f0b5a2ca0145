//! The texts that name loads, sizes and times in reports.

use std::time::Duration;

use super::{Load, Motion, Wake};
use crate::text;

/// Names how a receiver learns of a message, and how its bytes move.
pub(crate) fn kind(wake: Wake, how: Motion) -> String {
    let wake = match wake {
        Wake::Poll => "polling",
        Wake::Event => "event-driven, one message after the other",
        Wake::EventOneCpu => "event-driven on one CPU",
    };
    format!("{wake}, {}", motion(how))
}

/// Names how a message's bytes move.
pub(crate) fn motion(motion: Motion) -> &'static str {
    match motion {
        Motion::Touch => "in place",
        Motion::Fill => "copied in",
        Motion::Copy => "copied in and out",
    }
}

/// Names the operations of the raw limit.
pub(crate) fn limit(wake: Wake, motion: Motion) -> String {
    let wake = match wake {
        Wake::Poll => "a spin on a shared atomic",
        Wake::Event => "a spin of 50 us, then epoll and eventfd",
        Wake::EventOneCpu => "epoll and eventfd",
    };
    match motion {
        Motion::Touch => wake.to_owned(),
        Motion::Fill => format!("{wake}, and a memcpy from 89 B on"),
        Motion::Copy => format!("{wake}, and two memcpy from 89 B on"),
    }
}

/// Formats a size, in binary units if it is a multiple of one.
pub(crate) fn size(bytes: usize) -> String {
    match bytes {
        b if b >= 1 << 20 && b.is_multiple_of(1 << 20) => format!("{} MiB", b >> 20),
        b if b >= 1 << 10 && b.is_multiple_of(1 << 10) => format!("{} KiB", b >> 10),
        b => text::bytes(b as u64).replace(".0 MB", " MB"),
    }
}

/// Formats the bytes per second at `rate` messages per second, if the bytes are copied.
pub(crate) fn throughput(load: &Load, rate: f64) -> String {
    match load.motion {
        Motion::Touch => "-".to_owned(),
        Motion::Fill | Motion::Copy => text::bytes((rate * load.size as f64) as u64),
    }
}

/// Formats the frequency of messages.
pub(crate) fn pace(pace: Duration) -> String {
    match 1e9 / pace.as_nanos() as f64 {
        hz if hz >= 1000.0 => format!("{} kHz", hz / 1000.0),
        hz => format!("{hz} Hz"),
    }
}

/// Formats a time.
pub(crate) fn nanoseconds(ns: f64) -> String {
    text::duration(ns.max(0.0).round() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_paces_read_well() {
        let sizes = [8, 1 << 10, 64 << 10, 1 << 20, 25_000_000, 100_000].map(size);
        assert_eq!([10, 1].map(|ms| pace(Duration::from_millis(ms))), ["100 Hz", "1 kHz"]);
        assert_eq!(sizes, ["8 B", "1 KiB", "64 KiB", "1 MiB", "25 MB", "100 kB"]);
    }
}
