//! `kme-sim probe`: checks whether a KME conforms to ETSI GS QKD 014 V1.1.1, by its answers.

mod keys;
mod party;
mod quirks;
mod refusals;
mod report;
mod status;
mod tls;
mod wire;

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use party::{Party, PartyFiles};
use report::Report;
use tls::{Auth, GROUPS, VERSIONS};
use wire::Wire;

use crate::{CommandFailure, CommandResult, other, say};

/// Tries a KME, any KME, against the specification and prints a table: clause, what was expected,
/// what came, verdict.
///
/// Without --consume-keys nothing is asked that a KME would serve with keys. An option that is not
/// given is read from the environment that `kme-sim init` prints. A refusal by a code that the specification
/// does not name for it (a limit exceeded, an unknown SAE) is noted, and no failure. Exit status: 0 if
/// all checks passed (or were skipped or noted), 1 if one failed or was only tolerated, 2 on wrong
/// arguments.
#[derive(Args)]
pub(crate) struct Arguments {
    /// `https://host[:port][/prefix]` of the KME.
    #[arg(env = "AXON_KME_URL")]
    url: String,
    /// The CA of the KME's certificate, PEM or DER.
    #[arg(long, value_name = "FILE", env = "AXON_KME_CA")]
    ca: PathBuf,
    /// The SAE's certificate, PEM or DER.
    #[arg(long, value_name = "FILE", env = "AXON_SAE_CERT")]
    cert: PathBuf,
    /// The SAE's private key, PEM or DER.
    #[arg(long, value_name = "FILE", env = "AXON_SAE_KEY")]
    key: PathBuf,
    /// The ID of the SAE in the certificate; the master of all keys drawn.
    #[arg(long, value_name = "ID", env = "AXON_SAE_ID")]
    sae: String,
    /// The SAE to share keys with.
    #[arg(long, value_name = "ID")]
    slave_sae: String,
    /// The KME's ID, to be compared with its certificate.
    #[arg(long, value_name = "ID", env = "AXON_KME_ID")]
    kme_id: Option<String>,
    /// Know the KME by its ID alone, whatever host its certificate names.
    #[arg(long, requires = "kme_id")]
    kme_id_only: bool,
    /// The slave SAE's environment, as `kme-sim init` prints it: lets the probe draw the keys at
    /// the other end too.
    #[arg(long, value_name = "FILE")]
    slave_env: Option<PathBuf>,
    /// Also make requests that deliver keys, and requests that a faulty KME might answer with keys.
    #[arg(long)]
    consume_keys: bool,
    /// Time for one request.
    #[arg(long, value_name = "SECONDS", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=3600))]
    timeout: u64,
}

pub(crate) fn probe(arguments: Arguments) -> CommandResult {
    let timeout = Duration::from_secs(arguments.timeout);
    let slave_env = arguments.slave_env.as_deref();
    let slave = slave_env
        .map(|file| Party::from_env_file(file, &arguments.slave_sae, timeout))
        .transpose()?;
    let master = Party::load(PartyFiles {
        url: arguments.url,
        sae: arguments.sae,
        kme_id: arguments.kme_id,
        kme_id_only: arguments.kme_id_only,
        ca: arguments.ca,
        cert: arguments.cert,
        key: arguments.key,
        timeout,
    })?;
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(other)?;
    let both = (&master, slave.as_ref());
    let report = runtime.block_on(all(both, &arguments.slave_sae, arguments.consume_keys))?;
    say(&report.to_string());
    if report.passed() {
        Ok(())
    } else {
        Err(CommandFailure::Other(format!(
            "{} does not hold to all of the specification",
            master.url
        )))
    }
}

async fn all(
    (master, slave): (&Party, Option<&Party>),
    slave_sae: &str,
    consume: bool,
) -> CommandResult<Report> {
    let mut report = Report::default();
    if !status::connection(master, slave_sae, &mut report).await? {
        return Ok(report);
    }
    let wire = Wire::new(master, tls::config(master, &VERSIONS, &GROUPS, Auth::Sae)?)?;
    let status = status::status(master, slave_sae, &wire, &mut report).await?;
    refusals::refusals(master, slave_sae, &wire, &mut report).await?;
    match status {
        _ if !consume => {
            report.skip("5.3", "requests for keys, and their limits", "no --consume-keys");
        }
        Some(read) => {
            let status = &read.value;
            keys::refusals(master, slave_sae, status, &wire, &mut report).await?;
            keys::delivery((master, slave), slave_sae, status, &wire, &mut report).await?;
        }
        None => report.skip("5.3", "requests for keys, and their limits", "no status"),
    }
    Ok(report)
}
