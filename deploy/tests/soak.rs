//! `rit soak`: a short one.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output};
use serde_json::Value;
use std::process::{Command, Stdio};

#[test]
fn a_run_under_fire_ends_as_if_nothing_had_happened() {
    let folder = RunFolder::new();
    let dir = folder.path().join("soak");
    let soak = output(&[
        "soak",
        "--kills",
        "8",
        "--seed",
        "4",
        "--steps",
        "2000",
        "--json",
        "--dir",
        dir.to_str().unwrap(),
        "--set",
        "algorithm.buffer_size=200",
    ]);
    assert!(soak.status.success(), "{}", String::from_utf8_lossy(&soak.stderr));
    let report: Value = serde_json::from_slice(&soak.stdout).unwrap();
    println!("{report:#}");
    assert_eq!(report["kills"], 8);
    assert_eq!((&report["lost"], &report["duplicated"]), (&0.into(), &0.into()));
    assert_eq!(report["weights_digest"], report["undisturbed_weights_digest"]);
    assert_eq!(report["episodes_compared"], 200);
    assert_eq!(report["same"], true);
}

/// What is hung up ends, although the soak itself was started to outlive its terminal.
#[test]
fn a_soak_under_nohup_hangs_up_too() {
    let folder = RunFolder::new();
    let dir = folder.path().join("soak");
    let mut soak = Command::new("nohup");
    soak.arg(env!("CARGO_BIN_EXE_rit")).args(["soak", "--kills", "1", "--seed", "18", "--steps", "600"]);
    let soak = soak.args(["--json", "--dir"]).arg(dir).stdin(Stdio::null()).output().unwrap();
    assert!(soak.status.success(), "{}", String::from_utf8_lossy(&soak.stderr));
    let report: Value = serde_json::from_slice(&soak.stdout).unwrap();
    assert_eq!(report["by_blow"]["learner_hung_up"]["kills"], 1, "{report:#}");
    assert_eq!(report["same"], true);
}

#[test]
fn a_folder_that_is_there_is_left_alone() {
    let folder = RunFolder::new();
    let soak = output(&["soak", "--dir", folder.path().to_str().unwrap()]);
    assert_eq!(soak.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&soak.stderr).contains("choose another --dir"));
}
