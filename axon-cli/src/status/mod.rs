//! `axon status`: shows the daemon's status as tables.

mod paths;

use std::{
    collections::BTreeMap, fmt::Write as _, io::Write as _, process::ExitCode, time::Duration,
};

use axon_transport::{
    config::DaemonLocation,
    internal::session::unix_nanos,
    status::{LinkStatus, RelayStatus, SessionStatus, Status, TopicStatus},
};
use serde_json::Value;

use crate::{
    cli,
    failure::CliError,
    logging,
    say::say,
    text::{self, TextTable, grouped},
};

/// Runs `axon status`.
///
/// # Errors
/// A setting that locates the daemon is wrong, or the daemon's answer cannot be shown.
pub(crate) fn run(args: &cli::Status) -> Result<ExitCode, CliError> {
    // The status of a running daemon is shown even if this host's settings or files are wrong.
    let wrong = match logging::configure().and_then(|config| Ok(config.with_rules_of_host()?)) {
        Ok(config) => {
            if let Some(line) = config.unknown_variables() {
                say(format_args!("axon: {line}"));
            }
            axon_daemon::check(&config).map_err(CliError::failed).err()
        }
        Err(failure) => Some(failure),
    };
    let status = wrong.as_ref().map(CliError::report);
    let json =
        match DaemonLocation::from_env().map(|place| axon_transport::daemon_status_at(&place)) {
            Ok(Ok(json)) => json,
            Ok(Err(error)) => {
                let failure = crate::session::failure(error);
                let said = failure.report();
                return Ok(status.unwrap_or(said));
            }
            // The first error was already reported, so a second setting is not reported.
            Err(error) => return status.ok_or(error.into()),
        };
    let text = if args.json {
        let value: Value = serde_json::from_str(&json).map_err(CliError::failed)?;
        let json = serde_json::to_string_pretty(&value).map_err(CliError::failed)?;
        text::printable_json(&json) + "\n"
    } else {
        render(&serde_json::from_str(&json).map_err(CliError::failed)?)
    };
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(ExitCode::SUCCESS)
}

/// The text that replaces the details that the daemon does not report to another user.
const WITHHELD: &str = "\nThe daemon belongs to another user and has access rules: it tells no other user its settings, \
                        rules, links, topics and sessions. Its own user sees them with `axon status`.\n";

/// Formats the status as text.
fn render(status: &Status) -> String {
    let mut out = String::new();
    heading(&mut out, "Daemon");
    let uptime = text::duration(nanoseconds(status.uptime));
    if status.withheld {
        facts(
            &mut out,
            &[
                ("id", status.daemon.clone()),
                ("process", format!("{}, up {uptime}, version {}", status.pid, status.version)),
                ("domain", status.domain.to_string()),
                ("gateway", status.gateway.clone()),
            ],
        );
        out.push_str(WITHHELD);
        return out;
    }
    let port = status.port.map_or_else(|| "none".to_owned(), |port| port.to_string());
    facts(
        &mut out,
        &[
            ("id", status.daemon.clone()),
            ("process", format!("{}, up {uptime}, version {}", status.pid, status.version)),
            ("domain", status.domain.to_string()),
            ("mode", mode(status)),
            ("socket", status.socket.clone()),
            ("keeps files in", status.runtime_dir.clone().unwrap_or_else(|| "nothing".to_owned())),
            ("discovery", discovery(status)),
            ("gateway", format!("{}, UDP port {port}", status.gateway)),
            ("descriptors", descriptors(status)),
            ("access rules", access_rules(status)),
        ],
    );
    section(&mut out, "Settings", "none", settings(status));
    section(&mut out, "Links", "no other host is linked", links(&status.links));
    if !status.links.is_empty() {
        section(&mut out, "Paths", "none", paths::paths(&status.links));
    }
    if status.links.iter().any(|link| !link.routes_refused.is_empty()) {
        section(&mut out, "Routes refused", "none", routes_refused(&status.links));
    }
    if status.links.iter().any(|link| !link.denied.is_empty()) {
        section(&mut out, "Denied by access rules", "none", denied(&status.links));
    }
    if status.links.iter().any(|link| !link.limits.is_empty()) {
        section(&mut out, "Limits", "none", limits(&status.links));
    }
    keys(&mut out, &status.keys);
    section(&mut out, "Topics", "none", topics(status));
    section(&mut out, "Out of range", "no pair", out_of_range(status));
    if status.topics.iter().any(|topic| !topic.refused.is_empty()) {
        section(&mut out, "Refused, or waiting for a refused route", "none", refused(status));
    }
    section(&mut out, "Sessions", "none", sessions(status));
    section(&mut out, "Refusals", "nobody was refused", refusals(status));
    out
}

fn mode(status: &Status) -> String {
    let details = [status.key_mode.as_deref(), status.kex.as_deref(), Some(&status.cipher)];
    let sae = status.sae.as_ref().map(|sae| format!(", SAE {sae}")).unwrap_or_default();
    let details: Vec<&str> = details.into_iter().flatten().collect();
    format!("{} ({}){sae}", status.mode, details.join(", "))
}

/// Returns the file of the access rules that the daemon has in force.
fn access_rules(status: &Status) -> String {
    match (status.settings.get("AXON_ACCESS_FILE"), &status.access_digest) {
        (Some(file), Some(digest)) => format!("{file}, digest {digest}"),
        (Some(file), None) => file.clone(),
        (None, _) => "none: everything is allowed".to_owned(),
    }
}

/// Returns how many descriptors the daemon has open, and its limit.
fn descriptors(status: &Status) -> String {
    let Some(shown) = status.descriptors else { return "not told".to_owned() };
    let limit = shown.limit.map_or_else(|| "any number".to_owned(), |limit| limit.to_string());
    let refused = match shown.sessions_refused {
        0 => String::new(),
        times => format!("; sessions were refused for want of them {times} times (RLIMIT_NOFILE)"),
    };
    format!("{} open of {limit}{refused}", shown.open)
}

/// Returns the discovery range of the daemon, and the hosts that it looks for by name.
fn discovery(status: &Status) -> String {
    let looks = &status.discovery;
    if looks.hosts.is_empty() {
        return looks.range.clone();
    }
    format!("{}, looks for {}", looks.range, looks.hosts.join(", "))
}

fn settings(status: &Status) -> TextTable {
    let mut table = TextTable::new(&["variable", "value"]);
    for (name, value) in &status.settings {
        table.row([name.clone(), value.clone()]);
    }
    table
}

fn links(links: &[LinkStatus]) -> TextTable {
    let mut table = TextTable::new(&[
        "host",
        "address",
        "SAE",
        "state",
        "key exchange",
        "cipher",
        "peer is",
        ">rtt",
        ">in",
        ">out",
        ">dropped",
    ]);
    for link in links {
        let traffic = |samples, bytes| format!("{} ({})", grouped(samples), text::bytes(bytes));
        table.row([
            link.host.clone(),
            link.address.clone(),
            link.sae.clone().unwrap_or_else(dash),
            link.state.clone(),
            link.key_exchange.clone(),
            link.cipher.clone(),
            link.authenticated_as.clone(),
            text::duration(nanoseconds(link.rtt)),
            traffic(link.samples_in, link.bytes_in),
            traffic(link.samples_out, link.bytes_out),
            causes(&link.dropped),
        ]);
    }
    table
}

fn routes_refused(links: &[LinkStatus]) -> TextTable {
    reasons(links, "topic", |link| (&link.routes_refused, link.more_routes_refused))
}

/// Returns one row for each name and reason of each link, and one row for those that a link does
/// not list.
fn reasons<'a>(
    links: &'a [LinkStatus],
    column: &'static str,
    of: impl Fn(&'a LinkStatus) -> (&'a BTreeMap<String, String>, usize),
) -> TextTable {
    let mut table = TextTable::new(&["host", column, "why"]);
    for link in links {
        let (listed, more) = of(link);
        for (name, why) in listed {
            table.row([link.host.clone(), name.clone(), why.clone()]);
        }
        if more > 0 {
            let more = format!("and {} more", grouped(more as u64));
            table.row([link.host.clone(), more, dash()]);
        }
    }
    table
}

fn denied(links: &[LinkStatus]) -> TextTable {
    reasons(links, "use", |link| (&link.denied, link.more_denied))
}

fn limits(links: &[LinkStatus]) -> TextTable {
    let mut table = TextTable::new(&["host", "use", "limit", "written in", ">passed", ">dropped"]);
    for link in links {
        for limit in &link.limits {
            table.row([
                link.host.clone(),
                format!("{} {}", limit.verb, limit.name),
                limit.limit.clone(),
                limit.place.clone(),
                grouped(limit.passed),
                grouped(limit.dropped),
            ]);
        }
        if link.more_limits > 0 {
            let more = format!("and {} more", grouped(link.more_limits as u64));
            let row = [link.host.clone(), more, dash(), dash(), dash(), dash()];
            table.row(row);
        }
    }
    table
}

fn causes(dropped: &BTreeMap<String, u64>) -> String {
    let causes = dropped.iter().filter(|(_, count)| **count > 0);
    let causes: Vec<String> =
        causes.map(|(cause, count)| format!("{} {cause}", grouped(*count))).collect();
    if causes.is_empty() { "0".to_owned() } else { causes.join(", ") }
}

/// Shows the key supply as the gateway describes it, with each value under its path.
fn keys(out: &mut String, keys: &Value) {
    let mut table = TextTable::new(&["of", ">value"]);
    flatten(&mut table, "", keys);
    section(out, "Keys", "no key manager in this mode", table);
}

fn flatten(table: &mut TextTable, path: &str, value: &Value) {
    let under = |name: &str| {
        if path.is_empty() { name.to_owned() } else { format!("{path} {name}") }
    };
    match value {
        Value::Null => {}
        Value::Object(fields) => {
            fields.iter().for_each(|(name, value)| flatten(table, &under(name), value));
        }
        Value::Array(items) => {
            for (number, value) in items.iter().enumerate() {
                flatten(table, &under(&(number + 1).to_string()), value);
            }
        }
        Value::String(text) => table.row([path.to_owned(), text.clone()]),
        value => table.row([path.to_owned(), value.to_string()]),
    }
}

fn topics(status: &Status) -> TextTable {
    let mut table = TextTable::new(&[
        "topic",
        "type",
        ">publishers",
        ">elsewhere",
        ">subscriptions",
        ">elsewhere",
        ">depth",
        ">memory",
        ">published",
        ">arrived",
        ">dropped",
        "stalled readers",
    ]);
    for topic in &status.topics {
        table.row([
            topic.topic.clone(),
            topic.type_name.clone(),
            topic.publishers.to_string(),
            topic.remote_publishers.to_string(),
            topic.subscriptions.to_string(),
            topic.remote_subscriptions.to_string(),
            depth(topic),
            text::bytes(topic.bytes_committed),
            grouped(topic.published),
            grouped(topic.arrived),
            causes(&topic.dropped),
            stalled(topic),
        ]);
    }
    table
}

/// Returns the depth of the publishers here: one value, or a range.
fn depth(topic: &TopicStatus) -> String {
    let depths = topic.writers.iter().map(|writer| writer.depth.map_or(u64::MAX, u64::from));
    let name = |depth| if depth == u64::MAX { "all".to_owned() } else { grouped(depth) };
    match (depths.clone().min(), depths.max()) {
        (Some(least), Some(most)) if least == most => name(least),
        (Some(least), Some(most)) => format!("{} to {}", name(least), name(most)),
        _ => dash(),
    }
}

/// Returns the processes with a reader that does not take its samples, and how long the oldest
/// sample has waited.
fn stalled(topic: &TopicStatus) -> String {
    let mut longest: BTreeMap<u32, (Duration, bool)> = BTreeMap::new();
    for reader in topic.readers.iter().filter(|reader| reader.is_stalled()) {
        let entry = longest.entry(reader.pid).or_default();
        *entry = (entry.0.max(reader.waiting.unwrap_or_default()), reader.stopped);
    }
    let named = longest.into_iter().map(|(pid, (waiting, stopped))| {
        let stopped = if stopped { "stopped, " } else { "" };
        let waiting = text::duration(nanoseconds(waiting));
        format!("pid {pid} ({stopped}{waiting})")
    });
    let named: Vec<String> = named.collect();
    if named.is_empty() { dash() } else { named.join(", ") }
}

fn sessions(status: &Status) -> TextTable {
    let mut table = TextTable::new(&[">process", "name", "role", ">endpoints", "range", "memory"]);
    for session in &status.sessions {
        let (pid, endpoints) = (session.pid.to_string(), session.endpoints.to_string());
        let (name, role) = (session.name.clone(), session.role.clone());
        let memory = memory(session.relay.as_ref());
        table.row([pid, name, role, endpoints, range(session, &status.links), memory]);
    }
    table
}

/// Returns a session's discovery range and static peers, and which linked hosts are static peers.
fn range(session: &SessionStatus, links: &[LinkStatus]) -> String {
    let Some(range) = &session.range else { return dash() };
    let mut text = range.clone();
    if !session.range_stated {
        text += " (its library states none)";
    }
    if !session.static_peers.is_empty() {
        let named = |id: &String| {
            let link = links.iter().find(|link| link.peer == *id);
            link.map_or_else(|| id.clone(), |link| link.host.clone())
        };
        let linked: Vec<String> = session.lists.iter().map(named).collect();
        let linked = if linked.is_empty() { "none".to_owned() } else { linked.join(", ") };
        let _ = write!(text, ", lists {}; linked: {linked}", session.static_peers.join(", "));
    }
    text
}

fn out_of_range(status: &Status) -> TextTable {
    let mut table = TextTable::new(&["topic", "publisher", "subscription", "why"]);
    for topic in &status.topics {
        for pair in &topic.out_of_range {
            table.row([
                topic.topic.clone(),
                pair.writer.clone(),
                pair.reader.clone(),
                pair.reason.clone(),
            ]);
        }
    }
    table
}

/// Returns the endpoints that exchange no data because a route was refused.
fn refused(status: &Status) -> TextTable {
    let mut table = TextTable::new(&["topic", "endpoint", "host", "why"]);
    for topic in &status.topics {
        for waiting in &topic.refused {
            table.row([
                topic.topic.clone(),
                waiting.endpoint.clone(),
                if waiting.host.is_empty() { "this host" } else { &waiting.host }.to_owned(),
                waiting.reason.clone(),
            ]);
        }
    }
    table
}

/// Returns whether a session shares memory. If it does not, returns the reason and the relayed
/// traffic.
fn memory(relay: Option<&RelayStatus>) -> String {
    let Some(relay) = relay else { return "shared".to_owned() };
    let traffic = |samples, bytes| format!("{} ({})", grouped(samples), text::bytes(bytes));
    format!(
        "relayed: {}; in {}, out {}, lost {}",
        relay.reason,
        traffic(relay.samples_in, relay.bytes_in),
        traffic(relay.samples_out, relay.bytes_out),
        grouped(relay.lost)
    )
}

fn refusals(status: &Status) -> TextTable {
    let mut table = TextTable::new(&["when", "who", "what", "why"]);
    for refusal in &status.refusals {
        table.row([
            text::instant(unix_nanos(refusal.at)),
            refusal.peer.clone(),
            refusal.what.clone(),
            refusal.reason.clone(),
        ]);
    }
    table
}

fn dash() -> String {
    "-".to_owned()
}

fn heading(out: &mut String, title: &str) {
    let gap = if out.is_empty() { "" } else { "\n" };
    let _ = writeln!(out, "{gap}{title}");
}

fn facts(out: &mut String, facts: &[(&str, String)]) {
    for (name, value) in facts {
        let _ = writeln!(out, "  {name:<14}  {}", text::printable(value));
    }
}

fn section(out: &mut String, title: &str, none: &str, table: TextTable) {
    heading(out, title);
    if table.is_empty() {
        let _ = writeln!(out, "  {none}");
    } else {
        out.push_str(&table.render(2));
    }
}

/// Converts a time for `text::duration`. A time that does not fit becomes the longest one, which is
/// some centuries.
fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests;
