//! What can be typed after `axon acl`.

use std::path::PathBuf;

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
  axon reload                              a daemon that runs takes the rules as they are now";

/// `axon acl`.
#[derive(Debug, Subcommand)]
pub(crate) enum Acl {
    /// Say whether a peer may do something, and which rule decides
    #[command(after_help = CHECK_HELP)]
    Check(Check),
    /// Compare the rules of a file with the expectations written beside them
    #[command(after_help = TEST_HELP)]
    Test(Test),
    /// Write the rules that say what SROS2's permissions or policy of an enclave say
    #[command(after_help = IMPORT_HELP)]
    Import(Import),
}

const CHECK_HELP: &str = "\
Without FILE the rules are those that the settings name, and a daemon that runs is asked what the \
peer's rules say of this host's end of the pair.

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
    /// Each verb and name that has to be allowed.
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
    /// permissions.xml of an enclave (not the signed .p7s), or the policy that SROS2 makes it of
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// The host or user that the rules are for, as it stands in peer
    #[arg(long, value_name = "NAME")]
    pub(crate) peer: String,
    /// The enclave whose rules are taken, where the document has more than one
    #[arg(long, value_name = "PATH")]
    pub(crate) enclave: Option<String>,
}
