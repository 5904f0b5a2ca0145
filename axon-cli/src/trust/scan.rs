//! `axon trust scan`: prints the keys that a host's daemons show, so that a person can confirm
//! them.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    io::Write as _,
    net::SocketAddr,
    time::Duration,
};

use axon_daemon::internal::quic_ports;
use axon_tls::identity::{Shown, SpkiDigest};
use axon_transport::config::{Config, OsFiles};
use quinn::Endpoint;
use tokio::{
    task::JoinSet,
    time::{Instant, timeout, timeout_at},
};

use super::{
    cli,
    line::line,
    look::{self, look},
};
use crate::{failure::CliError, say::say, text::printable};

/// The time that the other ports have after one port has answered.
const OTHERS: Duration = Duration::from_secs(1);

const NOTHING_VERIFIED: &str = "\
# Nothing was verified: an attacker who answers at an address can show another key. Before a line goes
# into a trust file, compare it with what `axon trust keygen` printed on that host. A host without
# AXON_CLASSIC_KEY shows another key each time its daemon starts.";

/// Runs `axon trust scan`.
pub(super) fn run(args: &cli::Scan) -> Result<(), CliError> {
    let name = args.name.as_deref().unwrap_or(&args.target.host);
    // The name is checked before any host is contacted.
    line(name, SpkiDigest([0; 32]))?;
    let domain = domain()?;
    let limit = Duration::from_secs(args.timeout);

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (seen, asked) = runtime.block_on(async {
        let addresses = args.target.addresses(quic_ports(domain)).await.map_err(|error| {
            let host = printable(&args.target.host);
            CliError::failed(format!("{host}: no address is known for this name ({error})"))
        })?;
        let seen = scan(&addresses, limit).await;
        Ok::<_, CliError>((seen, addresses))
    })?;

    let found = Found::of(&seen);
    if !found.notes.is_empty() {
        say(found.notes.trim_end());
    }
    if found.keys.is_empty() {
        let answered = !found.notes.is_empty();
        return Err(CliError::failed(nobody(args, &asked, domain, answered)));
    }
    let mut out = String::new();
    for (key, names) in &found.keys {
        let _ = match names {
            None => writeln!(out, "{}", line(name, *key)?),
            // This is not a line of a trust file, because such a host is known by its root
            // certificates.
            Some(names) => writeln!(
                out,
                "# {name} shows a certificate (AXON_CLASSIC_AUTH=ca) for {}: {key}",
                if names.is_empty() { "no host".to_owned() } else { printable(&names.join(", ")) }
            ),
        };
    }
    say(NOTHING_VERIFIED);
    std::io::stdout().lock().write_all(out.as_bytes())?;
    Ok(())
}

/// Returns the domain. A scan must work before this host's own keys are set up, so no other setting
/// is read.
fn domain() -> Result<u32, CliError> {
    let env = std::env::vars_os().filter(|(name, _)| name == "ROS_DOMAIN_ID");
    Ok(Config::resolve(env, None, &OsFiles)?.domain)
}

/// An address, and the key found there or the reason why none was found.
type Seen = (SocketAddr, Result<Shown, String>);

/// Probes all addresses at the same time, and returns the results that came in time.
async fn scan(addresses: &[SocketAddr], limit: Duration) -> Vec<Seen> {
    let mut endpoints: BTreeMap<bool, Endpoint> = BTreeMap::new();
    let mut looks = JoinSet::new();
    let mut seen = Vec::new();
    for address in addresses.iter().copied() {
        let endpoint = match endpoints.get(&address.is_ipv4()) {
            Some(endpoint) => endpoint.clone(),
            None => match look::endpoint(address) {
                Ok(endpoint) => {
                    endpoints.insert(address.is_ipv4(), endpoint.clone());
                    endpoint
                }
                Err(error) => {
                    seen.push((address, Err(error.to_string())));
                    continue;
                }
            },
        };
        looks.spawn(async move { (address, look(&endpoint, address).await) });
    }
    let mut deadline = Instant::now() + limit;
    while let Ok(Some(looked)) = timeout_at(deadline, looks.join_next()).await {
        let Ok(one) = looked else { continue };
        if one.1.is_ok() {
            deadline = deadline.min(Instant::now() + OTHERS);
        }
        seen.push(one);
    }
    drop(looks);
    // This tells the daemons that the probes have ended, so that they do not wait for the rest of a
    // handshake.
    for endpoint in endpoints.into_values() {
        let _ = timeout(OTHERS, endpoint.wait_idle()).await;
    }
    seen.sort_by_key(|(address, _)| *address);
    seen
}

/// The results of a scan.
struct Found {
    /// Each key once, with the names in its certificate if it came in one.
    keys: BTreeSet<(SpkiDigest, Option<Vec<String>>)>,
    /// One comment line for each address with a result.
    notes: String,
}

impl Found {
    fn of(seen: &[Seen]) -> Self {
        let mut found = Self { keys: BTreeSet::new(), notes: String::new() };
        for (address, seen) in seen {
            let note = match seen {
                Err(reason) => reason.clone(),
                Ok(Shown { key, scheme, certificate_names, .. }) => {
                    found.keys.insert((*key, certificate_names.clone()));
                    let kind =
                        certificate_names.as_ref().map_or("raw public key", |_| "certificate");
                    format!("signed its handshake with a {kind}, {scheme:?}")
                }
            };
            let _ = writeln!(found.notes, "# {address} {note}");
        }
        found
    }
}

fn nobody(args: &cli::Scan, asked: &[SocketAddr], domain: u32, answered: bool) -> String {
    let host = printable(&args.target.host);
    let ports = match args.target.port {
        Some(port) => format!("UDP port {port}"),
        None => {
            let ports = quic_ports(domain);
            format!("the UDP ports {} to {} of domain {domain}", ports.start(), ports.end())
        }
    };
    let count = asked.iter().map(SocketAddr::ip).collect::<BTreeSet<_>>().len();
    let at = if count > 1 { format!(" at any of its {count} addresses") } else { String::new() };
    if answered {
        return format!(
            "{host}: no key was shown{at} on {ports}; the lines above say who answered instead, \
             and with a port of its own, HOST:PORT, another one is asked"
        );
    }
    format!(
        "{host}: no key was shown{at} on {ports} within {} s; is a daemon running there, under \
         the same ROS_DOMAIN_ID, and is UDP let through?",
        args.timeout
    )
}
