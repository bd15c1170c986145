//! `rit train` with real processes: a learner and two actors.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, metrics_lines, pids, shared_memory_of, wait_until_gone};
use rustix::process::Signal;
use serde_json::Value;
use std::os::unix::fs::PermissionsExt as _;

/// Steps of a short run: 150 episodes, of which the last 118 bring an update each.
const SHORT: &[&str] = &["matrix-game", "--steps", "300", "--seed", "3"];

fn short(more: &[&str]) -> Vec<&'static str> {
    let more: Vec<&'static str> =
        more.iter().map(|word| &*Box::leak((*word).to_owned().into_boxed_str())).collect();
    [SHORT, &more].concat()
}

#[test]
fn two_actors_and_a_learner_train_and_leave_a_whole_run_directory() {
    let folder = RunFolder::new();
    let mut train = folder.start(&short(&["--actors", "2", "--steps", "3000"]));
    let status = train.wait_for("both actors", |status| {
        let actors = status["actors"].as_array().unwrap();
        actors.len() == 2 && actors.iter().all(|actor| actor["episodes"].as_u64() > Some(0))
    });
    let ledger = &status["ledger"];
    let count = |key: &str| ledger[key].as_u64().unwrap();
    assert_eq!(count("handed_out"), count("inserted") + count("outstanding"));
    let processes = pids(&status);

    let summary = train.finish();
    assert_eq!((&summary["env_steps"], &summary["episodes"]), (&Value::from(3000), &Value::from(1500)));
    assert_eq!(summary["updates"], Value::from(1500 - 31), "one an episode, from the 32nd on");
    for game in ["game-1", "game-2", "game-3", "game-4"] {
        let result = &summary["evaluation"][game];
        assert_eq!(result["episodes"], Value::from(32));
        assert!(result["mean_return"].is_f64() && result["win_rate"].is_f64(), "{result}");
    }

    let run_dir = folder.run_dir();
    let on_disk: Value =
        serde_json::from_slice(&std::fs::read(run_dir.join("summary.json")).unwrap()).unwrap();
    assert_eq!(on_disk, summary);
    assert!(run_dir.join("checkpoints/latest/weights.safetensors").is_file());
    let lines = metrics_lines(&run_dir);
    let of_kind = |kind: &str| lines.iter().filter(|line| line["kind"] == kind).count();
    // At the beginning and at the end.
    assert_eq!((of_kind("training"), of_kind("evaluation")), (6, 2));
    assert_eq!(std::fs::metadata(&run_dir).unwrap().permissions().mode() & 0o777, 0o700);

    assert_eq!(shared_memory_of(&run_dir), [] as [std::path::PathBuf; 0]);
    assert!(!run_dir.join("learner.sock").exists() && !run_dir.join("address").exists());
    processes.into_iter().for_each(wait_until_gone);
}

#[test]
fn the_same_seed_gives_the_same_weights_with_any_number_of_actors() {
    let digest = |arguments: &[&str]| {
        let folder = RunFolder::new();
        let summary = folder.train(&short(arguments));
        let weights = folder.run_dir().join("checkpoints/latest/weights.safetensors");
        (summary["weights_digest"].clone(), std::fs::read(weights).unwrap())
    };
    let alone = digest(&["--actors", "1"]);
    assert!(alone == digest(&["--actors", "3"]), "three actors");
    assert!(alone == digest(&["--actors", "1", "--set", "learner.threads=1"]), "one thread");
    assert_ne!(alone.0, digest(&["--actors", "1", "--seed", "4"]).0, "another seed");
}

/// Batches of eight episodes: one actor rolls them side by side, three in shares of three, and with
/// `actors.episodes_at_once=1` one after another.
#[test]
fn the_same_seed_gives_the_same_weights_however_many_episodes_are_rolled_side_by_side() {
    let digest = |arguments: &[&str]| {
        let settings = [
            "cooperative-navigation",
            "--steps",
            "3000",
            "--set",
            "algorithm.batch_size=8",
            "--set",
            "evaluation.episodes=1",
        ];
        let summary = RunFolder::new().train(&[&settings, arguments].concat());
        assert_eq!(summary["updates"], Value::from(15), "one for each batch");
        summary["weights_digest"].clone()
    };
    let together = digest(&["--actors", "1"]);
    assert_eq!(together, digest(&["--actors", "3"]));
    assert_eq!(together, digest(&["--actors", "1", "--set", "actors.episodes_at_once=1"]));
}

#[test]
fn ctrl_c_ends_everything_in_order() {
    for signal in [Signal::INT, Signal::TERM] {
        let folder = RunFolder::new();
        let mut train = folder.start(&["matrix-game", "--actors", "2"]);
        let status = train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
        train.signal(signal);
        let output = train.wait();
        assert_eq!(output.status.code(), Some(130));
        let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!(summary["env_steps"].as_u64() >= status["env_steps"].as_u64());
        assert!(folder.run_dir().join("checkpoints/latest/weights.safetensors").is_file());
        assert!(shared_memory_of(&folder.run_dir()).is_empty());
        pids(&status).into_iter().for_each(wait_until_gone);
    }
}

#[test]
fn nothing_outlives_a_killed_supervisor() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "2"]);
    let status = train.wait_for("both actors", |status| status["actors"].as_array().unwrap().len() == 2);
    train.signal(Signal::KILL);
    train.wait();
    pids(&status).into_iter().for_each(wait_until_gone);
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn an_early_stop_ends_at_an_evaluation() {
    let until = ["--until", "win_rate=0.25", "--set", "evaluation.every_env_steps=100"];
    let folder = RunFolder::new();
    let summary = folder.train(&[&["matrix-game", "--steps", "20000", "--seed", "1"][..], &until].concat());
    assert!(summary["env_steps"].as_u64() < Some(20_000), "{summary}");
    let results = summary["evaluation"].as_object().unwrap();
    assert!(results.values().all(|result| result["win_rate"].as_f64() >= Some(0.25)), "{summary}");

    // It stays over, until more is asked for.
    let again = Train::resume(&folder, &[]).finish();
    assert_eq!(
        (&again["env_steps"], &again["weights_digest"]),
        (&summary["env_steps"], &summary["weights_digest"])
    );
    let steps = summary["env_steps"].as_u64().unwrap() + 100;
    let further = Train::resume(&folder, &["--until", "mean_return=1000", "--steps", &steps.to_string()]);
    assert_eq!(further.finish()["env_steps"], Value::from(steps));
}
