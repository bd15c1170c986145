//! How a run ended: `summary.json` and the exit code say the same, and scripts can tell the ends apart.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, actor_pid, kill, learner_pid, output, refused, rit, wait_until_gone};
use rustix::process::Signal;
use serde_json::Value;
use std::{
    fs,
    process::{Command, Stdio},
};

const RUN: &[&str] = &[
    "matrix-game",
    "--seed",
    "3",
    "--steps",
    "1000000",
    "--actors",
    "1",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "checkpoints.every_env_steps=60",
    "--set",
    "web.listen=off",
];

fn summary(folder: &RunFolder) -> Value {
    serde_json::from_slice(&fs::read(folder.run_dir().join("summary.json")).unwrap()).unwrap()
}

fn under_way(folder: &RunFolder, more: &[&str]) -> Train {
    let mut train = folder.start(&[RUN, more].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(20));
    train
}

#[test]
fn a_run_that_has_done_its_steps_or_reached_its_goal_has_finished() {
    let folder = RunFolder::new();
    let ended = folder.start(&[RUN, &["--steps", "200"]].concat()).end_with(0);
    assert_eq!(ended["ended"], "finished");
    assert_eq!(ended, summary(&folder));
    let folder = RunFolder::new();
    let goal = ["--until", "mean_return=-1000", "--set", "evaluation.every_env_steps=50"];
    let ended = folder.start(&[RUN, &goal].concat()).end_with(0);
    assert_eq!(ended["ended"], "until");
}

#[test]
fn a_run_that_was_asked_to_end_says_by_whom() {
    let folder = RunFolder::new();
    let train = under_way(&folder, &[]);
    assert!(train.ctl(&["stop"]).status.success());
    train.finish_stopped();
    assert_eq!(summary(&folder)["ended"], "stopped");

    // While it goes on there is no end to tell of.
    let mut again = Train::resume(&folder, &[]);
    again.wait_for("training", |status| status["updates"].as_u64() > Some(20));
    assert!(!folder.run_dir().join("summary.json").exists());
    again.signal(Signal::TERM);
    assert_eq!(again.end_with(130)["ended"], "interrupted");
    let status = output(&["ctl", "--run", folder.run_dir().to_str().unwrap(), "status"]);
    let status = String::from_utf8(status.stdout).unwrap();
    assert!(status.starts_with("the run is over: interrupted"), "{status}");
}

#[test]
fn a_terminal_that_closes_ends_a_run_in_order_and_nohup_keeps_it() {
    let folder = RunFolder::new();
    let mut train = under_way(&folder, &[]);
    let learner = learner_pid(&train.wait_for("the learner", |_| true));
    train.signal(Signal::HUP);
    assert_eq!(train.end_with(130)["ended"], "interrupted");
    assert_eq!(summary(&folder)["ended"], "interrupted");
    wait_until_gone(learner);

    let folder = RunFolder::new();
    let mut command = Command::new("nohup");
    command.arg(env!("CARGO_BIN_EXE_rit")).stdin(Stdio::null());
    let mut train = folder.start_as(command, &[&["--json"], RUN].concat());
    let before = train.wait_for("training", |status| status["updates"].as_u64() > Some(20));
    train.signal(Signal::HUP);
    kill(learner_pid(&before), Signal::HUP);
    let after = train.wait_for("further training", |status| {
        status["updates"].as_u64() > before["updates"].as_u64().map(|updates| updates + 50)
    });
    assert_eq!(learner_pid(&after), learner_pid(&before), "children ignore it too");
    train.signal(Signal::TERM);
    assert_eq!(train.wait().status.code(), Some(130));
}

/// Started with SIGHUP ignored, the test above waited for ever.
#[test]
fn a_terminal_that_closes_is_tested_under_nohup_too() {
    let mut tests = Command::new("timeout");
    tests.args(["110", "nohup"]).arg(std::env::current_exe().unwrap()).stdin(Stdio::null());
    tests.args(["--exact", "a_terminal_that_closes_ends_a_run_in_order_and_nohup_keeps_it"]);
    let output = tests.output().unwrap();
    let stdout = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && stdout.contains("1 passed"), "{:?} {stdout}", output.status);
}

#[test]
fn a_run_whose_directory_is_removed_says_so_before_it_ends() {
    let folder = RunFolder::new();
    let mut train = folder.start_as(rit(&[]), RUN);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(20));
    let elsewhere = folder.path().join("elsewhere");
    fs::rename(folder.run_dir(), &elsewhere).unwrap();
    let log = elsewhere.join("logs/train.log");
    while !fs::read_to_string(&log).unwrap().contains("is gone, removed or renamed") {
        std::thread::yield_now();
    }
    // Back in its place, all is well.
    fs::rename(&elsewhere, folder.run_dir()).unwrap();
    train.signal(Signal::TERM);
    assert_eq!(train.wait().status.code(), Some(130));
    assert_eq!(summary(&folder)["ended"], "interrupted");
}

#[test]
fn a_run_that_ended_in_order_never_begins_anew() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "100"]].concat());
    let run_dir = folder.run_dir();
    fs::remove_dir_all(run_dir.join("checkpoints")).unwrap();
    fs::remove_file(run_dir.join("checkpoints.json")).unwrap();
    let metrics = fs::read(run_dir.join("metrics.jsonl")).unwrap();
    let run = run_dir.to_str().unwrap();
    refused(
        &["train", "--resume", run, "--steps", "200"],
        &["holds no checkpoint", "summary.json tells of it"],
    );
    assert_eq!(fs::read(run_dir.join("metrics.jsonl")).unwrap(), metrics);

    // One that was killed before its first checkpoint has nothing else to do, and says it.
    fs::remove_file(run_dir.join("summary.json")).unwrap();
    Train::resume(&folder, &["--steps", "200"]).finish();
    let said = fs::read_to_string(run_dir.join("logs/train.log")).unwrap();
    assert!(said.contains("no checkpoint was written yet: training begins again at step 0"), "{said}");
}

/// Waiting for room on a disk is of no use where the directory itself was removed.
#[test]
fn a_learner_whose_run_was_removed_ends_with_its_supervisor() {
    let folder = RunFolder::new();
    let mut train = under_way(&folder, &[]);
    let learner = learner_pid(&train.wait_for("the learner", |_| true));
    // The learner may write into it while it goes.
    while folder.run_dir().exists() {
        let _ = fs::remove_dir_all(folder.run_dir());
    }
    train.signal(Signal::KILL);
    wait_until_gone(learner);
}

#[test]
fn a_third_interrupt_ends_a_run_whose_learner_hangs() {
    let folder = RunFolder::new();
    let mut train = under_way(&folder, &[]);
    let learner = learner_pid(&train.wait_for("the learner", |_| true));
    let log = folder.run_dir().join("logs/train.log");
    kill(learner, Signal::STOP);
    for said in ["interrupted: shutting the run down", "interrupted again: "] {
        train.signal(Signal::INT);
        while !fs::read_to_string(&log).unwrap().contains(said) {
            std::thread::yield_now();
        }
    }
    train.signal(Signal::INT);
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("interrupted three times, and its processes were killed"), "{stderr}");
    wait_until_gone(learner);
    assert_eq!(summary(&folder)["ended"], "failed");
    assert!(fs::read_to_string(&log).unwrap().contains("a second interrupt ends the retries"));
}

#[test]
fn a_learner_that_is_asked_to_end_alone_is_restarted() {
    for signal in [Signal::TERM, Signal::INT] {
        let folder = RunFolder::new();
        let mut train = under_way(&folder, &[]);
        let first = learner_pid(&train.wait_for("the learner", |_| true));
        kill(first, signal);
        let after = train.wait_for("the next learner and the actor", |status| {
            learner_pid(status) != first && actor_pid(status, "actor-0").is_some()
        });
        train.wait_for("progress", |status| status["updates"].as_u64() > after["updates"].as_u64());
        train.signal(Signal::INT);
        assert_eq!(train.end_with(130)["ended"], "interrupted");
    }
}

#[test]
fn a_learner_of_its_own_ends_as_interrupted() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    let mut command = rit(&["learner", "--new", "matrix-game", "--run-dir", run, "--set", "web.listen=off"]);
    let mut learner = command.stderr(Stdio::null()).spawn().unwrap();
    while !run_dir.join("address").exists() {
        assert!(learner.try_wait().unwrap().is_none(), "it listens");
        std::thread::yield_now();
    }
    kill(learner.id(), Signal::TERM);
    assert_eq!(learner.wait().unwrap().code(), Some(130));
    assert_eq!(summary(&folder)["ended"], "interrupted");
}

/// A learner that is restarted reads its configuration anew: what is wrong with it then was not typed, and the run has
/// failed.
#[test]
fn a_run_that_is_spoilt_while_it_goes_on_says_the_same_in_summary_and_exit_code() {
    let folder = RunFolder::new();
    let mut train = under_way(&folder, &[]);
    let learner = learner_pid(&train.wait_for("the learner", |_| true));
    fs::write(folder.run_dir().join("config.toml"), "nonsense").unwrap();
    kill(learner, Signal::KILL);
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    let ended = summary(&folder);
    assert_eq!((output.status.code(), &ended["ended"]), (Some(1), &"failed".into()), "{stderr}");
    assert!(ended["reason"].as_str().unwrap().contains("config.toml"), "{ended}");
}

#[test]
fn a_run_that_failed_says_why() {
    let folder = RunFolder::new();
    let settings = ["checkpoints.last_retry_ms=0", "checkpoints.every_env_steps=1000000"];
    let train = under_way(&folder, &["--set", settings[0], "--set", settings[1]]);
    // No place for the last checkpoint.
    let checkpoints = folder.run_dir().join("checkpoints");
    fs::remove_dir_all(&checkpoints).unwrap();
    fs::write(&checkpoints, "").unwrap();
    assert!(train.ctl(&["stop"]).status.success());
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    let ended = summary(&folder);
    assert_eq!(ended["ended"], "failed");
    assert!(ended["reason"].as_str().unwrap().contains("the last checkpoint was not written"), "{ended}");
    assert!(ended["updates"].as_u64() > Some(20), "{ended}");
}
