//! The program of the example, as a person starts it.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests too")]

use serde_json::Value;
use std::process::{Command, Output};

fn corridor(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_corridor")).args(arguments).output().unwrap()
}

fn said(output: &Output) -> String {
    [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text)).concat()
}

#[test]
fn it_trains_evaluates_and_lists_its_own_tasks() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let run = run.to_str().unwrap();
    let trained = corridor(&[
        "train",
        "corridor",
        "--run-dir",
        run,
        "--actors",
        "2",
        "--steps",
        "400",
        "--set",
        "evaluation.episodes=4",
    ]);
    assert!(trained.status.success(), "{}", said(&trained));
    let evaluated = corridor(&[
        "evaluate",
        "--run",
        run,
        "--tasks",
        "corridor-7,corridor-4",
        "--episodes",
        "3",
        "--json",
    ]);
    assert!(evaluated.status.success(), "{}", said(&evaluated));
    let result: Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    assert_eq!(result["tasks"]["corridor-4"]["episodes"], 3, "a task that no list names: {result:#}");
    let listed = corridor(&["experiments"]);
    assert!(said(&listed).contains("corridor  "), "{}", said(&listed));
    let checked = corridor(&["env", "check", "corridor"]);
    assert!(said(&checked).contains("corridor-7: 2 agents, 3 entities"), "{}", said(&checked));
}

#[test]
fn help_and_messages_name_this_program() {
    for (arguments, words) in [
        (&["train", "--help"][..], "Usage: corridor train"),
        (&["train", "--help"], "Name of an experiment (see `corridor experiments`)"),
        (&["sweep", "--help"], "# a name of `corridor experiments`, or a .toml file"),
        (&["train"], "error: <EXPERIMENT> is missing; `corridor train --help` explains it"),
        (&["train", "corridors"], "did you mean corridor? `corridor experiments` lists them"),
        (&["experiments"], "`corridor train EXPERIMENT --algorithm NAME`"),
        (&["ctl", "--run", "/nowhere", "status"], "/nowhere"),
        (&["completions", "bash"], "complete -F _corridor"),
    ] {
        let said = said(&corridor(arguments));
        assert!(said.contains(words), "{arguments:?}: {said}");
        assert!(!said.contains("`rit "), "{arguments:?}: {said}");
    }
}

#[test]
fn a_task_that_is_none_is_refused() {
    let refused = corridor(&["train", "corridor", "--set", "environment.training_tasks=[\"corridor-1\"]"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(said(&refused).contains("unknown task \"corridor-1\"; known: corridor-3"), "{}", said(&refused));
}
