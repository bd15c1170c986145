//! `rit ctl` and `rit evaluate` against a real run.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, kill, learner_pid, output, pids, rit, wait_until_gone};
use rustix::process::Signal;
use serde_json::Value;
use std::process::Stdio;

fn json(output: &std::process::Output) -> Value {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A pause is the run's, not the learner's: the learner that takes over from a killed one is paused too. Started again, the
/// run goes on.
#[test]
fn a_pause_outlives_the_learner_and_not_the_run() {
    let run = ["matrix-game", "--actors", "1", "--seed", "1", "--steps", "2000"];
    let folder = RunFolder::new();
    let mut train = folder.start(&run);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    json(&train.ctl(&["pause"]));
    let killed = learner_pid(&json(&train.ctl(&["status"])));
    kill(killed, Signal::KILL);
    let next = train.wait_for("the next learner and the actor", |status| {
        learner_pid(status) != killed && !status["actors"].as_array().unwrap().is_empty()
    });
    assert_eq!((&next["state"], &next["ledger"]["outstanding"]), (&"paused".into(), &0.into()));
    train.signal(Signal::KILL);
    train.wait();
    pids(&next).into_iter().for_each(wait_until_gone);
    let resumed = Train::resume(&folder, &[]).finish();
    let undisturbed = RunFolder::new().train(&run);
    assert_eq!(resumed["weights_digest"], undisturbed["weights_digest"]);
}

#[test]
fn a_stop_ends_a_pause() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "1", "--seed", "1"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    let paused = folder.run_dir().join("paused");
    assert_eq!(json(&train.ctl(&["pause"]))["state"], "paused");
    assert!(paused.is_file());
    assert_eq!(json(&train.ctl(&["stop"]))["state"], "stopping");
    train.finish_stopped();
    assert!(!paused.exists(), "the run would go on paused");
}

#[test]
fn a_run_is_paused_evaluated_saved_resumed_and_stopped() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "2", "--seed", "1"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));

    assert_eq!(json(&train.ctl(&["pause"]))["state"], "paused");
    // What is outstanding still arrives; then everything stands.
    let still = train.wait_for("quiet", |status| {
        status["ledger"]["outstanding"] == 0 && status["ledger"]["inserted"] == status["episodes"]
    });
    let evaluation =
        json(&train.ctl(&["evaluate", "--episodes", "20", "--tasks", "game-2,game-4", "--seed", "5"]));
    let tasks: Vec<_> = evaluation["tasks"].as_array().unwrap().iter().map(|task| &task["task"]).collect();
    assert_eq!(tasks, ["game-2", "game-4"]);
    assert_eq!(evaluation["weights_version"], still["updates"]);
    let written = json(&train.ctl(&["checkpoint"]));
    assert_eq!(written["env_steps"], still["env_steps"]);

    // The same episodes with the same weights from the checkpoint: another process, the same results.
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    let arguments =
        ["evaluate", "--run", run, "--json", "--episodes", "20", "--tasks", "game-2,game-4", "--seed", "5"];
    let offline = json(&output(&arguments));
    assert_eq!(offline["weights_digest"], written["weights_digest"]);
    for task in evaluation["tasks"].as_array().unwrap() {
        let name = task["task"].as_str().unwrap();
        assert_eq!(offline["tasks"][name]["mean_return"], task["mean_return"]);
        assert_eq!(offline["tasks"][name]["win_rate"], task["win_rate"]);
    }
    assert_eq!(json(&train.ctl(&["status"]))["env_steps"], still["env_steps"], "a pause is a pause");

    assert_eq!(json(&train.ctl(&["resume"]))["state"], "running");
    train.wait_for("training again", |status| status["env_steps"].as_u64() > still["env_steps"].as_u64());
    assert_eq!(json(&train.ctl(&["stop"]))["state"], "stopping");
    let summary = train.finish_stopped();
    assert!(summary["env_steps"].as_u64() < Some(50_000));
}

#[test]
fn an_evaluation_ends_when_its_caller_has_gone() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "1", "--seed", "1"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    let run_dir = folder.run_dir();
    let evaluate = ["ctl", "--run", run_dir.to_str().unwrap(), "evaluate", "--episodes", "1000000"];
    for _ in 0..3 {
        let mut caller = rit(&evaluate).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        // Long enough or not: it is under way, or never was.
        train.wait_for("an answer beside it", |_| true);
        caller.kill().unwrap();
        caller.wait().unwrap();
    }
    // Its turn comes at once; after minutes the call would have ended without an answer.
    let repeated = vec!["game-2"; 3000].join(",");
    let evaluation = json(&train.ctl(&["evaluate", "--episodes", "20", "--tasks", &repeated]));
    assert_eq!(evaluation["tasks"].as_array().unwrap().len(), 1, "{evaluation}");
}

#[test]
fn people_get_tables() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "1", "--seed", "1"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    let run_dir = folder.run_dir();
    let text = output(&["ctl", "--run", run_dir.to_str().unwrap(), "status"]);
    let text = String::from_utf8(text.stdout).unwrap();
    for part in
        ["running for", "environment steps", "ledger", "actor-0", "exploring episodes of late", "game-3"]
    {
        assert!(text.contains(part), "{part} in\n{text}");
    }
    let status = train.ctl(&["evaluate", "--tasks", "chess"]);
    assert_eq!(status.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&status.stderr).contains("unknown task \"chess\"; known: game-1"));
    let none = train.ctl(&["evaluate", "--tasks", "testing"]);
    assert_eq!(none.status.code(), Some(2));
}

#[test]
fn settings_change_while_the_run_goes_on() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "1", "--seed", "1"]);
    let actors = |status: &Value| status["actors"].as_array().unwrap().len();
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));

    let status = json(&train.ctl(&["set", "actors.count=3", "log=debug"]));
    assert_eq!(status["actors_wanted"], 3);
    train.wait_for("three actors", |status| actors(status) == 3);
    train.ctl(&["set", "actors.count=1"]);
    train.wait_for("one actor", |status| actors(status) == 1);

    train.ctl(&["set", "algorithm.epsilon_finish=0.25"]);
    train.wait_for("epsilon on its way to the new floor", |status| {
        let (env_steps, epsilon) =
            (status["env_steps"].as_f64().unwrap(), status["epsilon"].as_f64().unwrap());
        // To 0.05 it would be 0.008 lower at least.
        env_steps > 2000.0 && (epsilon - (1.0 - 0.75 * env_steps / 50_000.0)).abs() < 0.003
    });
    let (_, config) = rit_config::RunDir::open(&folder.run_dir()).unwrap();
    assert_eq!((config.algorithm.epsilon_finish, config.actors.count), (0.25, 1), "it is written down");
    let log = std::fs::read_to_string(folder.run_dir().join("logs/learner.log")).unwrap();
    assert!(log.contains("DEBUG"), "the learner logs more");

    for (setting, words) in [
        ("algorithm.gamma=0.5", "algorithm.gamma cannot change while the learner runs"),
        ("actors.count=17", "actors.count = 17 is out of range 0..=16"),
        ("algorithm.epsilon_finish=2", "algorithm.epsilon_finish = 2 is out of range 0..=1"),
        ("actors.cuont=2", "did you mean actors.count?"),
        ("nonsense", "write KEY=VALUE"),
    ] {
        let refused = train.ctl(&["set", setting]);
        let stderr = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{setting}: {stderr}");
        assert!(stderr.contains(words), "{stderr}");
    }
    json(&train.ctl(&["stop"]));
    train.finish_stopped();
}

/// Counts that change faster than actors come and go: each slot is filled once, and the run goes on.
#[test]
fn the_number_of_actors_may_change_again_and_again() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "2", "--seed", "1"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    for count in ["6", "1", "6", "2", "5", "0", "4", "1", "3"] {
        let answer = train.ctl(&["set", &format!("actors.count={count}")]);
        let stderr = String::from_utf8_lossy(&answer.stderr);
        if count == "0" {
            assert_eq!(answer.status.code(), Some(2), "{stderr}");
            assert!(stderr.contains("`rit ctl pause` lets it rest"), "{stderr}");
        } else {
            assert!(answer.status.success(), "{stderr}");
        }
    }
    train.wait_for("the three that are wanted", |status| {
        let mut names: Vec<_> = status["actors"]
            .as_array()
            .unwrap()
            .iter()
            .map(|actor| actor["name"].as_str().unwrap())
            .collect();
        names.sort_unstable();
        names == ["actor-0", "actor-1", "actor-2"]
    });
    json(&train.ctl(&["stop"]));
    train.finish_stopped();
}

#[test]
fn a_drained_run_has_nothing_under_way_and_goes_on_to_the_same_weights() {
    let steps = ["matrix-game", "--seed", "3", "--steps", "3000"];
    let undisturbed = RunFolder::new().train(&[&steps[..], &["--actors", "1"]].concat());

    let folder = RunFolder::new();
    let mut train = folder.start(&[&steps[..], &["--actors", "2"]].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(100));
    assert_eq!(json(&train.ctl(&["stop", "--drain"]))["state"], "stopping");
    let halfway = train.finish_stopped();
    assert!(halfway["env_steps"].as_u64() < Some(3000));
    let log = std::fs::read_to_string(folder.run_dir().join("logs/learner.log")).unwrap();
    assert!(log.contains("rejected: {}"), "no episode was taken back: {log}");

    let whole = Train::resume(&folder, &[]).finish();
    assert_eq!(whole["weights_digest"], undisturbed["weights_digest"]);
}
