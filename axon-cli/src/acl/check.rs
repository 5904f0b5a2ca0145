//! `axon acl check`: reports whether a peer may do something, and which rule decides.

use std::{io::Write as _, process::ExitCode};

use axon_transport::{
    access::{AccessRules, InterfaceLimit, Principal, Verb},
    config::{Config, DaemonLocation},
    daemon_check_access_at,
    internal::graph::other_end,
    status::{LinkStatus, PeerDecision, Status},
};

use super::cli;
use crate::{
    failure::CliError,
    say::say,
    text::{TextTable, printable},
};

/// The number of uses in one question to a peer.
const USES_PER_QUESTION: usize = 32;

/// Runs `axon acl check`.
pub(super) fn run(args: &cli::Check) -> Result<ExitCode, CliError> {
    let rules = super::rules(args.file.as_deref())?;
    let wrong = |what| CliError::Setting(format!("--peer {:?}: accepted: {what}", args.peer));
    let peer = super::party(&args.peer).map_err(wrong)?;
    let permissions = rules.permissions(peer);
    let status = if args.file.is_none() { status() } else { None };
    if let Some(status) = &status {
        warn_of_other_rules(status, &rules);
    }
    let mut table = TextTable::new(&["it would", "here", "there"]);
    let mut allowed = true;
    let uses = args.what.uses();
    // On the peer's side this host is the other end: it subscribes where the peer publishes, and serves where the peer
    // calls.
    let ends: Vec<_> = uses.iter().map(|(verb, name)| (other_end(*verb), name.clone())).collect();
    let there = match &status {
        Some(status) => there(status, peer, &ends),
        None => vec!["not asked".to_owned(); ends.len()],
    };
    for ((verb, name), there) in uses.into_iter().zip(there) {
        let decision = permissions.check(verb, &name);
        allowed &= decision.allowed();
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

/// Returns the status of the daemon, or `None` if none runs.
fn status() -> Option<Status> {
    let place = DaemonLocation::from_env().ok()?;
    serde_json::from_str(&axon_transport::daemon_status_at(&place).ok()?).ok()
}

/// Warns if the rules of the daemon may differ from `rules`. The daemon may have been started with other settings than
/// this process, or before the file was changed.
fn warn_of_other_rules(status: &Status, rules: &AccessRules) {
    if status.withheld {
        return say(format_args!(
            "axon: the daemon that runs belongs to another user and does not tell its access rules: the answer is \
             about the rules here, and nothing is known of other hosts"
        ));
    }
    let daemon = status.settings.get("AXON_ACCESS_FILE").map_or("none", String::as_str);
    let own = Config::from_env().and_then(Config::with_rules_of_host);
    let own = own.ok().and_then(|config| config.access_file);
    let own = own.map_or_else(|| "none".to_owned(), |file| file.display().to_string());
    if own != daemon {
        say(format_args!(
            "axon: AXON_ACCESS_FILE is {own} here and {daemon} in the daemon that runs: the answer is about \
             the rules here"
        ));
    } else if status.access_digest.is_some() && status.access_digest != rules.digest() {
        say(format_args!(
            "axon: the daemon that runs has other rules in force than are in {own} now: the answer is about the \
             file; `axon reload` has the daemon read it again"
        ));
    }
}

/// Returns, for each use by this host, the decision of the peer's rules. A peer may have more than one link. A use that
/// one of them denies is denied.
fn there(status: &Status, peer: Principal<'_>, uses: &[(Verb, String)]) -> Vec<String> {
    let links: Vec<_> = status.links.iter().filter(|link| is_of(link, peer)).collect();
    let answers: Vec<_> = links.iter().filter_map(|link| ask(link, uses)).collect();
    let of = |at: usize| {
        let decisions = || answers.iter().map(move |decisions| &decisions[at]);
        decisions().find(|decision| !decision.allowed).or_else(|| decisions().next())
    };
    let all = uses.iter().enumerate().map(|(at, (verb, name))| match of(at) {
        Some(decision) => decision.reason.clone(),
        None => heard(status, &links, *verb, name),
    });
    all.collect()
}

/// Returns the decisions of the peer of one link. Returns `None` if the peer does not answer: a daemon of an earlier
/// version does not know the question.
fn ask(link: &LinkStatus, uses: &[(Verb, String)]) -> Option<Vec<PeerDecision>> {
    let place = DaemonLocation::from_env().ok()?;
    let mut decisions = Vec::new();
    for part in uses.chunks(USES_PER_QUESTION) {
        match daemon_check_access_at(&place, &link.peer, part) {
            Ok(answer) if answer.decisions.len() == part.len() => {
                decisions.extend(answer.decisions);
            }
            Ok(answer) => {
                let why = answer.error.unwrap_or_else(|| "it gave no answer".to_owned());
                say(format_args!("axon: {} was not asked: {why}", printable(&link.host)));
                return None;
            }
            Err(error) => {
                say(format_args!(
                    "axon: {} does not say which of its rules decides ({error}): \"there\" is what it has said \
                     of endpoints of this host",
                    printable(&link.host)
                ));
                return None;
            }
        }
    }
    Some(decisions)
}

/// Returns what the peer's reports say about a use. A peer reports what it denies to the endpoints that exist.
fn heard(status: &Status, links: &[&LinkStatus], verb: Verb, name: &str) -> String {
    if links.is_empty() {
        return "not linked".to_owned();
    }
    let used = format!("{verb} {name} (ours)");
    if let Some(why) = links.iter().find_map(|link| link.denied.get(&used)) {
        return why.strip_prefix("by the peer: ").unwrap_or(why).to_owned();
    }
    if links.iter().any(|link| link.more_denied > 0) {
        return "not known: more is denied than status lists".to_owned();
    }
    // The peer reports only about endpoints that exist.
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

/// Returns whether a link belongs to this peer, as rules name it. The name that a host gives itself proves nothing.
fn is_of(link: &LinkStatus, peer: Principal<'_>) -> bool {
    match (Principal::parse(&link.party), peer) {
        (Ok(Principal::Name(of)), Principal::Certificate(name)) => of.eq_ignore_ascii_case(name),
        (Ok(Principal::Address(of)), Principal::Address(ip)) => {
            of.to_canonical() == ip.to_canonical()
        }
        (Ok(of), peer) => of == peer,
        (Err(_), _) => false,
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::status::TopicStatus;

    use super::*;

    /// Returns a link of this party, whose host gives itself another name.
    fn link(party: &str) -> LinkStatus {
        let mut link = LinkStatus::default();
        (link.host, link.party) = ("localhost".into(), party.into());
        link
    }

    #[test]
    fn only_denials_reported_by_the_peer_are_shown() {
        let mut base = link("base");
        let why = "by the peer: denied by line 3 of access.toml";
        base.denied.insert("publish /scan (ours)".into(), why.into());
        let mut topic = TopicStatus::default();
        (topic.topic, topic.publishers) = ("/odom".into(), 1);
        let mut status = Status::default();
        (status.links, status.topics) = (vec![link("base"), base], vec![topic]);
        let there = |peer, verb, name| {
            let of_peer = |link: &&LinkStatus| is_of(link, Principal::Name(peer));
            let links: Vec<_> = status.links.iter().filter(of_peer).collect();
            heard(&status, &links, verb, name)
        };
        assert_eq!(there("base", Verb::Publish, "/scan"), "denied by line 3 of access.toml");
        assert_eq!(there("base", Verb::Publish, "/odom"), "no denial was heard");
        assert!(there("base", Verb::Subscribe, "/odom").starts_with("not known"));
        assert_eq!(there("arm", Verb::Publish, "/scan"), "not linked");
        assert_eq!(there("localhost", Verb::Publish, "/scan"), "not linked");
    }

    #[test]
    fn a_link_is_of_the_party_that_rules_know_it_as() {
        let address = |text: &str| Principal::Address(text.parse().unwrap());
        assert!(is_of(&link("address:10.0.0.7"), address("::ffff:10.0.0.7")));
        assert!(!is_of(&link("address:10.0.0.7"), address("10.0.0.8")));
        assert!(!is_of(&link("address:10.0.0.7"), Principal::Name("address:10.0.0.7")));
        assert!(is_of(&link("base"), Principal::Name("base")));
        assert!(!is_of(&link("base"), Principal::Name("Base")));
        assert!(is_of(&link("base.example"), Principal::Certificate("Base.Example")));
        assert!(!is_of(&link(""), Principal::Name("")), "a daemon of an earlier version");
    }
}
