//! `axon play`: publishes a recorded log with its recorded timing.

use std::{
    io::IsTerminal,
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, Publisher, Session, qos::Qos, status::Status};
use indicatif::{ProgressBar, ProgressStyle};

use crate::{
    cli::{self, Profile},
    failure::CliError,
    log::{LogError, Message, Part, Survey},
    logging,
    say::say,
    served::Served,
    session, text,
};

/// The number of messages that are read ahead of their time.
const READ_AHEAD: usize = 64;
/// The longest wait at the end of a replay while other hosts acknowledge nothing.
const UNACKNOWLEDGED: Duration = Duration::from_secs(15);
/// The status counts losses of links once a second. After this time it includes those of the replay.
const STATUS_INTERVAL: Duration = Duration::from_millis(1_200);
/// The time between two checks for messages that are not acknowledged.
const CHECK_INTERVAL: Duration = Duration::from_millis(10);

impl Profile {
    /// Returns the QoS policies of the profile.
    pub(crate) fn qos(self) -> Qos {
        match self {
            Self::KeepAll => Qos::keep_all(),
            Self::Default => Qos::default(),
            Self::SensorData => Qos::sensor_data(),
        }
    }
}

/// The progress of a replay.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sent {
    /// The number of messages published.
    pub(crate) messages: u64,
    /// The number of their bytes.
    pub(crate) bytes: u64,
    /// How often the publisher waited for a full reader.
    pub(crate) waits: u64,
    /// Messages that were published while their topic had fewer subscriptions than `--wait` requires.
    pub(crate) missed: u64,
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
    let names: Vec<&str> = survey.topics.iter().map(|topic| topic.name.as_str()).collect();
    let dropped_before = Dropped::of(&session, &names);
    let mut served = Served::new(args.qos.qos(), publishers.len());
    let started = Instant::now();
    let bar = progress_bar(&survey);
    let mut total = Sent::default();
    loop {
        let pace = (args.rate, args.wait);
        let sent = replay(&survey, &session, &publishers, &mut served, pace, |sent| {
            bar.set_position(sent.messages);
            Ok(true)
        })?;
        total.messages += sent.messages;
        total.bytes += sent.bytes;
        total.waits += sent.waits;
        total.missed += sent.missed;
        if !args.repeat {
            break;
        }
    }
    bar.finish_and_clear();
    wait_acknowledged(&publishers, UNACKNOWLEDGED);
    let outcome = Outcome::of(&publishers, &served);
    let Sent { messages, bytes, waits, missed } = total;
    let waited = match args.qos {
        Profile::KeepAll => format!(
            "{} acknowledged; waited {} times for a reader",
            text::grouped(outcome.acknowledged),
            text::grouped(waits)
        ),
        Profile::Default => "--qos default waits for no reader".to_owned(),
        Profile::SensorData => "--qos sensor-data waits for no reader".to_owned(),
    };
    say(format_args!(
        "axon play: {} messages, {} in {}; {waited}",
        text::grouped(messages),
        text::bytes(bytes),
        text::duration(started.elapsed().as_nanos() as u64),
    ));
    if let Some(others) = served.others() {
        let dropped = dropped_before.and_then(|before| {
            thread::sleep(STATUS_INTERVAL);
            before.since(&Dropped::of(&session, &names)?)
        });
        say(format_args!("axon play: {}", unpromised(&others, &outcome, dropped)));
    }
    unheard(outcome.left, outcome.given_up, missed)
}

/// The state of a replay's messages at its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Outcome {
    /// Messages that their RELIABLE and KEEP_ALL subscriptions have received.
    acknowledged: u64,
    /// Messages of topics with such subscriptions that are not acknowledged.
    left: u64,
    /// Messages of such topics that will never be acknowledged.
    given_up: u64,
    /// Messages of other topics that are not acknowledged or will never be.
    unpromised: u64,
}

impl Outcome {
    fn of(publishers: &[Publisher], served: &Served) -> Self {
        let mut outcome = Self::default();
        for (index, publisher) in publishers.iter().enumerate() {
            let counts = (publisher.unacknowledged(), publisher.given_up());
            outcome.add(served.kept(index), counts);
        }
        outcome
    }

    /// Adds a publisher. For `kept` of its messages a subscription was promised everything.
    fn add(&mut self, kept: u64, (left, given_up): (u64, u64)) {
        if kept == 0 {
            self.unpromised += left + given_up;
        } else {
            self.acknowledged += kept.saturating_sub(left).saturating_sub(given_up);
            self.left += left;
            self.given_up += given_up;
        }
    }
}

/// Samples of the replay's topics that this host's daemon dropped, as its status reports.
struct Dropped {
    daemon: String,
    samples: u64,
}

impl Dropped {
    /// Reads the count from the status. Returns `None` if there is no status.
    fn of(session: &Session, topics: &[&str]) -> Option<Self> {
        let status: Status = serde_json::from_str(&session.status_json().ok()?).ok()?;
        let own = status.topics.iter().filter(|topic| topics.contains(&topic.topic.as_str()));
        let samples = own.filter_map(|topic| topic.dropped.get("queue")).sum();
        Some(Self { daemon: status.daemon, samples })
    }

    /// Returns how many samples were dropped between `self` and `now`. Returns `None` if `now` is of another daemon.
    fn since(&self, now: &Self) -> Option<u64> {
        (self.daemon == now.daemon).then(|| now.samples.saturating_sub(self.samples))
    }
}

/// Returns the message about subscriptions that were not promised everything.
fn unpromised(others: &str, outcome: &Outcome, dropped: Option<u64>) -> String {
    let mut text = others.to_owned();
    if let Some(dropped) = dropped.filter(|dropped| *dropped > 0) {
        let dropped = text::grouped(dropped);
        text += &format!("; this host's daemon dropped at least {dropped} for newer ones");
    }
    if outcome.unpromised > 0 {
        let unpromised = text::grouped(outcome.unpromised);
        text += &format!("; {unpromised} more may not have left this host");
    }
    text
}

/// Waits until other hosts have acknowledged everything. Gives up after `patience` without a new acknowledgement.
fn wait_acknowledged(publishers: &[Publisher], patience: Duration) {
    let left = || publishers.iter().map(Publisher::unacknowledged).sum::<u64>();
    let (mut least, mut since) = (left(), Instant::now());
    while least > 0 && since.elapsed() < patience {
        thread::sleep(CHECK_INTERVAL);
        let now = left();
        if now < least {
            (least, since) = (now, Instant::now());
        }
    }
}

/// Returns an error if the replay may not have reached each subscription that was promised everything.
fn unheard(left: u64, given_up: u64, missed: u64) -> Result<(), CliError> {
    let mut why = Vec::new();
    if left > 0 {
        let seconds = UNACKNOWLEDGED.as_secs();
        let left = text::grouped(left);
        why.push(format!("{left} messages were not acknowledged, none of them for {seconds} s"));
    }
    if given_up > 0 {
        let given_up = text::grouped(given_up);
        why.push(format!(
            "{given_up} messages were given up (a link or a daemon ended, a host read nothing, or a limit dropped them)"
        ));
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

/// Creates a publisher for each topic of the log.
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

/// Waits until every publisher has `count` readers. Returns the index of a publisher that did not have them in time.
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

/// Publishes the log at `rate` times its pace, in the order of the file. A message that was recorded before its
/// predecessor is published at once. The result counts messages of topics with fewer subscriptions than `readers`.
/// `served` counts messages for which a subscription was promised everything. `progress` returns whether to continue.
pub(crate) fn replay(
    survey: &Survey,
    session: &Session,
    publishers: &[Publisher],
    served: &mut Served,
    (rate, readers): (f64, usize),
    mut progress: impl FnMut(Sent) -> std::io::Result<bool>,
) -> Result<Sent, CliError> {
    let mut sent = Sent::default();
    let mut pace = None;
    for message in read_ahead(survey)? {
        let message = message.map_err(CliError::failed)?;
        let pace = *pace.get_or_insert_with(|| Pace::new(message.time, rate));
        thread::sleep(pace.until(message.time, Instant::now()));
        // The subscriptions are read before the message is published, because a subscription may end as soon as it has
        // the last message.
        let matched = publishers[message.topic].matched();
        let there = matched.len();
        served.look(session, message.topic, matched);
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
        served.count(message.topic);
        sent.missed += u64::from(there < readers);
        sent.messages += 1;
        sent.bytes += message.data.len() as u64;
        if !progress(sent)? {
            return Ok(sent);
        }
    }
    Ok(sent)
}

/// Reads and decompresses in another thread, so that neither delays publication.
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

/// Maps recorded time to current time.
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

    /// Returns how long to wait at `now` for a message recorded at `time`.
    fn until(&self, time: u64, now: Instant) -> Duration {
        if self.rate == 0.0 {
            return Duration::ZERO;
        }
        let recorded = Duration::from_nanos(time.saturating_sub(self.first));
        // A time beyond the range of the clock (a rate near zero) is waited for one day at a time.
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
            ((0, 2000, 0), "2,000 messages were given up"),
            ((0, 0, 3), "3 messages found fewer"),
        ] {
            match unheard(counts.0, counts.1, counts.2) {
                Err(CliError::Failed(text)) => assert!(text.contains(part), "{text}"),
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn messages_that_no_subscription_was_promised_fail_nothing() {
        let mut outcome = Outcome::default();
        outcome.add(0, (3, 4));
        assert_eq!(outcome, Outcome { unpromised: 7, ..Outcome::default() });
        outcome.add(100, (20, 5));
        let expected = Outcome { acknowledged: 75, left: 20, given_up: 5, unpromised: 7 };
        assert_eq!(outcome, expected);
        outcome.add(1, (2, 0));
        assert_eq!((outcome.acknowledged, outcome.left), (75, 22));
    }

    #[test]
    fn known_losses_of_subscriptions_without_a_delivery_promise_are_reported() {
        let outcome = Outcome { unpromised: 1, ..Outcome::default() };
        assert_eq!(unpromised("others", &Outcome::default(), None), "others");
        assert_eq!(unpromised("others", &Outcome::default(), Some(0)), "others");
        let text = unpromised("others", &outcome, Some(5_839));
        assert!(text.contains("dropped at least 5,839"), "{text}");
        assert!(text.contains("1 more may not have left"), "{text}");
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
