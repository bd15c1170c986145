//! UPDeT, REFIL and ROMA in the service: whichever actor rolls, the same seed gives the same weights, and what they measure is told.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, json_lines, output};
use serde_json::Value;

/// A run of a method on the matrix game, long enough for some updates.
fn matrix(method: &str) -> Vec<&str> {
    ["matrix-game", "--algorithm", method, "--seed", "3", "--steps", "160"].to_vec()
}

/// REFIL draws groups at each update; ROMA draws noise at each update, and more while it acts.
#[test]
fn the_same_seed_gives_the_same_weights_with_any_number_of_actors() {
    for method in ["updet-mix", "refil", "roma"] {
        let digest = |arguments: &[&str]| {
            let summary = RunFolder::new().train(&[&matrix(method), arguments].concat());
            assert!(summary["updates"].as_u64() > Some(10), "{method}: {summary}");
            (summary["weights_digest"].clone(), summary["evaluation"].clone())
        };
        let alone = digest(&["--actors", "1"]);
        assert_eq!(alone, digest(&["--actors", "3", "--set", "learner.threads=4"]), "{method}");
        assert_eq!(alone, digest(&["--actors", "1", "--set", "actors.episodes_at_once=1"]), "{method}");
        assert_ne!(alone.0, digest(&["--actors", "1", "--seed", "4"]).0, "{method}");
    }
}

#[test]
fn what_is_measured_is_what_the_method_declares() {
    let often = ["--actors", "1", "--set", "learner.metrics_every_env_steps=20"];
    let own: [(&str, &[&str]); 3] = [
        ("updet-vdn", &[]),
        ("refil", &["imagined_loss"]),
        ("roma", &["role_loss", "role_entropy", "role_kl", "dissimilarity_loss"]),
    ];
    for (method, own) in own {
        let folder = RunFolder::new();
        folder.train(&[&matrix(method)[..], &often].concat());
        let lines = json_lines(&folder.run_dir().join("metrics.jsonl"));
        let line = lines.iter().rfind(|line| line["kind"] == "training" && line["td_loss"].is_number());
        let line = line.unwrap_or_else(|| panic!("{method}: nothing was measured"));
        for name in own.iter().chain(&["td_loss", "grad_norm", "q_total_mean", "target_mean"]) {
            assert!(line[*name].as_f64().is_some_and(f64::is_finite), "{method}: {name} in {line}");
        }
        assert_eq!(line.get("contrastive_loss"), None, "{method}");
    }
}

#[test]
fn options_of_one_method_are_refused_for_another() {
    let refused =
        output(&["train", "matrix-game", "--algorithm", "roma", "--set", "algorithm.imagined_weight=0.3"]);
    assert_eq!(refused.status.code(), Some(2));
    let beside = ["--set", "algorithm.encoder=beside", "--actors", "1"];
    let summary = RunFolder::new().train(&[&matrix("refil")[..], &beside].concat());
    assert_ne!(summary["weights_digest"], Value::Null);
}
