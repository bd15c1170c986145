//! Every kept input through its check: what fuzzing found stays found, without a fuzzer.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use rit_fuzz_checks::{checkpoint::Run, config, frame, worker};
use std::{
    fs,
    panic::{self, AssertUnwindSafe},
    path::Path,
};

/// Every input of `common/fuzz/corpus/{target}`, and the whole ones that fuzzing begins from.
fn replay(target: &str, whole: &[(String, Vec<u8>)], check: impl Fn(&[u8]) -> bool) {
    for (name, input) in whole {
        assert!(check(input), "{target}: {name} is accepted");
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../corpus").join(target);
    let kept: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(kept.len() >= 20, "{} holds inputs", folder.display());
    for path in kept {
        let input = fs::read(&path).unwrap();
        let outcome = panic::catch_unwind(AssertUnwindSafe(|| check(&input)));
        assert!(outcome.is_ok(), "{}", path.display());
    }
}

#[test]
fn frames() {
    replay("frame", &frame::seeds(), frame::check);
}

#[test]
fn checkpoints() {
    let run = Run::new().unwrap();
    replay("checkpoint", &run.seeds(), |input| run.check(input));
}

#[test]
fn workers() {
    replay("worker", &worker::seeds(), worker::check);
}

#[test]
fn configurations() {
    let seeds = config::seeds();
    let (refused, whole): (Vec<_>, Vec<_>) = seeds.into_iter().partition(|(name, _)| name == "refused");
    assert!(refused.iter().all(|(_, input)| !config::check(input)));
    replay("config", &whole, config::check);
}
