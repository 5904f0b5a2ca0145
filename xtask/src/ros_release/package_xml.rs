//! `package.xml`: what the package is, and its form in the source package.

use std::collections::BTreeSet;

use roxmltree::{Document, Node};

/// The fields of `package.xml` that Debian's files need.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Package {
    pub(super) name: String,
    pub(super) version: String,
    pub(super) description: String,
    /// `Name <address>`
    pub(super) maintainer: String,
    pub(super) repository: String,
    /// Keys of rosdep that a build needs.
    pub(super) build: BTreeSet<String>,
    /// Those that tests need as well.
    pub(super) test: BTreeSet<String>,
    /// Keys that a program with this package needs.
    pub(super) run: BTreeSet<String>,
}

pub(super) fn parse(text: &str) -> Result<Package, String> {
    let document = Document::parse(text).map_err(|err| format!("package.xml: {err}"))?;
    let root = document.root_element();
    let all = |name: &'static str| root.children().filter(move |node| node.has_tag_name(name));
    let text_of = |node: Node<'_, '_>| {
        node.text().unwrap_or_default().split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let one = |name: &'static str| {
        all(name).next().map(text_of).ok_or_else(|| format!("package.xml has no <{name}>"))
    };
    let keys = |names: &[&'static str]| -> BTreeSet<String> {
        names.iter().flat_map(|name| all(name)).map(text_of).collect()
    };
    let maintainer = all("maintainer").next().ok_or("package.xml has no <maintainer>")?;
    let address =
        maintainer.attribute("email").ok_or("the maintainer in package.xml has no email")?;
    let repository = all("url").find(|node| node.attribute("type") == Some("repository"));
    Ok(Package {
        name: one("name")?,
        version: one("version")?,
        description: one("description")?,
        maintainer: format!("{} <{address}>", text_of(maintainer)),
        repository: repository
            .map(text_of)
            .ok_or("package.xml has no <url type=\"repository\">")?,
        build: keys(&["depend", "build_depend", "build_export_depend", "buildtool_depend"]),
        test: keys(&["test_depend"]),
        run: keys(&["depend", "exec_depend", "build_export_depend", "buildtool_export_depend"]),
    })
}

/// The file with the texts of our licences named, and with the licences of the crates that are linked in.
pub(super) fn released(text: &str, of_crates: &BTreeSet<String>) -> Result<String, String> {
    const OURS: [(&str, &str); 2] = [("MIT", "LICENSE-MIT"), ("Apache-2.0", "LICENSE-APACHE")];
    let mut made = text.to_owned();
    for (licence, file) in OURS {
        let bare = format!("<license>{licence}</license>");
        if made.matches(&bare).count() != 1 {
            return Err(format!("package.xml must have this once: {bare}"));
        }
        made = made.replace(&bare, &format!("<license file=\"{file}\">{licence}</license>"));
    }
    let end = made.rfind("</license>").map(|at| at + "</license>".len()).expect("it is there");
    let others: String = of_crates
        .iter()
        .filter(|licence| OURS.iter().all(|(ours, _)| ours != licence))
        .map(|licence| format!("\n  <license>{licence}</license>"))
        .collect();
    if !others.is_empty() {
        made.insert_str(
            end,
            &format!(
                "\n  <!-- Those of crates that are linked in; NOTICES has the texts. -->{others}"
            ),
        );
    }
    Ok(made)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "<?xml version=\"1.0\"?>\n<package format=\"3\">\n  <name>rmw_axon</name>\n  <version>0.1.0</version>\n  \
        <description>\n    Two\n    lines.\n  </description>\n  <maintainer email=\"a@b.c\">A</maintainer>\n  \
        <license>MIT</license>\n  <license>Apache-2.0</license>\n  <url type=\"repository\">https://host/a</url>\n  \
        <buildtool_depend>cargo</buildtool_depend>\n  <depend>rmw</depend>\n  <test_depend>fastcdr</test_depend>\n</package>\n";

    #[test]
    fn package_is_read() {
        let package = parse(TEXT).unwrap();
        assert_eq!(package.description, "Two lines.");
        assert_eq!(package.maintainer, "A <a@b.c>");
        assert_eq!(package.repository, "https://host/a");
        assert!(package.build.contains("cargo") && package.build.contains("rmw"));
        assert!(package.run.contains("rmw") && !package.run.contains("cargo"));
        assert_eq!(package.test.len(), 1);
        assert!(parse("<package/>").unwrap_err().contains("<maintainer>"));
        assert!(parse("no xml").is_err());
    }

    #[test]
    fn licences_of_crates_are_added_once() {
        let of_crates = ["MIT", "ISC", "Zlib"].map(str::to_owned).into();
        let made = released(TEXT, &of_crates).unwrap();
        assert!(made.contains("<license file=\"LICENSE-MIT\">MIT</license>"), "{made}");
        for licence in ["MIT", "Apache-2.0", "ISC", "Zlib"] {
            assert_eq!(made.matches(&format!(">{licence}</license>")).count(), 1, "{made}");
        }
        assert_eq!(parse(&made), parse(TEXT));
        assert!(released(&made, &of_crates).is_err(), "it is not made twice");
    }
}
