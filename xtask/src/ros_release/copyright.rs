//! `debian/copyright` and `NOTICES`: copyright holders and licences of all sources.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::files::{below, read};
use super::graph::Crate;
use super::layout::CORE;

/// True for the name of a file that has a licence or a notice.
pub(super) fn is_licence(name: &str) -> bool {
    let upper = name.to_uppercase();
    let starts = ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"];
    starts.iter().any(|start| upper.starts_with(start)) && !upper.ends_with(".RS")
}

/// A part of the source package with an owner of its own.
#[derive(Debug)]
struct Part {
    /// `axon/vendor/a-1.0.0`
    folder: String,
    licence: String,
    copyright: Vec<String>,
}

/// Both files.
#[derive(Debug)]
pub(super) struct Legal {
    /// In Debian's machine-readable format.
    pub(super) copyright: String,
    /// The texts, each once, with the folders that they are of.
    pub(super) notices: String,
    /// The SPDX identifiers of all crates.
    pub(super) identifiers: BTreeSet<String>,
}

/// Collects holders, licences and texts of the crates in the source package.
pub(super) fn collect(
    tree: &Path,
    crates: &[Crate],
    name: &str,
    repository: &str,
) -> Result<Legal, String> {
    let mut parts =
        vec![("third_party/rustls-axon".to_owned(), "Apache-2.0 OR ISC OR MIT", &[][..])];
    for one in crates {
        if one.licence.is_empty() {
            return Err(format!("{} {} states no licence in its manifest", one.name, one.version));
        }
        parts.push((format!("vendor/{}-{}", one.name, one.version), &one.licence, &one.authors));
    }
    let mut texts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut described = Vec::new();
    for (folder, licence, authors) in parts {
        let folder = format!("{CORE}/{folder}");
        let mut copyright = BTreeSet::new();
        for path in below(&tree.join(&folder))? {
            if !is_licence(path.rsplit('/').next().unwrap_or(&path)) {
                continue;
            }
            let text = read(&tree.join(&folder).join(&path))?.replace("\r\n", "\n");
            copyright.extend(holders(&text));
            texts.entry(text.trim().to_owned()).or_default().push(format!("{folder}/{path}"));
        }
        if copyright.is_empty() {
            copyright.extend(authors.iter().cloned());
        }
        if copyright.is_empty() {
            copyright.insert("its authors, who are not named".into());
        }
        described.push(Part {
            folder,
            licence: licence.to_owned(),
            copyright: copyright.into_iter().collect(),
        });
    }
    let identifiers = described
        .iter()
        .flat_map(|part| identifiers(&part.licence))
        .chain(["MIT".into(), "Apache-2.0".into()])
        .collect();
    Ok(Legal {
        copyright: copyright(&described, &identifiers, name, repository),
        notices: notices(&texts),
        identifiers,
    })
}

/// Returns the lines that name a copyright holder.
fn holders(text: &str) -> Vec<String> {
    let is_holder = |line: &&str| {
        let rest = line.strip_prefix("Copyright").unwrap_or_default();
        let is_named = rest.contains("(c)") || rest.contains("(C)") || rest.contains('©');
        let has_year = rest.contains(|c: char| c.is_ascii_digit());
        // The appendix of the Apache licence has a line to fill in.
        (is_named || has_year) && !rest.contains("yyyy") && !rest.contains("name of")
    };
    let bare = |line: &str| line.trim_matches([' ', '\t', '*', '/', '#', ';']).trim().to_owned();
    text.lines().map(bare).filter(|line| is_holder(&line.as_str())).collect()
}

fn identifiers(licence: &str) -> BTreeSet<String> {
    // A slash is what SPDX's OR was before.
    licence
        .split(|c: char| c.is_whitespace() || "()/".contains(c))
        .filter(|part| !part.is_empty() && !matches!(*part, "OR" | "AND" | "WITH"))
        // What follows WITH is an exception, and no licence.
        .filter(|part| !part.ends_with("-exception"))
        .map(str::to_owned)
        .collect()
}

/// A licence as Debian's format spells it: `or` binds less than `and`, and a comma less than both.
fn debian_expression(licence: &str) -> String {
    let joined = |text: &str| {
        text.replace('/', " OR ")
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
            .replace(" OR ", " or ")
    };
    let mut parts: Vec<String> = Vec::new();
    for part in top_level(licence) {
        let part = joined(part.trim().trim_start_matches('(').trim_end_matches(')'));
        if !parts.contains(&part) {
            parts.push(part);
        }
    }
    if parts.len() > 1 && parts.iter().any(|part| part.contains(" or ")) {
        parts.join(", and ")
    } else {
        parts.join(" and ")
    }
    .replace(" AND ", " and ")
    .replace(" WITH ", " with ")
}

/// What stands between the ANDs that are in no parentheses.
fn top_level(licence: &str) -> Vec<&str> {
    let (mut parts, mut start, mut depth) = (Vec::new(), 0, 0_i32);
    for (at, c) in licence.char_indices() {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            ' ' if depth == 0 && licence[at..].starts_with(" AND ") => {
                parts.push(&licence[start..at]);
                start = at + " AND ".len();
            }
            _ => {}
        }
    }
    parts.push(&licence[start..]);
    parts
}

fn copyright(
    parts: &[Part],
    identifiers: &BTreeSet<String>,
    name: &str,
    repository: &str,
) -> String {
    let mut made = format!(
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: {name}\n\
         Source: {repository}\n\nFiles: *\nCopyright: The AXON developers\nLicense: MIT or Apache-2.0\n"
    );
    for part in parts {
        made.push_str(&format!(
            "\nFiles: {}/*\nCopyright: {}\nLicense: {}\n",
            part.folder,
            part.copyright.join("\n "),
            debian_expression(&part.licence),
        ));
    }
    for licence in identifiers {
        made.push_str(&format!(
            "\nLicense: {licence}\n The text is in the file NOTICES, which is installed in share/{name} below the\n \
             distribution's prefix.\n"
        ));
        if licence == "Apache-2.0" {
            made.push_str(
                " On Debian systems it is also in /usr/share/common-licenses/Apache-2.0.\n",
            );
        }
    }
    made
}

fn notices(texts: &BTreeMap<String, Vec<String>>) -> String {
    let mut made =
        String::from("Licences and notices of what rmw_axon and axon_daemon are made from.\n");
    // By the file, so that it does not depend on how a text begins.
    let mut texts: Vec<_> = texts.iter().collect();
    texts.sort_by_key(|(_, files)| *files);
    for (text, files) in texts {
        made.push_str(&format!("\n{}\n{}\n\n{text}\n", "=".repeat(80), files.join("\n")));
    }
    made
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn licences_are_known_by_their_names() {
        for name in
            ["LICENSE", "LICENSE-MIT", "license-apache-2.0", "COPYING.txt", "NOTICE", "LICENCE.md"]
        {
            assert!(is_licence(name), "{name}");
        }
        for name in ["README.md", "license.rs", "lib.rs"] {
            assert!(!is_licence(name), "{name}");
        }
    }

    #[test]
    fn holders_are_named_and_conditions_are_not() {
        let text = "Copyright (c) 2020 A\n   Copyright 2021 B. All rights reserved.\n * Copyright © C\n\
            Copyright [yyyy] [name of copyright owner]\nCopyright notices above shall\nsee 2. Copyright 3\n";
        assert_eq!(
            holders(text),
            ["Copyright (c) 2020 A", "Copyright 2021 B. All rights reserved.", "Copyright © C"]
        );
    }

    #[test]
    fn expressions_are_written_as_debian_does() {
        for (spdx, debian) in [
            ("MIT", "MIT"),
            ("MIT OR Apache-2.0", "MIT or Apache-2.0"),
            ("MIT/Apache-2.0", "MIT or Apache-2.0"),
            ("ISC AND (Apache-2.0 OR ISC)", "ISC, and Apache-2.0 or ISC"),
            ("(MIT OR Apache-2.0) AND Unicode-3.0", "MIT or Apache-2.0, and Unicode-3.0"),
            ("MIT AND BSD-3-Clause", "MIT and BSD-3-Clause"),
            ("Apache-2.0 WITH LLVM-exception OR MIT", "Apache-2.0 with LLVM-exception or MIT"),
        ] {
            assert_eq!(debian_expression(spdx), debian);
        }
        let found: Vec<_> = identifiers("(MIT OR Apache-2.0 WITH LLVM-exception) AND Unicode-3.0")
            .into_iter()
            .collect();
        assert_eq!(found, ["Apache-2.0", "MIT", "Unicode-3.0"]);
    }

    #[test]
    fn each_crate_is_listed_and_each_text_once() {
        let tree = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            super::super::files::write(&tree.path().join(path), text).unwrap()
        };
        write("axon/third_party/rustls-axon/LICENSE-ISC", "Copyright (c) 2016 R\nISC\n");
        write("axon/vendor/a-1.0.0/LICENSE", "Copyright (c) 2016 R\nISC");
        write("axon/vendor/b-2.0.0/src/lib.rs", "");
        let one = |name: &str, version: &str, licence: &str| Crate {
            name: name.into(),
            version: version.into(),
            licence: licence.into(),
            authors: vec!["Author <x@y>".into()],
            rust_version: None,
        };
        let crates = [one("a", "1.0.0", "ISC"), one("b", "2.0.0", "Zlib OR MIT")];
        let legal = collect(tree.path(), &crates, "rmw_axon", "https://host/axon").unwrap();
        let text = &legal.copyright;
        assert!(
            text.contains(
                "Files: axon/vendor/a-1.0.0/*\nCopyright: Copyright (c) 2016 R\nLicense: ISC\n"
            ),
            "{text}"
        );
        assert!(
            text.contains(
                "Files: axon/vendor/b-2.0.0/*\nCopyright: Author <x@y>\nLicense: Zlib or MIT\n"
            ),
            "{text}"
        );
        for id in ["Apache-2.0", "ISC", "MIT", "Zlib"] {
            assert!(text.contains(&format!("\nLicense: {id}\n The text")), "{id}: {text}");
        }
        assert_eq!(legal.notices.matches("2016 R").count(), 1);
        assert!(
            collect(tree.path(), &[one("a", "1.0.0", "")], "n", "r")
                .unwrap_err()
                .contains("states no licence")
        );
    }
}
