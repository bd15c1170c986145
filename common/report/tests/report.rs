//! Records that are written as a learner writes them, and what a report makes of them: refusals in words, files, numbers.

#![allow(clippy::panic, clippy::unwrap_used, reason = "helpers of tests are tests too")]

use rit_report::{Measure, Options, Report, ReportError, finished, read, report};
use serde_json::{Value, json};
use std::{
    fs,
    path::{Path, PathBuf},
};

const TRAINING: [&str; 3] = ["navigation-2-2", "navigation-3-3", "navigation-4-4"];
const TESTING: [&str; 2] = ["navigation-5-5", "navigation-6-6"];

/// A run as it is committed.
#[derive(Clone)]
struct Run {
    method: &'static str,
    seed: u64,
    settings: Vec<(&'static str, &'static str)>,
    version: &'static str,
    ended: &'static str,
    every: u64,
    /// What is added to every return.
    level: f64,
}

impl Run {
    fn new(method: &'static str, seed: u64) -> Self {
        let (settings, version, ended) = (Vec::new(), "0.1.0", "finished");
        let level = method.len() as f64 * 10.0 + seed as f64;
        Self { method, seed, settings, version, ended, every: 10, level }
    }

    fn with(mut self, key: &'static str, value: &'static str) -> Self {
        self.settings.push((key, value));
        self
    }

    /// Writes it to a file of this name.
    fn write(&self, folder: &Path, name: &str) -> PathBuf {
        let mut settings = json!({
            "seed": self.seed.to_string(),
            "algorithm.name": self.method,
            "algorithm.gamma": "0.99",
            "algorithm.random_permutation": "true",
            "environment.task_set": "cooperative-navigation",
            "evaluation.every_env_steps": self.every.to_string(),
            "evaluation.testing_every_env_steps": self.every.to_string(),
            "training.t_max": "40",
        });
        for (key, value) in &self.settings {
            settings[key] = json!(value);
        }
        let build = json!({ "version": self.version, "commit": "abc", "target_features": [] });
        let header = json!({
            "kind": "run", "format_version": 1, "run_id": format!("{:032x}", self.seed), "settings": settings,
            "build": build, "host": { "name": "h", "cpu": "cpu", "cores": 2 }, "parameters": 1234, "measures": [],
        });
        // The kind comes first: so a file is known.
        let header = header.to_string();
        let rest =
            header.trim_start_matches('{').replace("\"kind\":\"run\",", "").replace(",\"kind\":\"run\"", "");
        let mut text = format!("{{\"kind\":\"run\",{rest}\n");
        let points = (0..=4).map(|at| (at * self.every, "scheduled")).chain([(40, "final")]);
        for (env_steps, occasion) in points {
            for (split, tasks) in [("training", &TRAINING[..]), ("testing", &TESTING[..])] {
                text += &self.evaluation(env_steps, occasion, split, tasks).to_string();
                text.push('\n');
            }
        }
        fs::create_dir_all(folder).unwrap();
        let path = folder.join(format!("{name}.jsonl"));
        fs::write(&path, text).unwrap();
        let summary = json!({
            "ended": self.ended, "env_steps": 40, "episodes": 4, "updates": 2, "wall_s": 1.5, "cpu_s": 2.5,
            "weights_digest": format!("{}{}", self.method, self.seed),
        });
        fs::write(path.with_extension("json"), summary.to_string()).unwrap();
        path
    }

    fn evaluation(&self, env_steps: u64, occasion: &str, split: &str, tasks: &[&str]) -> Value {
        let result = |(at, task): (usize, &&str)| {
            let mean = self.level - 100.0 * at as f64 + env_steps as f64;
            (
                (*task).to_owned(),
                json!({ "episodes": 2, "mean_return": mean, "returns": [mean - 1.0, mean + 1.0], "lengths": 25 }),
            )
        };
        let tasks: serde_json::Map<String, Value> = tasks.iter().enumerate().map(result).collect();
        json!({
            "kind": "evaluation", "env_steps": env_steps, "episodes": 1, "updates": 1, "wall_s": 1.0, "split": split,
            "occasion": occasion, "tasks": tasks,
        })
    }
}

fn options() -> Options {
    Options { replications: 200, ..Options::default() }
}

fn made(paths: &[PathBuf], options: &Options) -> Result<Report, ReportError> {
    let input = read(paths)?;
    let (groups, unfinished) = finished(&input, options)?;
    report(&input, &groups, &unfinished, options, Vec::new())
}

fn refusal(runs: &[Run], options: &Options) -> String {
    let folder = tempfile::tempdir().unwrap();
    for (at, run) in runs.iter().enumerate() {
        run.write(folder.path(), &format!("run-{at}"));
    }
    made(&[folder.path().to_owned()], options).unwrap_err().to_string()
}

fn text(report: &Report, path: &str) -> String {
    let file = report.files.iter().find(|(name, _)| name == Path::new(path));
    String::from_utf8(file.unwrap_or_else(|| panic!("{path} is not there")).1.clone()).unwrap()
}

/// Two methods with five seeds each.
fn comparison(folder: &Path) -> Vec<PathBuf> {
    let runs =
        ["rit", "qmix-attn"].into_iter().flat_map(|method| (1..=5).map(move |seed| Run::new(method, seed)));
    runs.map(|run| run.write(&folder.join(run.method), &format!("seed-{}", run.seed))).collect()
}

#[test]
fn what_cannot_be_averaged_or_compared_is_refused_in_words() {
    let first = Run::new("rit", 1);
    let cases: [(Vec<Run>, &[&str]); 7] = [
        (
            vec![first.clone(), Run::new("rit", 2).with("training.t_max", "80")],
            &["training.t_max (40, 80)", "not averaged", "--by training.t_max"],
        ),
        (
            vec![first.clone(), Run::new("rit", 2).with("algorithm.gamma", "0.8")],
            &["run-0.jsonl and ", "algorithm.gamma (0.99, 0.8)", "not averaged", "--by algorithm.gamma"],
        ),
        (
            vec![first.clone(), Run { level: 3.0, ..first.clone() }],
            &["are the same run, seed 1: give it once"],
        ),
        (
            vec![first.clone(), Run { every: 20, ..Run::new("mat", 1) }],
            &["every 10 environment steps", "every 20", "cannot be compared"],
        ),
        (
            vec![first.clone(), Run { version: "0.2.0", ..Run::new("rit", 2) }],
            &["version 0.1.0", "version 0.2.0", "train them again"],
        ),
        (
            vec![first.clone(), Run { version: "0.2.0", ..Run::new("mat", 1) }],
            &["version 0.1.0", "version 0.2.0", "train them again"],
        ),
        (
            vec![Run { ended: "stopped", ..first.clone() }, Run { ended: "failed", ..Run::new("mat", 1) }],
            &["none of 2 runs has finished"],
        ),
    ];
    for (runs, words) in cases {
        let refused = refusal(&runs, &options());
        for word in words {
            assert!(refused.contains(word), "{word:?} is not in {refused}");
        }
    }
    let win_rate = Options { measure: Some(Measure::WinRate), ..options() };
    let refused = refusal(std::slice::from_ref(&first), &win_rate);
    assert!(refused.contains("has no win rate of navigation-2-2"), "{refused}");
    let pair = Options { pairs: vec![("rit".into(), "roma".into())], ..options() };
    assert!(
        refusal(std::slice::from_ref(&first), &pair).contains("there is no method roma; the methods are rit")
    );
    let by = Options { by: vec!["algorithm.gama".into()], ..options() };
    assert!(refusal(&[first], &by).contains("--by algorithm.gama: no run has this key"));
    let empty = tempfile::tempdir().unwrap();
    assert!(
        made(&[empty.path().to_owned()], &options())
            .unwrap_err()
            .to_string()
            .contains("holds no record of a run")
    );
}

#[test]
fn configurations_are_compared_where_that_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    Run::new("rit", 1).write(folder.path(), "a");
    Run::new("rit", 1).with("algorithm.gamma", "0.8").write(folder.path(), "b");
    let options = Options { by: vec!["algorithm.gamma".into()], ..options() };
    // The weights are another run's.
    let text_b = fs::read_to_string(folder.path().join("b.json")).unwrap().replace("rit1", "other");
    fs::write(folder.path().join("b.json"), text_b).unwrap();
    let input = read(&[folder.path().to_owned()]).unwrap();
    let (groups, _) = finished(&input, &options).unwrap();
    let labels: Vec<&str> = groups[0].methods.iter().map(|method| method.label.as_str()).collect();
    assert_eq!(labels, ["rit", "rit gamma=0.8"]);
    // The paper's figure has the plain method; what else was tried has one of its own, beside it.
    let made = made(&[folder.path().to_owned()], &options).unwrap();
    assert!(!text(&made, "figures/figure-2.svg").contains("gamma=0.8"));
    let other = text(&made, "figures/curves-cooperative-navigation-other-settings.svg");
    assert!(other.contains("rit gamma=0.8") && other.contains(">rit</text>"), "{other}");
    // Where the plain name means something else, the other one is the variant.
    let plain = |_: &str, _: &str| Some([("algorithm.gamma".to_owned(), "0.8".to_owned())].into());
    let (groups, _) = finished(&input, &Options { plain, ..options }).unwrap();
    let labels: Vec<&str> = groups[0].methods.iter().map(|method| method.label.as_str()).collect();
    assert_eq!(labels, ["rit", "rit gamma=0.99"]);
}

#[test]
fn a_method_is_named_for_a_permutation_that_it_is_without_unless_it_never_has_one() {
    let folder = tempfile::tempdir().unwrap();
    for method in ["rit", "mat"] {
        Run::new(method, 1).with("algorithm.random_permutation", "false").write(folder.path(), method);
    }
    let input = read(&[folder.path().to_owned()]).unwrap();
    let (groups, _) = finished(&input, &options()).unwrap();
    let labels: Vec<&str> = groups[0].methods.iter().map(|method| method.label.as_str()).collect();
    assert_eq!(labels, ["rit-no-random-permutation", "mat"]);
}

#[test]
fn a_report_has_these_files_and_each_can_be_read() {
    let folder = tempfile::tempdir().unwrap();
    comparison(folder.path());
    let made = made(&[folder.path().to_owned()], &options()).unwrap();
    for (path, bytes) in &made.files {
        let text = String::from_utf8(bytes.clone()).unwrap();
        let name = path.to_str().unwrap();
        match name.split_once('/') {
            None => assert!(["index.html", "marl-eval.json", "runs.csv"].contains(&name), "{name}"),
            Some(("figures", file)) => {
                assert!(file.ends_with(".svg"), "{name}");
                roxmltree::Document::parse(&text).unwrap();
            }
            Some((folder, file)) => assert!(folder == "tables" && file.ends_with(".md"), "{name}"),
        }
    }
    for name in ["figure-2", "team-size", "zero-shot-curves"] {
        text(&made, &format!("figures/{name}.svg"));
    }
    // Nothing is loaded from anywhere.
    let page = text(&made, "index.html");
    for word in ["http://", "https://", "<script", "<link", "@import", "url("] {
        let harmless = page.matches("http://www.w3.org/2000/svg").count();
        assert_eq!(page.matches(word).count(), if word == "http://" { harmless } else { 0 }, "{word}");
    }
    assert!(page.contains("10 finished runs: 2 methods on 1 task set, 5 seeds each."));
    assert!(!page.contains("not reliable. Figures"));
    let again = self::made(&[folder.path().to_owned()], &options()).unwrap();
    assert!(again.files == made.files, "the same records give the same files");
}

#[test]
fn the_papers_numbers_stand_beside_ours_with_a_mark() {
    let folder = tempfile::tempdir().unwrap();
    comparison(folder.path());
    let table = text(&made(&[folder.path().to_owned()], &options()).unwrap(), "tables/table-3.md");
    // Levels 30 + seed, after 40 steps, 0 and 100 less: 30 + 40 − 50 + (1 … 5); s/√5 = 1.5811/2.2361 = 0.7071.
    let rit = table.lines().find(|line| line.starts_with("| rit |")).unwrap();
    assert!(rit.starts_with("| rit | −342.4 ± 14.1 | 23.0 ± 0.7 (5) ▲ | 6.5 ± 1.5 | – |"), "{rit}");
    let roma = table.lines().find(|line| line.starts_with("| roma |")).unwrap();
    assert!(roma.starts_with("| roma | −1081.6 ± 303.8 | – |"), "{roma}");
    let shorter = "Cooperative navigation, ours: training.t_max = 40 in place of 5050000.";
    assert!(table.contains(shorter), "{table}");
}

#[test]
fn few_seeds_are_said_and_drawn_one_by_one() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<PathBuf> =
        (1..=3).map(|seed| Run::new("rit", seed).write(folder.path(), &format!("seed-{seed}"))).collect();
    let made = made(&paths, &options()).unwrap();
    let page = text(&made, "index.html");
    assert!(
        page.contains(
            "1 of 1 cell (a method on a task set) has fewer than 5 seeds: the intervals are not reliable."
        ),
        "{page}"
    );
    assert!(text(&made, "tables/tasks-cooperative-navigation.md").contains("]†"));
    // The mean and three runs; no band.
    let figure = text(&made, "figures/figure-2.svg");
    let parsed = roxmltree::Document::parse(&figure).unwrap();
    let with = |name: &'static str| parsed.descendants().filter(move |node| node.has_attribute(name));
    assert_eq!(with("fill-opacity").count(), 0);
    let thin: Vec<_> = with("stroke-opacity").map(|group| group.children().count()).collect();
    assert_eq!(thin, [3], "three runs, drawn alike");
}

#[test]
fn marl_evals_file_has_every_algorithm_with_the_same_runs_and_steps() {
    let folder = tempfile::tempdir().unwrap();
    comparison(folder.path());
    fs::remove_file(folder.path().join("rit/seed-5.jsonl")).unwrap();
    let made = made(&[folder.path().to_owned()], &options()).unwrap();
    let json: Value = serde_json::from_str(&text(&made, "marl-eval.json")).unwrap();
    let environments: Vec<&String> = json.as_object().unwrap().keys().collect();
    assert_eq!(environments, ["cooperative-navigation", "cooperative-navigation-unseen"]);
    let tasks = json["cooperative-navigation"].as_object().unwrap();
    assert_eq!(tasks.keys().collect::<Vec<_>>(), TRAINING.iter().collect::<Vec<_>>());
    for algorithms in tasks.values() {
        assert_eq!(algorithms.as_object().unwrap().keys().collect::<Vec<_>>(), ["qmix-attn", "rit"]);
        for runs in algorithms.as_object().unwrap().values() {
            assert_eq!(
                runs.as_object().unwrap().keys().collect::<Vec<_>>(),
                ["run_1", "run_2", "run_3", "run_4"]
            );
            let keys =
                ["absolute_metrics", "step_00000", "step_00001", "step_00002", "step_00003", "step_00004"];
            assert_eq!(runs["run_1"].as_object().unwrap().keys().collect::<Vec<_>>(), keys);
        }
    }
    let run = &tasks["navigation-2-2"]["rit"]["run_2"];
    let expected = json!({ "step_count": 10, "return": [42.0], "episode_return": [41.0, 43.0] });
    assert_eq!(run["step_00001"], expected);
    assert_eq!(run["absolute_metrics"]["return"], json!([72.0]));
}

#[test]
fn the_flat_file_has_a_line_for_each_evaluation_of_a_task() {
    let folder = tempfile::tempdir().unwrap();
    comparison(folder.path());
    let lines = text(&made(&[folder.path().to_owned()], &options()).unwrap(), "runs.csv");
    let mut lines = lines.lines();
    let head: Vec<&str> = lines.next().unwrap().split(',').collect();
    let lines: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    // Ten runs, six evaluations, five tasks.
    assert_eq!(lines.len(), 300);
    let of = |line: &[&str], key: &str| line[head.iter().position(|it| *it == key).unwrap()].to_owned();
    let found =
        lines.iter().find(|line| of(line, "task") == "navigation-5-5" && of(line, "env_steps_due") == "20");
    let values =
        ["method", "seed", "split", "agents", "occasion", "mean_return"].map(|key| of(found.unwrap(), key));
    assert_eq!(values, ["rit", "1", "testing", "5", "scheduled", "51"]);
}

#[test]
fn a_sweep_that_still_runs_says_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    Run::new("rit", 1).write(&folder.path().join("runs"), "rit-seed-1");
    let cell = |name: &str, seed: u64| json!({ "name": name, "experiment": "cooperative-navigation", "seed": seed, "settings": {} });
    let sweep = json!({
        "format_version": 1, "axes": ["algorithm.name"],
        "cells": [cell("rit-seed-2", 2), cell("rit-seed-3", 3), cell("rit-seed-4", 4)],
    });
    // One that failed before it began has left nothing but its words.
    fs::create_dir(folder.path().join("logs")).unwrap();
    fs::write(folder.path().join("logs/rit-seed-3.log"), "begins\nerror: no such token\n").unwrap();
    fs::write(folder.path().join("sweep.json"), sweep.to_string()).unwrap();
    let made = made(&[folder.path().to_owned()], &options()).unwrap();
    let said = made.said.join("\n");
    assert!(
        said.contains(
            "3 of 3 runs are missing: rit-seed-2 (has not begun), rit-seed-3 (failed: no such token), rit-seed-4 (has not \
             begun)."
        ),
        "{said}"
    );
}
