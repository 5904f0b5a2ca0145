//! Runs `kme-sim probe` as a user does and reads its table.

#![allow(dead_code, reason = "each test program uses its part")]

use std::path::Path;
use std::process::Command;

/// The output of the probe, and whether its exit status reported success.
pub(crate) struct Probed {
    pub(crate) passed: bool,
    pub(crate) text: String,
}

/// One line of the table.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Row {
    pub(crate) clause: String,
    pub(crate) expected: String,
    pub(crate) verdict: String,
}

/// The variables that give the probe its identity.
pub(crate) type Env = Vec<(&'static str, String)>;

pub(crate) fn probe(env: &[(&str, String)], args: &[&str]) -> Probed {
    let mut command = Command::new(env!("CARGO_BIN_EXE_kme-sim"));
    command.arg("probe").args(["--slave-sae", "sae-b"]).args(args).env_clear();
    let output = command.envs(env.iter().map(|(name, value)| (name, value))).output().unwrap();
    let text = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
    assert!(matches!(output.status.code(), Some(0 | 1)), "{text}");
    Probed { passed: output.status.success(), text }
}

/// Writes environments as `kme-sim init` prints them; the file's name.
pub(crate) fn env_file(dir: &Path, all: &[Env]) -> String {
    let line = |(name, value): &(&str, String)| format!("export {name}='{value}'\n");
    let text: String = all.iter().flatten().map(line).collect();
    let file = dir.join("environment");
    std::fs::write(&file, text).unwrap();
    file.display().to_string()
}

impl Probed {
    pub(crate) fn rows(&self) -> Vec<Row> {
        let mut lines = self.text.lines();
        let head = lines.next().unwrap_or_default();
        let column = |name: &str| head.find(name).unwrap_or_else(|| panic!("{}", self.text));
        let (expected, came, verdict) = (column("expected"), column("came"), column("verdict"));
        let row = |line: &str| {
            let line: Vec<char> = line.chars().collect();
            let part = |from: usize, to: usize| {
                let to = to.min(line.len());
                let text: String = line.get(from..to)?.iter().collect();
                Some(text.trim().to_owned())
            };
            Some(Row {
                clause: part(0, expected)?,
                expected: part(expected, came)?,
                verdict: part(verdict, usize::MAX)?,
            })
        };
        lines.take_while(|line| !line.contains(" passed, ")).filter_map(row).collect()
    }

    /// Returns the expectations of the rows whose verdict begins with `verdict`.
    pub(crate) fn with(&self, verdict: &str) -> Vec<String> {
        let rows = self.rows().into_iter().filter(|row| row.verdict.starts_with(verdict));
        rows.map(|row| row.expected).collect()
    }
}
