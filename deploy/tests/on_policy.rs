//! MAPPO and MAT in the service: whichever actor rolls and whatever is killed, the same seed gives the same weights.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, actor_pid, json_lines, kill, learner_pid, output};
use rustix::process::Signal;
use serde_json::Value;

/// The run of a method on the matrix game: 200 updates of 32 episodes of two steps, checkpoints between them. It is this
/// long because nothing holds it between a kill and the successor's first answer: some thousand steps pass in that time.
fn matrix(method: &str) -> Vec<&str> {
    let run = ["matrix-game", "--algorithm", method, "--seed", "3", "--steps", "12800"];
    let often = ["--set", "checkpoints.every_env_steps=320", "--set", "evaluation.every_env_steps=6400"];
    [&run[..], &often].concat()
}

/// What a run ends with.
fn end(summary: &Value) -> [&Value; 5] {
    ["weights_digest", "env_steps", "episodes", "updates", "evaluation"].map(|key| &summary[key])
}

/// Undisturbed by one actor; then by three, two of which are killed and started again, while the learner is killed
/// too, goes on from its newest checkpoint, and is stopped and resumed.
fn kills_change_nothing(method: &str) {
    let run = matrix(method);
    let undisturbed = RunFolder::new().train(&[&run[..], &["--actors", "1"]].concat());
    assert_eq!(undisturbed["updates"], Value::from(200), "one for each batch");

    let folder = RunFolder::new();
    let mut train = folder.start(&[&run[..], &["--actors", "3"]].concat());
    let status = train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(400));
    let killed = learner_pid(&status);
    kill(killed, Signal::KILL);
    let actor = "actor-1";
    let status = train.wait_for("its successor and an actor", |status| {
        learner_pid(status) != killed && actor_pid(status, actor).is_some()
    });
    kill(actor_pid(&status, actor).unwrap(), Signal::KILL);
    train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(1200));
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
    let resumed = Train::resume(&folder, &[]).finish();
    assert_eq!(end(&resumed), end(&undisturbed));
}

#[test]
fn kills_change_nothing_for_mappo() {
    kills_change_nothing("mappo");
}

#[test]
fn kills_change_nothing_for_mat() {
    kills_change_nothing("mat");
}

/// Particle worlds, where MAPPO's agents remember and MAT's episodes are cut off at the limit: however many actors, however
/// many episodes side by side, however many threads.
#[test]
fn the_same_seed_gives_the_same_weights_with_any_number_of_actors() {
    for method in ["mappo", "mat"] {
        let digest = |arguments: &[&str]| {
            let run = ["cooperative-navigation", "--algorithm", method, "--steps", "1000"];
            let few = ["--set", "evaluation.episodes=1", "--set", "evaluation.testing_episodes=1"];
            let folder = RunFolder::new();
            let summary = folder.train(&[&run[..], &few, arguments].concat());
            assert_eq!(summary["updates"], Value::from(5), "one for each batch");
            let lines = json_lines(&folder.run_dir().join("metrics.jsonl"));
            (summary["weights_digest"].clone(), summary["evaluation"].clone(), lines.len())
        };
        let alone = digest(&["--actors", "1"]);
        assert_eq!(alone, digest(&["--actors", "3", "--set", "learner.threads=4"]), "{method}");
        assert_eq!(alone, digest(&["--actors", "1", "--set", "actors.episodes_at_once=1"]), "{method}");
        assert_ne!(alone.0, digest(&["--actors", "1", "--seed", "4"]).0, "{method}");
    }
}

/// Actors obey `algorithm.time_limit`: the world calls its limit an end, a method may call it a cut.
#[test]
fn actors_end_episodes_at_the_time_limit_as_the_settings_say() {
    let digest = |time_limit: &str| {
        let run = ["cooperative-navigation", "--algorithm", "mappo", "--steps", "400", "--actors", "1"];
        let few = ["--set", "evaluation.episodes=1", "--set", "evaluation.testing_episodes=1"];
        let setting = format!("algorithm.time_limit={time_limit}");
        let summary = RunFolder::new().train(&[&run[..], &few, &["--set", &setting]].concat());
        summary["weights_digest"].clone()
    };
    let [environment, terminated, truncated] = ["environment", "terminated", "truncated"].map(digest);
    assert_eq!(environment, terminated);
    assert_ne!(environment, truncated);
}

#[test]
fn what_is_measured_is_what_the_method_declares() {
    let folder = RunFolder::new();
    let summary = folder.train(&["matrix-game", "--algorithm", "mappo", "--steps", "640", "--actors", "1"]);
    assert_eq!(summary["updates"], Value::from(10));
    let lines = json_lines(&folder.run_dir().join("metrics.jsonl"));
    let line = lines.iter().find(|line| line["kind"] == "training").unwrap();
    let value = |name: &str| line[name].as_f64().unwrap_or_else(|| panic!("{name} in {line}"));
    assert!((value("ratio_mean") - 1.0).abs() < 0.1 && value("kl") >= 0.0);
    // Three actions: ln 3 = 1.0986 at most, and at first nearly that.
    assert!((0.5..1.0987).contains(&value("entropy")));
    assert!(value("actor_grad_norm") > 0.0 && value("critic_grad_norm") > 0.0);
    assert!(line.get("td_loss").is_none(), "{line}");

    // Its checkpoint is its own: another method cannot go on from it.
    let run_dir = folder.run_dir();
    let refused = output(&["train", "--resume", run_dir.to_str().unwrap(), "--algorithm", "mat"]);
    assert_eq!(refused.status.code(), Some(2));
}
