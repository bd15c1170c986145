//! Tells the program which commit it is built from: what RIT_COMMIT says, where it is set (a container has no history),
//! or else what git does. Debug builds are not told, so that a commit alone compiles nothing again.

#![allow(clippy::print_stdout, reason = "that is how a build script speaks to cargo")]

use std::{env, path::Path, process::Command};

fn main() {
    println!("cargo::rerun-if-env-changed=RIT_COMMIT");
    println!("cargo::rerun-if-changed=build.rs");
    if env::var_os("RIT_COMMIT").is_some() || env::var("PROFILE").as_deref() != Ok("release") {
        return;
    }
    let git = |arguments: &[&str]| -> Option<String> {
        let output = Command::new("git").args(arguments).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let Some(commit) = git(&["rev-parse", "HEAD"]) else { return };
    let changed = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|it| !it.is_empty());
    println!("cargo::rustc-env=RIT_COMMIT={commit}{}", if changed { "+" } else { "" });
    // The files that a commit changes, wherever this checkout keeps them, and those that git calls changed.
    for name in ["HEAD", "logs/HEAD"] {
        if let Some(path) = git(&["rev-parse", "--git-path", name]).filter(|path| Path::new(path).exists()) {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    for folder in ["src", "../actor", "../common", "../learner", "../proto", "../Cargo.lock", "../Cargo.toml"]
    {
        println!("cargo::rerun-if-changed={folder}");
    }
}
