//! Whose a run is: one writer at a time, nothing removed that is not its own, no run in another's way.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{
    RunFolder, Train, actor_pid, kill, learner_pid, output, pids, refused, rit, shared_memory_of,
    wait_until_gone,
};
use rustix::process::Signal;
use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

const RUN: &[&str] = &[
    "matrix-game",
    "--seed",
    "3",
    "--steps",
    "1200",
    "--actors",
    "1",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "checkpoints.every_env_steps=60",
    "--set",
    "web.listen=off",
];

/// As [`RUN`], and long enough to be there until the test has done with it.
fn long() -> Vec<&'static str> {
    [RUN, &["--steps", "1000000"]].concat()
}

/// Where an actor is and training goes on.
fn under_way(train: &mut Train) -> Value {
    train.wait_for("training", |status| {
        status["updates"].as_u64() > Some(20) && actor_pid(status, "actor-0").is_some()
    })
}

/// Kills the actor, and waits for the next one to work.
fn replace_actor(train: &mut Train) {
    let status = under_way(train);
    let killed = actor_pid(&status, "actor-0").unwrap();
    kill(killed, Signal::KILL);
    let works = |actor: &Value| actor["pid"] != killed && actor["episodes"].as_u64() > Some(0);
    train.wait_for("the killed actor's successor", |status| {
        status["actors"].as_array().unwrap().iter().any(works)
    });
}

/// Everything below a folder that does not change while a run stands still.
fn names(root: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for entry in fs::read_dir(root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(names(&path));
        }
        all.push(path);
    }
    all.sort();
    all
}

fn copy(from: &Path, to: &Path) {
    assert!(Command::new("cp").arg("-a").args([from, to]).status().unwrap().success());
}

#[test]
fn a_resume_beside_a_live_run_is_refused_and_the_live_run_takes_no_harm() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    under_way(&mut train);
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    assert!(train.ctl(&["pause"]).status.success());
    // But for what the run itself still writes: a checkpoint may be under way when the pause begins.
    let names = || -> Vec<_> {
        let own = ["checkpoints", "checkpoints.partial", "checkpoints.json", "replay"]
            .map(|name| run_dir.join(name));
        names(&run_dir).into_iter().filter(|path| !own.iter().any(|own| path.starts_with(own))).collect()
    };
    let before = names();
    let holder = format!("in use by process {}", train.pid());
    refused(&["train", "--resume", run], &[&holder, "rit ctl --run"]);
    refused(&["train", "--resume", run, "--set", "actors.count=3"], &[&holder]);
    refused(&["learner", "--run-dir", run], &[&holder]);
    assert_eq!(names(), before);
    assert!(fs::read_to_string(run_dir.join("config.toml")).unwrap().contains("count = 1\n"));
    assert!(train.ctl(&["resume"]).status.success());
    replace_actor(&mut train);
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
    assert!(shared_memory_of(&run_dir).is_empty());
}

#[test]
fn of_several_resumes_at_once_one_goes_on() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "200"]].concat());
    let all: Vec<_> = (0..4).map(|_| Train::resume(&folder, &["--steps", "1200"])).collect();
    let ended: Vec<_> = all.into_iter().map(Train::wait).collect();
    let codes: Vec<_> = ended.iter().map(|output| output.status.code().unwrap()).collect();
    // One that comes when another has ended finds a run of 1200 steps, and nothing to do.
    assert!(codes.contains(&0) && codes.iter().all(|code| [0, 2].contains(code)), "{codes:?}");
    for output in ended.iter().filter(|output| output.status.code() == Some(2)) {
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(stderr.contains("is in use by") && stderr.lines().count() == 1, "{stderr}");
    }
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn a_resume_that_cannot_begin_leaves_the_run_as_it_was() {
    let folder = RunFolder::new();
    folder.train(&[RUN, &["--steps", "200"]].concat());
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    fs::remove_file(run_dir.join("metrics.jsonl")).unwrap();
    let config = fs::read(run_dir.join("config.toml")).unwrap();
    let checkpoints = names(&run_dir.join("checkpoints"));
    refused(
        &["train", "--resume", run, "--steps", "900", "--set", "learner.listen=tcp:0.0.0.0:50999"],
        &["learner"],
    );
    assert_eq!(names(&run_dir.join("checkpoints")), checkpoints);
    assert_eq!(fs::read(run_dir.join("config.toml")).unwrap(), config, "what was refused is not set");
    Train::resume(&folder, &["--steps", "300"]).finish();
}

#[test]
fn a_start_that_fails_removes_no_folder_that_was_there() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    fs::create_dir(&run_dir).unwrap();
    let run = run_dir.to_str().unwrap();
    let listen = ["--set", "learner.listen=tcp:0.0.0.0:50999"];
    refused(&[&["train"], RUN, &["--run-dir", run], &listen].concat(), &["learner"]);
    assert_eq!(names(&run_dir), Vec::<PathBuf>::new());
    fs::remove_dir(&run_dir).unwrap();
    refused(&[&["train"], RUN, &["--run-dir", run], &listen].concat(), &["learner"]);
    assert!(!run_dir.exists());
    refused(&["learner", "--new", "matrix-game", "--run-dir", run, "--set", listen[1]], &["learner"]);
    assert!(!run_dir.exists());
}

#[test]
fn copies_of_a_live_run_are_runs_of_their_own() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    under_way(&mut train);
    train.wait_for("a checkpoint", |status| status["checkpoints"]["written"].as_u64() > Some(0));
    assert!(train.ctl(&["pause"]).status.success());
    assert!(train.ctl(&["checkpoint"]).status.success());
    let copies = ["first", "second"].map(|name| folder.path().join(name));
    copies.iter().for_each(|to| copy(&folder.run_dir(), to));
    // A copy that was not resumed leads to no learner.
    let status = output(&["ctl", "--run", copies[0].to_str().unwrap(), "status"]);
    assert!(!status.status.success(), "{}", String::from_utf8_lossy(&status.stdout));
    assert!(train.ctl(&["resume"]).status.success());

    let steps = train.wait_for("progress", |_| true)["env_steps"].as_u64().unwrap() + 600;
    let steps = steps.to_string();
    let resumed: Vec<_> = copies
        .iter()
        .map(|copy| {
            let mut command = rit(&["train", "--resume", copy.to_str().unwrap(), "--steps", &steps]);
            command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
        })
        .collect();
    for (copy, child) in copies.iter().zip(resumed) {
        let output = child.wait_with_output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        assert!(stderr.contains(&format!("is a copy of {}", folder.run_dir().display())), "{stderr}");
        assert!(shared_memory_of(copy).is_empty());
    }
    let summaries = copies.each_ref().map(|copy| {
        let text = fs::read_to_string(copy.join("summary.json")).unwrap();
        serde_json::from_str::<Value>(&text).unwrap()["weights_digest"].clone()
    });
    assert_eq!(summaries[0], summaries[1], "the same seed, the same steps");
    // All the while the first went on, and actors still find it.
    replace_actor(&mut train);
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
    for run in copies.iter().chain([&folder.run_dir()]) {
        let mut again = Train::resume_in(run, &["--steps", "1000000"]);
        under_way(&mut again);
        again.signal(Signal::INT);
        assert_eq!(again.wait().status.code(), Some(130));
    }
}

#[test]
fn starts_in_one_folder_at_the_same_moment_take_numbers() {
    let folder = RunFolder::new();
    let starts: Vec<_> = (0..3)
        .map(|_| {
            let mut command = rit(&[&["train", "--json"], RUN, &["--steps", "50"]].concat());
            command.current_dir(folder.path()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        })
        .collect();
    for start in starts {
        let output = start.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    for n in 1..4 {
        assert!(folder.path().join(format!("runs/matrix-game-{n}/summary.json")).exists(), "{n}");
    }
}

#[test]
fn a_learner_without_its_supervisor_keeps_the_run_until_it_has_ended() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    let status = under_way(&mut train);
    train.signal(Signal::KILL);
    // Its learner now writes a last checkpoint; the next one waits for that, and goes on from it.
    let mut next = Train::resume(&folder, &[]);
    let after = next.wait_for("the next learner, at work", |now| {
        learner_pid(now) != learner_pid(&status) && actor_pid(now, "actor-0").is_some()
    });
    assert!(after["env_steps"].as_u64() >= status["env_steps"].as_u64(), "{after}");
    next.signal(Signal::INT);
    assert_eq!(next.wait().status.code(), Some(130));
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn what_a_dead_life_has_left_is_removed_by_the_next() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    let status = under_way(&mut train);
    train.signal(Signal::KILL);
    pids(&status).into_iter().for_each(|pid| kill(pid, Signal::KILL));
    train.wait();
    pids(&status).into_iter().for_each(wait_until_gone);
    let left = shared_memory_of(&folder.run_dir());
    assert!(left.iter().any(|path| path.starts_with("/dev/shm")), "{left:?}");
    let mut next = Train::resume(&folder, &[]);
    under_way(&mut next);
    assert!(left.iter().all(|path| !path.exists()), "{left:?}");
    next.signal(Signal::INT);
    next.wait();
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn files_of_other_users_are_in_no_runs_way() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    let status = under_way(&mut train);
    let segment =
        shared_memory_of(&folder.run_dir()).into_iter().find(|path| path.starts_with("/dev/shm")).unwrap();
    let name = segment.file_name().unwrap().to_str().unwrap();
    let theirs = PathBuf::from(format!(
        "/dev/shm/{}zzz",
        &name[..name.rfind("rit_").unwrap() + "rit_0123456789abcdef_".len()]
    ));
    fs::write(&theirs, "theirs").unwrap();
    if std::os::unix::fs::chown(&theirs, Some(65534), None).is_err() {
        println!("skipped: files cannot be given to others here");
        fs::remove_file(&theirs).unwrap();
        return;
    }
    replace_actor(&mut train);
    kill(learner_pid(&status), Signal::KILL);
    train.wait_for("the next learner", |now| learner_pid(now) != learner_pid(&status));
    replace_actor(&mut train);
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
    assert!(theirs.exists(), "it is left alone");
    fs::remove_file(&theirs).unwrap();
    assert!(shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn a_program_that_is_replaced_or_removed_goes_on() {
    let folder = RunFolder::new();
    let program = folder.path().join("rit");
    // By another process: a program cannot be started while a process has it open to write.
    copy(Path::new(env!("CARGO_BIN_EXE_rit")), &program);
    let mut train = folder.start_as(Command::new(&program), &long());
    replace_actor(&mut train);
    // As `cargo build` and package managers do it: another file of the same name.
    fs::remove_file(&program).unwrap();
    fs::write(&program, "#!/bin/sh\nexit 1\n").unwrap();
    replace_actor(&mut train);
    fs::remove_file(&program).unwrap();
    let status = under_way(&mut train);
    kill(learner_pid(&status), Signal::KILL);
    train.wait_for("the next learner", |now| learner_pid(now) != learner_pid(&status));
    let status = under_way(&mut train);
    for pid in pids(&status) {
        assert_eq!(fs::read_to_string(format!("/proc/{pid}/comm")).unwrap().trim(), "rit");
    }
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
}

#[test]
fn a_run_whose_logs_are_removed_goes_on() {
    let folder = RunFolder::new();
    let mut train = folder.start(&long());
    under_way(&mut train);
    let logs = folder.run_dir().join("logs");
    fs::remove_dir_all(&logs).unwrap();
    replace_actor(&mut train);
    assert!(logs.join("actor-0.log").exists());
    train.signal(Signal::INT);
    assert_eq!(train.wait().status.code(), Some(130));
}

#[test]
fn a_run_whose_temporary_folder_is_removed_goes_on() {
    let (folder, undisturbed) = (RunFolder::new(), RunFolder::new());
    let steps = [RUN, &["--steps", "3000"]].concat();
    let mut train = folder.start(&steps);
    let status = under_way(&mut train);
    let place = |run_dir: &Path| fs::read_to_string(run_dir.join("shared_memory")).unwrap().trim().to_owned();
    let first = place(&folder.run_dir());
    fs::remove_dir_all(&first).unwrap();
    let after = train.wait_for("the actor, joined again", |now| {
        let said = now["happenings"].to_string().contains("shared memory was removed while it ran");
        said && actor_pid(now, "actor-0").is_some()
    });
    assert_eq!(learner_pid(&after), learner_pid(&status), "the same learner");
    assert_ne!(place(&folder.run_dir()), first);
    let digest = train.finish()["weights_digest"].clone();
    assert_eq!(digest, undisturbed.train(&steps)["weights_digest"]);
    assert!(!Path::new(&first).exists() && shared_memory_of(&folder.run_dir()).is_empty());
}

#[test]
fn a_temporary_folder_that_cannot_be_used_is_named_and_another_is_taken() {
    let folder = RunFolder::new();
    let long = folder.path().join("x".repeat(100));
    fs::create_dir(&long).unwrap();
    let missing = folder.path().join("missing");
    for tmpdir in [long, missing] {
        let mut command = rit(&[]);
        command.env("TMPDIR", &tmpdir);
        folder.start_as(command, &[RUN, &["--json"]].concat()).finish();
        let log = fs::read_to_string(folder.run_dir().join("logs/learner.log")).unwrap();
        let words = format!("TMPDIR = {} is no place for shared memory, /tmp is used", tmpdir.display());
        assert!(log.contains(&words), "{log}");
        fs::remove_dir_all(folder.run_dir()).unwrap();
    }
}

#[test]
fn what_is_wrong_with_a_run_directory_is_said() {
    let folder = RunFolder::new();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::os::unix::fs::symlink("gone", path("link")).unwrap();
    fs::write(path("file"), "").unwrap();
    fs::create_dir(path("full")).unwrap();
    fs::write(path("full") + "/thesis.tex", "").unwrap();
    for (resumed, words) in [("link", "is a link to gone"), ("file", "is a file and no directory")] {
        refused(&["train", "--resume", &path(resumed)], &[words]);
        refused(&["train", "matrix-game", "--run-dir", &path(resumed)], &[words]);
    }
    refused(&["train", "matrix-game", "--run-dir", &path("full")], &["thesis.tex lies there"]);
    // A folder that was deleted under the process that stands in it.
    let gone = path("deleted");
    let script = format!("cd {gone} && rmdir {gone} && exec \"$0\" \"$@\"");
    for arguments in [&["train", "matrix-game"][..], &["train", "--resume", "run"]] {
        fs::create_dir(&gone).unwrap();
        let mut command = Command::new("sh");
        command.args(["-c", &script, env!("CARGO_BIN_EXE_rit")]).args(arguments);
        let output = command.stdin(Stdio::null()).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(stderr.contains("the current folder") && stderr.contains("has been deleted"), "{stderr}");
    }
}
