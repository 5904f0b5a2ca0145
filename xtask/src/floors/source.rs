//! The files of a crate, and the paths in them.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use syn::visit::{self, Visit};
use syn::{Attribute, Item, UsePath, UseRename, UseTree};

/// A file of a crate, with the path of its module.
pub(super) struct Source {
    pub(super) path: PathBuf,
    pub(super) module: Vec<String>,
    pub(super) file: syn::File,
    /// How many lines it has.
    pub(super) lines: usize,
}

/// The names that a `use` brings.
fn names_of(tree: &UseTree, names: &mut Vec<String>) {
    match tree {
        UseTree::Path(path) => names_of(&path.tree, names),
        UseTree::Group(group) => group.items.iter().for_each(|tree| names_of(tree, names)),
        UseTree::Name(name) => names.push(name.ident.to_string()),
        UseTree::Rename(name) => names.push(name.rename.to_string()),
        UseTree::Glob(_) => {}
    }
}

/// Reads the files below `dir`, but for programs in `bin`.
pub(super) fn read(folder: &Path, dir: &Path, sources: &mut Vec<Source>) -> Result<(), String> {
    let entries = fs::read_dir(dir).map_err(|e| format!("{}: {e}", dir.display()))?;
    for entry in entries {
        let path = entry.map_err(|e| format!("{}: {e}", dir.display()))?.path();
        let inside = path.strip_prefix(folder).expect("below it");
        if path.is_dir() {
            if inside != Path::new("bin") {
                read(folder, &path, sources)?;
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
            let file = syn::parse_file(&text).map_err(|e| format!("{}: {e}", path.display()))?;
            let lines = text.lines().count();
            sources.push(Source { module: module_of(inside), file, path, lines });
        }
    }
    Ok(())
}

impl Source {
    /// The names that this root hands out of other crates.
    pub(super) fn of_other_crates(&self, rooms: &BTreeSet<String>) -> Vec<String> {
        let mut names = Vec::new();
        for item in &self.file.items {
            let Item::Use(item) = item else { continue };
            let (UseTree::Path(UsePath { ident, .. }) | UseTree::Rename(UseRename { ident, .. })) =
                &item.tree
            else {
                continue;
            };
            let first = ident.to_string();
            if !rooms.contains(&first) && !["crate", "self", "super"].contains(&&*first) {
                names_of(&item.tree, &mut names);
            }
        }
        names
    }

    /// The modules in files of their own that this one has for tests only.
    pub(super) fn test_modules(&self) -> Vec<Vec<String>> {
        let is_test_file = |item: &Item| match item {
            Item::Mod(item) if item.content.is_none() && is_test(&item.attrs) => {
                Some(item.ident.to_string())
            }
            _ => None,
        };
        let names = self.file.items.iter().filter_map(is_test_file);
        names.map(|name| [&self.module[..], &[name]].concat()).collect()
    }
}

/// The path of the module in this file, from the crate's root, whose own is empty.
fn module_of(inside: &Path) -> Vec<String> {
    let mut module: Vec<String> =
        inside.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if module.last().is_some_and(|last| last == "mod") || module == ["lib"] || module == ["main"] {
        module.pop();
    }
    module
}

/// Collects the paths of a file that begin with `crate` or `super`, as paths from the root.
pub(super) struct Paths {
    pub(super) module: Vec<String>,
    pub(super) found: Vec<Vec<String>>,
}

impl Paths {
    /// Notes a path by its parts, if it leaves this module.
    fn note(&mut self, parts: &[String]) {
        match parts.first().map(String::as_str) {
            // Alone it is that of `pub(crate)`, in a macro.
            Some("crate") if parts.len() > 1 => self.found.push(parts[1..].to_vec()),
            Some("super") => {
                let ups = parts.iter().take_while(|part| *part == "super").count();
                let above = &self.module[..self.module.len().saturating_sub(ups)];
                self.found.push(above.iter().chain(&parts[ups..]).cloned().collect());
            }
            _ => {}
        }
    }

    fn note_use(&mut self, before: &mut Vec<String>, tree: &UseTree) {
        match tree {
            UseTree::Path(path) => {
                before.push(path.ident.to_string());
                self.note_use(before, &path.tree);
                before.pop();
            }
            UseTree::Group(group) => {
                group.items.iter().for_each(|tree| self.note_use(before, tree))
            }
            UseTree::Name(name) => self.note(&[&before[..], &[name.ident.to_string()]].concat()),
            UseTree::Rename(name) => self.note(&[&before[..], &[name.ident.to_string()]].concat()),
            UseTree::Glob(_) => self.note(&[&before[..], &["*".to_owned()]].concat()),
        }
    }

    /// A macro's tokens are no syntax tree: `crate::` is looked for among them.
    fn note_tokens(&mut self, tokens: TokenStream) {
        let mut parts: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(ident) => {
                    if colons != 2 {
                        self.note(&std::mem::take(&mut parts));
                    }
                    parts.push(ident.to_string());
                    colons = 0;
                }
                TokenTree::Punct(punct) if punct.as_char() == ':' => colons += 1,
                other => {
                    self.note(&std::mem::take(&mut parts));
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.note_tokens(group.stream());
                    }
                }
            }
        }
        self.note(&parts);
    }
}

/// Whether this item is compiled for tests only.
pub(super) fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Path>().is_ok_and(|path| path.is_ident("test"))
    })
}

impl<'ast> Visit<'ast> for Paths {
    fn visit_item(&mut self, item: &'ast Item) {
        let attributes = match item {
            Item::Mod(item) => &item.attrs,
            Item::Use(item) => &item.attrs,
            Item::Fn(item) => &item.attrs,
            Item::Impl(item) => &item.attrs,
            _ => return visit::visit_item(self, item),
        };
        if is_test(attributes) {
            return;
        }
        match item {
            Item::Use(item) => self.note_use(&mut Vec::new(), &item.tree),
            Item::Mod(inner) => {
                self.module.push(inner.ident.to_string());
                visit::visit_item(self, item);
                self.module.pop();
            }
            _ => visit::visit_item(self, item),
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let parts: Vec<String> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        self.note(&parts);
        visit::visit_path(self, path);
    }

    fn visit_vis_restricted(&mut self, _: &'ast syn::VisRestricted) {
        // `pub(in crate::room)` imports nothing.
    }

    fn visit_macro(&mut self, found: &'ast syn::Macro) {
        self.note_tokens(found.tokens.clone());
        visit::visit_macro(self, found);
    }
}
