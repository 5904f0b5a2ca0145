//! `axon acl check`: whether a peer may do something, and which rule decides.

use std::{io::Write as _, process::ExitCode};

use axon_transport::{
    access::{InterfaceLimit, Verb},
    config::{Config, DaemonPlace},
    internal::graph::other_end,
    status::{LinkStatus, Status},
};

use super::cli;
use crate::{
    failure::CliError,
    say::say,
    text::{TextTable, printable},
};

/// Runs `axon acl check`.
pub(super) fn run(args: &cli::Check) -> Result<ExitCode, CliError> {
    let rules = super::rules(args.file.as_deref())?;
    let wrong = |what| CliError::Setting(format!("--peer {:?}: accepted: {what}", args.peer));
    let permissions = rules.permissions(super::party(&args.peer).map_err(wrong)?);
    let status = if args.file.is_none() { status() } else { None };
    if let Some(status) = &status {
        warn_of_other_rules(status);
    }
    let mut table = TextTable::new(&["it would", "here", "there"]);
    let mut allowed = true;
    for (verb, name) in args.what.uses() {
        let decision = permissions.check(verb, &name);
        allowed &= decision.allowed();
        let there = status.as_ref().map_or_else(
            || "not asked".to_owned(),
            |status| there(status, &args.peer, other_end(verb), &name),
        );
        table.row([printable(&format!("{verb} {name}")), decision.to_string(), printable(&there)]);
    }
    let mut text = table.render(0);
    for (verb, name) in args.what.uses() {
        for limit in permissions.limits(verb, &name) {
            let line = format!("limited: {verb} {name}: {limit}");
            text.push_str(&format!("{}\n", printable(&line)));
        }
    }
    for limit in permissions.egress() {
        let line =
            format!("limited: all packets to it: line {} of {}: {limit}", limit.line, limit.file);
        text.push_str(&format!("{}\n", printable(&line)));
    }
    for InterfaceLimit { interfaces, limit, .. } in rules.interface_limits() {
        let interfaces = interfaces.join(", ");
        let line = format!(
            "limited: all packets by {interfaces}: line {} of {}: {limit}",
            limit.line, limit.file
        );
        text.push_str(&format!("{}\n", printable(&line)));
    }
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(if allowed { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The status of the daemon, where one runs.
fn status() -> Option<Status> {
    let place = DaemonPlace::from_env().ok()?;
    serde_json::from_str(&axon_transport::daemon_status_at(&place).ok()?).ok()
}

/// The daemon may have been started with other settings than this process.
fn warn_of_other_rules(status: &Status) {
    let daemon = status.settings.get("AXON_ACCESS_FILE").map_or("none", String::as_str);
    let own = Config::from_env().ok().and_then(|config| config.access_file);
    let own = own.map_or_else(|| "none".to_owned(), |file| file.display().to_string());
    if own != daemon {
        say(format_args!(
            "axon: AXON_ACCESS_FILE is {own} here and {daemon} in the daemon that runs: the answer is about \
             the rules here"
        ));
    }
}

/// What the peer's rules say of this host's end of the pair, as far as the peer has said it.
fn there(status: &Status, peer: &str, verb: Verb, name: &str) -> String {
    // In qkd the host's name is what the peer calls itself.
    let of_peer = |link: &&LinkStatus| match &link.sae {
        Some(sae) => sae == peer,
        None => link.host == peer && !link.authenticated_as.starts_with("UNAUTHENTICATED"),
    };
    let Some(link) = status.links.iter().find(of_peer) else {
        return "not linked".to_owned();
    };
    if let Some(why) = link.denied.get(&format!("{verb} {name} (ours)")) {
        return why.strip_prefix("by the peer: ").unwrap_or(why).to_owned();
    }
    if link.more_denied > 0 {
        return "not known: more is denied than status lists".to_owned();
    }
    // The peer speaks of endpoints that there are.
    let ours = status.topics.iter().filter(|topic| topic.topic == name).any(|topic| match verb {
        Verb::Publish => topic.publishers > 0,
        Verb::Subscribe => topic.subscriptions > 0,
        _ => false,
    });
    let text = match (ours, verb) {
        (true, _) => "no denial was heard",
        (false, Verb::Serve | Verb::Call) => "no denial was heard of a service",
        (false, _) => "not known: this host has no such endpoint",
    };
    text.to_owned()
}

#[cfg(test)]
mod tests {
    use axon_transport::status::TopicStatus;

    use super::*;

    #[test]
    fn what_the_peer_said_of_an_endpoint_is_shown_and_nothing_else_is_claimed() {
        let mut link = LinkStatus::default();
        link.host = "base".into();
        let why = "by the peer: denied by line 3 of access.toml";
        link.denied.insert("publish /scan (ours)".into(), why.into());
        let mut topic = TopicStatus::default();
        (topic.topic, topic.publishers) = ("/odom".into(), 1);
        let mut status = Status::default();
        (status.links, status.topics) = (vec![link], vec![topic]);
        let there = |peer, verb, name| there(&status, peer, verb, name);
        assert_eq!(there("base", Verb::Publish, "/scan"), "denied by line 3 of access.toml");
        assert_eq!(there("base", Verb::Publish, "/odom"), "no denial was heard");
        assert!(there("base", Verb::Subscribe, "/odom").starts_with("not known"));
        assert_eq!(there("arm", Verb::Publish, "/scan"), "not linked");
    }
}
