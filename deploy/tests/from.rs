//! `rit train --from` and `rit runs`: a run that begins with another's weights, and the list of both.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, output, refused};
use rit_policy::Weights;
use serde_json::Value;
use std::{fs, path::Path};

/// Small networks, few updates. Two of the games are enough.
const SMALL: [&str; 16] = [
    "--seed",
    "3",
    "--actors",
    "1",
    "--set",
    "network.hidden_dim=8",
    "--set",
    "algorithm.batch_size=4",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "evaluation.every_env_steps=20",
    "--set",
    "checkpoints.every_env_steps=20",
    "--set",
    "checkpoints.keep=9",
];

fn with<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&["matrix-game"], &SMALL[..], more].concat()
}

/// A run of 40 steps.
fn first() -> (RunFolder, Value) {
    let folder = RunFolder::new();
    let summary = folder.train(&with(&["--steps", "40"]));
    (folder, summary)
}

fn checkpoint(run: &Path, name: &str) -> Weights {
    Weights::load(&run.join("checkpoints").join(name)).unwrap()
}

#[test]
fn a_run_begins_with_anothers_weights_and_is_as_deterministic_as_any() {
    let (first, summary) = first();
    let run = first.run_dir();
    let from = run.to_str().unwrap();
    let tasks = "environment.training_tasks=[\"game-1\", \"game-3\"]";
    let second = with(&["--set", tasks, "--from", from]);

    // Nothing was learned before the first batch is whole: the weights at its beginning are the first run's last.
    let begun = RunFolder::new();
    begun.train(&[&second[..], &["--steps", "6"]].concat());
    let initial = Weights::load(&begun.run_dir().join("initial.safetensors")).unwrap();
    assert_eq!(initial.description.digest, summary["weights_digest"]);
    let newest = checkpoint(&begun.run_dir(), "latest");
    assert_eq!(newest.params, initial.params);

    let whole = RunFolder::new();
    let digest = whole.train(&[&second[..], &["--steps", "60"]].concat())["weights_digest"].clone();
    assert_ne!(digest, RunFolder::new().train(&with(&["--set", tasks, "--steps", "60"]))["weights_digest"]);
    // The first run is needed no more; a run that stops in between comes to the same end.
    let gone_on = RunFolder::new();
    gone_on.train(&[&second[..], &["--steps", "30"]].concat());
    drop(first);
    let resumed = Train::resume(&gone_on, &["--steps", "60"]).finish();
    assert_eq!(resumed["weights_digest"], digest);

    fs::remove_file(gone_on.run_dir().join("initial.safetensors")).unwrap();
    let run = gone_on.run_dir();
    refused(
        &["train", "--resume", run.to_str().unwrap(), "--steps", "90"],
        &["network.initial_weights: ", "initial.safetensors"],
    );
}

#[test]
fn what_is_reused_and_what_is_not_is_said() {
    let (first, _) = first();
    let run = first.run_dir();
    let at = format!("{}@20", run.display());
    let folder = RunFolder::new();
    let new_run = folder.run_dir();
    let arguments = with(&["--steps", "4", "--from", &at, "--algorithm", "rit-vdn"]);
    let output = output(&[&["train", "--run-dir", new_run.to_str().unwrap()], &arguments[..]].concat());
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    let said = format!(
        "begins with the weights of {at} (rit on matrix-game): discriminator, task_encoder, utility of them reused; mixer \
         of those weights not used; optimiser, replay, exploration and counts begin afresh"
    );
    assert!(stderr.contains(&said), "{stderr}");
    let acting = checkpoint(&run, "step-000000000020");
    let range = acting.model.acting();
    assert_eq!(checkpoint(&new_run, "latest").params[range.clone()], acting.params[range]);
}

#[test]
fn weights_that_will_not_do_are_refused_before_anything_is_made() {
    let (first, _) = first();
    let run = first.run_dir();
    let from = run.to_str().unwrap();
    let folder = RunFolder::new();
    let new_run = folder.run_dir();
    let refuse = |arguments: &[&str], message: &[&str]| {
        refused(&[&["train", "--run-dir", new_run.to_str().unwrap()], arguments].concat(), message);
        assert!(!new_run.exists());
    };
    refuse(
        &["predator-prey", "--from", from],
        &["the number of actions is 3 in the weights and 5 in this run"],
    );
    refuse(&["matrix-game", "--from", from], &["hidden_dim is 8 in the weights and 64 in this run"]);
    refuse(
        &with(&["--from", from, "--algorithm", "vdn-attn"]),
        &["the weights are of rit with encoder \"beside\", this run is of vdn-attn with encoder \"within\""],
    );
    let at = |checkpoint: &str| format!("{from}@{checkpoint}");
    refuse(&with(&["--from", &at("30")]), &["has no checkpoint 30; it has latest, step-0000000000"]);
    refuse(&with(&["--from", "/nowhere"]), &["/nowhere: there is no such file or folder; give a run"]);
    refused(&["train", "--resume", from, "--from", from], &["--from", "--resume"]);
}

#[test]
fn runs_are_listed_with_what_they_have_reached() {
    let list = RunFolder::new();
    let root = list.path().to_str().unwrap();
    let empty = output(&["runs", root]);
    assert_eq!(String::from_utf8_lossy(&empty.stdout), format!("no run in {root}\n"));
    refused(&["runs", "/nowhere"], &["/nowhere: No such file"]);

    list.train(&with(&["--steps", "40"]));
    let (finished, broken_off, altered) =
        (list.run_dir(), list.path().join("deep/run-2"), list.path().join("deep/run-10"));
    fs::create_dir_all(&broken_off).unwrap();
    fs::create_dir_all(&altered).unwrap();
    for name in ["config.toml", "run_id", "token", "metrics.jsonl"] {
        fs::copy(finished.join(name), broken_off.join(name)).unwrap();
        fs::copy(finished.join(name), altered.join(name)).unwrap();
    }
    fs::write(altered.join("config.toml"), "seed = -1").unwrap();
    let runs = |arguments: &[&str]| {
        let listed = output(&[&["runs", root], arguments].concat());
        assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
        String::from_utf8(listed.stdout).unwrap()
    };
    let rows: Vec<Value> = serde_json::from_str(&runs(&["--json"])).unwrap();
    let facts: Vec<_> =
        rows.iter().map(|row| (row["run"].as_str().unwrap(), row["state"].as_str().unwrap())).collect();
    assert_eq!(facts, [("deep/run-2", "broken off"), ("deep/run-10", "unreadable"), ("run", "finished")]);
    let run = &rows[2];
    assert_eq!((&run["algorithm"], &run["seed"], &run["env_steps"]), (&"rit".into(), &3.into(), &40.into()));
    let (last, best) = (run["last_evaluation"].as_f64().unwrap(), run["best_evaluation"].as_f64().unwrap());
    assert!(run["metric"] == "win_rate" && last <= best && best <= 1.0, "{run}");
    let table = runs(&[]);
    assert!(table.starts_with("run          task set     algorithm  seed  steps  "), "{table}");
    assert_eq!(table.lines().count(), 4);
}

#[test]
fn a_run_that_goes_on_is_listed_as_running() {
    let folder = RunFolder::new();
    let mut train = folder.start(&with(&["--steps", "1e6"]));
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let listed = output(&["runs", folder.path().to_str().unwrap(), "--json"]);
    let rows: Vec<Value> = serde_json::from_slice(&listed.stdout).unwrap();
    assert_eq!((rows.len(), &rows[0]["state"]), (1, &"running".into()));
    assert!(train.ctl(&["stop"]).status.success());
    train.finish_stopped();
}
