//! `kme-sim init`: certificates, keys and the environment to use them.

use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use etsi_qkd014::sim::{Layout, Pki, Site};

use crate::{CommandFailure, CommandResult, layout_file, other, say};

/// Writes a throw-away CA and the certificates and keys of every KME and SAE into a directory, and
/// prints the environment of each SAE.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The directory; made if need be.
    dir: PathBuf,
    /// A KME and the SAEs attached to it. Default: kme-a=127.0.0.1:8443=sae-a and
    /// kme-b=127.0.0.2:8443=sae-b.
    #[arg(long = "kme", value_name = "ID=ADDRESS:PORT=SAE[,SAE...]", value_parser = site)]
    sites: Vec<Site>,
    /// Replaces the files of an earlier run.
    #[arg(long)]
    force: bool,
}

pub(crate) fn init(arguments: &Arguments) -> CommandResult {
    let dir = &arguments.dir;
    let mut layout = Layout { sites: arguments.sites.clone() };
    if layout.sites.is_empty() {
        let default = ["kme-a=127.0.0.1:8443=sae-a", "kme-b=127.0.0.2:8443=sae-b"];
        layout.sites = default.map(site).into_iter().collect::<Result<_, _>>().map_err(other)?;
    }
    if let Some(site) = layout.sites.iter().find(|site| site.bind.port() == 0) {
        return Err(CommandFailure::Usage(format!(
            "{} needs a port: its URL is printed now",
            site.kme
        )));
    }
    let pki = Pki::create(&layout).map_err(other)?;
    if !arguments.force
        && let Some(file) = present(dir, &layout)
    {
        return Err(other(format!(
            "{} is there already, and nothing was written: name another directory, or say --force to \
             replace the certificates and keys in this one",
            file.display()
        )));
    }
    pki.write(dir).map_err(other)?;
    let text = serde_json::to_string_pretty(&layout).map_err(other)?;
    let file = layout_file(dir);
    fs::write(&file, text).map_err(|e| other(format!("{}: {e}", file.display())))?;
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

/// Returns a file of an earlier run that would be replaced. A dangling link counts as one.
fn present(dir: &Path, layout: &Layout) -> Option<PathBuf> {
    let ids = layout.sites.iter().flat_map(|site| site.saes.iter().chain([&site.kme]));
    let pairs = ids.flat_map(|id| [format!("{id}.crt"), format!("{id}.key")]);
    let files = pairs.chain(["ca.pem".to_owned()]).map(|name| dir.join(name));
    files.chain([layout_file(dir)]).find(|file| file.symlink_metadata().is_ok())
}

fn site(text: &str) -> Result<Site, String> {
    let wrong = |why: &str| format!("{why}; wanted: ID=ADDRESS:PORT=SAE[,SAE...]");
    let [kme, bind, saes] = text.split('=').collect::<Vec<_>>()[..] else {
        return Err(wrong("not three parts"));
    };
    let bind = bind.parse().map_err(|_| wrong("no address and port"))?;
    let saes = saes.split(',').map(str::to_owned).collect();
    Ok(Site { kme: kme.to_owned(), bind, saes })
}
