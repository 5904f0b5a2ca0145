//! Expressions for DDS names: those of POSIX's `fnmatch` without flags, so `*` and `?` also match slashes.

/// The longest expression, in bytes.
const MAX_EXPRESSION_BYTES: usize = 4096;

/// A well-formed expression.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Expression(String);

/// One step of an expression.
enum ExpressionStep<'a> {
    /// `*`.
    Many,
    /// `?`.
    One,
    Character(char),
    /// A bracket expression, without the `!` or `^`.
    Set {
        inner: &'a str,
        inverted: bool,
    },
}

impl Expression {
    /// Checks an expression.
    ///
    /// # Errors
    /// `fnmatch` would match no name with it, or the result would depend on the locale; or it is too long.
    pub fn new(text: &str) -> Result<Self, &'static str> {
        if text.len() > MAX_EXPRESSION_BYTES {
            return Err("longer than 4,096 bytes");
        }
        let mut rest = text;
        while !rest.is_empty() {
            let (step, behind) = step(rest).ok_or("ends in a backslash")?;
            if let ExpressionStep::Set { inner, .. } = step {
                let mut members = inner;
                while let Some((_, behind)) = member(members)? {
                    members = behind;
                }
            }
            rest = behind;
        }
        Ok(Self(text.to_owned()))
    }

    /// Returns whether the expression matches a name.
    pub fn fits(&self, name: &str) -> bool {
        let (mut pattern, mut name) = (self.0.as_str(), name);
        // The expression behind the last star, and the rest of the name that the star has not matched.
        let mut retry: Option<(&str, &str)> = None;
        loop {
            let character = name.chars().next();
            match (step(pattern), character) {
                (Some((ExpressionStep::Many, behind)), _) => {
                    retry = Some((behind, name));
                    pattern = behind;
                    continue;
                }
                (Some((step, behind)), Some(c)) if step.fits(c) => {
                    pattern = behind;
                    name = &name[c.len_utf8()..];
                    continue;
                }
                (None, None) => return true,
                _ => {}
            }
            // The star matches one more character.
            let Some((behind, left)) = retry else { return false };
            let Some(c) = left.chars().next() else { return false };
            name = &left[c.len_utf8()..];
            pattern = behind;
            retry = Some((behind, name));
        }
    }

    /// Returns the expression as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl ExpressionStep<'_> {
    /// Returns whether the step matches a character.
    fn fits(&self, c: char) -> bool {
        match *self {
            Self::Many | Self::One => true,
            Self::Character(one) => one == c,
            Self::Set { inner, inverted } => {
                let mut members = inner;
                let mut found = false;
                while let Ok(Some((member, behind))) = member(members) {
                    found |= match member {
                        Member::Range(low, high) => (low..=high).contains(&c),
                        Member::Class(class) => class(&c),
                    };
                    members = behind;
                }
                found != inverted
            }
        }
    }
}

/// Splits off the first step of a pattern. Returns `None` at its end, or if a backslash escapes nothing.
fn step(pattern: &str) -> Option<(ExpressionStep<'_>, &str)> {
    let mut characters = pattern.chars();
    let step = match characters.next()? {
        '*' => ExpressionStep::Many,
        '?' => ExpressionStep::One,
        '\\' => ExpressionStep::Character(characters.next()?),
        '[' => {
            let (inner, behind) = match set(characters.as_str()) {
                Some(found) => found,
                // No bracket closes it, so it is a character.
                None => return Some((ExpressionStep::Character('['), characters.as_str())),
            };
            let positive = inner.strip_prefix(['!', '^']);
            let inverted = positive.is_some();
            return Some((
                ExpressionStep::Set { inner: positive.unwrap_or(inner), inverted },
                behind,
            ));
        }
        other => ExpressionStep::Character(other),
    };
    Some((step, characters.as_str()))
}

/// Splits `open`, the text after an opening bracket: the text up to the closing bracket, and the text behind that.
fn set(open: &str) -> Option<(&str, &str)> {
    // A closing bracket in first place is a member of the set.
    let mut at = usize::from(open.starts_with(['!', '^']));
    at += usize::from(open[at..].starts_with(']'));
    loop {
        let rest = &open[at..];
        let special = ["[:", "[=", "[."].iter().find(|start| rest.starts_with(**start));
        let skipped = special.and_then(|start| {
            let end = format!("{}]", &start[1..]);
            rest[2..].find(&end).map(|found| found + 4)
        });
        let c = rest.chars().next()?;
        at += match (skipped, c) {
            (Some(length), _) => length,
            (None, ']') => return Some((&open[..at], &open[at + 1..])),
            (None, '\\') => 1 + rest[1..].chars().next()?.len_utf8(),
            (None, c) => c.len_utf8(),
        };
    }
}

/// A member of a set.
enum Member {
    Range(char, char),
    Class(fn(&char) -> bool),
}

/// Splits off the first member of a set.
fn member(inner: &str) -> Result<Option<(Member, &str)>, &'static str> {
    if inner.starts_with("[=") || inner.starts_with("[.") {
        return Err("has an equivalence class or a collating symbol");
    }
    if let Some((name, behind)) = inner.strip_prefix("[:").and_then(|named| named.split_once(":]"))
    {
        let class = class(name).ok_or("has a class of characters that there is not")?;
        return Ok(Some((Member::Class(class), behind)));
    }
    let Some((low, behind)) = character(inner) else { return Ok(None) };
    let range = behind.strip_prefix('-').filter(|end| !end.is_empty());
    if range.is_some_and(|end| ["[:", "[=", "[."].iter().any(|start| end.starts_with(start))) {
        return Err("has a range that ends in a class");
    }
    match range.and_then(character) {
        Some((high, behind)) => Ok(Some((Member::Range(low, high), behind))),
        None => Ok(Some((Member::Range(low, low), behind))),
    }
}

fn character(text: &str) -> Option<(char, &str)> {
    let text = text.strip_prefix('\\').filter(|escaped| !escaped.is_empty()).unwrap_or(text);
    let c = text.chars().next()?;
    Some((c, &text[c.len_utf8()..]))
}

/// Returns the class of characters of this name, as in the C locale.
fn class(name: &str) -> Option<fn(&char) -> bool> {
    Some(match name {
        "alnum" => char::is_ascii_alphanumeric,
        "alpha" => char::is_ascii_alphabetic,
        "blank" => |c| matches!(c, ' ' | '\t'),
        "cntrl" => char::is_ascii_control,
        "digit" => char::is_ascii_digit,
        "graph" => char::is_ascii_graphic,
        "lower" => char::is_ascii_lowercase,
        "print" => |c| c.is_ascii_graphic() || *c == ' ',
        "punct" => char::is_ascii_punctuation,
        "space" => |c| c.is_ascii_whitespace() || *c == '\u{b}',
        "upper" => char::is_ascii_uppercase,
        "xdigit" => char::is_ascii_hexdigit,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fits(expression: &str, name: &str) -> bool {
        Expression::new(expression).unwrap().fits(name)
    }

    #[test]
    fn stars_and_question_marks_stand_for_slashes() {
        for (expression, name) in [
            ("*", ""),
            ("*", "rt/a/b"),
            ("rt/*", "rt/a/b"),
            ("rt/*/c", "rt/a/b/c"),
            ("rt?a", "rt/a"),
            ("rt/[a-c][!d]", "rt/ae"),
            ("rt/[]]", "rt/]"),
            ("rt/[!]]", "rt/a"),
            ("rt/[a", "rt/[a"),
            ("rt/\\*", "rt/*"),
            ("rt/[[:digit:]_]x", "rt/7x"),
            ("rt/[a-]", "rt/-"),
            ("*a*b*", "aab"),
        ] {
            assert!(fits(expression, name), "{expression} {name}");
        }
        for (expression, name) in [
            ("", "a"),
            ("rt/a", "rt/A"),
            ("rt/a", "rt/ab"),
            ("rt/a?", "rt/a"),
            ("rt/*/c", "rt/c"),
            ("rt/[!a]", "rt/a"),
            ("rt/[c-a]", "rt/b"),
            ("rt/\\*", "rt/a"),
            ("*a*b", "abc"),
        ] {
            assert!(!fits(expression, name), "{expression} {name}");
        }
    }

    #[test]
    fn an_expression_that_fnmatch_knows_otherwise_is_refused() {
        let long = "a".repeat(MAX_EXPRESSION_BYTES + 1);
        for wrong in ["a\\", "[[=a=]]", "[[.a.]]", "[[:vowel:]]", "[a-[:digit:]]", &long] {
            Expression::new(wrong).unwrap_err();
        }
        Expression::new(&long[1..]).unwrap();
    }

    #[test]
    fn many_stars_take_no_more_than_the_product_of_both_lengths() {
        let expression = Expression::new(&"*a".repeat(MAX_EXPRESSION_BYTES / 2)).unwrap();
        assert!(!expression.fits(&"a".repeat(MAX_EXPRESSION_BYTES / 2 - 1)));
        assert!(!expression.fits(&format!("{}b", "a".repeat(50_000))));
    }
}
