//! Makes text from outside safe for a log line or a terminal.

/// Returns whether `c` is shown as itself. Control characters, line separators, marks that change the direction of
/// writing, and other characters without a shape of their own are not.
pub fn is_plain(c: char) -> bool {
    // The standard library has the table of printable characters, but also escapes quotes.
    matches!(c, '"' | '\'' | '\\') || c.escape_debug().len() == 1
}

/// `text` with each character that is not plain escaped.
pub fn escaped(text: &str) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut out, c| {
        if is_plain(c) {
            out.push(c);
        } else {
            out.extend(c.escape_unicode());
        }
        out
    })
}

/// The first `longest` characters of `text`, each that is not plain replaced by a space.
pub fn plain(text: &str, longest: usize) -> String {
    text.chars().take(longest).map(|c| if is_plain(c) { c } else { ' ' }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_character_that_steers_a_terminal_is_plain() {
        let bidirectional =
            "\u{61c}\u{200e}\u{200f}\u{202a}\u{202e}\u{2066}\u{2067}\u{2068}\u{2069}";
        let control = "\0\u{1b}\r\n\t\u{7f}\u{85}\u{9b}";
        let others = "\u{ad}\u{200b}\u{2028}\u{2029}\u{2060}\u{feff}\u{fff9}\u{e0041}";
        for c in bidirectional.chars().chain(control.chars()).chain(others.chars()) {
            assert!(!is_plain(c), "{c:?}");
        }
    }

    #[test]
    fn text_of_any_language_is_plain() {
        for text in ["/scan", "say \"it's\" \\", "Über", "カメラ", "صورة", "π≈3 ✓"] {
            assert_eq!(plain(text, 100), text);
        }
        assert_eq!(plain("a\u{2066}b\nc", 4), "a b ");
        assert_eq!(escaped("カメラ \"\u{1b}]0;evil\u{7}"), r#"カメラ "\u{1b}]0;evil\u{7}"#);
        assert_eq!(escaped("\0\u{202e}"), r"\u{0}\u{202e}");
    }
}
