//! `axon acl test`: compares the rules of a file with the expectations in it.

use std::{io::Write as _, process::ExitCode};

use super::cli;
use crate::{
    failure::CliError,
    text::{TextTable, printable},
};

/// Runs `axon acl test`.
pub(super) fn run(args: &cli::Test) -> Result<ExitCode, CliError> {
    let rules = super::rules(Some(&args.file))?;
    let expectations = rules.expectations();
    if expectations.is_empty() {
        let file = args.file.display();
        return Err(CliError::failed(format!("{file} has no [[expect]]: nothing was tested")));
    }
    let mut table = TextTable::new(&[">line", "peer", "would", "expected", "is"]);
    let mut unmet = 0;
    for expected in expectations {
        let peer = super::party(&expected.peer).map_err(CliError::failed)?;
        let decision = rules.check(peer, expected.verb, &expected.name);
        if decision.allowed() != expected.allowed {
            unmet += 1;
            table.row([
                expected.line.to_string(),
                printable(&expected.peer),
                printable(&format!("{} {}", expected.verb, expected.name)),
                if expected.allowed { "allowed" } else { "denied" }.to_owned(),
                decision.to_string(),
            ]);
        }
    }
    let met = expectations.len() - unmet;
    let text = match unmet {
        0 => format!("{met} expectations, all met\n"),
        _ => {
            format!("{}\n{unmet} of {} expectations not met\n", table.render(0), expectations.len())
        }
    };
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(if unmet == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
