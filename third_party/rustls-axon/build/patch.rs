//! A strict applier of unified diffs.
//!
//! It applies what `git diff` writes for changes within files, and only where it fits exactly: at
//! the line a hunk names, with every line of context equal. There is no fuzz and no search for a
//! hunk's place nearby, because a security patch that lands elsewhere is worse than none.

use std::collections::BTreeMap;

/// Applies every change in `diff` to `tree`. Text before the first change is a message to people.
///
/// On an error the tree is as far as the patch got: it must not be used.
pub(crate) fn apply(tree: &mut BTreeMap<String, String>, diff: &str) -> Result<(), String> {
    let mut lines = diff.lines().enumerate().peekable();
    while lines.next_if(|(_, line)| !line.starts_with("diff --git ")).is_some() {}
    if lines.peek().is_none() {
        return Err("changes no file".into());
    }

    while let Some((at, header)) = lines.next() {
        let path = changed_file(header)
            .ok_or_else(|| format!("line {}: not a change within a file below src/", at + 1))?;
        for expected in [format!("--- a/src/{path}"), format!("+++ b/src/{path}")] {
            match lines.next() {
                Some((_, line)) if line == expected => {}
                _ => return Err(format!("line {}: expected `{expected}` after this", at + 1)),
            }
        }

        let before = tree.get(path).ok_or_else(|| format!("src/{path} does not exist"))?;
        let mut file = Patched::new(before);
        if !lines.peek().is_some_and(|(_, line)| line.starts_with("@@ ")) {
            return Err(format!("src/{path} has no hunk"));
        }
        while let Some((at, header)) = lines.next_if(|(_, line)| line.starts_with("@@ ")) {
            let hunk = Hunk::parse(header).ok_or_else(|| format!("line {}: bad hunk", at + 1))?;
            file.apply(&hunk, &mut lines)
                .map_err(|why| format!("src/{path}, hunk at patch line {}: {why}", at + 1))?;
        }
        let after = file.finish();
        tree.insert(path.to_owned(), after);
    }
    Ok(())
}

/// The path in `diff --git a/src/PATH b/src/PATH`.
fn changed_file(header: &str) -> Option<&str> {
    let (a, b) = header.strip_prefix("diff --git a/src/")?.split_once(" b/src/")?;
    (a == b).then_some(a)
}

/// `@@ -old_start,old_len +new_start,new_len @@`
struct Hunk {
    old_start: usize,
    old_len: usize,
    new_start: usize,
    new_len: usize,
}

impl Hunk {
    fn parse(header: &str) -> Option<Self> {
        fn range(text: &str) -> Option<(usize, usize)> {
            let (start, len) = text.split_once(',').unwrap_or((text, "1"));
            Some((start.parse().ok()?, len.parse().ok()?))
        }

        let (ranges, _) = header.strip_prefix("@@ -")?.split_once(" @@")?;
        let (old, new) = ranges.split_once(" +")?;
        let ((old_start, old_len), (new_start, new_len)) = (range(old)?, range(new)?);
        // a hunk always has context here, so it has lines on both sides and starts at line 1 or on
        (old_start > 0 && new_start > 0 && old_len > 0 && new_len > 0).then_some(Self {
            old_start,
            old_len,
            new_start,
            new_len,
        })
    }
}

/// A file while it is patched: what is behind the last hunk, and what is before the next.
struct Patched<'a> {
    before: Vec<&'a str>,
    taken: usize,
    after: Vec<&'a str>,
}

impl<'a> Patched<'a> {
    fn new(before: &'a str) -> Self {
        Self { before: before.split('\n').collect(), taken: 0, after: Vec::new() }
    }

    fn apply<'d: 'a>(
        &mut self,
        hunk: &Hunk,
        lines: &mut impl Iterator<Item = (usize, &'d str)>,
    ) -> Result<(), String> {
        let start = hunk.old_start - 1;
        if start < self.taken || start > self.before.len() {
            return Err("starts before the last hunk ended, or behind the end of the file".into());
        }
        self.after.extend_from_slice(&self.before[self.taken..start]);
        self.taken = start;
        if self.after.len() != hunk.new_start - 1 {
            return Err("its two line numbers do not agree".into());
        }

        let (mut old_left, mut new_left) = (hunk.old_len, hunk.new_len);
        while old_left > 0 || new_left > 0 {
            let (_, line) = lines.next().ok_or("ends too early")?;
            // an empty line of context may have lost its one blank
            let (kind, text) = line.split_at_checked(1).unwrap_or((" ", ""));
            if matches!(kind, " " | "-") {
                if self.before.get(self.taken) != Some(&text) {
                    return Err(format!("line {} is not `{text}`", self.taken + 1));
                }
                self.taken += 1;
                old_left = old_left.checked_sub(1).ok_or("has more lines than it says")?;
            }
            match kind {
                " " | "+" => {
                    self.after.push(text);
                    new_left = new_left.checked_sub(1).ok_or("has more lines than it says")?;
                }
                "-" => {}
                _ => return Err(format!("not a line of a hunk: `{line}`")),
            }
        }
        Ok(())
    }

    fn finish(mut self) -> String {
        self.after.extend_from_slice(&self.before[self.taken..]);
        self.after.join("\n")
    }
}
