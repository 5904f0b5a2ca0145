//! `axon acl import`: writes rules from SROS2's documents.

mod convert;
mod document;
mod names;
mod notes;
mod permissions;
mod policy;
#[cfg(test)]
mod tests;

use std::{
    fs::File,
    io::{Read as _, Write as _},
    path::Path,
    process::ExitCode,
};

use axon_transport::internal::sros2::{
    document as read_document, signed,
    xml::{self, Lines},
};

use self::notes::Notes;
use super::{
    cli,
    write::{Uses, verify},
};
use crate::{failure::CliError, say::say, text::printable};

/// Runs `axon acl import`.
pub(super) fn run(args: &cli::Import) -> Result<ExitCode, CliError> {
    let of_peer = |what| CliError::Setting(format!("--peer {:?}: {what}", args.peer));
    verify(&Uses::default().toml("allow", &args.peer)).map_err(of_peer)?;
    let of_file = |what| CliError::failed(format!("{}: {what}", args.file.display()));
    let text = read(&args.file).map_err(of_file)?;
    let mut notes = Notes::default();
    let rules = import(&text, &args.peer, args.enclave.as_deref(), &mut notes);
    for line in notes.lines() {
        say(format_args!("axon: {line}"));
    }
    std::io::stdout().lock().write_all(rules.map_err(of_file)?.as_bytes())?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the text of a file. A file that is too large is refused.
fn read(path: &Path) -> Result<String, String> {
    let mut bytes = Vec::new();
    let mut file = File::open(path).map_err(|error| error.to_string())?.take(xml::LARGEST + 1);
    file.read_to_end(&mut bytes).map_err(|error| error.to_string())?;
    if bytes.len() as u64 > xml::LARGEST {
        return Err(format!("larger than {} bytes", xml::LARGEST));
    }
    String::from_utf8(bytes).map_err(|_| "not UTF-8".to_owned())
}

/// Returns the rules that a document gives a peer, as the text of a rules file.
fn import(
    text: &str,
    peer: &str,
    enclave: Option<&str>,
    notes: &mut Notes,
) -> Result<String, String> {
    let signed::Cleartext { text, lines_before } = signed::cleartext(text)?;
    let document = xml::parse(text)?;
    let lines = Lines::new(text, lines_before);
    let root = document.root_element();
    let grant = match root.tag_name().name() {
        "dds" => {
            permissions::choose_and_note(read_document::grants(root, &lines)?, enclave, notes)?
        }
        "policy" => policy::read(root, enclave, &lines, notes)?,
        other => {
            return Err(format!(
                "its first element is <{other}>; accepted: <dds> of permissions.xml, <policy> of SROS2"
            ));
        }
    };
    let rules = convert::convert(&grant, notes);
    if rules.allow.is_none() && rules.deny.is_empty() {
        return Err(
            "it denies nothing that rules here can deny, and allows by default: no rules".into()
        );
    }
    let mut out =
        format!("# {}\n", printable(&format!("Imported for {peer:?} from {:?}.", grant.enclave)));
    out += "# Each difference, and the line of the document that it is about:\n";
    for line in notes.lines() {
        out += &format!("# {line}\n");
    }
    for (header, uses) in [("deny", Some(&rules.deny)), ("allow", rules.allow.as_ref())] {
        if let Some(uses) = uses.filter(|uses| header == "allow" || !uses.is_empty()) {
            out += &format!("\n{}", uses.toml(header, peer));
        }
    }
    verify(&out)?;
    Ok(out)
}
