//! `axon play`: a recorded log, published as it was recorded.

use std::{
    io::IsTerminal,
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, Publisher, Session, qos::Qos};
use indicatif::{ProgressBar, ProgressStyle};

use crate::{
    cli::{self, Profile},
    failure::CliError,
    log::{LogError, Message, Part, Survey},
    logging,
    say::say,
    session, text,
};

/// Messages read ahead of their time.
const READ_AHEAD: usize = 64;
/// Messages that other hosts do not acknowledge are waited for so long.
const UNACKNOWLEDGED: Duration = Duration::from_secs(15);
/// Between two looks at them.
const LOOK: Duration = Duration::from_millis(10);

impl Profile {
    /// The policies of the profile.
    pub(crate) fn qos(self) -> Qos {
        match self {
            Self::KeepAll => Qos::keep_all(),
            Self::Default => Qos::default(),
            Self::SensorData => Qos::sensor_data(),
        }
    }
}

/// How far a replay is.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sent {
    /// Messages published.
    pub(crate) messages: u64,
    /// Their bytes.
    pub(crate) bytes: u64,
    /// How often a full reader made the publisher wait.
    pub(crate) waits: u64,
    /// Messages that were published while their topic had fewer subscriptions than were waited for.
    pub(crate) missed: u64,
    /// Messages that were published while their topic had none.
    pub(crate) unread: u64,
}

/// Runs `axon play`.
pub(crate) fn run(args: &cli::Play) -> Result<(), CliError> {
    let config = logging::configure()?;
    let part = match (args.incomplete, args.unverified) {
        (false, _) => Part::Nothing,
        (true, false) => Part::Verified,
        (true, true) => Part::Unverified,
    };
    let survey = Survey::of_part(&args.file, part).map_err(CliError::failed)?;
    if let Some(damage) = &survey.damage {
        let (messages, time) = (text::grouped(survey.messages), text::duration(survey.duration));
        let file = survey.path.display();
        say(format_args!(
            "axon play: {file} is damaged ({damage}); playing the {messages} messages, {time}, before"
        ));
        if survey.unverified > 0 {
            let unverified = text::grouped(survey.unverified);
            say(format_args!(
                "axon play: {unverified} of them are covered by no checksum that was right, and may be wrong"
            ));
        }
    }
    let session = session::open(&config, "axon play")?;
    let publishers = publishers(&session, &survey, args.qos.qos())?;
    if args.wait > 0 {
        say(format_args!("axon play: waiting for {} subscriptions a topic", args.wait));
        wait_matched(&publishers, args.wait, Duration::MAX);
    }
    let started = Instant::now();
    let bar = progress_bar(&survey);
    let mut total = Sent::default();
    loop {
        let sent = replay(&survey, &publishers, (args.rate, args.wait), |sent| {
            bar.set_position(sent.messages);
            Ok(true)
        })?;
        total.messages += sent.messages;
        total.bytes += sent.bytes;
        total.waits += sent.waits;
        total.missed += sent.missed;
        total.unread += sent.unread;
        if !args.repeat {
            break;
        }
    }
    bar.finish_and_clear();
    let left = wait_acknowledged(&publishers, UNACKNOWLEDGED);
    let given_up = publishers.iter().map(Publisher::given_up).sum::<u64>();
    let Sent { messages, bytes, waits, missed, unread } = total;
    let read = messages.saturating_sub(unread);
    let acknowledged = read.saturating_sub(left).saturating_sub(given_up);
    say(format_args!(
        "axon play: {} messages, {} in {}; {} acknowledged; waited {} times for a reader",
        text::grouped(messages),
        text::bytes(bytes),
        text::duration(started.elapsed().as_nanos() as u64),
        text::grouped(acknowledged),
        text::grouped(waits),
    ));
    unheard(left, given_up, missed)
}

/// Waits until other hosts have acknowledged what was published, for as long as that gets on; how many
/// messages they have not.
fn wait_acknowledged(publishers: &[Publisher], patience: Duration) -> u64 {
    let left = || publishers.iter().map(Publisher::unacknowledged).sum::<u64>();
    let (mut least, mut since) = (left(), Instant::now());
    while least > 0 && since.elapsed() < patience {
        thread::sleep(LOOK);
        let now = left();
        if now < least {
            (least, since) = (now, Instant::now());
        }
    }
    least
}

/// Why a replay is not known to have reached everybody, if so.
fn unheard(left: u64, given_up: u64, missed: u64) -> Result<(), CliError> {
    let mut why = Vec::new();
    if left > 0 {
        let seconds = UNACKNOWLEDGED.as_secs();
        let left = text::grouped(left);
        why.push(format!("{left} messages were not acknowledged, none of them for {seconds} s"));
    }
    if given_up > 0 {
        let given_up = text::grouped(given_up);
        why.push(format!("{given_up} messages were lost with a link or a daemon"));
    }
    if missed > 0 {
        let missed = text::grouped(missed);
        why.push(format!("{missed} messages found fewer subscriptions than --wait asks for"));
    }
    if why.is_empty() {
        return Ok(());
    }
    let why = why.join("; ");
    Err(CliError::failed(format_args!("{why}. `axon status` on both hosts shows links and losses")))
}

/// A publisher for each topic of the log.
pub(crate) fn publishers(
    session: &Session,
    survey: &Survey,
    qos: Qos,
) -> Result<Vec<Publisher>, CliError> {
    let publisher = |topic: &crate::log::Topic| {
        let spec = EndpointSpec::new(&topic.name, &topic.type_name, qos);
        session.create_publisher(spec).map_err(session::failure)
    };
    survey.topics.iter().map(publisher).collect()
}

/// Waits until every publisher has `count` readers; the index of one that has not in time.
pub(crate) fn wait_matched(
    publishers: &[Publisher],
    count: usize,
    timeout: Duration,
) -> Option<usize> {
    let started = Instant::now();
    publishers.iter().position(|publisher| {
        !publisher.wait_matched(count, timeout.saturating_sub(started.elapsed()))
    })
}

/// Publishes the log at `rate` times its pace, in the order of the file: a message that was
/// recorded before the one in front of it goes at once. Messages of topics with fewer subscriptions than
/// `readers` are counted. `progress` says whether to go on.
pub(crate) fn replay(
    survey: &Survey,
    publishers: &[Publisher],
    (rate, readers): (f64, usize),
    mut progress: impl FnMut(Sent) -> std::io::Result<bool>,
) -> Result<Sent, CliError> {
    let mut sent = Sent::default();
    let mut pace = None;
    for message in read_ahead(survey)? {
        let message = message.map_err(CliError::failed)?;
        let pace = *pace.get_or_insert_with(|| Pace::new(message.time, rate));
        thread::sleep(pace.until(message.time, Instant::now()));
        // Before: a subscription that got the last message may leave with it.
        let there = publishers[message.topic].matched().len();
        loop {
            match publishers[message.topic].publish(&message.data) {
                Ok(_) => break,
                Err(PublishError::Blocked { .. }) => sent.waits += 1,
                Err(error) => {
                    let topic = &survey.topics[message.topic].name;
                    return Err(CliError::failed(format_args!("{topic}: {error}")));
                }
            }
            if !progress(sent)? {
                return Ok(sent);
            }
        }
        sent.missed += u64::from(there < readers);
        sent.unread += u64::from(there == 0);
        sent.messages += 1;
        sent.bytes += message.data.len() as u64;
        if !progress(sent)? {
            return Ok(sent);
        }
    }
    Ok(sent)
}

/// Reads and decompresses on a thread of its own, so that neither disturbs the pace.
fn read_ahead(
    survey: &Survey,
) -> Result<impl Iterator<Item = Result<Message, LogError>> + use<>, CliError> {
    let messages = survey.messages().map_err(CliError::failed)?;
    let (sender, receiver) = mpsc::sync_channel(READ_AHEAD);
    thread::spawn(move || {
        for message in messages {
            if sender.send(message).is_err() {
                break;
            }
        }
    });
    Ok(receiver.into_iter())
}

/// Maps recorded time to time now.
#[derive(Clone, Copy, Debug)]
struct Pace {
    start: Instant,
    first: u64,
    rate: f64,
}

impl Pace {
    fn new(first: u64, rate: f64) -> Self {
        Self { start: Instant::now(), first, rate }
    }

    /// How long to wait at `now` for a message recorded at `time`.
    fn until(&self, time: u64, now: Instant) -> Duration {
        if self.rate == 0.0 {
            return Duration::ZERO;
        }
        let recorded = Duration::from_nanos(time.saturating_sub(self.first));
        // A time that no clock reaches (a rate next to zero) is waited for a day at a time.
        let due = Duration::try_from_secs_f64(recorded.as_secs_f64() / self.rate)
            .unwrap_or(Duration::MAX);
        due.saturating_sub(now.duration_since(self.start)).min(Duration::from_secs(86_400))
    }
}

fn progress_bar(survey: &Survey) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(survey.messages);
    if let Ok(style) =
        ProgressStyle::with_template("{bar:40} {human_pos}/{human_len} {per_sec} {eta}")
    {
        bar.set_style(style.progress_chars("=> "));
    }
    bar
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_replay_that_is_not_known_to_have_arrived_fails_and_says_why() {
        assert!(unheard(0, 0, 0).is_ok());
        for (counts, part) in [
            ((1, 0, 0), "1 messages were not acknowledged"),
            ((0, 2000, 0), "2,000 messages were lost"),
            ((0, 0, 3), "3 messages found fewer"),
        ] {
            match unheard(counts.0, counts.1, counts.2) {
                Err(CliError::Failed(text)) => assert!(text.contains(part), "{text}"),
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn pace_is_kept_and_never_overflows() {
        let second = 1_000_000_000;
        let pace = Pace::new(5 * second, 2.0);
        let now = pace.start;
        assert_eq!(pace.until(5 * second, now), Duration::ZERO);
        assert_eq!(pace.until(0, now), Duration::ZERO, "recorded out of order");
        assert_eq!(pace.until(9 * second, now), Duration::from_secs(2));
        assert_eq!(pace.until(9 * second, now + Duration::from_secs(3)), Duration::ZERO);
        let slow = Pace::new(0, f64::MIN_POSITIVE);
        assert_eq!(slow.until(u64::MAX, slow.start), Duration::from_secs(86_400));
        assert_eq!(Pace::new(0, 0.0).until(u64::MAX, now), Duration::ZERO);
    }
}
