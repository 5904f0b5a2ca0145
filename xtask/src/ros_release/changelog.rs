//! `CHANGELOG.rst`, as catkin_pkg reads it: for a release, and as Debian writes it.

/// The changes of a version.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Section {
    pub(super) version: String,
    /// `2026-01-31`
    pub(super) date: String,
    items: Vec<String>,
}

/// The heading of the changes since the last version.
const FORTHCOMING: &str = "Forthcoming";

/// The changelog in which `version` has a section; true if that one was called Forthcoming. Other changes under
/// Forthcoming, of a version that is out, are left out.
pub(super) fn released(text: &str, version: &str, date: &str) -> Result<(String, bool), String> {
    let lines: Vec<&str> = text.lines().collect();
    let headings = headings(&lines);
    let has_version =
        headings.iter().any(|&at| parse_heading(lines[at]).is_some_and(|(v, _)| v == version));
    let forthcoming = headings.iter().copied().find(|&at| lines[at] == FORTHCOMING);
    let mut made: Vec<String> = lines.iter().map(|line| (*line).to_owned()).collect();
    match (has_version, forthcoming) {
        (true, None) => {}
        (true, Some(at)) => {
            let end = headings.iter().copied().find(|&other| other > at).unwrap_or(lines.len());
            made.drain(at..end);
        }
        (false, Some(at)) => {
            let heading = format!("{version} ({date})");
            made[at + 1] = "-".repeat(heading.len());
            made[at] = heading;
        }
        (false, None) => {
            return Err(format!(
                "CHANGELOG.rst has neither a section `{version} (YYYY-MM-DD)` nor `{FORTHCOMING}`: \
                 write what changed since the last version"
            ));
        }
    }
    let made = made.join("\n") + "\n";
    if sections(&made)?.first().is_none_or(|first| first.version != version) {
        return Err(format!("the first section of CHANGELOG.rst is not that of version {version}"));
    }
    Ok((made, !has_version))
}

/// The sections of versions, as they stand in the file: the newest first.
pub(super) fn sections(text: &str) -> Result<Vec<Section>, String> {
    let lines: Vec<&str> = text.lines().collect();
    let headings = headings(&lines);
    let ends = headings.iter().copied().skip(1).chain([lines.len()]);
    let mut sections = Vec::new();
    for (&at, end) in headings.iter().zip(ends) {
        if lines[at] == FORTHCOMING {
            continue;
        }
        let (version, date) = parse_heading(lines[at]).ok_or_else(|| {
            format!(
                "CHANGELOG.rst: a heading is `0.1.0 (2026-01-31)` or `{FORTHCOMING}`, not `{}`",
                lines[at]
            )
        })?;
        let items = items(&lines[at + 2..end]);
        sections.push(Section { version: version.to_owned(), date: date.to_owned(), items });
    }
    Ok(sections)
}

/// Returns the indices of the lines that are underlined with dashes.
fn headings(lines: &[&str]) -> Vec<usize> {
    let is_rule = |line: &&str| line.len() > 2 && line.chars().all(|c| c == '-');
    (0..lines.len().saturating_sub(1))
        .filter(|&at| !lines[at].trim().is_empty() && is_rule(&lines[at + 1]))
        .collect()
}

fn parse_heading(line: &str) -> Option<(&str, &str)> {
    let (version, date) = line.strip_suffix(')')?.split_once(" (")?;
    let is_version = version.split('.').count() == 3
        && version
            .split('.')
            .all(|part| !part.is_empty() && part.bytes().all(|b| b.is_ascii_digit()));
    (is_version && parse_date(date).is_some()).then_some((version, date))
}

/// Each item in one line. Literals lose their quotes, which are those of reStructuredText.
fn items(lines: &[&str]) -> Vec<String> {
    let mut items: Vec<String> = Vec::new();
    for line in lines.iter().map(|line| line.trim_end()).filter(|line| !line.is_empty()) {
        match (line.strip_prefix("* "), items.last_mut()) {
            (Some(start), _) => items.push(start.to_owned()),
            (None, Some(item)) => *item = format!("{item} {}", line.trim_start()),
            (None, None) => items.push(line.to_owned()),
        }
    }
    items.into_iter().map(|item| item.replace("``", "")).collect()
}

/// Debian's changelog of a package: an entry for each version.
pub(super) fn debian(sections: &[Section], package: &str, suite: &str, maintainer: &str) -> String {
    let mut made = String::new();
    for section in sections {
        made.push_str(&format!(
            "{package} ({}-1{suite}) {suite}; urgency=medium\n\n",
            section.version
        ));
        for item in &section.items {
            made.push_str(&wrapped(item));
        }
        let date = rfc_2822(&section.date).unwrap_or_default();
        made.push_str(&format!("\n -- {maintainer}  {date}\n\n"));
    }
    made.truncate(made.trim_end().len());
    made + "\n"
}

/// An item in lines of at most 79 characters, if its words allow that.
fn wrapped(item: &str) -> String {
    let mut lines = vec![String::from("  *")];
    for word in item.split_whitespace() {
        let last = lines.last_mut().expect("there is one");
        if last.chars().count() + 1 + word.chars().count() > 79 && last.trim() != "*" {
            lines.push(format!("    {word}"));
        } else {
            last.push(' ');
            last.push_str(word);
        }
    }
    lines.join("\n") + "\n"
}

fn parse_date(date: &str) -> Option<(i64, usize, i64)> {
    let mut parts = date.split('-');
    let (year, month, day) = (parts.next()?, parts.next()?, parts.next()?);
    let fits = year.len() == 4 && month.len() == 2 && day.len() == 2 && parts.next().is_none();
    let (year, month, day) = (year.parse().ok()?, month.parse().ok()?, day.parse().ok()?);
    (fits && (1..=12).contains(&month) && (1..=31).contains(&day)).then_some((year, month, day))
}

/// Midnight of a day, as Debian's changelog writes it.
fn rfc_2822(date: &str) -> Option<String> {
    const MONTHS: [&str; 12] =
        ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
    const DAYS: [&str; 7] = ["Sun", "Mon", "Tue", "Wed", "Thu", "Fri", "Sat"];
    // Sakamoto's table of the days by which a month begins later in the week.
    const OFFSETS: [i64; 12] = [0, 3, 2, 5, 0, 3, 5, 1, 4, 6, 2, 4];
    let (year, month, day) = parse_date(date)?;
    let of = if month < 3 { year - 1 } else { year };
    let weekday = (of + of / 4 - of / 100 + of / 400 + OFFSETS[month - 1] + day) % 7;
    let weekday = DAYS[usize::try_from(weekday).ok()?];
    Some(format!("{weekday}, {day:02} {} {year} 00:00:00 +0000", MONTHS[month - 1]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "^^^^\nLog\n^^^^\n\nForthcoming\n-----------\n* One of ``rmw``,\n  in two lines.\n* Two.\n\n\
        0.1.0 (2026-01-31)\n------------------\n* First.\n";

    #[test]
    fn forthcoming_becomes_the_version_that_has_no_section() {
        let (made, was_forthcoming) = released(TEXT, "0.2.0", "2026-03-01").unwrap();
        assert!(was_forthcoming);
        assert!(made.contains("\n0.2.0 (2026-03-01)\n------------------\n* One of"), "{made}");
        assert!(!made.contains(FORTHCOMING));
        let sections = sections(&made).unwrap();
        assert_eq!(sections[0].items, ["One of rmw, in two lines.", "Two."]);
        assert_eq!(sections[1].version, "0.1.0");
    }

    #[test]
    fn later_changes_are_not_part_of_a_version_that_is_out() {
        let (made, was_forthcoming) = released(TEXT, "0.1.0", "2026-03-01").unwrap();
        assert!(!was_forthcoming && !made.contains("Two."), "{made}");
        assert_eq!(sections(&made).unwrap().len(), 1);
    }

    #[test]
    fn version_has_to_be_the_newest_section() {
        let old = "0.1.0 (2026-01-31)\n------------------\n* First.\n";
        assert!(released(old, "0.2.0", "2026-03-01").unwrap_err().contains("write what changed"));
        let two = format!("0.2.0 (2026-02-01)\n------------------\n* Second.\n\n{old}");
        assert!(released(&two, "0.1.0", "2026-03-01").unwrap_err().contains("first section"));
        assert!(sections("Unreleased\n----------\n* x\n").unwrap_err().contains("`Unreleased`"));
    }

    #[test]
    fn debian_changelog_has_an_entry_a_version() {
        let (text, _) = released(TEXT, "0.2.0", "2026-03-01").unwrap();
        let made = debian(&sections(&text).unwrap(), "ros-jazzy-a", "noble", "A <a@b.c>");
        assert_eq!(
            made,
            "ros-jazzy-a (0.2.0-1noble) noble; urgency=medium\n\n  * One of rmw, in two lines.\n  * Two.\n\n \
             -- A <a@b.c>  Sun, 01 Mar 2026 00:00:00 +0000\n\n\
             ros-jazzy-a (0.1.0-1noble) noble; urgency=medium\n\n  * First.\n\n \
             -- A <a@b.c>  Sat, 31 Jan 2026 00:00:00 +0000\n"
        );
    }

    #[test]
    fn long_items_are_wrapped() {
        let made = wrapped(&"word ".repeat(40));
        assert!(made.lines().count() == 3 && made.lines().all(|line| line.len() < 80), "{made}");
        assert!(made.lines().skip(1).all(|line| line.starts_with("    word")), "{made}");
    }

    #[test]
    fn weekdays_are_those_of_the_calendar() {
        assert_eq!(rfc_2822("2024-02-29").unwrap(), "Thu, 29 Feb 2024 00:00:00 +0000");
        assert_eq!(rfc_2822("2000-01-01").unwrap(), "Sat, 01 Jan 2000 00:00:00 +0000");
        assert_eq!(rfc_2822("2024-13-01"), None);
    }
}
