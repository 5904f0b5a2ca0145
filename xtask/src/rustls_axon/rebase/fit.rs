//! Which hunks of a patch fit a source tree, one by one.
//!
//! What is applied is decided by the strict applier alone. This looks on after the first misfit,
//! and looks for the place that a hunk may have moved to, so that one list has all there is to do.

use super::Tree;

/// One `@@` of a patch.
struct Hunk<'a> {
    /// Below `src/`.
    file: &'a str,
    /// Where it stands in the patch, from 1.
    patch_line: usize,
    /// Where it says that it belongs, from 1.
    at: usize,
    before: Vec<&'a str>,
    after: Vec<&'a str>,
}

/// A line for each hunk that does not fit where it says. Hunks that fit, there or at one other
/// place, are applied to `tree`, so that a later patch is not blamed for an earlier one.
pub(super) fn misfits(tree: &mut Tree, name: &str, patch: &str) -> Vec<String> {
    let mut list = Vec::new();
    let hunks = parse(patch);
    for of_file in hunks.chunk_by(|one, next| one.file == next.file) {
        let file = of_file[0].file;
        let Some(text) = tree.get(file) else {
            list.push(format!("patches/{name}: src/{file} does not exist"));
            continue;
        };
        let lines: Vec<&str> = text.split('\n').collect();
        let mut places = Vec::new();
        for hunk in of_file {
            let place = fits(&lines, hunk);
            match place {
                Ok(start) => places.push((start, hunk)),
                Err((start, _)) => places.extend(start.map(|start| (start, hunk))),
            }
            if let Err((_, why)) = place {
                let (at, patch_line) = (hunk.at, hunk.patch_line);
                list.push(format!("patches/{name}, line {patch_line}: src/{file}:{at}: {why}"));
            }
        }
        places.sort_by_key(|(start, _)| *start);

        let (mut changed, mut taken) = (Vec::new(), 0);
        for (start, hunk) in places {
            if start >= taken {
                changed.extend_from_slice(&lines[taken..start]);
                changed.extend_from_slice(&hunk.after);
                taken = start + hunk.before.len();
            }
        }
        changed.extend_from_slice(&lines[taken..]);
        let changed = changed.join("\n");
        tree.insert(file.to_owned(), changed);
    }
    list
}

/// The index of the line where `hunk` fits; or the only other place where it does, if there is one,
/// and what is wrong.
fn fits(lines: &[&str], hunk: &Hunk<'_>) -> Result<usize, (Option<usize>, String)> {
    let (before, wanted) = (&hunk.before[..], hunk.at.saturating_sub(1));
    if lines.get(wanted..).is_some_and(|rest| rest.starts_with(before)) {
        return Ok(wanted);
    }
    let mut windows = lines.windows(before.len().max(1)).enumerate();
    let found: Vec<usize> =
        windows.by_ref().filter(|(_, window)| *window == before).map(|(start, _)| start).collect();
    Err(match found[..] {
        [start] => (Some(start), format!("has moved to line {}, unchanged", start + 1)),
        [first, ..] => (None, format!("fits {} places, line {} first", found.len(), first + 1)),
        [] => (None, difference(lines, before, wanted)),
    })
}

/// The first line that differs at the place that is most like the hunk.
fn difference(lines: &[&str], before: &[&str], wanted: usize) -> String {
    let same = |start: usize| {
        lines[start..].iter().zip(before).filter(|(line, expected)| line == expected).count()
    };
    let closest = (0..lines.len())
        .max_by_key(|start| (same(*start), usize::MAX - start.abs_diff(wanted)))
        .unwrap_or_default();
    let expected = before.iter().enumerate();
    for (number, (offset, expected)) in (closest + 1..).zip(expected) {
        match lines.get(closest + offset) {
            Some(line) if line == expected => {}
            Some(line) => return format!("line {number} is `{line}`, not `{expected}`"),
            None => return format!("the file ends before line {number}, `{expected}`"),
        }
    }
    "does not fit".into()
}

fn parse(patch: &str) -> Vec<Hunk<'_>> {
    let mut hunks: Vec<Hunk<'_>> = Vec::new();
    let (mut file, mut open) = ("", false);
    for (index, line) in patch.lines().enumerate() {
        if let Some(header) = line.strip_prefix("diff --git a/src/") {
            (file, open) = (header.split(' ').next().unwrap_or_default(), false);
        } else if let Some(range) = line.strip_prefix("@@ -").filter(|_| !file.is_empty()) {
            let at = range.split([',', ' ']).next().and_then(|at| at.parse().ok()).unwrap_or(0);
            let (before, after) = (Vec::new(), Vec::new());
            hunks.push(Hunk { file, patch_line: index + 1, at, before, after });
            open = true;
        } else if let Some(hunk) = hunks.last_mut().filter(|_| open) {
            let (kind, text) = line.split_at_checked(1).unwrap_or((" ", ""));
            if matches!(kind, " " | "-") {
                hunk.before.push(text);
            }
            if matches!(kind, " " | "+") {
                hunk.after.push(text);
            }
        }
    }
    hunks
}
