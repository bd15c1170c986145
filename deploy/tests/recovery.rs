//! Whatever is killed, stopped or interrupted: the run goes on, and ends with the weights of an undisturbed one.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{
    RunFolder, Train, actor_pid, kill, learner_pid, metrics_lines, output, pids, rit, shared_memory_of,
    wait_until_gone,
};
use rustix::process::Signal;
use serde_json::Value;
use std::{
    fs,
    process::{Command, Stdio},
    sync::LazyLock,
};

/// 400 episodes; replay of 100, so that checkpoints in the middle have to bring back part of it.
const RUN: &[&str] = &[
    "matrix-game",
    "--seed",
    "3",
    "--steps",
    "800",
    "--set",
    "algorithm.buffer_size=100",
    "--set",
    "checkpoints.every_env_steps=60",
    "--set",
    "evaluation.every_env_steps=200",
    "--set",
    "algorithm.target_update_interval=30",
];

/// The summary of a run that nothing happens to, and the lines of its metrics but for their times.
static UNDISTURBED: LazyLock<(Value, Vec<Value>)> = LazyLock::new(|| {
    let folder = RunFolder::new();
    let summary = folder.train(&[RUN, &["--actors", "1"]].concat());
    let lines = metrics(&folder);
    (summary, lines)
});

fn metrics(folder: &RunFolder) -> Vec<Value> {
    let mut lines = metrics_lines(&folder.run_dir());
    for line in &mut lines {
        line.as_object_mut().unwrap().remove("wall_s");
    }
    lines
}

/// Lines that are points of curves: all but the evaluation at the end.
fn points(lines: &[Value]) -> usize {
    lines.iter().filter(|line| line.get("occasion").is_none()).count()
}

/// Events in TensorBoard's files but for the three that each file begins with.
fn tensorboard_events(folder: &RunFolder) -> usize {
    let files = fs::read_dir(folder.run_dir().join("tensorboard")).unwrap();
    files.map(|file| count_records(&fs::read(file.unwrap().path()).unwrap()) - 3).sum()
}

/// Records of a length, its checksum, data, its checksum.
fn count_records(mut bytes: &[u8]) -> usize {
    let mut count = 0;
    while let Some((len, _)) = bytes.split_first_chunk::<8>() {
        bytes = &bytes[8 + 4 + u64::from_le_bytes(*len) as usize + 4..];
        count += 1;
    }
    assert!(bytes.is_empty(), "whole records");
    count
}

/// Holds the end of a run to the undisturbed one: weights, evaluation, episodes and every line of the metrics.
#[track_caller]
fn nothing_was_lost(folder: &RunFolder, summary: &Value) {
    let (undisturbed, lines) = &*UNDISTURBED;
    for key in ["weights_digest", "env_steps", "episodes", "updates", "evaluation"] {
        assert_eq!(summary[key], undisturbed[key], "{key}");
    }
    for (line, expected) in metrics(folder).iter().zip(lines) {
        assert_eq!(line, expected);
    }
    assert_eq!(metrics(folder).len(), lines.len());
    assert_eq!(tensorboard_events(folder), points(lines), "each line once for TensorBoard too");
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn a_killed_actor_is_restarted() {
    let folder = RunFolder::new();
    let mut train = folder.start(&[RUN, &["--actors", "2"]].concat());
    for name in ["actor-0", "actor-1"] {
        let status = train.wait_for(name, |status| actor_pid(status, name).is_some());
        let victim = actor_pid(&status, name).unwrap();
        kill(victim, Signal::KILL);
        train.wait_for("its successor", |status| actor_pid(status, name).is_some_and(|pid| pid != victim));
    }
    nothing_was_lost(&folder, &train.finish());
}

/// An actor that is told to leave does so gracefully, and its own slot is filled again.
#[test]
fn an_actor_that_is_told_to_leave_is_replaced() {
    let folder = RunFolder::new();
    let steps = ["--actors", "2", "--steps", "3000"];
    let mut train = folder.start(&[RUN, &steps].concat());
    for (name, signal) in [
        ("actor-0", Signal::TERM),
        ("actor-0", Signal::INT),
        ("actor-1", Signal::TERM),
        ("actor-0", Signal::HUP),
        ("actor-1", Signal::QUIT),
    ] {
        let status = train.wait_for("both actors", |status| {
            ["actor-0", "actor-1"].iter().all(|name| actor_pid(status, name).is_some())
        });
        let victim = actor_pid(&status, name).unwrap();
        kill(victim, signal);
        // Else the run may be over before its successor is there.
        assert!(train.ctl(&["pause"]).status.success());
        train.wait_for("its successor", |status| actor_pid(status, name).is_some_and(|pid| pid != victim));
        assert!(train.ctl(&["resume"]).status.success());
    }
    let undisturbed = RunFolder::new().train(&[RUN, &["--actors", "1", "--steps", "3000"]].concat());
    assert_eq!(train.finish()["weights_digest"], undisturbed["weights_digest"]);
}

#[test]
fn a_killed_learner_is_restarted_from_its_newest_checkpoint_and_actors_find_it() {
    let folder = RunFolder::new();
    let mut train = folder.start(&[RUN, &["--actors", "2"]].concat());
    let mut actors = None;
    // Before the first checkpoint, and after others.
    for env_steps in [20, 200, 500] {
        let status = train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(env_steps));
        kill(learner_pid(&status), Signal::KILL);
        let killed = learner_pid(&status);
        let after = train.wait_for("its successor and both actors", |status| {
            learner_pid(status) != killed && status["actors"].as_array().unwrap().len() == 2
        });
        let mut survivors = pids(&after)[1..].to_vec();
        survivors.sort_unstable();
        assert_eq!(*actors.get_or_insert_with(|| survivors.clone()), survivors, "the actors lived on");
    }
    nothing_was_lost(&folder, &train.finish());
}

#[test]
fn a_hung_actor_is_noticed_and_replaced() {
    let folder = RunFolder::new();
    let heartbeat = ["--actors", "2", "--set", "actors.heartbeat_timeout_ms=2000", "--steps", "800"];
    let mut train = folder.start(&[RUN, &heartbeat].concat());
    let status = train.wait_for("actor-0", |status| actor_pid(status, "actor-0").is_some());
    let victim = actor_pid(&status, "actor-0").unwrap();
    kill(victim, Signal::STOP);
    // Its episodes go to the other, so the run may end before it is replaced: whichever comes first.
    let output = train.wait();
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    nothing_was_lost(&folder, &summary);
    wait_until_gone(victim);
    let log = fs::read_to_string(folder.run_dir().join("logs/learner.log")).unwrap();
    assert!(log.contains("an actor hangs"), "{log}");
}

#[test]
fn an_interrupted_run_goes_on_where_it_was() {
    let folder = RunFolder::new();
    let mut train = folder.start(&[RUN, &["--actors", "2"]].concat());
    train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(100));
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
    // Killed with everything it started, the hard way.
    let mut train = Train::resume(&folder, &["--actors", "3"]);
    let status = train.wait_for("progress", |status| status["env_steps"].as_u64() >= Some(400));
    pids(&status).into_iter().for_each(|pid| kill(pid, Signal::KILL));
    train.signal(Signal::KILL);
    train.wait();
    pids(&status).into_iter().for_each(wait_until_gone);
    nothing_was_lost(&folder, &Train::resume(&folder, &[]).finish());
}

#[test]
fn a_finished_run_goes_on_to_more_steps() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "300"]].concat());
    let longer = Train::resume(&folder, &["--steps", "800"]).finish();
    nothing_was_lost(&folder, &longer);
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_one_before_is_used() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "300"]].concat());
    let newest = fs::canonicalize(folder.run_dir().join("checkpoints/latest")).unwrap();
    fs::write(newest.join("state.safetensors"), "damaged").unwrap();
    let run_dir = folder.run_dir();
    let resumed = output(&["train", "--resume", run_dir.to_str().unwrap(), "--steps", "800"]);
    let stderr = String::from_utf8_lossy(&resumed.stderr);
    assert!(resumed.status.success(), "{stderr}");
    let said = "warning: a checkpoint is damaged, the one at 240 steps is used: ";
    assert!(stderr.contains(said) && stderr.contains("state.safetensors was altered"), "{stderr}");
    let summary = serde_json::from_slice(&fs::read(run_dir.join("summary.json")).unwrap()).unwrap();
    nothing_was_lost(&folder, &summary);

    // All of them damaged: never a silent fresh start.
    for entry in fs::read_dir(folder.run_dir().join("checkpoints")).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            fs::write(path.join("SHA256SUMS"), "").unwrap();
        }
    }
    let refused = Train::resume(&folder, &["--steps", "900"]).wait();
    assert_eq!(refused.status.code(), Some(2));
    let stderr = String::from_utf8_lossy(&refused.stderr);
    assert!(stderr.contains("no checkpoint in") && stderr.contains("was altered"), "{stderr}");
    assert!(folder.run_dir().join("summary.json").exists(), "nothing was overwritten");
}

#[test]
fn a_learner_that_dies_before_it_speaks_is_started_again_after_a_while() {
    let folder = RunFolder::new();
    let mut train = folder.start_as(rit(&[]), &[RUN, &["--actors", "1"]].concat());
    let begun = train.wait_for("an actor", |status| actor_pid(status, "actor-0").is_some());
    let mut killed = learner_pid(&begun);
    kill(killed, Signal::KILL);
    // The others before `rit train` has heard of them.
    for _ in 0..2 {
        killed = train.wait_for_learner_process(killed);
        kill(killed, Signal::KILL);
    }
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    for words in ["", " in 0.25 s", " in 0.5 s"] {
        let line = format!("the learner was ended by signal 9 and is restarted{words}\n");
        assert!(stderr.contains(&line), "{line:?} in {stderr}");
    }
    let summary = fs::read(folder.run_dir().join("summary.json")).unwrap();
    nothing_was_lost(&folder, &serde_json::from_slice(&summary).unwrap());
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn what_would_change_the_result_cannot_change() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "100"]].concat());
    let refused = Train::resume(&folder, &["--set", "algorithm.gamma=0.5"]).wait();
    assert_eq!(refused.status.code(), Some(2));
    let stderr = String::from_utf8_lossy(&refused.stderr);
    assert!(stderr.contains("algorithm.gamma cannot change in a run that has begun"), "{stderr}");
}

#[test]
fn torn_metrics_are_repaired_at_the_last_whole_line_and_it_is_said() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "300"]].concat());
    let run_dir = folder.run_dir();
    let path = run_dir.join("metrics.jsonl");
    let whole = fs::read_to_string(&path).unwrap();
    // The evaluation at the end lies after the checkpoint, which knows nothing of it.
    let lines = whole.split_inclusive('\n').filter(|line| !line.contains("\"occasion\""));
    let lines: Vec<&str> = lines.collect();
    assert!(lines.len() > 2, "{whole}");
    let (last, before) = lines.split_last().unwrap();
    fs::write(&path, before.concat() + &last[..last.len() / 2]).unwrap();
    for entry in fs::read_dir(run_dir.join("tensorboard")).unwrap() {
        let path = entry.unwrap().path();
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
    }
    let resumed = output(&["train", "--resume", run_dir.to_str().unwrap(), "--steps", "800"]);
    let stderr = String::from_utf8_lossy(&resumed.stderr);
    assert!(resumed.status.success(), "{stderr}");
    for said in
        ["lines are missing, it goes on after its last whole one", "it is cut after its last whole one"]
    {
        assert!(stderr.contains(said), "{stderr}");
    }
    let (_, undisturbed) = &*UNDISTURBED;
    let lost: Value = serde_json::from_str(last).unwrap();
    let kept = undisturbed
        .iter()
        .filter(|line| (&line["kind"], &line["env_steps"]) != (&lost["kind"], &lost["env_steps"]));
    assert!(metrics(&folder).iter().eq(kept), "every other line is there once");
    assert_eq!(tensorboard_events(&folder), points(undisturbed) - 1);

    // Nor is it silent where nothing is left to be done, and the learner ends before it is asked.
    fs::write(&path, "").unwrap();
    let resumed = output(&["train", "--resume", run_dir.to_str().unwrap()]);
    let stderr = String::from_utf8_lossy(&resumed.stderr);
    assert!(resumed.status.success() && stderr.contains("lines are missing"), "{stderr}");
}

/// What was done to a run directory after it was trained in, and what is said of it; nothing is trained anew.
#[test]
fn what_does_not_belong_together_is_refused() {
    let (folder, other) = (RunFolder::new(), RunFolder::new());
    folder.train(&[RUN, &["--steps", "300"]].concat());
    other.train(&[RUN, &["--steps", "400"]].concat());
    let run_dir = folder.run_dir();
    let (config, checkpoints) = (run_dir.join("config.toml"), run_dir.join("checkpoints"));
    let metrics = fs::read(run_dir.join("metrics.jsonl")).unwrap();
    let refused = |arguments: &[&str], message: &[&str]| {
        common::refused(&[&["train", "--resume", run_dir.to_str().unwrap()], arguments].concat(), message);
        assert_eq!(fs::read(run_dir.join("metrics.jsonl")).unwrap(), metrics, "nothing was written");
    };
    refused(&["--steps", "200"], &["training.t_max = 200, and 300 steps are done already", "--steps"]);

    let good = fs::read_to_string(&config).unwrap();
    for (from, to, key) in
        [("seed = 3", "seed = 4", "seed"), ("gamma = 0.99", "gamma = 0.5", "algorithm.gamma")]
    {
        assert!(good.contains(from), "{good}");
        fs::write(&config, good.replace(from, to)).unwrap();
        refused(&[], &[&format!("it was trained with {key} = "), "set it back"]);
    }
    fs::write(&config, good).unwrap();

    let theirs = fs::canonicalize(other.run_dir().join("checkpoints/latest")).unwrap();
    let foreign = checkpoints.join(theirs.file_name().unwrap());
    fs::rename(theirs, &foreign).unwrap();
    refused(&[], &["step-000000000400: it is of another run", "move it away"]);
    fs::remove_dir_all(foreign).unwrap();

    for entry in fs::read_dir(&checkpoints).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.is_symlink() {
            fs::remove_dir_all(path).unwrap();
        }
    }
    refused(
        &[],
        &["holds no checkpoint, and this run has written some", "step-000000000300", "put them back"],
    );
    fs::remove_file(checkpoints.join("latest")).unwrap();
    refused(&[], &["holds no checkpoint, and this run has written some"]);
}

/// `deploy/rit-run.sh`, which service managers call again and again.
#[test]
fn the_same_command_begins_a_run_and_goes_on_with_it() {
    let folder = RunFolder::new();
    let run = |arguments: &[&str]| {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/rit-run.sh");
        let mut command = Command::new(script);
        command.arg(folder.run_dir()).args(arguments).env("RIT", env!("CARGO_BIN_EXE_rit"));
        let output = command.stdin(Stdio::null()).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let summary = || {
        let text = fs::read_to_string(folder.run_dir().join("summary.json")).unwrap();
        serde_json::from_str::<Value>(&text).unwrap()
    };
    let (code, stderr) = run(&[]);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.starts_with("usage: "), "{stderr}");

    let command = ["matrix-game", "--steps", "300", "--seed", "3"];
    let (code, stderr) = run(&command);
    assert_eq!(code, Some(0), "{stderr}");
    let first = summary();
    let (code, stderr) = run(&command);
    assert_eq!(code, Some(0), "{stderr}");
    assert!(stderr.contains("going on with matrix-game"), "{stderr}");
    let second = summary();
    assert_eq!(
        (&first["env_steps"], &first["weights_digest"]),
        (&second["env_steps"], &second["weights_digest"])
    );
}
