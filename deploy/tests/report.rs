//! `rit report` and `rit shapley` on real runs, and on the committed records.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, refused};
use serde_json::Value;
use std::{fs, path::Path};

/// Small, quick and with task representations.
const TRAIN: [&str; 9] = [
    "cooperative-navigation",
    "--steps",
    "800",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "algorithm.batch_size=8",
    "--set",
    "evaluation.every_env_steps=200",
];

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_report_of_a_run_holds_its_representations_and_nothing_else_is_written_over() {
    let folder = RunFolder::new();
    folder.train(&TRAIN);
    let (run_dir, out) = (folder.run_dir(), folder.path().join("report"));
    let (run, place) = (run_dir.to_str().unwrap(), out.to_str().unwrap());
    let quick = ["--replications", "200"];
    let arguments = |more: &[&'static str]| [&["report", run, "--out", place], &quick[..], more].concat();
    let made = output(&arguments(&["--json"]));
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let said: Value = serde_json::from_slice(&made.stdout).unwrap();
    assert!(said["said"][1].as_str().unwrap().contains("fewer than 5 seeds"), "{said}");
    assert_eq!(names(&out), ["figures", "index.html", "marl-eval.json", "runs.csv", "tables"]);
    for file in ["figures/figure-2.svg", "figures/figure-6-cooperative-navigation.svg"] {
        roxmltree::Document::parse(&fs::read_to_string(out.join(file)).unwrap()).unwrap();
    }
    let table = fs::read_to_string(out.join("tables/representations-cooperative-navigation.md")).unwrap();
    assert!(table.contains("| navigation-6-6 (unseen) |") && table.contains("silhouette"), "{table}");
    // An earlier report is replaced, and with it what no longer belongs there.
    fs::write(out.join("figures/old.svg"), "").unwrap();
    assert!(output(&arguments(&[])).status.success());
    assert!(!out.join("figures/old.svg").exists());
    fs::write(out.join("thesis.tex"), "mine").unwrap();
    refused(&arguments(&[]), &["holds something else than a report: thesis.tex", "--force"]);
    assert!(output(&arguments(&["--force"])).status.success());
    assert_eq!(fs::read_to_string(out.join("thesis.tex")).unwrap(), "mine");
    let foreign = folder.path().join("foreign");
    fs::create_dir_all(foreign.join("figures")).unwrap();
    fs::write(foreign.join("figures/mine.svg"), "mine").unwrap();
    let beside = ["report", run, "--replications", "200", "--out", foreign.to_str().unwrap()];
    refused(&beside, &["holds figures, and no index.html", "--force"]);
    assert_eq!(fs::read_to_string(foreign.join("figures/mine.svg")).unwrap(), "mine");
    let elsewhere = folder.path().join("elsewhere");
    let elsewhere = ["--out", elsewhere.to_str().unwrap()];
    refused(&[&["report", run, run], &elsewhere[..]].concat(), &["are the same run"]);
    refused(&[&["report", "/tmp/is-not-there"], &elsewhere[..]].concat(), &["is-not-there"]);
    refused(
        &[&["report", run, "--metric", "win_rate"], &elsewhere[..]].concat(),
        &["has no win rate of navigation-2-2"],
    );
    refused(&[&["report", run, "--pair", "rit"], &elsewhere[..]].concat(), &["write two methods"]);
    assert!(!Path::new(elsewhere[1]).exists(), "what is refused leaves nothing");
    shapley(&folder, run);
}

/// On the same run: training it takes the most time.
fn shapley(folder: &RunFolder, run: &str) {
    let figure = folder.path().join("shapley.svg");
    let arguments = [
        "shapley",
        "--run",
        run,
        "--task",
        "navigation-3-3",
        "--episodes",
        "2",
        "--rolled-steps",
        "1",
        "--json",
        "--out",
        figure.to_str().unwrap(),
    ];
    let found = output(&arguments);
    assert!(found.status.success(), "{}", String::from_utf8_lossy(&found.stderr));
    let found: Value = serde_json::from_slice(&found.stdout).unwrap();
    assert_eq!(
        (&found["agents"], &found["steps"], &found["rolled_steps"]),
        (&3.into(), &50.into(), &2.into())
    );
    // Shapley values sum to what the whole team has above the empty team, by definition.
    assert!(found["efficiency"][0]["mean_error"].as_f64().unwrap() < 1e-4, "{found}");
    assert_eq!(found["estimates"].as_array().unwrap().len(), 4, "M = 1, 2, 4 and all 6 orders");
    roxmltree::Document::parse(&fs::read_to_string(&figure).unwrap()).unwrap();
    refused(&arguments, &["shapley.svg is there already"]);
    let out = folder.path().join("with-shapley");
    let place = out.to_str().unwrap();
    let brief = ["report", run, "--out", place, "--replications", "200", "--without-data"];
    assert!(output(&brief).status.success());
    assert_eq!(names(&out), ["index.html", "tables"]);
    let page = fs::read_to_string(out.join("index.html")).unwrap();
    assert!(page.contains("navigation-3-3 (the final weights, 2 greedy episodes, 50 steps)"), "{page}");
    let table = fs::read_to_string(out.join("tables/shapley-estimates.md")).unwrap();
    assert!(table.contains("| M = 1 | M = 2 | M = 4 | M = 6 |"), "{table}");
    let task = |name| ["shapley", "--run", run, "--task", name];
    refused(&task("navigation-7-7"), &["has 7 agents", "up to 6"]);
    refused(&task("navigation"), &["unknown task"]);
}

#[test]
fn the_committed_records_make_a_report() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let results = concat!(env!("CARGO_MANIFEST_DIR"), "/results");
    let arguments = ["report", results, "--out", out.to_str().unwrap(), "--replications", "200"];
    refused(&arguments, &["differ in algorithm.gamma (0.99, 0.8)", "--by algorithm.gamma"]);
    let by = [
        "--by",
        "algorithm.encoder",
        "--by",
        "algorithm.reward_scale",
        "--by",
        "algorithm.gamma",
        "--by",
        "algorithm.time_limit",
        "--by",
        "environment.approach_shaping",
    ];
    let made = output(&[&arguments[..], &by].concat());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let table = fs::read_to_string(out.join("tables/tasks-predator-prey.md")).unwrap();
    assert!(table.contains("predator-prey-5-2 (unseen)"), "{table}");
    // Older records say no method, and what lies beside them does: they are RIT's. Over 1000 episodes a task.
    let table = fs::read_to_string(out.join("tables/table-3.md")).unwrap();
    assert!(table.contains("| rit | −342.4 ± 14.1 | −312.7 ± 6.6 (5) ▲ | 6.5 ± 1.5 | 14.1 ±"), "{table}");
}
