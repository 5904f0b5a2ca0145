//! The log of a daemon: lines on standard error, or in a file that is rotated.
//!
//! Logging never ends a daemon: a line that cannot be written is dropped. A peer or another user cannot fill a file
//! system through the log: each kind of line has a rate limit (`throttle`), and the file has a size limit (`output`).

mod output;
mod throttle;

use std::{fmt, sync::OnceLock, time::Instant};

use axon_transport::{config::Config, internal::text::is_plain};
use tracing::{Event, Level, Subscriber, callsite};
use tracing_subscriber::{
    EnvFilter,
    fmt::{
        FmtContext, FormatEvent, FormatFields,
        format::{Format, Writer},
    },
    registry::LookupSpan,
};

pub(super) use self::output::keep_in;
use self::throttle::Throttle;

/// Sends this process's log lines to standard error, filtered by `AXON_LOG`. For a program's `main`; if a subscriber is
/// set already, that one stays.
pub fn start(config: &Config) {
    // A program that checks its configuration refuses a wrong filter; warnings are shown without one.
    let filter = EnvFilter::try_new(&config.log).unwrap_or_else(|_| EnvFilter::new("warn"));
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(|| output::LogOutput)
        // A line that cannot be written is dropped; the default prints that to standard error, and panics if that fails
        // as well.
        .log_internal_errors(false)
        .event_format(LineFormat { format: Format::default(), throttle: Throttle::default() })
        .with_filter_reloading();
    let filter = lines.reload_handle();
    let set = lines.try_init();
    if set.is_err() {
        return tracing::debug!("logging was set up before");
    }
    let _ = SET_FILTER.set(Box::new(move |new| drop(filter.reload(new))));
}

/// The function that changes the filter of the subscriber that [`start`] set.
type SetFilter = Box<dyn Fn(EnvFilter) + Send + Sync>;

static SET_FILTER: OnceLock<SetFilter> = OnceLock::new();

/// Sets the filter to this `AXON_LOG` text.
pub(super) fn set_filter(text: &str) {
    if let (Some(set), Ok(filter)) = (SET_FILTER.get(), EnvFilter::try_new(text)) {
        set(filter);
    }
}

/// The format of log lines: one line for each event, of plain characters, with a rate limit for each kind.
struct LineFormat {
    format: Format,
    /// The throttle counts by the place in the code, not by the text: the cause of a flood may choose the text.
    throttle: Throttle<callsite::Identifier>,
}

impl<S, N> FormatEvent<S, N> for LineFormat
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let metadata = event.metadata();
        let left_out = if *metadata.level() <= Level::INFO {
            match self.throttle.admit(metadata.callsite(), Instant::now()) {
                Some(left_out) => left_out,
                None => return Ok(()),
            }
        } else {
            // DEBUG and TRACE are only on if a user asked for all details.
            0
        };
        let mut line = String::new();
        self.format.format_event(context, Writer::new(&mut line), event)?;
        for c in line.trim_end_matches('\n').chars() {
            if is_plain(c) {
                writer.write_char(c)?;
            } else {
                write!(writer, "{}", c.escape_unicode())?;
            }
        }
        if left_out > 0 {
            write!(writer, " ({left_out} lines of this kind were left out before)")?;
        }
        writer.write_char('\n')
    }
}
