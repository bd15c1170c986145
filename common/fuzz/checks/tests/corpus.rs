//! Every kept input through its check: what fuzzing found stays found, without a fuzzer.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use rit_fuzz_checks::{checkpoint::Run, config, frame, starcraft, worker};
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
fn answers_of_a_game() {
    for (name, input) in starcraft::refused() {
        assert!(!starcraft::check(&input), "{name} is refused");
    }
    replay("starcraft", &starcraft::seeds(), starcraft::check);
}

/// Every byte of every whole answer changed in a few ways, and every answer cut off everywhere: nothing panics.
#[test]
fn changed_answers_of_a_game_are_read_or_refused() {
    for (_, input) in starcraft::seeds() {
        for at in 0..input.len() {
            starcraft::check(&input[..at]);
            for mask in [0x01, 0x10, 0x80, 0xff] {
                let mut changed = input.clone();
                changed[at] ^= mask;
                starcraft::check(&changed);
            }
        }
    }
}

#[test]
fn configurations() {
    let seeds = config::seeds();
    let (refused, whole): (Vec<_>, Vec<_>) = seeds.into_iter().partition(|(name, _)| name == "refused");
    assert!(refused.iter().all(|(_, input)| !config::check(input)));
    replay("config", &whole, config::check);
}
