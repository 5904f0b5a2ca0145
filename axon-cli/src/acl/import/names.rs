//! DDS topic names as ROS 2 and SROS2 write them, and the patterns of AXON that fit the same names.

use axon_transport::{access::TopicPattern, internal::sros2::names::TopicPart};

/// The most patterns that one expression may become.
const MAX_PATTERNS: usize = 16;

/// Returns the topic parts that a DDS expression stands for, each with the patterns that fit the same ROS names.
///
/// # Errors
/// No pattern is equivalent; the error says why.
pub(super) fn parts(expression: &str) -> Result<Vec<(TopicPart, Vec<String>)>, &'static str> {
    if !expression.is_empty() && expression.bytes().all(|byte| byte == b'*') {
        return Ok(TopicPart::ALL.map(|part| (part, vec!["/**".to_owned()])).into());
    }
    let is_of = |part: &TopicPart| {
        let name = expression.strip_prefix(part.mangling().0);
        name.is_some_and(|name| name.starts_with('/'))
    };
    let Some(part) = TopicPart::ALL.into_iter().find(is_of) else {
        return Err("not a topic of ROS 2: AXON carries those that begin with rt/, rq/ or rr/");
    };
    let suffix = part.mangling().1;
    // The name, with its leading slash.
    let name = &expression[2..];
    let name = match (name.strip_suffix(suffix), name.strip_suffix('*')) {
        (Some(name), _) => name,
        // The star also stands for the suffix. If the text before the star ends with the beginning of the suffix, no
        // pattern is equivalent.
        (None, Some(before)) if !(1..=suffix.len()).any(|n| before.ends_with(&suffix[..n])) => name,
        _ => return Err("not a service's: its topics end in Request and Reply"),
    };
    Ok(vec![(part, patterns(name)?)])
}

/// Returns the patterns that together fit what an expression fits. A `*` of an expression stands for any characters,
/// including slashes.
fn patterns(name: &str) -> Result<Vec<String>, &'static str> {
    if name.contains(['?', '[', '\\']) {
        return Err("AXON's patterns have * and ** alone, not ?, [ ] and \\");
    }
    let mut all = vec![String::new()];
    for segment in name.split('/').skip(1) {
        let ways = ways(segment);
        if all.len() * ways.len() > MAX_PATTERNS {
            return Err("too many * within segments");
        }
        let longer =
            |before: &String| ways.iter().map(|way| format!("{before}/{way}")).collect::<Vec<_>>();
        all = all.iter().flat_map(longer).collect();
    }
    for pattern in &mut all {
        // `/**` is equivalent here, because a name has at least one segment.
        if pattern == "/*/**" {
            "/**".clone_into(pattern);
        }
        TopicPattern::new(pattern)?;
    }
    Ok(all)
}

/// Returns the ways to write one segment of an expression. Its `*` may stand for slashes. A name has no empty segment.
fn ways(segment: &str) -> Vec<String> {
    let inner = segment.trim_matches('*');
    if inner.is_empty() && !segment.is_empty() {
        return vec!["*/**".to_owned()];
    }
    let mut all = vec![if segment.starts_with('*') { "**/*" } else { "" }.to_owned()];
    for (index, piece) in inner.split('*').filter(|piece| !piece.is_empty()).enumerate() {
        let between: &[&str] = if index == 0 { &[""] } else { &["*", "*/**/*"] };
        if all.len() > MAX_PATTERNS {
            break;
        }
        let longer = |before: &String| {
            between.iter().map(|star| format!("{before}{star}{piece}")).collect::<Vec<_>>()
        };
        all = all.iter().flat_map(longer).collect();
    }
    if segment.ends_with('*') {
        all.iter_mut().for_each(|way| way.push_str("*/**"));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_topics_and_services_are_unmangled() {
        for (expression, part, name) in [
            ("rt/chatter", TopicPart::Topic, "/chatter"),
            ("rt/*", TopicPart::Topic, "/**"),
            ("rt/camera/*", TopicPart::Topic, "/camera/*/**"),
            ("rt/camera*", TopicPart::Topic, "/camera*/**"),
            ("rt/*/cmd_vel", TopicPart::Topic, "/*/**/cmd_vel"),
            ("rq/add_two_intsRequest", TopicPart::Request, "/add_two_ints"),
            ("rr/a/bReply", TopicPart::Reply, "/a/b"),
            ("rq/*Request", TopicPart::Request, "/**"),
            ("rr/*", TopicPart::Reply, "/**"),
            ("rq/arm*", TopicPart::Request, "/arm*/**"),
        ] {
            let expected = vec![(part, vec![name.to_owned()])];
            assert_eq!(parts(expression), Ok(expected), "{expression}");
        }
        assert_eq!(parts("*").unwrap().len(), 3);
    }

    #[test]
    fn expressions_without_an_equivalent_pattern_are_refused() {
        let stars = format!("rt/{}", "a*".repeat(400_000));
        for expression in [
            "",
            "rt",
            "rt/",
            "Square",
            "r*",
            "rt*",
            "rt/a?",
            "rt/[ab]",
            "rt/a\\*",
            "rq/a",
            "rq/aReq*",
            "rr/aReply/",
            "rt//a",
            "rt/a/",
            &stars,
        ] {
            parts(expression).unwrap_err();
        }
    }

    /// Matches as fnmatch does without flags.
    fn fits(pattern: &[u8], name: &[u8]) -> bool {
        match (pattern.first(), name.first()) {
            (None, None) => true,
            (Some(b'*'), _) if fits(&pattern[1..], name) => true,
            (Some(b'*'), Some(_)) => fits(pattern, &name[1..]),
            (Some(one), Some(other)) => one == other && fits(&pattern[1..], &name[1..]),
            _ => false,
        }
    }

    /// Returns all names of up to `longest` of these characters after the leading slash, without empty segments.
    fn texts(characters: &[char], longest: usize) -> Vec<String> {
        let mut all = vec!["/".to_owned()];
        let mut last = all.clone();
        for _ in 0..longest {
            let longer =
                |text: &String| characters.iter().map(|c| format!("{text}{c}")).collect::<Vec<_>>();
            last = last.iter().flat_map(longer).collect();
            all.extend(last.iter().cloned());
        }
        all.retain(|text| !text.contains("//") && !text.ends_with('/'));
        all
    }

    #[test]
    fn patterns_fit_exactly_the_names_that_the_expression_fits() {
        let names = texts(&['a', 'b', '/'], 5);
        let mut compared = 0;
        for expression in texts(&['a', 'b', '/', '*'], 5) {
            let all = patterns(&expression).unwrap();
            let all: Vec<_> = all.iter().map(|text| TopicPattern::new(text).unwrap()).collect();
            for name in &names {
                let ours = all.iter().any(|pattern| pattern.fits(name));
                let theirs = fits(expression.as_bytes(), name.as_bytes());
                assert_eq!(ours, theirs, "{expression} {name} {all:?}");
                compared += 1;
            }
        }
        assert!(compared > 10_000);
    }
}
