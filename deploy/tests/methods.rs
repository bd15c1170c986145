//! Every algorithm through the whole service: the same promises for all of them.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, actor_pid, json_lines, kill, learner_pid, output, refused};
use rit_algo::{Method, Regime};
use rustix::process::Signal;
use serde_json::Value;
use std::fs;

/// Small networks, and few episodes of evaluation: what is tested does not depend on them.
const SMALL: &[&str] = &["--set", "network.hidden_dim=8", "--set", "evaluation.episodes=1", "--seed", "3"];

/// Settings for so many steps of the matrix game, an update at least every eight steps.
fn run<'a>(method: Method, steps: &'a str, actors: &'a str) -> Vec<&'a str> {
    let mut run = vec!["matrix-game", "--algorithm", method.name(), "--steps", steps, "--actors", actors];
    run.extend(SMALL);
    run.extend(match method.facts().regime {
        Regime::Replay => ["--set", "algorithm.batch_size=4", "--set", "algorithm.target_update_interval=20"],
        Regime::OnPolicy => ["--set", "algorithm.n_rollout_threads=4", "--set", "algorithm.epochs=2"],
    });
    run
}

#[test]
fn the_same_seed_gives_the_same_weights_with_every_method_and_any_number_of_actors() {
    for method in Method::ALL {
        let digest = |actors| {
            let summary = RunFolder::new().train(&run(method, "160", actors));
            let updates = match method.facts().regime {
                Regime::Replay => 80 - 3,
                Regime::OnPolicy => 80 / 4,
            };
            assert_eq!(summary["updates"], Value::from(updates), "{method}");
            summary["weights_digest"].clone()
        };
        assert_eq!(digest("1"), digest("3"), "{method}");
    }
}

/// Padding changes nothing: frames, replay and networks have room for the largest task, be it one that is never trained on.
/// MAPPO and MAT are left out, since the published ones read all slots, empty ones too, in one layer of their width.
#[test]
fn room_for_larger_teams_changes_no_weight() {
    for method in Method::ALL.into_iter().filter(|method| method.facts().regime == Regime::Replay) {
        let digest = |testing: &str| {
            let mut run = run(method, "400", "1");
            run[0] = "cooperative-navigation";
            let testing = format!("environment.testing_tasks=[\"{testing}\"]");
            run.extend(["--set", &testing, "--set", "evaluation.testing_episodes=1"]);
            let summary = RunFolder::new().train(&run);
            assert!(summary["updates"].as_u64() > Some(0), "{method}");
            summary["weights_digest"].clone()
        };
        assert_eq!(digest("navigation-4-4"), digest("navigation-9-9"), "{method}");
    }
}

/// An actor is killed, then the learner: the end is that of an undisturbed run.
fn kills_change_nothing(method: Method) {
    let arguments = |actors| {
        let mut run = run(method, "1600", actors);
        run.extend(["--set", "checkpoints.every_env_steps=200"]);
        run
    };
    let undisturbed = RunFolder::new().train(&arguments("1"));
    let folder = RunFolder::new();
    let mut train = folder.start(&arguments("2"));
    let status = train.wait_for("an actor", |status| actor_pid(status, "actor-0").is_some());
    let victim = actor_pid(&status, "actor-0").unwrap();
    kill(victim, Signal::KILL);
    let status = train.wait_for("its successor, and a checkpoint", |status| {
        actor_pid(status, "actor-0").is_some_and(|pid| pid != victim)
            && status["checkpoints"]["written"].as_u64() > Some(0)
    });
    let victim = learner_pid(&status);
    kill(victim, Signal::KILL);
    train.wait_for("its successor", |status| learner_pid(status) != victim);
    let summary = train.finish();
    for key in ["weights_digest", "env_steps", "episodes", "updates", "evaluation"] {
        assert_eq!(summary[key], undisturbed[key], "{method}: {key}");
    }
}

// A method of each kind of networks, and each that draws numbers of its own. `on_policy.rs` has MAPPO and MAT,
// `recovery.rs` RIT.

#[test]
fn kills_change_nothing_for_vdn_attn() {
    kills_change_nothing(Method::VdnAttn);
}

#[test]
fn kills_change_nothing_for_updet_mix() {
    kills_change_nothing(Method::UpdetMix);
}

#[test]
fn kills_change_nothing_for_refil() {
    kills_change_nothing(Method::Refil);
}

#[test]
fn kills_change_nothing_for_roma() {
    kills_change_nothing(Method::Roma);
}

#[test]
fn an_on_policy_method_learns_from_each_batch_once() {
    let folder = RunFolder::new();
    folder.train(&run(Method::Mappo, "80", "2"));
    let frames = fs::read_dir(folder.run_dir().join("replay")).unwrap();
    let bytes: u64 = frames.map(|frame| frame.unwrap().metadata().unwrap().len()).sum();
    assert_eq!(bytes, 0, "nothing is kept of an episode");
    let lines = json_lines(&folder.run_dir().join("metrics.jsonl"));
    let training: Vec<_> = lines.iter().filter(|line| line["kind"] == "training").collect();
    for line in training {
        let tasks = line["tasks"].as_object().unwrap();
        assert!(tasks.values().all(|task| task["policy_lag"] == 0), "{line}");
    }
    // And goes on where it was.
    let longer = Train::resume(&folder, &["--steps", "160"]).finish();
    let at_once = RunFolder::new().train(&run(Method::Mappo, "160", "1"));
    assert_eq!(longer["weights_digest"], at_once["weights_digest"]);
}

/// A line of metrics holds what the method reports, and so does the status.
#[test]
fn every_methods_measures_are_in_its_lines() {
    for (method, names) in [
        (
            Method::Rit,
            &["td_loss", "contrastive_loss", "grad_norm", "q_total_mean", "target_mean", "saturated_units"][..],
        ),
        (Method::VdnAttn, &["td_loss", "grad_norm", "q_total_mean", "target_mean", "saturated_units"]),
        (Method::Mappo, &["policy_loss", "value_loss", "entropy"]),
    ] {
        let folder = RunFolder::new();
        folder
            .train(&[&run(method, "40", "1")[..], &["--set", "learner.metrics_every_env_steps=8"]].concat());
        let lines = json_lines(&folder.run_dir().join("metrics.jsonl"));
        let line = lines.iter().rfind(|line| line["kind"] == "training").unwrap();
        assert!(names.iter().all(|name| line[name].is_f64()), "{method}: {line}");
        assert_eq!(line.get("contrastive_loss").is_some(), method == Method::Rit, "{line}");
    }
}

#[test]
fn what_does_not_go_with_a_method_is_refused_in_a_line() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let fresh = run_dir.to_str().unwrap();
    let train = |arguments: &[&str], message: &[&str]| {
        refused(&[&["train", "matrix-game", "--run-dir", fresh], arguments].concat(), message);
        assert!(!run_dir.exists(), "nothing was made");
    };
    train(&["--algorithm", "qmix"], &["unknown algorithm \"qmix\"; did you mean \"qmix-", "known: rit, "]);
    train(
        &["--algorithm", "vdn-attn", "--set", "algorithm.imagined_weight=0.3"],
        &["algorithm.imagined_weight means nothing to vdn-attn; these have it: refil"],
    );
    train(
        &["--algorithm", "vdn-attn", "--set", "algorithm.lambda=0.3"],
        &["unknown key \"algorithm.lambda\"; [algorithm] has batch_size, buffer_size, encoder, epsilon_"],
    );
    train(
        &["--algorithm", "mappo", "--set", "algorithm.buffer_size=100"],
        &["algorithm.buffer_size means nothing to mappo; these have it: rit, "],
    );
    train(&["--algorithm", "mat", "--set", "algorithm.policy_lag=1"], &["only 0 will do"]);
    train(
        &["--algorithm", "mat", "--set", "network.n_heads=3"],
        &["network.hidden_dim = 64 is not a multiple of network.n_heads = 3"],
    );
    train(
        &["--algorithm", "mappo", "--set", "algorithm.minibatches=64"],
        &["algorithm.minibatches = 64 is out of range 1..=32"],
    );
    refused(&["bench", "rollout", "--algorithm", "all"], &["--algorithm all is for learner"]);
}

#[test]
fn a_run_keeps_its_method() {
    let folder = RunFolder::new();
    let summary = folder.train(&run(Method::VdnAttn, "40", "1"));
    let run_dir = folder.run_dir();
    let root = run_dir.to_str().unwrap();
    refused(
        &["train", "--resume", root, "--algorithm", "mappo", "--steps", "80"],
        &["begun with the algorithm vdn-attn and cannot go on with mappo"],
    );
    // Another method is written into the run's own configuration.
    let config = fs::read_to_string(run_dir.join("config.toml")).unwrap();
    fs::write(run_dir.join("config.toml"), config.replace("vdn-attn", "vdn-int")).unwrap();
    let resumed = output(&["train", "--resume", root, "--steps", "80"]);
    let stderr = String::from_utf8_lossy(&resumed.stderr);
    assert!(!resumed.status.success() && stderr.contains("algorithm.name"), "{stderr}");
    let on_disk: Value = serde_json::from_slice(&fs::read(run_dir.join("summary.json")).unwrap()).unwrap();
    assert_eq!(on_disk, summary, "nothing was written over");
    // Put right, it goes on.
    fs::write(run_dir.join("config.toml"), config).unwrap();
    Train::resume(&folder, &["--steps", "80", "--algorithm", "vdn-attn"]).finish();
}
