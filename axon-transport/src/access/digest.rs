//! A short digest by which two programs compare their rules.

use super::AccessRules;

impl AccessRules {
    /// Returns a digest of the rules, limits and expectations, with their lines, or `None` if there are none.
    /// Different rules normally have different digests, but an attacker can construct two rule sets with the same
    /// digest. Other versions of AXON may compute a different digest of the same rules.
    pub fn digest(&self) -> Option<String> {
        self.file()?;
        // FNV-1a. The text names each field, and its order is the same in each run.
        let text = format!("{:?} {:?} {:?}", self.rules, self.limits, self.interface_limits);
        let add = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        Some(format!("{:016x}", text.bytes().fold(0xcbf2_9ce4_8422_2325, add)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_digest_is_the_same_for_the_same_rules_and_another_one_for_others() {
        let of = |text: &str| AccessRules::parse(text, "access.toml").unwrap().digest().unwrap();
        let rules =
            "[[allow]]\npeer = \"a\"\npublish = \"/x\"\n[[limit]]\npeer = \"*\"\nrate = 5\n";
        assert_eq!(of(rules), of(rules));
        assert_eq!(of(rules), of(&format!("{rules}# a comment below all rules\n")));
        let others = [
            rules.replace("allow", "deny"),
            rules.replace("\"a\"", "\"b\""),
            rules.replace("publish", "subscribe"),
            rules.replace("/x", "/y"),
            rules.replace('5', "6"),
            format!("default = \"deny\"\n{rules}"),
            format!("{rules}[[limit]]\ninterface = \"wlan*\"\negress = \"30 Mbit/s\"\n"),
            format!("{rules}[[limit]]\ninterface = \"wlan*\"\negress = \"40 Mbit/s\"\n"),
            // Decisions name lines.
            format!("\n{rules}"),
        ];
        let mut all: Vec<_> = others.iter().map(|text| of(text)).chain([of(rules)]).collect();
        all.sort();
        all.dedup();
        assert_eq!(all.len(), others.len() + 1);
        assert_eq!(AccessRules::default().digest(), None);
    }
}
