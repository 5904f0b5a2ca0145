//! `axon echo`: prints a line for each message of a topic.

use std::{
    collections::HashMap,
    io::{self, Write},
    time::Duration,
};

use axon_transport::internal::session::unix_nanos;
use axon_transport::{
    EndpointSpec, GuardCondition, MessageInfo, Session, Subscription,
    graph::{EndpointKind, GraphView},
    ids::Gid,
    qos::{Qos, Reliability},
};
use serde_json::json;

use crate::{cli, failure::CliError, interrupt, logging, say::say, session, text};

/// The number of payload bytes that a line shows.
const HEAD: usize = 16;

/// The depth of the subscription if no profile is given.
const DEPTH: u32 = 1_000;

/// The time in which an existing topic appears in the graph.
const GRAPH_DELAY: Duration = Duration::from_secs(1);

/// Runs `axon echo`.
pub(crate) fn run(args: &cli::Echo) -> Result<(), CliError> {
    let config = logging::configure()?;
    let session = session::open(&config, "axon echo")?;
    let type_name = match &args.type_name {
        Some(type_name) => type_name.clone(),
        None => find_type(&session, &args.topic),
    };
    let qos = args.qos.map_or_else(|| qos_of(&session, &args.topic), cli::Profile::qos);
    let spec = EndpointSpec::new(&args.topic, &type_name, qos);
    let subscription = session.create_subscription(spec).map_err(session::failure)?;
    let interrupt = interrupt::of(&session)?;
    let mut numbers = Numbers::default();
    let mut left = args.count;
    let outcome = print(args, &mut left, (&session, &subscription, &interrupt), &mut numbers);
    // What comes after the last requested message is not missed.
    if left != Some(0) {
        numbers.look_at_waiting(&subscription);
    }
    let missed = numbers.missing.max(subscription.lost()) + numbers.unprinted;
    if missed > 0 {
        let messages = if missed == 1 { "message" } else { "messages" };
        say(format_args!("axon echo: missed {} {messages}", text::grouped(missed)));
    }
    outcome
}

/// Counts the messages that were not printed. Some are missing among the received ones: they were lost, or dropped
/// because more came than the depth allows. Others were received, but standard output had no room for them.
#[derive(Default)]
struct Numbers {
    /// The last sequence number of each publisher.
    last: HashMap<Gid, u64>,
    missing: u64,
    /// Messages that were received and could not be printed.
    unprinted: u64,
}

impl Numbers {
    fn came(&mut self, info: &MessageInfo) {
        let last = self.last.entry(info.publisher).or_insert(info.sequence);
        let missing = info.sequence.saturating_sub(last.saturating_add(1));
        *last = info.sequence.max(*last);
        // A publisher may send any number. It cannot have published as many messages as a larger gap means.
        if missing < 1 << 32 {
            self.missing += missing;
        }
    }

    /// Takes messages that wait: the first of each publisher shows which ones before it were overwritten, while the
    /// program was stopped or waited for the reader of its output. Those that wait do not count themselves.
    fn look_at_waiting(&mut self, subscription: &Subscription) {
        let mut payload = Vec::new();
        // A publisher may be as fast as this loop.
        for _ in 0..DEPTH {
            let Some(info) = subscription.take(&mut payload) else { break };
            self.came(&info);
        }
    }
}

/// Prints messages until the requested number has been printed, standard output is closed, or a signal comes. `left` is
/// the number that is still to be printed.
fn print(
    args: &cli::Echo,
    left: &mut Option<u64>,
    (session, subscription, interrupt): (&Session, &Subscription, &GuardCondition),
    numbers: &mut Numbers,
) -> Result<(), CliError> {
    let mut payload = Vec::new();
    let mut out = io::stdout().lock();
    while *left != Some(0) {
        session.wait(|| subscription.has_data() || interrupt.is_triggered(), None);
        if interrupt.is_triggered() {
            return match left {
                Some(left) => Err(CliError::failed(format_args!(
                    "interrupted: {left} messages of those asked for did not come"
                ))),
                None => Ok(()),
            };
        }
        while *left != Some(0) && !interrupt.is_triggered() {
            let Some(info) = subscription.take(&mut payload) else { break };
            numbers.came(&info);
            let line = if args.json { as_json(&info, &payload) } else { as_text(&info, &payload) };
            match writeln!(out, "{line}").and_then(|()| out.flush()) {
                Ok(()) => {}
                // The reader of the pipe closed it, so it wants no more lines.
                Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
                Err(error) => {
                    numbers.unprinted += 1;
                    return Err(error.into());
                }
            }
            *left = left.map(|left| left - 1);
        }
    }
    Ok(())
}

/// Returns the type of the topic's first endpoint. Waits until there is one.
fn find_type(session: &Session, topic: &str) -> String {
    let mut found = None;
    let mut look = |graph: &GraphView| {
        let endpoints = graph.endpoints.values().map(|entry| &entry.endpoint);
        let known = endpoints.filter(|endpoint| endpoint.topic == topic).find(|endpoint| {
            matches!(endpoint.kind, EndpointKind::Publisher | EndpointKind::Subscription)
        });
        found = known.map(|endpoint| endpoint.type_name.clone());
        found.is_some()
    };
    if !session.wait_graph(GRAPH_DELAY, &mut look) {
        say(format_args!("axon echo: waiting for {} to appear", text::printable(topic)));
        while !session.wait_graph(Duration::from_secs(3_600), &mut look) {}
    }
    found.unwrap_or_default()
}

/// Returns the QoS to request: RELIABLE unless a publisher of the topic offers BEST_EFFORT.
fn qos_of(session: &Session, topic: &str) -> Qos {
    let graph = session.graph();
    let best_effort = graph.endpoints.values().map(|entry| &entry.endpoint).any(|endpoint| {
        endpoint.topic == topic
            && endpoint.kind == EndpointKind::Publisher
            && endpoint.qos.reliability == Reliability::BestEffort
    });
    let reliability = if best_effort { Reliability::BestEffort } else { Reliability::Reliable };
    Qos::default().with_reliability(reliability).with_depth(DEPTH)
}

fn as_text(info: &MessageInfo, payload: &[u8]) -> String {
    format!(
        "{}  {:>9} B  {:<47}  {}",
        text::instant(unix_nanos(info.source_timestamp)),
        payload.len(),
        text::hex(payload, HEAD),
        text::ascii(payload, HEAD),
    )
}

fn as_json(info: &MessageInfo, payload: &[u8]) -> String {
    json!({
        "source_timestamp_ns": unix_nanos(info.source_timestamp),
        "received_timestamp_ns": unix_nanos(info.received_timestamp),
        "publisher": info.publisher,
        "sequence": info.sequence,
        "size": payload.len(),
        "head": text::hex(payload, HEAD),
    })
    .to_string()
}
