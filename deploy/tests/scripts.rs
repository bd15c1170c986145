//! `rit evaluate --policy script:NAME`: reference points without a run.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, refused};
use serde_json::Value;
use std::fs;

/// What `rit evaluate` prints.
fn evaluate(policy: &str, arguments: &[&str]) -> String {
    let output = output(&[&["evaluate", "--policy", policy], arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn mean_return(policy: &str, experiment: &str, task: &str) -> f64 {
    let arguments =
        ["--experiment", experiment, "--tasks", task, "--episodes", "50", "--seed", "1", "--json"];
    let output: Value = serde_json::from_str(&evaluate(policy, &arguments)).unwrap();
    assert_eq!((&output["policy"], &output["weights_digest"]), (&Value::from(policy), &Value::Null));
    output["tasks"][task]["mean_return"].as_f64().unwrap()
}

#[test]
fn scripts_that_know_their_task_beat_chance() {
    let navigation = |policy| mean_return(policy, "cooperative-navigation", "navigation-5-5");
    let random = navigation("script:random");
    assert!(navigation("script:nearest-assignment") > random + 100.0);
    assert_eq!(random, navigation("script:random"), "the same seed, the same episodes");
    let hunt = |policy| mean_return(policy, "predator-prey-pro", "predator-prey-pro-4-2");
    assert!(hunt("script:chase") > hunt("script:random"));
}

#[test]
fn several_tasks_are_followed_by_their_mean() {
    let arguments = ["--experiment", "matrix-game", "--episodes", "10"];
    let text = evaluate("script:still", &arguments);
    // Still is action a¹ twice: it wins game 4 and no other.
    let expected = "task    episodes  mean return       std        95 % interval  win rate\n\
                    game-1        10       -24.00      0.00     [-24.00, -24.00]     0.000\n\
                    game-2        10       -18.00      0.00     [-18.00, -18.00]     0.000\n\
                    game-3        10       -12.00      0.00     [-12.00, -12.00]     0.000\n\
                    game-4        10       106.00      0.00     [106.00, 106.00]     1.000\n\
                    mean          40        13.00         -       [13.00, 13.00]     0.250\n";
    assert_eq!(text, expected);
    let one = evaluate("script:still", &[&arguments[..], &["--tasks", "game-4"]].concat());
    assert!(one.lines().count() == 2 && !one.contains("mean  "), "{one}");
}

#[test]
fn a_run_and_a_file_say_what_is_played_too() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "100", "--seed", "3"]);
    let run_dir = folder.run_dir();
    let of_run = evaluate("script:random", &["--run", run_dir.to_str().unwrap(), "--episodes", "20"]);
    let file = folder.path().join("mine.toml");
    fs::write(&file, "environment.task_set = \"matrix-game\"\nseed = 3").unwrap();
    let of_file = evaluate("script:random", &["--experiment", file.to_str().unwrap(), "--episodes", "20"]);
    assert_eq!(of_run, of_file, "the run's seed is the evaluation's");
    let of_weights = output(&["evaluate", "--run", run_dir.to_str().unwrap(), "--json"]);
    let of_weights: Value = serde_json::from_slice(&of_weights.stdout).unwrap();
    assert_eq!(of_weights["policy"], Value::from("checkpoint"));
    assert!(of_weights["weights_digest"].is_string());
}

#[test]
fn what_does_not_go_together_is_refused() {
    let evaluate = |arguments: &[&str], message: &[&str]| {
        refused(&[&["evaluate"], arguments].concat(), message);
    };
    evaluate(&[], &["give --run DIR", "--policy script:NAME"]);
    evaluate(&["--experiment", "matrix-game"], &["--experiment is for scripts", "--run DIR"]);
    evaluate(&["--policy", "script:chase"], &["give --experiment NAME or --run DIR"]);
    let both = ["--policy", "script:random", "--experiment", "matrix-game", "--run", "x"];
    evaluate(&both, &["give one"]);
    evaluate(
        &["--policy", "luck"],
        &["unknown policy \"luck\"", "checkpoint or script:NAME", "random, still, nearest-assignment, chase"],
    );
    evaluate(&["--policy", "script:luck"], &["unknown script \"luck\"; known: random"]);
    let plays = |script: &str, experiment: &str, message: &str| {
        evaluate(&["--policy", script, "--experiment", experiment], &[message]);
    };
    plays("script:chase", "matrix-gme", "did you mean matrix-game?");
    plays("script:chase", "matrix-game", "those that are: random, still");
    plays("script:nearest-assignment", "predator-prey", "those that are: random, still, chase");
    plays("script:chase", "cooperative-navigation", "not made for cooperative-navigation");
}
