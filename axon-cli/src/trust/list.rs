//! `axon trust list`: lists the keys in a trust file.

use std::{io::Write as _, path::PathBuf, time::SystemTime};

use axon_tls::identity::{SpkiDigest, TrustFile};
use axon_transport::config::{ClassicConfig, Config, Security};

use super::{cli, files};
use crate::{
    failure::CliError,
    logging,
    say::say,
    text::{TextTable, printable},
};

/// Runs `axon trust list`.
pub(super) fn run(args: &cli::List) -> Result<(), CliError> {
    let (trust, key) = paths(args)?;
    let file = files::trust(&trust)?;
    let own = key.as_deref().map(files::key).transpose()?.map(|key| key.spki_digest());
    let text = render(&file, own, SystemTime::now());
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// Returns the paths of the trust file, and of this host's key if it has one. Arguments take
/// precedence over settings.
fn paths(args: &cli::List) -> Result<(PathBuf, Option<PathBuf>), CliError> {
    if let Some(file) = &args.file {
        // A file can be listed before the settings are complete.
        let key = args.key.clone().or_else(|| match Config::from_env() {
            Ok(config) => classic(config).and_then(|classic| classic.key),
            Err(error) => {
                let error = printable(&error.to_string());
                say(format_args!("axon: this host's key is not marked: {error}"));
                None
            }
        });
        return Ok((file.clone(), key));
    }
    let configured = classic(logging::check()?);
    let (trust, key) = configured.map_or((None, None), |classic| (classic.trust, classic.key));
    let missing = "AXON_CLASSIC_TRUST: not set, accepted: the path of a trust file, or give it as \
                   an argument";
    let trust = trust.ok_or_else(|| CliError::Setting(missing.to_owned()))?;
    Ok((trust, args.key.clone().or(key)))
}

fn classic(config: Config) -> Option<ClassicConfig> {
    match config.security {
        Security::Classic(classic) => Some(classic),
        Security::Qkd(_) => None,
    }
}

fn render(file: &TrustFile, own: Option<SpkiDigest>, now: SystemTime) -> String {
    let mut table = TextTable::new(&["name", "key", "not after", "state"]);
    for pin in file.pins() {
        let state = if pin.holds(now) { "valid" } else { "expired" };
        let mark = if own == Some(pin.key()) { ", this host" } else { "" };
        table.row([
            pin.name().to_owned(),
            pin.key().to_string(),
            pin.last_day().unwrap_or("-").to_owned(),
            format!("{state}{mark}"),
        ]);
    }
    let mut out = match table.is_empty() {
        true => "no keys: nobody is trusted\n".to_owned(),
        false => table.render(0),
    };
    if let Some(own) = own {
        out += &format!("\nthis host: {own}\n");
    }
    out
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_trust_list_shows_key_validity_and_marks_the_local_key() {
        let [ours, theirs] = [1, 2].map(|byte| SpkiDigest([byte; 32]));
        let text = format!("base {ours}\narm {theirs} 2024-02-29\n");
        let file = TrustFile::parse(&text).unwrap();
        let midnight = SystemTime::UNIX_EPOCH + Duration::from_secs(1_709_251_200);
        let states = |now| {
            let text = render(&file, Some(ours), now);
            let cells = |line: &str| line.rsplit("  ").next().unwrap_or_default().trim().to_owned();
            text.lines().skip(2).take(2).map(cells).collect::<Vec<_>>()
        };
        assert_eq!(states(midnight - Duration::from_secs(1)), ["valid", "valid, this host"]);
        assert_eq!(states(midnight), ["expired", "valid, this host"]);
        assert!(render(&TrustFile::default(), None, midnight).contains("nobody"));
    }
}
