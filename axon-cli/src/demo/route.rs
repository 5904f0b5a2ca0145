//! Replays a log once: a player and a subscriber on host A, a subscriber on host B.

use std::{cell::Cell, ffi::OsString, path::Path, time::Duration};

use serde_json::Value;
use tokio::time::Instant;

use super::{
    DemoError,
    events::Event,
    hosts::Host,
    kmes::{KeysHandedOut, Kmes},
    mode::Mode,
    process::Process,
    progress::Progress,
    report::Row,
    tally::RunTally,
};

/// The time in which a process has to get ready. It includes bootstrap with slow KMEs.
const READY: Duration = Duration::from_secs(40);

/// The time without a message after which a subscriber stops waiting for the rest.
const SILENCE: Duration = Duration::from_secs(15);

/// Two running hosts.
#[derive(Debug)]
pub(crate) struct Pair {
    /// The host that publishes the log.
    pub(crate) a: Host,
    /// The host that receives the log.
    pub(crate) b: Host,
}

/// The log to replay, and its pace.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Replay<'a> {
    /// The log.
    pub(crate) file: &'a Path,
    /// The speed, as a multiple of the recorded pace.
    pub(crate) rate: f64,
    /// The number of messages in the log.
    pub(crate) messages: u64,
}

/// The results of one replay.
#[derive(Debug)]
pub(crate) struct Outcomes {
    /// The result of the subscriber on host A.
    pub(crate) local: Row,
    /// The result of the subscriber on host B.
    pub(crate) remote: Row,
}

/// Replays the log between the hosts of `pair`.
pub(crate) async fn run(
    mode: Mode,
    pair: &Pair,
    kmes: &Kmes,
    keys_before: Option<KeysHandedOut>,
    replay: Replay<'_>,
    progress: &Progress,
) -> Result<Outcomes, DemoError> {
    let file: OsString = replay.file.into();
    let subscriber = |host: &Host| {
        host.spawn("subscriber", &["demo-subscriber".into(), "--file".into(), file.clone()])
    };
    progress.step(mode.route(), "starting the subscribers");
    let mut local = subscriber(&pair.a)?;
    let mut remote = subscriber(&pair.b)?;
    ready(&mut local).await?;
    ready(&mut remote).await?;

    progress.step(mode.route(), "matching");
    let rate = replay.rate.to_string().into();
    let player_args = ["demo-player".into(), "--file".into(), file, "--rate".into(), rate];
    let mut args = player_args.to_vec();
    args.extend(["--wait".into(), "2".into()]);
    let mut player = pair.a.spawn("player", &args)?;
    ready(&mut player).await?;

    progress.step(mode.route(), "replaying");
    let sent = Cell::new(None);
    let quiet = Progress::hidden();
    let (waits, here, there) = tokio::try_join!(
        play(&mut player, &sent),
        receive(&mut local, &sent, &quiet),
        receive(&mut remote, &sent, progress),
    )?;
    progress.finished(replay.messages);

    // The negotiated properties are read while the link that carried the messages still exists.
    let link = Negotiated::of(&pair.b.status().await?);
    for process in [player, local, remote] {
        process.stop().await;
    }
    let keys = kmes.handed_out().zip(keys_before).filter(|_| mode.is_qkd());
    let keys = keys.map(|(now, before)| now - before);
    Ok(Outcomes {
        local: Row::new("shared memory", here, waits, None, None),
        remote: Row::new(mode.route(), there, waits, Some(link), keys),
    })
}

/// The properties that the link's handshake negotiated, as the daemon's status reports them.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub(crate) struct Negotiated {
    /// The key exchange.
    pub(crate) key_exchange: String,
    /// The cipher.
    pub(crate) cipher: String,
}

impl Negotiated {
    fn of(status: &Value) -> Self {
        let link = status["links"].as_array().and_then(|links| {
            links.iter().find(|link| link["state"] == "connected").or(links.first())
        });
        let text =
            |key: &str| link.and_then(|link| link[key].as_str()).unwrap_or("unknown").to_owned();
        Self { key_exchange: text("key_exchange"), cipher: text("cipher") }
    }
}

async fn ready(process: &mut Process) -> Result<(), DemoError> {
    match tokio::time::timeout(READY, process.event()).await {
        Ok(Ok(Event::Ready)) => Ok(()),
        Ok(Ok(event)) => Err(process.unexpected(&event)),
        Ok(Err(error)) => Err(error),
        Err(_) => Err(process.late("ready", READY)),
    }
}

/// Follows the player to the end of the log. Returns how often it had to wait.
async fn play(player: &mut Process, sent: &Cell<Option<Instant>>) -> Result<u64, DemoError> {
    loop {
        match player.event().await? {
            Event::Progress { .. } => {}
            Event::Sent { waits, .. } => {
                sent.set(Some(Instant::now()));
                return Ok(waits);
            }
            event => return Err(player.unexpected(&event)),
        }
    }
}

/// Follows a subscriber until it has the whole log, or until nothing more arrives for `SILENCE`
/// after the last message was sent.
async fn receive(
    subscriber: &mut Process,
    sent: &Cell<Option<Instant>>,
    progress: &Progress,
) -> Result<RunTally, DemoError> {
    let mut received = (0, Instant::now());
    loop {
        match tokio::time::timeout(SILENCE, subscriber.event()).await {
            Ok(Ok(Event::Progress { messages })) => {
                if messages > received.0 {
                    received = (messages, Instant::now());
                }
                progress.received(messages);
            }
            Ok(Ok(Event::Outcome(outcome))) => return Ok(outcome),
            Ok(Ok(event)) => return Err(subscriber.unexpected(&event)),
            Ok(Err(error)) => return Err(error),
            Err(_) => return Err(subscriber.late("heard of", SILENCE)),
        }
        if sent.get().is_some_and(|sent| sent.max(received.1).elapsed() > SILENCE) {
            // The other messages are lost. The subscriber reports those that it has.
            subscriber.release().await;
        }
    }
}
