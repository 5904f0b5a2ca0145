//! Reads files that tell which SAE a host is, in the form that `kme-sim init` prints: one line for
//! each variable, `export NAME='VALUE'`, with a shell's quoting. A shell's expansions are not
//! performed.

use std::path::Path;

/// The variables that the file may set.
const KNOWN: [&str; 9] = [
    "AXON_KME_URL",
    "AXON_KME_CA",
    "AXON_KME_ID",
    "AXON_KME_QUIRKS",
    "AXON_KME_CONNECT_TIMEOUT",
    "AXON_KME_ANSWER_TIMEOUT",
    "AXON_SAE_ID",
    "AXON_SAE_CERT",
    "AXON_SAE_KEY",
];

/// The variables that the file must set.
const REQUIRED: [&str; 5] =
    ["AXON_KME_URL", "AXON_KME_CA", "AXON_SAE_ID", "AXON_SAE_CERT", "AXON_SAE_KEY"];

/// The length of the largest file that is read.
const MAX: u64 = 64 << 10;

/// Reads a file. An error names the path, and the line if a line is wrong.
pub(crate) fn read(path: &Path) -> Result<Vec<(String, String)>, String> {
    let failed = |why: String| format!("{}: {why}", path.display());
    let length = std::fs::metadata(path).map_err(|e| failed(e.to_string()))?.len();
    if length > MAX {
        return Err(failed(format!("{length} bytes, accepted: at most {MAX}")));
    }
    let text = std::fs::read_to_string(path).map_err(|e| failed(e.to_string()))?;
    parse(&text).map_err(failed)
}

fn parse(text: &str) -> Result<Vec<(String, String)>, String> {
    let mut variables: Vec<(String, String)> = Vec::new();
    for (line, number) in text.lines().zip(1..) {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let assignment = line.strip_prefix("export ").unwrap_or(line).trim_start();
        let (name, value) = assignment
            .split_once('=')
            .and_then(|(name, value)| Some((name, unquoted(value)?)))
            .ok_or_else(|| format!("line {number} is not of the form export NAME='VALUE'"))?;
        if !KNOWN.contains(&name) {
            let accepted = KNOWN.join(", ");
            return Err(format!("line {number} sets {name}, accepted: {accepted}"));
        }
        if variables.iter().any(|(known, _)| known == name) {
            return Err(format!("line {number} sets {name} again; a file is for one SAE"));
        }
        variables.push((name.to_owned(), value));
    }
    let set =
        |name: &&str| variables.iter().any(|(known, value)| known == *name && !value.is_empty());
    match REQUIRED.iter().find(|name| !set(name)) {
        Some(missing) => Err(format!("{missing} is not set")),
        None => Ok(variables),
    }
}

/// Returns a value without its quotes. Returns `None` if a shell would read the value differently.
fn unquoted(value: &str) -> Option<String> {
    if let Some(inner) = value.strip_prefix('\'') {
        let inner = inner.strip_suffix('\'')?.replace("'\\''", "\0");
        return (!inner.contains('\'')).then(|| inner.replace('\0', "'"));
    }
    let (value, special) = match value.strip_prefix('"') {
        Some(inner) => (inner.strip_suffix('"')?, "\"\\$`"),
        None => (value, "\"'\\$`;&|<>()*?[]#~ \t"),
    };
    (!value.contains(|c| special.contains(c))).then(|| value.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = "# sae-a\nexport AXON_KME_URL='https://127.0.0.1:8443'\n\
        AXON_KME_CA=/certs/ca.pem\n\n  export AXON_SAE_ID=\"sae-a\"\n\
        export AXON_SAE_CERT='/it'\\''s here/sae-a.crt'\nexport AXON_SAE_KEY='/certs/sae-a.key'\n";

    #[test]
    fn env_file_parses_shell_quoting() {
        let read = parse(WHOLE).expect("a whole file");
        let values: Vec<_> = read.iter().map(|(_, value)| value.as_str()).collect();
        let cert = "/it's here/sae-a.crt";
        let url = "https://127.0.0.1:8443";
        assert_eq!(values, [url, "/certs/ca.pem", "sae-a", cert, "/certs/sae-a.key"]);
    }

    #[test]
    fn env_file_errors_name_the_line_or_variable() {
        let with = |line: &str| parse(&format!("{WHOLE}{line}\n")).expect_err(line);
        for line in ["AXON_KME_ID", "AXON_KME_ID='a", "AXON_KME_ID=$HOME", "AXON_KME_ID=a b"] {
            assert!(with(line).contains("line 8 is not"), "{}", with(line));
        }
        assert!(with("PATH=/bin").contains("PATH"));
        assert!(with("AXON_SAE_ID='sae-b'").contains("again"));
        assert!(with("AXON_SECURITY_MODE=classic").contains("AXON_SECURITY_MODE"));
        for name in REQUIRED {
            let rest: Vec<_> = WHOLE.lines().filter(|line| !line.contains(name)).collect();
            assert_eq!(parse(&rest.join("\n")), Err(format!("{name} is not set")));
        }
    }
}
