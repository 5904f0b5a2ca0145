//! `kme-sim run`: serves the KMEs of a directory that `init` made.

use std::fs;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use etsi_qkd014::sim::{Control, Fault, FaultPlan, FillRate, Layout, Network, Pki};

use crate::{CommandFailure, CommandResult, layout_file, other, say};

/// Serves the KMEs of a directory until it is interrupted.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The directory that `kme-sim init` made.
    dir: PathBuf,
    /// How fast each link between two KMEs makes keys. Default: as fast as they are asked for.
    #[arg(long, value_name = "KEYS_PER_SECOND", value_parser = rate)]
    rate: Option<f64>,
    /// Keys that each link stores at most.
    #[arg(long, value_name = "KEYS")]
    max_stored: Option<u64>,
    /// Keys that each link stores at the start.
    #[arg(long, value_name = "KEYS")]
    stored: Option<u64>,
    /// Default size of a key.
    #[arg(long, value_name = "BITS")]
    key_size: Option<u32>,
    /// Most keys in one request.
    #[arg(long, value_name = "KEYS")]
    max_per_request: Option<u64>,
    /// Refuses members, parameters and nulls that the specification does not list, empty bodies, and bodies in
    /// chunks. By default they are accepted, since it does not forbid them.
    #[arg(long)]
    strict: bool,
    /// Delays every answer of every KME.
    #[arg(long, value_name = "MILLISECONDS")]
    latency: Option<u64>,
    /// A fault of one KME: what, and when it happens. As kme-a:cut, kme-a:latency=250,
    /// kme-a:status=500,probability=0.1 or kme-a:reset,times=2,on=dec_keys.
    #[arg(long = "fault", value_name = "KME:PLAN", value_parser = fault)]
    faults: Vec<(String, FaultPlan)>,
    /// Lets `kme-sim fault` change the faults while the KMEs run. A loopback address.
    #[arg(long, value_name = "ADDRESS:PORT")]
    control: Option<SocketAddr>,
}

pub(crate) fn run(arguments: Arguments) -> CommandResult {
    let file = layout_file(&arguments.dir);
    let text = fs::read_to_string(&file)
        .map_err(|e| other(format!("{}: {e}; make it with kme-sim init", file.display())))?;
    let layout: Layout =
        serde_json::from_str(&text).map_err(|e| other(format!("{}: {e}", file.display())))?;
    let known = |id: &String| layout.sites.iter().any(|site| site.kme == *id);
    if let Some((id, _)) = arguments.faults.iter().find(|(id, _)| !known(id)) {
        return Err(CommandFailure::Usage(format!("--fault: there is no KME {id:?}")));
    }
    let runtime = tokio::runtime::Runtime::new().map_err(other)?;
    runtime.block_on(serve(arguments, layout))
}

async fn serve(arguments: Arguments, layout: Layout) -> CommandResult {
    let pki = Pki::load(&arguments.dir, &layout).map_err(other)?;
    let control = match arguments.control {
        Some(bind) => Some(Control::bind(bind).await.map_err(other)?),
        None => None,
    };
    let mut builder = Network::builder().layout(layout, pki);
    if let Some(rate) = arguments.rate {
        builder = builder.fill_rate(FillRate::PerSecond(rate));
    }
    if let Some(keys) = arguments.max_stored {
        builder = builder.max_stored(keys);
    }
    if let Some(keys) = arguments.stored {
        builder = builder.initially_stored(keys);
    }
    if let Some(bits) = arguments.key_size {
        builder = builder.key_size(bits);
    }
    if let Some(keys) = arguments.max_per_request {
        builder = builder.max_keys_per_request(keys);
    }
    if arguments.strict {
        builder = builder.strict();
    }
    let network = Arc::new(builder.start().await.map_err(other)?);
    for kme in network.kmes() {
        if let Some(time) = arguments.latency {
            kme.plan(FaultPlan::new(Fault::Latency(Duration::from_millis(time))));
        }
        let its = arguments.faults.iter().filter(|(id, _)| id == kme.id());
        its.for_each(|(_, plan)| kme.plan(plan.clone()));
        say(&format!("{} {}\n", kme.id(), kme.url()));
    }
    let control = control.map(|control| {
        say(&format!("control http://{}\n", control.addr()));
        tokio::spawn(control.serve(Arc::clone(&network)))
    });
    tokio::signal::ctrl_c().await.map_err(other)?;
    if let Some(task) = control {
        task.abort();
    }
    for kme in network.kmes() {
        say(&format!("{} {:?}\n", kme.id(), kme.counters()));
    }
    Ok(())
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate: &f64| rate.is_finite() && *rate >= 0.0);
    rate.ok_or_else(|| "a number from 0 is wanted".to_owned())
}

/// Parses `KME:PLAN`.
fn fault(text: &str) -> Result<(String, FaultPlan), String> {
    let (id, plan) = text.split_once(':').ok_or("KME:PLAN is wanted")?;
    Ok((id.to_owned(), plan.parse()?))
}
