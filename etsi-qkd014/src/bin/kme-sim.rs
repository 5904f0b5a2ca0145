//! `kme-sim`: KMEs to test an ETSI GS QKD 014 client against.
#![forbid(unsafe_code)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use etsi_qkd014::sim::{Fault, FaultPlan, FillRate, Layout, Network, NetworkBuilder, Pki, Site};

const HELP: &str = "\
KMEs that share key material as a QKD link does, over real mutual TLS. For tests only.

kme-sim init DIR [--kme ID=ADDRESS:PORT=SAE[,SAE...]]...
    Writes a throw-away CA and the certificates and keys of every KME and SAE into DIR, and prints
    the environment of each SAE. Without --kme: kme-a=127.0.0.1:8443=sae-a and
    kme-b=127.0.0.2:8443=sae-b.

kme-sim run DIR [--rate KEYS_PER_SECOND] [--max-stored KEYS] [--stored KEYS] [--key-size BITS]
                [--max-per-request KEYS] [--latency MILLISECONDS] [--fault KME:PLAN]...
    Serves the KMEs of DIR until it is interrupted. A PLAN is a fault and when it
    happens: cut, latency=250, status=500,probability=0.1 or reset,times=2,on=dec_keys.

Exit status: 0, 1 on failure, 2 on wrong arguments.
";

enum Failure {
    Usage(String),
    Other(String),
}

type Outcome<T = ()> = Result<T, Failure>;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let outcome = match args.as_slice() {
        ["-h" | "--help" | "help", ..] => {
            say(HELP);
            Ok(())
        }
        ["init", dir, rest @ ..] if !dir.starts_with('-') => init(Path::new(dir), rest),
        ["run", dir, rest @ ..] if !dir.starts_with('-') => run(Path::new(dir), rest),
        _ => Err(Failure::Usage("init DIR or run DIR is wanted".into())),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Usage(why)) => {
            eprintln!("kme-sim: {why}; see kme-sim --help");
            ExitCode::from(2)
        }
        Err(Failure::Other(why)) => {
            eprintln!("kme-sim: {why}");
            ExitCode::FAILURE
        }
    }
}

#[allow(clippy::print_stdout, reason = "this is what the program is asked to print")]
fn say(text: &str) {
    print!("{text}");
}

fn other(error: impl std::fmt::Display) -> Failure {
    Failure::Other(error.to_string())
}

fn layout_file(dir: &Path) -> PathBuf {
    dir.join("layout.json")
}

fn init(dir: &Path, args: &[&str]) -> Outcome {
    let mut layout = Layout::default();
    for (option, value) in options(args)? {
        match option {
            "--kme" => layout.sites.push(site(value)?),
            _ => return Err(Failure::Usage(format!("init does not know {option}"))),
        }
    }
    if layout.sites.is_empty() {
        layout.sites =
            vec![site("kme-a=127.0.0.1:8443=sae-a")?, site("kme-b=127.0.0.2:8443=sae-b")?];
    }
    if let Some(site) = layout.sites.iter().find(|site| site.bind.port() == 0) {
        return Err(Failure::Usage(format!("{} needs a port: its URL is printed now", site.kme)));
    }
    let pki = Pki::create(&layout).map_err(other)?;
    pki.write(dir).map_err(other)?;
    let text = serde_json::to_string_pretty(&layout).map_err(other)?;
    fs::write(layout_file(dir), text)
        .map_err(|e| other(format!("{}: {e}", layout_file(dir).display())))?;
    let dir = fs::canonicalize(dir).map_err(other)?;
    let mut out = String::new();
    for (sae, env) in layout.env(&dir) {
        out.push_str(&format!("# {sae}\n"));
        for (name, value) in env {
            out.push_str(&format!("export {name}='{}'\n", value.replace('\'', "'\\''")));
        }
    }
    say(&out);
    Ok(())
}

/// `ID=ADDRESS:PORT=SAE[,SAE...]`
fn site(text: &str) -> Outcome<Site> {
    let wrong = |why: &str| {
        Failure::Usage(format!("--kme {text:?}: {why}; wanted: ID=ADDRESS:PORT=SAE[,SAE...]"))
    };
    let [kme, bind, saes] = text.split('=').collect::<Vec<_>>()[..] else {
        return Err(wrong("not three parts"));
    };
    let bind = bind.parse().map_err(|_| wrong("no address and port"))?;
    let saes = saes.split(',').map(str::to_owned).collect();
    Ok(Site { kme: kme.to_owned(), bind, saes })
}

fn run(dir: &Path, args: &[&str]) -> Outcome {
    let file = layout_file(dir);
    let text = fs::read_to_string(&file)
        .map_err(|e| other(format!("{}: {e}; make it with kme-sim init", file.display())))?;
    let layout: Layout =
        serde_json::from_str(&text).map_err(|e| other(format!("{}: {e}", file.display())))?;
    let pki = Pki::load(dir, &layout).map_err(other)?;
    let (builder, plans) = settings(Network::builder().layout(layout, pki), args)?;
    let runtime = tokio::runtime::Runtime::new().map_err(other)?;
    runtime.block_on(async {
        let network = builder.start().await.map_err(other)?;
        if let Some(id) =
            plans.iter().filter_map(|(id, _)| id.as_ref()).find(|id| network.kme(id).is_none())
        {
            return Err(Failure::Usage(format!("--fault: there is no KME {id:?}")));
        }
        for kme in network.kmes() {
            let its = plans.iter().filter(|(id, _)| id.as_ref().is_none_or(|id| id == kme.id()));
            its.for_each(|(_, plan)| kme.plan(plan.clone()));
            say(&format!("{} {}\n", kme.id(), kme.url()));
        }
        tokio::signal::ctrl_c().await.map_err(other)?;
        for kme in network.kmes() {
            say(&format!("{} {:?}\n", kme.id(), kme.counters()));
        }
        Ok(())
    })
}

/// Faults from the start, of one KME or of all.
type Plans = Vec<(Option<String>, FaultPlan)>;

fn settings(mut builder: NetworkBuilder, args: &[&str]) -> Outcome<(NetworkBuilder, Plans)> {
    let mut plans = Vec::new();
    for (option, value) in options(args)? {
        builder = match option {
            "--rate" => {
                let rate: f64 = number(option, value)?;
                if !(rate.is_finite() && rate >= 0.0) {
                    return Err(Failure::Usage("--rate is a number from 0".into()));
                }
                builder.fill_rate(FillRate::PerSecond(rate))
            }
            "--max-stored" => builder.max_stored(number(option, value)?),
            "--stored" => builder.initially_stored(number(option, value)?),
            "--key-size" => builder.key_size(number(option, value)?),
            "--max-per-request" => builder.max_keys_per_request(number(option, value)?),
            "--latency" => {
                let fault = Fault::Latency(Duration::from_millis(number(option, value)?));
                plans.push((None, FaultPlan::new(fault)));
                builder
            }
            "--fault" => {
                let (id, plan) = value
                    .split_once(':')
                    .ok_or_else(|| Failure::Usage(format!("--fault {value:?} is not KME:PLAN")))?;
                let plan = plan.parse().map_err(|why| Failure::Usage(format!("--fault: {why}")))?;
                plans.push((Some(id.to_owned()), plan));
                builder
            }
            _ => return Err(Failure::Usage(format!("run does not know {option}"))),
        };
    }
    Ok((builder, plans))
}

fn number<T: std::str::FromStr>(option: &str, value: &str) -> Outcome<T> {
    value.parse().map_err(|_| Failure::Usage(format!("{option} {value:?} is not a number")))
}

/// `--option value` pairs.
fn options<'a>(args: &[&'a str]) -> Outcome<Vec<(&'a str, &'a str)>> {
    let pair = |pair: &[&'a str]| match pair {
        [option, value] => Ok((*option, *value)),
        rest => Err(Failure::Usage(format!("{} needs a value", rest.join(" ")))),
    };
    args.chunks(2).map(pair).collect()
}
