//! The arguments of the command line, and the texts of `--help`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::{acl::cli::Acl, demo::mode::Mode, trust::cli::Trust};

const ABOUT: &str = "Robot data between processes over shared memory and between hosts over QUIC, \
                     under post-quantum or quantum-distributed keys";

const AFTER_HELP: &str = "\
Start here:
  axon demo                     the whole of it on this machine, in about a minute
  axon play log.mcap            replay a recorded log
  axon echo /scan               look at what arrives, here or on another host
  axon status                   the daemon's peers, links, keys and refusals
  axon trust keygen host.key    a key for this host, for peers to pin
  axon acl check --peer base --publish /cmd_vel   who may do what, by the access rules
  axon bench shm                what shared memory costs on this machine

Settings come from the environment (AXON_SECURITY_MODE, AXON_DAEMON_PEERS, ...) and from the file \
that AXON_CONFIG names; docs/configuration.md lists them. The first session on a host starts the \
daemon; it ends by itself when the last session has been gone for a while.

Exit status:
  0  done
  1  it failed, and stderr says why
  2  a setting or an argument is unknown, obsolete or half-given; one line on stderr names it";

/// What was typed.
#[derive(Debug, Parser)]
#[command(name = "axon", version, about = ABOUT, after_help = AFTER_HELP)]
#[command(disable_help_subcommand = true, max_term_width = 100)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Show AXON end to end on this machine: two hosts, two KMEs, a recorded log, every route
    #[command(after_help = DEMO_HELP)]
    Demo(Demo),
    /// Replay a recorded MCAP log under the topics and types it was recorded with
    #[command(after_help = PLAY_HELP)]
    Play(Play),
    /// Print a line for each message of a topic
    #[command(after_help = ECHO_HELP)]
    Echo(Echo),
    /// Show the daemon: mode, peers, links, keys, topics, refusals
    #[command(after_help = STATUS_HELP)]
    Status(Status),
    /// Make this host's key, and look at the keys of others
    #[command(subcommand, after_help = crate::trust::cli::HELP)]
    Trust(Trust),
    /// Say who may do what here, by the access rules
    #[command(subcommand, after_help = crate::acl::cli::HELP)]
    Acl(Acl),
    /// Have the daemon read its access rules, peers and log filter again
    #[command(after_help = RELOAD_HELP)]
    Reload,
    /// Run the daemon in the foreground
    #[command(after_help = DAEMON_HELP)]
    Daemon(Daemon),
    /// Measure on this machine what AXON costs
    #[command(subcommand, after_help = BENCH_HELP)]
    Bench(Bench),
    #[command(hide = true)]
    BenchAnswer,
    #[command(hide = true)]
    BenchRead,
    #[command(hide = true)]
    BenchSessionAnswer,
    #[command(hide = true)]
    BenchNetAnswer,
    #[command(hide = true)]
    BenchNetRead,
    #[command(hide = true)]
    DemoPlayer(DemoPlayer),
    #[command(hide = true)]
    DemoSubscriber(DemoSubscriber),
}

const DEMO_HELP: &str = "\
Starts two KMEs (ETSI GS QKD 014 over mutual TLS, certificates made on the spot) and two hosts, each \
with a daemon, a runtime directory, a KME and an SAE identity of its own, on 127.0.0.1 and 127.0.0.2. \
A log that a robot recorded goes from host A to a subscriber on host A and one on host B:

  shared memory          between processes of one host
  QUIC classic           TLS 1.3 with X25519MLKEM768 and nothing else
  QUIC qkd/session       TLS 1.3 on a pre-shared key from the KMEs
  QUIC qkd/messages10    the same, and every message in an envelope under a KME key of its own ten

Each message is compared byte for byte with the log. Then peers that must not get in try to. Settings \
in the environment do not reach the demo's hosts (AXON_LOG does). Everything is removed at the end.

Examples:
  axon demo
  axon demo --json | jq .verdict
  axon demo --file camera.mcap --rate 1
  axon demo --kme-env sae-1.env --kme-env sae-2.env --rate 10

With --kme-env the keys come from KMEs that run already: the first FILE says which SAE host A is, the \
second host B, as kme-sim init prints it. docs/qukaydee.md does so with KMEs in the cloud.

Exit status: 0 only when nothing was lost, all compared equal and every wrong peer was refused.";

/// `axon demo`.
#[derive(Args, Debug)]
pub(crate) struct Demo {
    /// The log to replay [default: examples/data/mit-csail.mcap, built in]
    #[arg(long, value_name = "FILE.mcap")]
    pub(crate) file: Option<PathBuf>,
    /// Times the recorded pace; 0 is as fast as possible
    #[arg(long, default_value_t = 40.0, value_parser = rate)]
    pub(crate) rate: f64,
    /// Take keys from KMEs that run already; given twice, for host A and for host B
    #[arg(long, value_name = "FILE", value_parser = clap::value_parser!(PathBuf))]
    pub(crate) kme_env: Vec<PathBuf>,
    /// Print the report as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
    /// Leave the daemons' logs in this directory
    #[arg(long, value_name = "DIR")]
    pub(crate) logs: Option<PathBuf>,
}

const PLAY_HELP: &str = "\
Each topic is published under the name and type in the log, at the pace of the recording. With \
--qos keep-all, the default, a full reader that keeps all as well slows the replay and nothing is \
lost; the other profiles never wait for a reader. At the end it waits for other hosts to acknowledge what \
they got. It prints how many messages every RELIABLE and KEEP_ALL subscription has (acknowledged), and \
fails where such a subscription misses some: after 15 s in which no more were acknowledged, or when \
messages were given up, with a link or a daemon for example. It counts the subscriptions that keep the \
last messages only, or are best effort: these may miss messages, and it does not fail for that. With \
--wait N a message that had fewer than N subscriptions makes it fail.

A log whose end is missing, or that fails a checksum, is refused; the error says how much of it is \
whole, and --incomplete publishes that. Where no checksum covers a message of that part (a log without \
chunks, or one that was written without checksums), --incomplete publishes nothing, unless --unverified \
is given too.

Examples:
  axon play examples/data/mit-csail.mcap
  axon play log.mcap --rate 10 --wait 1
  axon play log.mcap --rate 0 --qos sensor-data --loop";

/// `axon play`.
#[derive(Args, Debug)]
pub(crate) struct Play {
    /// The log
    #[arg(value_name = "FILE.mcap")]
    pub(crate) file: PathBuf,
    /// Times the recorded pace; 0 is as fast as possible
    #[arg(long, default_value_t = 1.0, value_parser = rate)]
    pub(crate) rate: f64,
    /// Quality of service that the publishers offer
    #[arg(long, value_enum, default_value_t = Profile::KeepAll)]
    pub(crate) qos: Profile,
    /// Start when every topic has this many subscriptions
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) wait: usize,
    /// Start again at the end, until interrupted
    #[arg(long = "loop")]
    pub(crate) repeat: bool,
    /// Play a damaged log as far as it is whole
    #[arg(long)]
    pub(crate) incomplete: bool,
    /// With --incomplete: play also messages that no checksum covers
    #[arg(long, requires = "incomplete")]
    pub(crate) unverified: bool,
}

/// The profiles on offer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Profile {
    /// RELIABLE, KEEP_ALL
    KeepAll,
    /// RELIABLE, KEEP_LAST(10): ROS 2's default
    Default,
    /// BEST_EFFORT, KEEP_LAST(5): ROS 2's sensor data
    SensorData,
}

const ECHO_HELP: &str = "\
A line says when the message was published (UTC), its size, and the head of its payload in \
hexadecimal and ASCII. Without --qos the subscription asks for what the publishers offer: RELIABLE \
where all of them do, else BEST_EFFORT, and never slows them. How many messages it missed, if any, \
is said on stderr at the end.

Examples:
  axon echo /scan
  axon echo /camera/image --type sensor_msgs/msg/Image --count 1
  axon echo /odom --json | jq .size";

/// `axon echo`.
#[derive(Args, Debug)]
pub(crate) struct Echo {
    /// The topic
    pub(crate) topic: String,
    /// Its type, such as sensor_msgs/msg/LaserScan [default: as its first endpoint says]
    #[arg(long = "type", value_name = "TYPE")]
    pub(crate) type_name: Option<String>,
    /// Quality of service to ask for; keep-all slows a publisher that keeps all rather than miss any
    #[arg(long, value_enum)]
    pub(crate) qos: Option<Profile>,
    /// End after this many messages
    #[arg(long, value_name = "N")]
    pub(crate) count: Option<u64>,
    /// A JSON object a line
    #[arg(long)]
    pub(crate) json: bool,
}

const STATUS_HELP: &str = "\
Asks the daemon of this user and ROS domain. Never starts one.

Examples:
  axon status
  axon status --json | jq '.refusals'

Exit status: 0 when the daemon answers; otherwise 1, or 2 where a setting is wrong as well.";

/// `axon status`.
#[derive(Args, Debug)]
pub(crate) struct Status {
    /// The daemon's own JSON
    #[arg(long)]
    pub(crate) json: bool,
}

const RELOAD_HELP: &str = "\
The daemon reads its own environment and files: AXON_CONFIG, AXON_ACCESS_FILE and the files that they \
name. Access rules, AXON_DAEMON_PEERS, AXON_TRUSTED_UIDS and AXON_LOG count at once; what needs a \
restart is named. Where something is wrong nothing changes. SIGHUP does the same, and the log says \
what came of it.

Examples:
  axon reload

Exit status: 1 when there is no daemon, 2 when its settings are wrong.";

const DAEMON_HELP: &str = "\
The same as axon_daemon. The first session on a host starts it, so this is for service managers, \
for logs (AXON_LOG=info) and for a host that has no sessions yet. Ends on SIGINT or SIGTERM. One that \
a session started ends after its grace time without sessions; this one stays.

Examples:
  AXON_LOG=info axon daemon
  AXON_SECURITY_MODE=classic AXON_DAEMON_PEERS=robot.local axon daemon";

/// `axon daemon`.
#[derive(Args, Debug)]
pub(crate) struct Daemon {
    /// Started by a session, which waits for the outcome
    #[arg(long, hide = true)]
    pub(crate) spawned: bool,
    /// The process that remains of a spawned one
    #[arg(long, hide = true, conflicts_with = "spawned")]
    pub(crate) detached: bool,
    /// End when standard input ends
    #[arg(long, hide = true)]
    pub(crate) while_stdin: bool,
}

const BENCH_HELP: &str = "\
Examples:
  axon bench shm
  axon bench shm --sizes 64,1048576 --out results";

/// `axon bench`.
#[derive(Debug, Subcommand)]
pub(crate) enum Bench {
    /// Shared memory between two processes, beside what the machine gives without any middleware
    #[command(after_help = BENCH_SHM_HELP)]
    Shm(BenchShm),
    /// Sessions between two processes, beside bare shared memory
    #[command(after_help = BENCH_SESSION_HELP)]
    Session(BenchSession),
    /// Messages between two hosts, beside a stream of bare quinn
    #[command(after_help = BENCH_NET_HELP)]
    Net(BenchNet),
}

const BENCH_NET_HELP: &str = "\
Two hosts with a daemon each, on this machine's loopback: latency, also at 100 Hz and 1 kHz beside a \
wake-up, and streams of a publisher that \
waits for a slow reader (KEEP_ALL) and of one that overtakes it (KEEP_LAST), each beside a stream of \
bare quinn in the same run (written and read 64 KiB at a time, where messages follow each other), with \
the processor time of a message in all processes. With X25519MLKEM768 \
(classic) and with keys of two KMEs that are simulated. The rest of the machine should be idle. \
About five minutes; --quick takes seconds and is only to see it run. Writes net.json.

Examples:
  axon bench net
  axon bench net --modes classic --sizes 1024,1048576 --out results
  axon bench net --quick --out results && jq .modes[].streams results/net.json";

/// `axon bench net`.
#[derive(Args, Debug)]
pub(crate) struct BenchNet {
    /// Security modes [default: all]
    #[arg(long, value_name = "MODE", value_delimiter = ',', value_enum)]
    pub(crate) modes: Vec<Mode>,
    /// Sizes of messages in bytes, from 8 to 64 MiB [default: six from 64 B to 4 MiB]
    #[arg(long, value_name = "BYTES", value_delimiter = ',', value_parser = message_size)]
    pub(crate) sizes: Vec<usize>,
    /// Where to write net.json
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub(crate) out: PathBuf,
    /// A few messages only: the figures are good for nothing
    #[arg(long)]
    pub(crate) quick: bool,
}

const BENCH_SESSION_HELP: &str = "\
Latency of a publisher and a subscription, and of a service, in the sessions of two processes with a \
daemon of their own, beside bare shared memory in the same run: with a receiver that polls and one \
that waits on a wait set. Then the throughput of the same, and with each figure the processor time of a \
message. The rest of the machine should be idle. Under a minute; --quick takes seconds and is only to \
see it run. Writes session.json, with all percentiles.

Examples:
  axon bench session
  axon bench session --sizes 64,1048576 --out results
  axon bench session --quick --out results && jq .latency[].session_to_bare results/session.json";

/// `axon bench session`.
#[derive(Args, Debug)]
pub(crate) struct BenchSession {
    /// Sizes of messages in bytes, from 8 to 64 MiB [default: seven from 64 B to 4 MiB]
    #[arg(long, value_name = "BYTES", value_delimiter = ',', value_parser = message_size)]
    pub(crate) sizes: Vec<usize>,
    /// Where to write session.json
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub(crate) out: PathBuf,
    /// A few messages only: the figures are good for nothing
    #[arg(long)]
    pub(crate) quick: bool,
}

const BENCH_SHM_HELP: &str = "\
Latency (p50, p99, p99.9) with a receiver that polls, one that looks for 50 us before it sleeps, and \
one that sleeps between messages that come at 100 Hz and 1 kHz; throughput; and a publish to 1 to 16 \
processes that sleep and read every byte. Each stands beside the raw limit of the same run (a spin on a \
shared atomic, epoll and eventfd, a futex, one memcpy, two), with the processor time of a message in all \
processes. The rest of the machine should be idle. About five minutes; --quick takes seconds and is only \
to see it run. Writes shm.json, with all percentiles, and shm.svg.

Examples:
  axon bench shm
  axon bench shm --sizes 64,1048576 --out results
  axon bench shm --quick --out results && jq .latency[].ratio results/shm.json";

/// `axon bench shm`.
#[derive(Args, Debug)]
pub(crate) struct BenchShm {
    /// Sizes of messages in bytes, from 8 to 64 MiB [default: ten from 8 B to 25 MB]
    #[arg(long, value_name = "BYTES", value_delimiter = ',', value_parser = message_size)]
    pub(crate) sizes: Vec<usize>,
    /// Where to write shm.json and shm.svg
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub(crate) out: PathBuf,
    /// A few messages only: the figures are good for nothing
    #[arg(long)]
    pub(crate) quick: bool,
}

fn message_size(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(size) if (8..=64 << 20).contains(&size) => Ok(size),
        _ => Err("not a number of bytes from 8 to 67108864".to_owned()),
    }
}

/// The demo's publisher, a process of host A.
#[derive(Args, Debug)]
pub(crate) struct DemoPlayer {
    #[arg(long)]
    pub(crate) file: PathBuf,
    #[arg(long, value_parser = rate)]
    pub(crate) rate: f64,
    #[arg(long)]
    pub(crate) wait: usize,
}

/// One of the demo's subscribers.
#[derive(Args, Debug)]
pub(crate) struct DemoSubscriber {
    #[arg(long)]
    pub(crate) file: PathBuf,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate.is_finite() && rate >= 0.0 => Ok(rate),
        _ => Err("not a number of at least 0".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    /// Returns the commands of `axon` in the blocks of a page, without their comments.
    fn commands_of(page: &str) -> Vec<String> {
        let mut is_block = false;
        let mut commands = Vec::new();
        for line in page.lines() {
            if line.starts_with("```") {
                is_block = !is_block;
            } else if is_block && line.starts_with("axon ") {
                let command = line.split(" #").next().unwrap_or(line);
                commands.push(command.split(['|', '>', '&']).next().unwrap_or(command).to_owned());
            }
        }
        commands
    }

    #[test]
    fn commands_are_found_in_blocks_and_without_comments() {
        let page = "axon text\n```sh\naxon a FILE --b c   # d\n  axon e\naxon f > g\n```\naxon h\n";
        assert_eq!(commands_of(page), ["axon a FILE --b c  ", "axon f "]);
    }

    #[test]
    #[expect(clippy::print_stderr, reason = "a test that skips prints why")]
    fn each_command_that_a_page_shows_is_accepted() {
        let project = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let mut pages = vec![project.join("axon-cli/README.md"), project.join("README.md")];
        let Ok(docs) = std::fs::read_dir(project.join("docs")) else {
            eprintln!("skipped: the pages are not in the package of axon-cli");
            return;
        };
        pages.extend(docs.map(|page| page.unwrap().path()));
        pages.retain(|page| page.extension().is_some_and(|extension| extension == "md"));
        let mut accepted = 0;
        for page in pages {
            for command in commands_of(&std::fs::read_to_string(&page).unwrap()) {
                let parsed = Cli::try_parse_from(command.split_whitespace());
                parsed.unwrap_or_else(|error| panic!("{}: {command}: {error}", page.display()));
                accepted += 1;
            }
        }
        assert!(accepted >= 20, "{accepted} commands");
    }

    /// Checks that help texts contain no line break of their own, because the terminal's width decides where a line
    /// ends.
    fn assert_unbroken(command: &clap::Command) {
        let text = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        let is_prose = |line: &str| !line.is_empty() && !line.starts_with(' ');
        for (line, next) in text.lines().zip(text.lines().skip(1)) {
            let is_whole = !is_prose(line) || line.ends_with(':') || !is_prose(next);
            assert!(is_whole, "{}: a paragraph is broken after {line:?}", command.get_name());
        }
        command.get_subcommands().for_each(assert_unbroken);
    }

    #[test]
    fn help_leaves_line_breaks_to_the_terminal() {
        assert_unbroken(&Cli::command());
    }

    #[test]
    fn a_size_holds_a_stamp_and_fits_in_memory() {
        for wrong in ["7", "-1", "", "1k", "67108865"] {
            assert!(message_size(wrong).is_err(), "{wrong}");
        }
        assert_eq!((message_size("8"), message_size("67108864")), (Ok(8), Ok(64 << 20)));
    }

    #[test]
    fn a_rate_is_a_finite_number_of_at_least_zero() {
        for wrong in ["-1", "nan", "inf", "", "fast"] {
            assert!(rate(wrong).is_err(), "{wrong}");
        }
        assert_eq!((rate("0"), rate("0.5")), (Ok(0.0), Ok(0.5)));
    }
}
