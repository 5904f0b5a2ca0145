//! The arguments of `axon acl`.

use std::{path::PathBuf, time::Duration};

use axon_transport::{
    access::Verb,
    internal::access::{ACTION_SERVICES, ACTION_TOPICS},
};
use clap::{Args, Subcommand};

pub(crate) const HELP: &str = "\
A robot that only its base station may drive, in access.toml:

  [[allow]]
  peer = \"base\"
  publish = \"/cmd_vel\"
  subscribe = [\"/scan\", \"/camera/**\"]

  axon acl check access.toml --peer base --publish /cmd_vel
  axon acl test access.toml                the [[expect]] in it
  export AXON_ACCESS_FILE=$PWD/access.toml
  axon acl import permissions.xml --peer base > access.toml     from SROS2
  axon acl learn --for 10m > access.toml                         from what others do here
  axon reload                              a daemon that runs takes the rules as they are now";

/// `axon acl`.
#[derive(Debug, Subcommand)]
pub(crate) enum Acl {
    /// Say whether a peer may do something, and which rule decides
    #[command(after_help = CHECK_HELP, override_usage = CHECK_USAGE)]
    Check(Check),
    /// Compare the rules of a file with the expectations written beside them
    #[command(after_help = TEST_HELP)]
    Test(Test),
    /// Write the rules that say what SROS2's permissions or policy of an enclave say
    #[command(after_help = IMPORT_HELP)]
    Import(Import),
    /// Watch what other hosts and users do here, and write the rules that let them go on
    #[command(after_help = LEARN_HELP)]
    Learn(Learn),
}

/// The usage that clap derives from the group is one line that is wider than a terminal.
const CHECK_USAGE: &str =
    "axon acl check --peer <PEER> --publish|--subscribe|--serve|--call|--act|--see <NAME> [FILE]";

const CHECK_HELP: &str = "\
Without FILE the rules are those that the settings name, and a daemon that runs is asked what the \
peer's rules say of this host's end of the pair. The permissions of SROS2's enclaves act in the processes \
themselves, and are not seen here.

Examples:
  axon acl check --peer base --publish /cmd_vel
  axon acl check access.toml --peer uid:1001 --call /robot/arm/set_mode
  axon acl check access.toml --peer operator-2 --act /dock

Exit status: 0 when the peer may do it here, 1 when it may not.";

/// `axon acl check`.
#[derive(Args, Debug)]
pub(crate) struct Check {
    /// The file with the rules [default: as the settings say]
    #[arg(value_name = "FILE")]
    pub(crate) file: Option<PathBuf>,
    /// The peer's name as it is proved (pin, certificate or SAE ID), or uid:N, or address:IP
    #[arg(long, value_name = "NAME")]
    pub(crate) peer: String,
    #[command(flatten)]
    pub(crate) what: What,
}

/// What the peer does.
#[derive(Args, Debug)]
#[group(required = true, multiple = false)]
pub(crate) struct What {
    /// It publishes on this topic
    #[arg(long, value_name = "TOPIC")]
    publish: Option<String>,
    /// It subscribes to this topic
    #[arg(long, value_name = "TOPIC")]
    subscribe: Option<String>,
    /// It serves this service
    #[arg(long, value_name = "SERVICE")]
    serve: Option<String>,
    /// It calls this service
    #[arg(long, value_name = "SERVICE")]
    call: Option<String>,
    /// It uses this action: each of its services and topics
    #[arg(long, value_name = "ACTION")]
    act: Option<String>,
    /// It sees this topic, service or node in the graph
    #[arg(long, value_name = "NAME")]
    see: Option<String>,
}

impl What {
    /// Returns each verb and name that must be allowed.
    pub(super) fn uses(&self) -> Vec<(Verb, String)> {
        let one = |verb, name: &Option<String>| name.clone().map(|name| (verb, name));
        let simple = [
            one(Verb::Publish, &self.publish),
            one(Verb::Subscribe, &self.subscribe),
            one(Verb::Serve, &self.serve),
            one(Verb::Call, &self.call),
            one(Verb::See, &self.see),
        ];
        let mut uses: Vec<_> = simple.into_iter().flatten().collect();
        for action in self.act.iter() {
            let part = |verb| move |part: &str| (verb, format!("{action}/{part}"));
            uses.extend(ACTION_SERVICES.map(part(Verb::Call)));
            uses.extend(ACTION_TOPICS.map(part(Verb::Subscribe)));
        }
        uses
    }
}

const TEST_HELP: &str = "\
An expectation stands beside the rules, in the same file:

  [[expect]]
  peer = \"guest\"
  publish = \"/cmd_vel\"
  allowed = false

Examples:
  axon acl test access.toml

Exit status: 1 when an expectation is not met, or there is none.";

/// `axon acl test`.
#[derive(Args, Debug)]
pub(crate) struct Test {
    /// The file with the rules and the expectations
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
}

const IMPORT_HELP: &str = "\
The rules go to standard output, and what they cannot say to standard error and into comments: \
\"allows more\" and \"allows less\" compare the rules with the document. Signatures are not \
verified, and dates and domains have no rules here.

Examples:
  axon acl import permissions.xml --peer base > access.toml
  axon acl import policy.xml --enclave /talker_listener/talker --peer base

Exit status: 0 when rules were written, 1 when the document cannot be read, 2 when NAME is no name.";

/// `axon acl import`.
#[derive(Args, Debug)]
pub(crate) struct Import {
    /// permissions.xml or permissions.p7s of an enclave, or the policy that SROS2 makes them of
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// The host or user that the rules are for, as it stands in peer
    #[arg(long, value_name = "NAME")]
    pub(crate) peer: String,
    /// The enclave whose rules are taken, where the document has more than one
    #[arg(long, value_name = "PATH")]
    pub(crate) enclave: Option<String>,
}

const LEARN_HELP: &str = "\
A use counts where an endpoint of this host is at the other end, at the same time. Each host is named \
as it proves itself, or by its address where it proves nothing. What rules in force deny stays denied, \
and is a comment. The rules end with [[expect]] for each use, which axon acl test compares.

Examples:
  axon acl learn --for 10m --output access.toml
  axon acl learn > access.toml             until Ctrl-C
  axon acl test access.toml

Exit status: 0 when rules were written, 1 when nobody did anything, or there is no daemon.";

/// `axon acl learn`.
#[derive(Args, Debug)]
pub(crate) struct Learn {
    /// How long to watch, as in 90s, 10m or 2h [default: until Ctrl-C]
    #[arg(long = "for", value_name = "TIME", value_parser = duration)]
    pub(crate) watch: Option<Duration>,
    /// The file to write, which must not exist [default: standard output]
    #[arg(long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Replace FILE
    #[arg(long, requires = "output")]
    pub(crate) force: bool,
    /// Let each of them see the whole graph of this host, as ros2 node list needs
    #[arg(long)]
    pub(crate) see: bool,
}

/// Parses a time with a unit.
fn duration(text: &str) -> Result<Duration, String> {
    let unit = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(unit);
    let factor = match unit {
        "ms" => 0.001,
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        _ => return Err("a number and ms, s, m or h".to_owned()),
    };
    let seconds = number.parse::<f64>().map_err(|error| error.to_string())? * factor;
    Duration::try_from_secs_f64(seconds).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_a_unit() {
        for (text, seconds) in [("90s", 90.0), ("10m", 600.0), ("1.5h", 5400.0), ("250ms", 0.25)] {
            assert_eq!(duration(text), Ok(Duration::from_secs_f64(seconds)));
        }
        for text in ["", "5", "s", "-5s", "5 s", "1d", "1e99h", "1.2.3s"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }
}
