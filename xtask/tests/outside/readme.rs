//! What a README tells its reader to do: commands, and programs in Rust.

use std::fs;

use crate::PUBLISHED;
use crate::support::workspace;

pub(crate) struct Readme {
    /// The lines of its `sh` and `console` blocks, without comments.
    pub(crate) commands: Vec<String>,
    /// Its `rust` blocks, as programs.
    pub(crate) programs: Vec<Program>,
    text: String,
}

pub(crate) struct Program {
    /// The README, and the line.
    pub(crate) place: String,
    pub(crate) text: String,
    /// Has a `main` of its own, and so something to run.
    pub(crate) has_main: bool,
}

fn text(dir: &str) -> String {
    let file = workspace().join(dir).join("README.md");
    fs::read_to_string(&file).unwrap_or_else(|e| panic!("{}: {e}", file.display()))
}

impl Readme {
    pub(crate) fn of(name: &str) -> Self {
        let (_, dir) = PUBLISHED.iter().find(|(one, _)| *one == name).expect(name);
        Self::parse(name, &text(dir))
    }

    fn parse(name: &str, text: &str) -> Self {
        let mut readme = Self { commands: vec![], programs: vec![], text: text.to_owned() };
        let mut lines = text.lines().enumerate();
        while let Some((at, line)) = lines.next() {
            let Some(label) = line.trim_start().strip_prefix("```") else { continue };
            let block: Vec<&str> = lines
                .by_ref()
                .map(|(_, line)| line)
                .take_while(|line| line.trim() != "```")
                .collect();
            let (language, attributes) = label.split_once(',').unwrap_or((label, ""));
            match language {
                "rust" => readme.programs.push(Program::parse(
                    &format!("{name}, line {}", at + 1),
                    attributes,
                    &block,
                )),
                "sh" | "console" => readme.commands.extend(commands(&block)),
                _ => {}
            }
        }
        readme
    }

    /// What it has the reader add: the arguments of each `cargo add`.
    pub(crate) fn adds(&self) -> impl Iterator<Item = Vec<&str>> {
        let adds = self.commands.iter().filter_map(|line| line.strip_prefix("cargo add "));
        adds.map(|arguments| arguments.split_whitespace().collect())
    }

    /// The commands in the first column of its tables, without the program and what is in capitals.
    pub(crate) fn table(&self) -> impl Iterator<Item = Vec<&str>> {
        let cells =
            self.text.lines().filter_map(|line| line.strip_prefix("| `axon ")?.split('`').next());
        let is_word = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase());
        cells.map(move |cell| cell.split(' ').take_while(is_word).collect())
    }
}

impl Program {
    fn parse(place: &str, attributes: &str, block: &[&str]) -> Self {
        // A reader has no use for a block that nobody compiled.
        let known = |attribute: &str| ["", "no_run"].contains(&attribute);
        assert!(attributes.split(',').all(known), "{place}: {attributes:?}");
        let hidden = block.iter().find(|line| line.trim() == "#" || line.starts_with("# "));
        assert_eq!(hidden, None, "{place}: hidden from rustdoc alone, a reader sees it");
        let mut text = block.join("\n") + "\n";
        let has_main = text.contains("fn main(");
        if !has_main {
            text = format!("#![allow(dead_code)]\n{text}\nfn main() {{}}\n");
        }
        Self { place: place.to_owned(), text, has_main }
    }
}

/// Joins lines that end in `\`, and leaves out comments.
fn commands(block: &[&str]) -> Vec<String> {
    let joined = block.join("\n").replace("\\\n", " ");
    let lines = joined.lines().map(|line| line.split(" #").next().unwrap_or_default());
    let lines = lines.map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "));
    lines.filter(|line| !line.is_empty() && !line.starts_with('#')).collect()
}

#[test]
fn a_readme_is_read_as_its_reader_does() {
    let readme = Readme::parse(
        "x",
        "# Title\n```sh\ncargo add one -F two   # three\n# four\nrun \\\n  it\n```\n\
         ```rust\nfn f() {}\n```\ntext\n```rust,no_run\nfn main() {\n    f();\n}\n```\n```c\nint i;\n```\n",
    );
    assert_eq!(readme.commands, ["cargo add one -F two", "run it"]);
    assert_eq!(readme.adds().collect::<Vec<_>>(), [["one", "-F", "two"]]);
    let [first, second] = &readme.programs[..] else { panic!("two programs") };
    assert_eq!((&*first.place, first.has_main), ("x, line 8", false));
    assert_eq!((&*second.place, second.has_main), ("x, line 12", true));
    assert_eq!(second.text, "fn main() {\n    f();\n}\n");
}

#[test]
#[should_panic(expected = "ignore")]
fn an_uncompiled_readme_block_is_refused() {
    Readme::parse("x", "```rust,ignore\nlet x = 1;\n```\n");
}

#[test]
#[should_panic(expected = "a reader sees it")]
fn a_block_with_hidden_lines_is_refused() {
    Readme::parse("x", "```rust\n# fn main() {\nlet x = 1;\n# }\n```\n");
}

/// The version of a crate's `rust-version`, its own or the workspace's.
fn rust_version(dir: &str) -> String {
    let value = |file: &str| {
        let text = fs::read_to_string(workspace().join(file)).expect(file);
        let line = text.lines().find_map(|line| line.strip_prefix("rust-version = "));
        line.map(|version| version.trim_matches('"').to_owned())
    };
    value(&format!("{dir}/Cargo.toml")).or_else(|| value("Cargo.toml")).expect("a rust-version")
}

#[test]
fn each_readme_names_the_rust_version_of_its_manifest() {
    // rmw_axon is published as a package of ROS 2; what cargo builds of it is in a folder of its own.
    let published = PUBLISHED.map(|(name, dir)| (name, dir, dir));
    for (name, dir, manifest) in
        published.into_iter().chain([("rmw_axon", "rmw_axon", "rmw_axon/core")])
    {
        let version = rust_version(manifest);
        let text = text(dir);
        let named: Vec<&str> = text
            .split("Rust ")
            .skip(1)
            .map(|rest| rest.split(|c: char| !c.is_ascii_digit() && c != '.').next().unwrap_or(""))
            .map(|version| version.trim_end_matches('.'))
            .filter(|version| version.contains('.'))
            .collect();
        assert!(!named.is_empty(), "{name}: its README names no version, as `Rust {version}`");
        assert!(named.iter().all(|one| *one == version), "{name}: {named:?}, not {version}");
    }
}
