//! The demo's player: `axon play` that reports events and stays until it is released.

use std::{
    io::Read,
    sync::mpsc,
    time::{Duration, Instant},
};

use axon_transport::qos::Qos;

use super::events::Event;
use crate::{cli, failure::CliError, log::Survey, logging, play, served::Served, session};

/// The time between two reports of progress.
const REPORT: Duration = Duration::from_millis(200);

/// The time in which its publishers have to find their readers.
const MATCH: Duration = Duration::from_secs(35);

/// Runs the player and writes its events to standard output.
pub(crate) fn run(args: &cli::DemoPlayer) -> Result<(), CliError> {
    let config = logging::configure()?;
    let survey = Survey::of(&args.file).map_err(CliError::failed)?;
    let session = session::open(&config, "demo player")?;
    let publishers = play::publishers(&session, &survey, Qos::keep_all())?;
    if let Some(unmatched) = play::wait_matched(&publishers, args.wait, MATCH) {
        let topic = &survey.topics[unmatched].name;
        let reason = format!(
            "{topic} has {} of {} readers after {} s",
            publishers[unmatched].matched().len(),
            args.wait,
            MATCH.as_secs()
        );
        Event::Failed { reason }.say()?;
        return Ok(());
    }
    Event::Ready.say()?;

    let stopped = end_of_stdin();
    let mut reported = Instant::now();
    let mut served = Served::new(Qos::keep_all(), publishers.len());
    let pace = (args.rate, 0);
    let sent = play::replay(&survey, &session, &publishers, &mut served, pace, |progress| {
        if reported.elapsed() >= REPORT {
            reported = Instant::now();
            Event::Progress { messages: progress.messages }.say()?;
        }
        Ok(matches!(stopped.try_recv(), Err(mpsc::TryRecvError::Empty)))
    })?;
    Event::Sent { messages: sent.messages, waits: sent.waits }.say()?;
    // The publishers exist until the subscribers have received everything.
    let _ = stopped.recv();
    Ok(())
}

/// Returns a channel that receives a value, or closes, when standard input ends.
pub(crate) fn end_of_stdin() -> mpsc::Receiver<()> {
    let (ended, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let mut ignored = [0; 64];
        while std::io::stdin().read(&mut ignored).is_ok_and(|count| count > 0) {}
        let _ = ended.send(());
    });
    receiver
}
