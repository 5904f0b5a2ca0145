//! A file of access rules that somebody names: one of rules alone, or an `axon.toml` under any name.

use super::sources::is_setting_key;
use crate::access::{AccessError, AccessRules};

/// The rules of a file. One that has a setting is read as settings with rules among them, which `AXON_CONFIG` may
/// name; any other as `AXON_ACCESS_FILE` is.
///
/// # Errors
/// The first thing that is wrong with a rule. The settings are not looked at.
pub fn parse(text: &str, file: &str) -> Result<AccessRules, AccessError> {
    let table = text.parse::<toml::Table>();
    if table.is_ok_and(|table| table.keys().any(|key| is_setting_key(key))) {
        return AccessRules::parse_among_settings(text, file);
    }
    AccessRules::parse(text, file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{Party, Verb};

    const RULES: &str = "[[deny]]\npeer = \"*\"\ncall = \"/reboot\"\n";

    #[test]
    fn rules_are_found_alone_and_among_settings_whatever_the_file_is_called() {
        for settings in [
            "",
            "quic_cipher = \"aes-256-gcm\"\n",
            "[link]\nmtu = 1400\n",
            "[[topic]]\nname = \"/a\"\n",
            "[qkd]\nsae_id = \"a\"\n",
        ] {
            let rules = parse(&format!("{settings}{RULES}"), "robot.toml").unwrap();
            let line = 3 + settings.matches('\n').count();
            let decision = rules.check(Party::User(7), Verb::Call, "/reboot");
            assert_eq!(decision.line(), Some(line as u32), "{settings}");
        }
    }

    #[test]
    fn a_key_that_is_neither_rule_nor_setting_is_refused_where_there_are_rules_alone() {
        let error = parse(&format!("{RULES}[[alow]]\npeer = \"*\"\n"), "f").unwrap_err();
        assert!(error.what.contains("unknown key \"alow\""), "{error}");
        let among = format!("security_mode = \"classic\"\n{RULES}[[allow]]\npeer = 7\n");
        assert_eq!(parse(&among, "f").unwrap_err().line, 6);
        parse("# nothing", "f").unwrap_err();
        parse("= x", "f").unwrap_err();
    }
}
