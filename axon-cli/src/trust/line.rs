//! Formats a line to be added to a trust file.

use axon_tls::identity::{SpkiDigest, TrustFile};

use crate::{failure::CliError, text::printable};

/// Returns `NAME spki-sha256:BASE64`.
///
/// # Errors
/// A trust file that contains the line would not return this exact name.
pub(super) fn line(name: &str, key: SpkiDigest) -> Result<String, CliError> {
    let line = format!("{name} {key}");
    let read = TrustFile::parse(&line);
    let means_it = read.is_ok_and(|file| {
        let mut pins = file.pins();
        pins.next().is_some_and(|pin| pin.name() == name && pin.key() == key)
    });
    if means_it {
        return Ok(line);
    }
    Err(CliError::Setting(format!(
        "{:?} cannot be a name in a trust file: at most 255 printable ASCII characters, no space, \
         no #; choose one with --name",
        printable(name)
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trust_line_refuses_unparsable_names() {
        let key = SpkiDigest([7; 32]);
        assert_eq!(line("arm-2", key).unwrap(), format!("arm-2 {key}"));
        let long = "x".repeat(256);
        for name in ["", " ", "a b", "#a", "a#b", "a\nb", "\u{e4}", "a\x1b[2J", &long] {
            assert!(line(name, key).is_err(), "{name:?}");
        }
    }
}
