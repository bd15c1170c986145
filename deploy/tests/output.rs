//! Output that cannot be written: its reader has gone, or the disk is full. A run goes on; other commands end, and
//! nothing panics.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, rit};
use std::{
    fs::{self, OpenOptions},
    io::{BufRead as _, BufReader, PipeWriter, Write as _},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

/// A pipe whose reader has gone.
fn closed_pipe() -> PipeWriter {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer
}

fn full() -> Stdio {
    OpenOptions::new().write(true).open("/dev/full").unwrap().into()
}

/// Files below a folder, with this ending.
fn files(folder: &Path, ending: &str, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && path.file_name().is_some_and(|name| name != "target") {
            files(&path, ending, found);
        } else if path.extension().is_some_and(|found| found == ending) {
            found.push(path);
        }
    }
}

#[test]
fn no_source_prints_by_a_macro_that_panics() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut sources = Vec::new();
    files(root, "rs", &mut sources);
    sources.retain(|path| path.components().any(|part| part.as_os_str() == "src"));
    assert!(sources.len() > 100, "the sources are where they were");
    for source in sources {
        let text = fs::read_to_string(&source).unwrap();
        // Tests stand at the end of a file, or in one of their own, wherever that is declared.
        let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
        let is_tests = source.file_name().is_some_and(|name| name == "tests.rs");
        for (number, line) in code.lines().enumerate().filter(|_| !is_tests) {
            let line = line.trim_start();
            let prints = ["println!(", "print!(", "eprintln!(", "eprint!(", "dbg!("];
            assert!(
                line.starts_with("//") || !prints.iter().any(|print| line.contains(print)),
                "{}:{}: print through deploy/src/output.rs: {line}",
                source.display(),
                number + 1
            );
        }
    }
}

/// Commands that print and end, of a run that is over.
fn commands(run: &str) -> Vec<Vec<String>> {
    let words = |line: &str| line.split(' ').map(|word| word.replace("RUN", run)).collect();
    [
        "experiments",
        "completions bash",
        "--help",
        "train --help",
        "--version",
        "evaluate --run RUN --episodes 1",
        "evaluate --run RUN --episodes 1 --json",
        "ctl --run RUN status",
        "ctl --run RUN --json status",
        "ctl --run RUN metrics",
        "watch --run RUN",
        "bench env --seconds 0.01",
        "bench env --seconds 0.01 --json",
    ]
    .map(words)
    .into()
}

#[test]
fn commands_end_quietly_on_a_closed_pipe_and_with_one_line_on_a_full_disk() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "100"]);
    let run_dir = folder.run_dir();
    for arguments in commands(run_dir.to_str().unwrap()) {
        let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let quiet = rit(&words).stdout(closed_pipe()).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(quiet.status.code(), Some(0), "{arguments:?}");
        assert_eq!(String::from_utf8_lossy(&quiet.stderr), "", "{arguments:?}");

        let refused = rit(&words).stdout(full()).stderr(Stdio::piped()).output().unwrap();
        let stderr = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(1), "{arguments:?}: {stderr}");
        let message = "error: cannot write to standard output: No space left on device (os error 28)\n";
        assert_eq!(stderr, message, "{arguments:?}");

        let mute = rit(&words).stdout(full()).stderr(full()).status().unwrap();
        assert_eq!(mute.code(), Some(1), "{arguments:?}");
    }
    let mute = rit(&["train", "matrx-game"]).stderr(full()).status().unwrap();
    assert_eq!(mute.code(), Some(2), "what was typed wrong is wrong without a reader, too");
    let certificates = folder.path().join("certificates");
    let arguments = ["certificates", "--out", certificates.to_str().unwrap(), "--host", "localhost"];
    assert_eq!(rit(&arguments).stdout(closed_pipe()).status().unwrap().code(), Some(0));
}

/// `rit train` whose standard output and error go where they cannot be written.
fn train(folder: &RunFolder, stdout: Stdio, stderr: Stdio) -> Option<i32> {
    let run_dir = folder.run_dir();
    let mut command =
        rit(&["train", "matrix-game", "--steps", "200", "--run-dir", run_dir.to_str().unwrap()]);
    command.args(["--set", "evaluation.episodes=2"]).stdout(stdout).stderr(stderr).status().unwrap().code()
}

#[test]
fn a_run_goes_on_without_a_reader_and_says_so_in_its_log() {
    let cases: [(Stdio, Stdio, &str); 4] = [
        (closed_pipe().into(), closed_pipe().into(), "Broken pipe"),
        (full(), full(), "No space left on device"),
        (Stdio::piped(), closed_pipe().into(), "standard error cannot be written"),
        (full(), Stdio::null(), "the summary is in summary.json alone"),
    ];
    for (stdout, stderr, why) in cases {
        let folder = RunFolder::new();
        assert_eq!(train(&folder, stdout, stderr), Some(0), "{why}");
        let run_dir = folder.run_dir();
        let log = fs::read_to_string(run_dir.join("logs/train.log")).unwrap();
        assert!(log.contains(why), "{why} in {log}");
        assert!(log.contains("run directory"), "what is said is in the log: {log}");
        let summary: serde_json::Value =
            serde_json::from_slice(&fs::read(run_dir.join("summary.json")).unwrap()).unwrap();
        assert_eq!(summary["env_steps"], 200);
        assert!(run_dir.join("checkpoints/latest").exists());
        assert_eq!(common::shared_memory_of(&run_dir), Vec::<PathBuf>::new());
    }
}

#[test]
fn a_run_goes_on_when_its_reader_leaves_after_the_first_line() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let (reader, writer) = std::io::pipe().unwrap();
    let mut command: Command =
        rit(&["train", "matrix-game", "--steps", "200", "--run-dir", run_dir.to_str().unwrap()]);
    command.args(["--set", "evaluation.episodes=2"]).stdout(writer.try_clone().unwrap()).stderr(writer);
    let mut train = command.spawn().unwrap();
    drop(command);
    let mut line = String::new();
    BufReader::new(reader).read_line(&mut line).unwrap();
    assert!(line.contains("run directory"), "{line}");
    assert_eq!(train.wait().unwrap().code(), Some(0));
    assert!(run_dir.join("summary.json").exists());
}

#[test]
fn a_run_goes_on_beside_a_full_pipe_without_a_reader() {
    let (reader, mut writer) = std::io::pipe().unwrap();
    rustix::io::ioctl_fionbio(&writer, true).unwrap();
    while writer.write(&[b'.'; 4096]).is_ok() {}
    // Writers wait from now on.
    rustix::io::ioctl_fionbio(&writer, false).unwrap();
    let folder = RunFolder::new();
    assert_eq!(train(&folder, Stdio::null(), writer.into()), Some(0));
    let log = fs::read_to_string(folder.run_dir().join("logs/train.log")).unwrap();
    assert!(log.contains("run directory"), "{log}");
    drop(reader);
}

#[test]
fn watching_and_following_end_when_their_reader_has_gone() {
    let folder = RunFolder::new();
    let mut run =
        folder.start(&["matrix-game", "--actors", "1", "--set", "learner.metrics_every_env_steps=2"]);
    run.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let run_dir = folder.run_dir();
    let root = run_dir.to_str().unwrap();
    for arguments in [&["watch", "--run", root][..], &["ctl", "--run", root, "metrics", "--follow"]] {
        let ended = rit(arguments).stdout(closed_pipe()).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(ended.status.code(), Some(0), "{arguments:?}");
        assert_eq!(String::from_utf8_lossy(&ended.stderr), "", "{arguments:?}");
        let refused = rit(arguments).stdout(full()).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(refused.status.code(), Some(1), "{arguments:?}");
    }
    assert!(run.ctl(&["stop"]).status.success());
    run.finish_stopped();
    assert!(output(&["ctl", "--run", root, "status"]).status.success());
}
