//! The demo's subscriber: subscribes to every topic of the log, and compares the received messages
//! with the log.

use std::{
    sync::mpsc,
    time::{Duration, Instant},
};

use axon_transport::internal::session::unix_nanos;
use axon_transport::{EndpointSpec, qos::Qos};

use super::{
    events::Event,
    player::end_of_stdin,
    tally::{Arrival, Tally},
};
use crate::{cli, failure::CliError, log::Log, logging, session};

/// The time between two reports of progress.
const REPORT: Duration = Duration::from_millis(200);

/// The time for which it continues to listen after everything has arrived. A repeated message would
/// arrive in this time.
const LISTEN_ON: Duration = Duration::from_millis(300);

/// Runs the subscriber and writes its events to standard output.
pub(crate) fn run(args: &cli::DemoSubscriber) -> Result<(), CliError> {
    let config = logging::configure()?;
    let log = Log::load(&args.file).map_err(CliError::failed)?;
    let session = session::open(&config, "demo subscriber")?;
    let mut subscriptions = Vec::new();
    for topic in &log.survey.topics {
        let spec = EndpointSpec::new(&topic.name, &topic.type_name, Qos::keep_all());
        subscriptions.push(session.create_subscription(spec).map_err(session::failure)?);
    }
    Event::Ready.say()?;

    let stopped = end_of_stdin();
    let mut tally = Tally::new(log.payloads);
    let mut payload = Vec::new();
    let mut reported = Instant::now();
    let mut complete: Option<Instant> = None;
    while complete.is_none_or(|since| since.elapsed() < LISTEN_ON)
        && matches!(stopped.try_recv(), Err(mpsc::TryRecvError::Empty))
    {
        session.wait(|| subscriptions.iter().any(|s| s.has_data()), Some(REPORT / 2));
        for (topic, subscription) in subscriptions.iter().enumerate() {
            while let Some(info) = subscription.take(&mut payload) {
                tally.arrived(Arrival {
                    topic,
                    sequence: info.sequence,
                    published: unix_nanos(info.source_timestamp),
                    received: unix_nanos(info.received_timestamp),
                    payload: &payload,
                });
            }
        }
        if tally.is_complete() {
            complete.get_or_insert_with(Instant::now);
        }
        if reported.elapsed() >= REPORT {
            reported = Instant::now();
            Event::Progress { messages: tally.messages() }.say()?;
        }
    }
    Event::Outcome(tally.finish()).say()?;
    Ok(())
}
