//! What comparing a run's utilities with exact Shapley values came to: a file for each task, kept with the run.

use crate::{RecordError, number};
use rit_config::write_whole;
use serde::{Deserialize, Serialize};
use std::{
    fs::{self, DirBuilder},
    io::ErrorKind,
    os::unix::fs::DirBuilderExt as _,
    path::{Path, PathBuf},
};

/// The folder of a run directory that they lie in.
const FOLDER: &str = "shapley";
/// No comparison is longer.
const BYTES_MAX: u64 = 16 << 20;
/// Points that a file keeps for its figure.
const POINTS_MAX: usize = 500;

/// Utilities of a run on one task beside the Shapley values of its agents.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Shapley {
    /// The run, as it was given.
    pub run: String,
    /// The task.
    pub task: String,
    /// `algorithm.name`.
    pub method: String,
    /// SHA-256 of the weights that were compared, in hexadecimal.
    pub weights_digest: String,
    /// Agents of the task.
    pub agents: usize,
    /// Greedy episodes.
    pub episodes: usize,
    /// Steps of all of them.
    pub steps: usize,
    /// Steps whose continuations were rolled.
    pub rolled_steps: usize,
    /// Pearson's correlation, over agents and steps, of utilities in the episode's own order (M = 1) with the Shapley
    /// values of the learned game; here and below none where one side does not vary.
    pub utilities_learned: Option<f64>,
    /// The same with the Shapley values of the environment's own game.
    pub utilities_own: Option<f64>,
    /// The Shapley values of both games with each other.
    pub learned_own: Option<f64>,
    /// The first with each step's mean over agents taken off both sides: which agent counts for more.
    pub within_steps_learned: Option<f64>,
    /// The second likewise.
    pub within_steps_own: Option<f64>,
    /// Equation 10 with M orders, against the learned game's Shapley values.
    pub estimates: Vec<ShapleyEstimate>,
    /// Mean absolute Shapley value of the learned game: what errors are to be compared with.
    #[serde(deserialize_with = "number::or_nan")]
    pub mean_shapley: f64,
    /// Lemma 1: how far sums over agents are from what they are said to be.
    pub efficiency: Vec<Residual>,
    /// Agents that the learned game treats alike.
    pub symmetry: Symmetry,
    /// Shapley values of the learned game, each with the utility: all of them, or some that are spread evenly.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<[f64; 2]>,
    /// The same of the environment's own game.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub own_points: Vec<[f64; 2]>,
}

/// Equation 10 with so many orders.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ShapleyEstimate {
    /// M.
    pub orders: usize,
    /// Mean absolute difference from the Shapley values.
    #[serde(deserialize_with = "number::or_nan")]
    pub mean_error: f64,
    /// Pearson's correlation with them.
    pub correlation: Option<f64>,
}

/// How far a sum over agents is from something.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Residual {
    /// What is summed.
    pub sum: String,
    /// What it is held against.
    pub of: String,
    /// Mean absolute difference, over steps.
    #[serde(deserialize_with = "number::or_nan")]
    pub mean_error: f64,
    /// Mean absolute value of what it is held against.
    #[serde(deserialize_with = "number::or_nan")]
    pub mean_size: f64,
}

/// Pairs of agents that the learned game treats alike at a step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Symmetry {
    /// How many there are.
    pub pairs: usize,
    /// Mean absolute difference between the two, of Shapley values; 0 where there is no pair, here and below.
    pub shapley: f64,
    /// Of utilities with M = 1.
    pub utilities: f64,
    /// Of utilities averaged over all orders.
    pub averaged: f64,
}

impl Shapley {
    /// Keeps it in a run directory, in the place of an earlier one of the same task. Returns where.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn keep(&self, run_dir: &Path) -> Result<PathBuf, RecordError> {
        let folder = run_dir.join(FOLDER);
        DirBuilder::new().recursive(true).mode(0o700).create(&folder).map_err(RecordError::io(&folder))?;
        let path = folder.join(self.file_name());
        let thinned =
            Self { points: thinned(&self.points), own_points: thinned(&self.own_points), ..self.clone() };
        let text = serde_json::to_vec(&thinned).map_err(|error| RecordError::io(&path)(error.into()))?;
        write_whole(&path, &text).map_err(RecordError::io(&path))?;
        Ok(path)
    }

    /// Named for the task, in letters that file systems have.
    fn file_name(&self) -> String {
        let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' };
        format!("{}.json", self.task.chars().map(plain).collect::<String>())
    }
}

/// At most so many, spread evenly, with the digits that a figure shows.
fn thinned(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let round = |value: f64| (value * 1e4).round() / 1e4;
    points.iter().step_by(points.len().div_ceil(POINTS_MAX).max(1)).map(|point| point.map(round)).collect()
}

/// Those of a run directory, in the order of their files' names.
pub(crate) fn of_run_dir(run_dir: &Path) -> Result<Vec<Shapley>, RecordError> {
    read(&run_dir.join(FOLDER), "")
}

/// Those beside a committed record.
pub(crate) fn of_committed(metrics: &Path) -> Result<Vec<Shapley>, RecordError> {
    let (folder, prefix) = beside(&metrics.with_extension(""));
    read(&folder, &prefix)
}

/// Copies those of a run directory to the record that is committed as this.
pub(crate) fn commit(run_dir: &Path, stem: &Path) -> Result<(), RecordError> {
    let (folder, prefix) = beside(stem);
    for path in files(&run_dir.join(FOLDER), "")? {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let to = folder.join(format!("{prefix}{name}"));
        let text = rit_config::read_regular(&path, BYTES_MAX).map_err(RecordError::io(&path))?;
        write_whole(&to, &text).map_err(RecordError::io(&to))?;
    }
    Ok(())
}

/// Where they lie beside a committed record, and how their names begin.
fn beside(stem: &Path) -> (PathBuf, String) {
    let folder = stem.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = stem.file_name().unwrap_or_default().to_string_lossy();
    (folder.to_owned(), format!("{name}.{FOLDER}-"))
}

fn files(folder: &Path, prefix: &str) -> Result<Vec<PathBuf>, RecordError> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(RecordError::io(folder))?,
    };
    let mut found = Vec::new();
    for entry in entries {
        let name = entry.map_err(RecordError::io(folder))?.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(prefix) && name.ends_with(".json") {
            found.push(folder.join(&*name));
        }
    }
    found.sort();
    Ok(found)
}

fn read(folder: &Path, prefix: &str) -> Result<Vec<Shapley>, RecordError> {
    let parsed = |path: PathBuf| {
        let text = rit_config::read_regular(&path, BYTES_MAX).map_err(RecordError::io(&path))?;
        serde_json::from_slice(&text).map_err(|error| RecordError::Other {
            path,
            what: "comparison with Shapley values",
            why: error.to_string(),
        })
    };
    files(folder, prefix)?.into_iter().map(parsed).collect()
}
