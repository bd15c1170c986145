//! What is drawn of runs.

use crate::{cli::PlotMetric, failure::Failure};
use rit_env::Split;
use rit_record::{Record, TaskResult};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// What makes runs comparable: see [`Record::kind`].
pub type Kind = BTreeMap<String, String>;

/// Greedy evaluations: by task, by environment steps, what is drawn.
pub type Evaluations = BTreeMap<String, BTreeMap<u64, f64>>;

/// A run that is drawn.
#[derive(Debug)]
pub struct Run {
    /// As it was given.
    pub name: String,
    pub kind: Kind,
    /// Its seed, where a configuration or a name tells.
    pub seed: Option<u64>,
    pub evaluations: Evaluations,
    /// Lines of its file that are none.
    pub broken_lines: usize,
    path: PathBuf,
}

/// Reads a run directory, its metrics.jsonl, or a committed record.
///
/// # Errors
/// When it cannot be read, or holds no evaluation with what is drawn.
pub fn read(given: &Path, metric: PlotMetric) -> Result<Run, Failure> {
    let record = Record::read(given).map_err(Failure::input)?;
    let named = |what: &str| Failure::input_message(format!("{record}: {what}"));
    let value = |result: &TaskResult| match metric {
        PlotMetric::MeanReturn => Some(result.mean_return).filter(|value| value.is_finite()),
        PlotMetric::WinRate => result.win_rate,
    };
    let mut evaluations = Evaluations::new();
    for (env_steps, evaluation) in record.curve(Split::Training) {
        for (task, result) in &evaluation.tasks {
            let points = evaluations.entry(task.clone()).or_default();
            points.extend(value(result).map(|value| (env_steps, value)));
        }
    }
    if evaluations.is_empty() {
        return Err(named("it holds no evaluation yet"));
    }
    if evaluations.values().all(BTreeMap::is_empty) {
        return Err(named("its tasks know no winning: there is no win rate to draw"));
    }
    let Record { name, kind, seed, broken_lines, path, .. } = record;
    Ok(Run { name, kind, seed, evaluations, broken_lines, path })
}

/// Refuses a run that is there twice: it would count for more than it is.
///
/// # Errors
/// When one is.
pub fn refuse_twice(runs: &[Run]) -> Result<(), Failure> {
    for (at, run) in runs.iter().enumerate() {
        let same = |other: &&Run| {
            let same_seed = run.seed.is_some() && run.seed == other.seed;
            run.path == other.path
                || (run.kind == other.kind && (same_seed || run.evaluations == other.evaluations))
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
