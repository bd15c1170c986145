//! What was measured of a run, and what kind of run it is.

use crate::{cli::PlotMetric, failure::Failure};
use rit_config::{RunDir, read_regular};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// No file of metrics is longer.
const BYTES_MAX: u64 = 1 << 32;

/// The key of [`Kind`] under which evaluations lie apart by so many environment steps.
const INTERVAL: &str = "evaluation.every_env_steps";

/// What makes runs comparable, key by key: the configuration that results follow from, but for the seed; or what a file
/// shows of it.
pub type Kind = BTreeMap<String, String>;

/// Greedy evaluations: by task, by environment steps, what is drawn.
pub type Evaluations = BTreeMap<String, BTreeMap<u64, f64>>;

/// A run that is drawn.
#[derive(Debug)]
pub struct Run {
    /// As it was given.
    pub name: String,
    pub kind: Kind,
    /// Its seed, where a configuration tells.
    pub seed: Option<u64>,
    pub evaluations: Evaluations,
    /// Lines of its file that are none.
    pub torn_lines: usize,
    path: PathBuf,
    text: String,
}

/// Reads a run directory, or a file like its metrics.jsonl.
///
/// # Errors
/// When it cannot be read, or holds no evaluation with what is drawn.
pub fn read(given: &Path, metric: PlotMetric) -> Result<Run, Failure> {
    let path = if given.is_dir() { given.join("metrics.jsonl") } else { given.to_owned() };
    let named = |what: &str| Failure::input_message(format!("{}: {what}", path.display()));
    let bytes = read_regular(&path, BYTES_MAX).map_err(|error| named(&error.to_string()))?;
    // What is no text is no line of metrics either, and counted as torn.
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let (found, torn_lines) = evaluations(&text, metric);
    if found.is_empty() {
        return Err(named("it holds no evaluation yet"));
    }
    if found.values().all(BTreeMap::is_empty) {
        return Err(named("its tasks know no winning: there is no win rate to draw"));
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let config = if given.is_dir() || folder.join("config.toml").exists() {
        Some(RunDir::open(folder)?.1)
    } else {
        None
    };
    let (kind, seed) = match &config {
        Some(config) => {
            let mut kind = config.result_settings()?;
            kind.remove("seed");
            kind.insert(INTERVAL.to_owned(), config.evaluation.every_env_steps.to_string());
            (kind, Some(config.seed.0))
        }
        None => (shown_kind(folder, &found), None),
    };
    let interval = kind.get(INTERVAL).and_then(|interval| interval.parse().ok()).unwrap_or(1);
    let path = path.canonicalize().map_err(|error| named(&error.to_string()))?;
    let evaluations = aligned(found, interval);
    Ok(Run { name: given.display().to_string(), kind, seed, evaluations, torn_lines, path, text })
}

/// What the lines hold, and how many are none.
fn evaluations(text: &str, metric: PlotMetric) -> (Evaluations, usize) {
    let key = match metric {
        PlotMetric::MeanReturn => "mean_return",
        PlotMetric::WinRate => "win_rate",
    };
    let (mut evaluations, mut torn) = (Evaluations::new(), 0);
    for line in text.lines() {
        let Ok(line) = serde_json::from_str::<Value>(line) else {
            torn += 1;
            continue;
        };
        if line["kind"] != "evaluation" {
            continue;
        }
        let env_steps = line["env_steps"].as_u64().unwrap_or_default();
        for (task, result) in line["tasks"].as_object().into_iter().flatten() {
            let points = evaluations.entry(task.clone()).or_default();
            points.extend(result[key].as_f64().map(|value| (env_steps, value)));
        }
    }
    (evaluations, torn)
}

/// What a file alone shows of its run: runs of one experiment lie in one folder, play the same tasks, and are evaluated
/// as often.
fn shown_kind(folder: &Path, evaluations: &Evaluations) -> Kind {
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let folder = folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let tasks = evaluations.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
    let interval = usual_gap(evaluations).to_string();
    let facts = [("folder", folder), ("tasks", tasks), (INTERVAL, interval)];
    facts.map(|(key, value)| (key.to_owned(), value)).into()
}

/// Environment steps from most evaluations to the next.
fn usual_gap(evaluations: &Evaluations) -> u64 {
    let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
    for points in evaluations.values() {
        for (before, after) in points.keys().zip(points.keys().skip(1)) {
            *counts.entry(after - before).or_default() += 1;
        }
    }
    let most = counts.into_iter().max_by_key(|&(gap, count)| (count, std::cmp::Reverse(gap)));
    most.map_or(1, |(gap, _)| gap.max(1))
}

/// The same with each evaluation at the multiple of the interval that it was due at: episodes that end early make it a
/// few steps later, and differently from run to run.
fn aligned(evaluations: Evaluations, interval: u64) -> Evaluations {
    let due = |env_steps: u64| env_steps - env_steps % interval.max(1);
    let points =
        |points: BTreeMap<u64, f64>| points.into_iter().map(|(at, value)| (due(at), value)).collect();
    evaluations.into_iter().map(|(task, of_task)| (task, points(of_task))).collect()
}

/// Refuses a run that is there twice: it would count for more than it is.
///
/// # Errors
/// When one is.
pub fn refuse_twice(runs: &[Run]) -> Result<(), Failure> {
    for (at, run) in runs.iter().enumerate() {
        let same = |other: &&Run| {
            let same_seed = run.seed.is_some() && run.seed == other.seed && run.kind == other.kind;
            run.path == other.path || run.text == other.text || same_seed
        };
        if let Some(other) = runs[..at].iter().find(same) {
            let seed = run.seed.map_or_else(String::new, |seed| format!(", seed {seed}"));
            return Err(Failure::input_message(format!(
                "{} and {} are the same run{seed}: give it once",
                other.name, run.name
            )));
        }
    }
    Ok(())
}
