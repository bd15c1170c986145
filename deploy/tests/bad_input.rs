//! Bad input gets one line that names the thing and the remedy, exit code 2, and overwrites nothing.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, refused, rit};
use std::{fs, path::Path, process::Stdio};

#[test]
fn what_is_typed_wrong_is_named() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let train = |more: &[&str], message: &[&str]| {
        refused(&[&["train", "--run-dir", run_dir.to_str().unwrap()], more].concat(), message);
        assert!(!run_dir.exists(), "nothing was made");
    };
    train(&["matrx-game"], &["unknown experiment \"matrx-game\"", "did you mean matrix-game?"]);
    train(&["no/such/file.toml"], &["no/such/file.toml", "No such file"]);
    train(&["matrix-game", "--set", "algorithm.gamma=7"], &["algorithm.gamma = 7 is out of range 0..=1"]);
    train(&["matrix-game", "--set", "algorithm.gama=0.9"], &["did you mean algorithm.gamma?"]);
    train(&["matrix-game", "--set", "algorithm.gamma"], &["write --set section.key=value"]);
    train(&["matrix-game", "--set", "training.t_max=6\nseed=9"], &["training.t_max must be a whole number"]);
    train(&["matrix-game", "--set", "algorithm.mixing=vdn"], &["algorithm.mixing must be", "network"]);
    train(
        &["matrix-game", "--set", "algorithm.optimizer=sgd"],
        &["algorithm.optimizer = \"sgd\"", "rmsprop, adam"],
    );
    train(&["matrix-game", "--set", "learner.device=cuda"], &["[learner] has listen,"]);
    train(&["matrix-game", "--lr", "0.1"], &["--set algorithm.lr=VALUE"]);
    train(
        &["matrix-game", "--seed", "9223372036854775808"],
        &["--seed", "out of range 0..=9223372036854775807"],
    );
    train(&["matrix-game", "--steps", "soon"], &["--steps", "1e6, 100k or 2M"]);
    train(
        &["matrix-game", "--log", "debgu"],
        &["\"debgu\" is no level", "error, warn, info, debug, trace, off"],
    );
    train(&["cooperative-navigation", "--until", "win_rate=0.9"], &["know no winning", "mean_return=NUMBER"]);
    train(&["matrix-game", "--until", "luck=1"], &["write win_rate=NUMBER or mean_return=NUMBER"]);
    train(&["matrix-game", "--actors", "0"], &["needs at least one actor"]);
    train(&["matrix-game", "--steps", "0"], &["training.t_max = 0 is out of range"]);
    let file = folder.path().join("mine.toml");
    fs::write(&file, "environment.task_set = \"matrix-game\"\nnetwork.hiden_dim = 32").unwrap();
    train(&[file.to_str().unwrap()], &["unknown key \"network.hiden_dim\"", "network.hidden_dim"]);
    fs::write(&file, "environment.task_set = \"matrix-game\"\n\nseed = = 3").unwrap();
    train(&[file.to_str().unwrap()], &["mine.toml, line 3, column 8: "]);
    // What is no file is not waited for.
    let (pipe, endless) = (folder.path().join("pipe.toml"), folder.path().join("endless.toml"));
    rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RWXU).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &endless).unwrap();
    for file in [pipe, endless] {
        train(&[file.to_str().unwrap()], &[".toml: it is no regular file"]);
    }
}

#[test]
fn other_commands_name_what_is_typed_wrong_too() {
    let folder = RunFolder::new();
    let certificates = folder.path().join("certificates");
    for host in ["", "a b", "a\nb", "a-", "a..b", "*"] {
        let arguments = ["certificates", "--out", certificates.to_str().unwrap(), "--host", host];
        refused(&arguments, &["--host", "write a host's name or IP address"]);
        assert!(!certificates.exists());
    }
    refused(&["experiments", "--log", "debgu"], &["\"debgu\" is no level"]);
    let matrix =
        ["evaluate", "--policy", "script:random", "--experiment", "matrix-game", "--tasks", "testing"];
    refused(&matrix, &["matrix-game has no testing tasks", "game-1, game-2, game-3, game-4"]);
    refused(&["plot", "x", "--out", "y.svg", "--line", "nan"], &["--line", "write a number"]);
    refused(&["plot", "x", "--out", "y.png"], &["y.png", "ends in .svg"]);
}

#[test]
fn a_plot_is_made_of_runs_of_one_kind_and_written_over_nothing() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "100", "--set", "evaluation.episodes=2"]);
    let (run_dir, out) = (folder.run_dir(), folder.path().join("curves.svg"));
    let (run, file) = (run_dir.to_str().unwrap(), out.to_str().unwrap());
    assert!(output(&["plot", run, "--out", file]).status.success());
    let drawn = fs::read_to_string(&out).unwrap();
    assert!(drawn.contains("win rate, mean of 4 tasks") && drawn.contains("Multi matrix game"), "{drawn}");
    refused(&["plot", run, "--out", file], &["curves.svg is there already; --force writes over it"]);
    assert!(
        output(&["plot", run, "--out", file, "--force", "--metric", "return", "--tasks"]).status.success()
    );
    let drawn = fs::read_to_string(&out).unwrap();
    assert!(drawn.contains("game-4") && !drawn.contains("win rate"), "{drawn}");
    refused(&["plot", run, run, "--out", file, "--force"], &["are the same run: give it once"]);

    let other = RunFolder::new();
    other.train(&[
        "matrix-game",
        "--steps",
        "100",
        "--set",
        "evaluation.episodes=2",
        "--set",
        "algorithm.gamma=0.5",
    ]);
    let other = other.run_dir();
    let pair = ["plot", run, other.to_str().unwrap(), "--out", file, "--force"];
    refused(&pair, &["algorithm.gamma (0.99, 0.5)", "give --by algorithm.gamma"]);
    assert!(output(&[&pair[..], &["--by", "algorithm.gamma"]].concat()).status.success());
    let drawn = fs::read_to_string(&out).unwrap();
    assert!(
        drawn.contains("rit gamma=0.5") && !drawn.contains("0.99"),
        "the preset's value has no name: {drawn}"
    );
}

#[test]
fn a_run_is_never_written_over() {
    let folder = RunFolder::new();
    let summary = folder.train(&["matrix-game", "--steps", "100"]);
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    refused(&["train", "matrix-game", "--run-dir", run], &["already holds a run", "--run-dir"]);
    refused(&["learner", "--new", "matrix-game", "--run-dir", run], &["already holds a run"]);
    let on_disk = fs::read(run_dir.join("summary.json")).unwrap();
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&on_disk).unwrap(), summary);
}

#[test]
fn what_is_no_run_is_no_run() {
    let folder = RunFolder::new();
    let nowhere = folder.run_dir();
    let nowhere = nowhere.to_str().unwrap();
    refused(&["evaluate", "--run", nowhere], &["holds no run"]);
    refused(&["ctl", "--run", nowhere, "status"], &["holds no run"]);
    refused(&["actor", "--run-dir", nowhere], &["holds no run"]);
    refused(&["learner", "--run-dir", nowhere], &["holds no run"]);
    refused(&["ctl", "status"], &["give --run DIR or --address ADDRESS"]);
}

#[test]
fn a_second_learner_and_a_second_actor_of_one_name_are_refused() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--actors", "1"]);
    train.wait_for("the actor", |status| !status["actors"].as_array().unwrap().is_empty());
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    refused(
        &["actor", "--run-dir", run, "--name", "actor-0"],
        &["an actor named actor-0 is there already", "--name"],
    );
    refused(&["learner", "--run-dir", run], &["is in use by process", "rit ctl"]);
    train.wait_for("training after all", |status| status["updates"].as_u64() > Some(0));
}

#[test]
fn a_port_in_use_is_refused() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let folder = RunFolder::new();
    let listen = format!("learner.listen=tcp:{}", taken.local_addr().unwrap());
    let token = format!("learner.token_file={}", folder.secret("token").display());
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    refused(&["train", "matrix-game", "--run-dir", run, "--set", &listen, "--set", &token], &["is in use"]);
    assert!(!run_dir.exists(), "the same directory will do for the next attempt");
}

#[test]
fn a_checkpoint_that_does_not_fit_is_refused() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "100"]);
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    let weights = run_dir.join("checkpoints/latest/weights.safetensors");
    let good = fs::read(&weights).unwrap();
    let with = |bytes: &[u8], message: &[&str]| {
        fs::write(&weights, bytes).unwrap();
        refused(&["evaluate", "--run", run], message);
    };
    with(&good[..good.len() / 2], &["weights.safetensors", "truncated or altered"]);
    let mut altered = good.clone();
    *altered.last_mut().unwrap() ^= 1;
    with(&altered, &["weights.safetensors was altered"]);

    let other = RunFolder::new();
    other.train(&["matrix-game", "--steps", "100", "--set", "network.hidden_dim=32"]);
    let theirs = fs::read(other.run_dir().join("checkpoints/latest/weights.safetensors")).unwrap();
    with(&theirs, &["weights of another model", "utility.embed.weight is [32, 6]"]);

    fs::write(&weights, &good).unwrap();
    assert!(output(&["evaluate", "--run", run]).status.success());
    assert!(Path::new(run).join("config.toml").exists());
}

#[test]
fn a_socket_path_that_is_too_long_is_named() {
    let folder = RunFolder::new();
    let long = folder.path().join("x".repeat(120));
    refused(
        &["train", "matrix-game", "--run-dir", long.to_str().unwrap()],
        &["107", "shorter run directory"],
    );
}

#[test]
fn help_and_usage_are_there() {
    for command in ["train", "learner", "actor", "evaluate", "ctl", "experiments"] {
        let help = output(&[command, "--help"]);
        assert!(help.status.success() && !help.stdout.is_empty(), "{command}");
    }
    let usage = rit(&["train"]).stderr(Stdio::null()).status().unwrap();
    assert_eq!(usage.code(), Some(2));
    let listed = String::from_utf8(output(&["experiments"]).stdout).unwrap();
    assert!(listed.contains("matrix-game-vdn") && listed.contains("cooperative-navigation"), "{listed}");
}
