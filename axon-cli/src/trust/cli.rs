//! The arguments of `axon trust`.

use std::path::PathBuf;

use axon_tls::identity::KeyAlgorithm;
use clap::{Args, Subcommand, ValueEnum};

use super::target::HostTarget;

pub(crate) const HELP: &str = "\
Two hosts that know each other by their keys:

  axon trust keygen /etc/axon/host.key     on each: makes its key, prints its line
  (put each host's line into the other's trust file)
  axon trust scan robot-2                  the key that a running daemon shows, to compare
  export AXON_CLASSIC_KEY=/etc/axon/host.key AXON_CLASSIC_TRUST=/etc/axon/trust
  axon trust list                          what is trusted now";

/// `axon trust`.
#[derive(Debug, Subcommand)]
pub(crate) enum Trust {
    /// Make a key for this host and print the line for the other hosts' trust files
    #[command(after_help = KEYGEN_HELP)]
    Keygen(Keygen),
    /// Print the key that a host shows, to compare and confirm
    #[command(after_help = SCAN_HELP)]
    Scan(Scan),
    /// Print the keys in a trust file
    #[command(after_help = LIST_HELP)]
    List(List),
}

const KEYGEN_HELP: &str = "\
FILE is created with mode 0600. A file that exists is never overwritten: delete it first if its key \
is not needed any more. The line goes into the trust file of every host that is to link with this \
one, by a way on which nobody can exchange it. No setting is read.

Examples:
  axon trust keygen /etc/axon/host.key
  axon trust keygen host.key --name arm-2 --algorithm ed25519";

/// `axon trust keygen`.
#[derive(Args, Debug)]
pub(crate) struct Keygen {
    /// The private key to make, PKCS#8 in PEM
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// What the others call this host [default: its node name]
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// What the key signs with
    #[arg(long, value_enum, default_value_t = Algorithm::MlDsa65)]
    pub(crate) algorithm: Algorithm,
}

/// The algorithms on offer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Algorithm {
    /// ML-DSA-65 (FIPS 204): a quantum computer does not forge it
    #[value(name = "ml-dsa-65")]
    MlDsa65,
    /// Ed25519: small, classical
    Ed25519,
}

impl From<Algorithm> for KeyAlgorithm {
    fn from(algorithm: Algorithm) -> Self {
        match algorithm {
            Algorithm::MlDsa65 => Self::MlDsa65,
            Algorithm::Ed25519 => Self::Ed25519,
        }
    }
}

const SCAN_HELP: &str = "\
Connects to the daemon there, takes the key that it signs the handshake with, and breaks off: no \
data is sent. Standard output has a line for a trust file, standard error where it is from.

NOTHING IS VERIFIED. An attacker who answers in the host's place shows another key. Compare the line \
with what keygen printed on the host before a trust file has it. The daemon there notes a refused \
handshake. No setting is read but ROS_DOMAIN_ID, for the ports to try.

Examples:
  axon trust scan robot.local
  axon trust scan 10.0.0.7:61300 --name arm-2

Exit status: 1 when no key was shown.";

/// `axon trust scan`.
#[derive(Args, Debug)]
pub(crate) struct Scan {
    /// The host; without a port the sixteen of the ROS domain are tried
    #[arg(value_name = "HOST[:PORT]")]
    pub(crate) target: HostTarget,
    /// What the line calls the host [default: as typed here]
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// Wait for this many seconds
    #[arg(long, value_name = "S", default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=600))]
    pub(crate) timeout: u64,
}

const LIST_HELP: &str = "\
\"valid\" says that a link with that key is accepted now, \"expired\" that its last day (UTC) is over. \
This host's own key is marked where it stands in the file, and printed below the table.

Examples:
  axon trust list
  axon trust list /etc/axon/trust --key /etc/axon/host.key";

/// `axon trust list`.
#[derive(Args, Debug)]
pub(crate) struct List {
    /// The trust file [default: AXON_CLASSIC_TRUST]
    #[arg(value_name = "FILE")]
    pub(crate) file: Option<PathBuf>,
    /// This host's private key [default: AXON_CLASSIC_KEY]
    #[arg(long, value_name = "FILE")]
    pub(crate) key: Option<PathBuf>,
}
