//! faer stays where it is: one file calls it, and no other crate knows it.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests too")]

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Every file below a folder, build outputs left out.
fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() && name != "target" && !name.starts_with('.') {
            files(&path, found);
        } else if path.is_file() {
            found.push(path);
        }
    }
}

#[test]
fn only_matmul_speaks_to_faer() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap();
    let mut found = Vec::new();
    for folder in ["common", "proto", "actor", "learner", "deploy"] {
        files(&root.join(folder), &mut found);
    }
    let speakers = found.into_iter().filter(|path| {
        let is = |extension: &str| path.extension().is_some_and(|found| found == extension);
        let Ok(text) = fs::read_to_string(path) else { return false };
        let mut lines = text.lines().map(str::trim_start);
        is("rs") && lines.any(|line| !line.starts_with("//") && line.contains(concat!("faer", "::")))
            || is("toml") && text.lines().any(|line| line.starts_with("faer"))
    });
    let mut speakers: Vec<String> =
        speakers.map(|path| path.strip_prefix(&root).unwrap().display().to_string()).collect();
    speakers.sort();
    assert_eq!(speakers, ["common/nn/Cargo.toml", "common/nn/src/matmul.rs"]);
}
