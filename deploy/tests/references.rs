//! Files that sources and pages name are there: a reader, or a help text's user, is not sent to a page that has moved.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use std::{
    fs,
    path::{Path, PathBuf},
};

/// What is read, from the repository's root.
const READ: &[&str] = &[
    "README.md",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
    "Cargo.toml",
    "proto",
    "actor",
    "learner",
    "common",
    "deploy",
];
/// Folders whose files are named by their path from the root.
const NAMED: &[&str] = &["proto/", "actor/", "learner/", "common/", "deploy/"];
/// Endings of files that are named, and of those that are read.
const ENDINGS: &[&str] = &["rs", "md", "py", "toml", "proto", "json", "svg", "png", "yaml", "sh"];
/// What builds and package managers leave.
const LEFT_OUT: &[&str] = &["target", "node_modules", "__pycache__"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

fn ends_as_one_of_them(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ENDINGS.iter().any(|one| ending == *one))
}

/// Every file to read at or below this path.
fn files(path: &Path, found: &mut Vec<PathBuf>) {
    let name = path.file_name().unwrap().to_string_lossy();
    if path.is_file() && ends_as_one_of_them(path) {
        found.push(path.to_owned());
    } else if path.is_dir() && !name.starts_with('.') && !LEFT_OUT.contains(&&*name) {
        fs::read_dir(path).unwrap().for_each(|entry| files(&entry.unwrap().path(), found));
    }
}

/// The files that this text names by their path from the root. `methods/NAME.rs` names none: it stands for many.
fn named(text: &str) -> impl Iterator<Item = &str> {
    let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "_-./".contains(c)));
    parts.map(|part| part.trim_end_matches('.')).filter(|part| {
        let stands_for_many = |name: &str| {
            let stem = name.split('.').next().unwrap();
            !stem.is_empty() && stem.chars().all(|c| c.is_ascii_uppercase() || c == '_')
        };
        NAMED.iter().any(|folder| part.starts_with(folder))
            && ends_as_one_of_them(Path::new(part))
            && !part.split('/').any(|name| name != "README.md" && stands_for_many(name))
    })
}

#[test]
fn files_that_are_named_exist() {
    let mut read = Vec::new();
    READ.iter().for_each(|path| files(&root().join(path), &mut read));
    let mut missing = Vec::new();
    for file in read {
        // What is no text names nothing.
        let Ok(text) = fs::read_to_string(&file) else { continue };
        // Some are named as their crate's build script sees them.
        let is_there = |path: &&str| file.ancestors().any(|folder| folder.join(path).exists());
        for path in named(&text).filter(|path| !is_there(path)) {
            missing.push(format!("{} names {path}", file.strip_prefix(root()).unwrap().display()));
        }
    }
    assert!(missing.is_empty(), "these are not there:\n{}", missing.join("\n"));
}

#[test]
fn what_counts_as_a_name() {
    let text = "see deploy/docs/export.md, `common/env/src/own.rs`. https://example.org/deploy/docs/no.md, \
                common/algo/src/methods/NAME.rs, deploy/python/README.md; ../common/x.rs and learner/src";
    let found: Vec<_> = named(text).collect();
    assert_eq!(found, ["deploy/docs/export.md", "common/env/src/own.rs", "deploy/python/README.md"]);
}
