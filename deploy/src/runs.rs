//! `rit runs`: which runs there are, how they stand, and what they have reached.

use crate::{cli::RunsOptions, failure::Failure, finished::Finished, output, report};
use rit_config::RunDir;
use rit_env::Split;
use rit_record::{Evaluation, Line, Lines, Occasion};
use serde::Serialize;
use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

/// Folders within folders that are looked into.
const DEPTH: usize = 4;

/// `rit runs`.
pub fn run(options: &RunsOptions) -> Result<ExitCode, Failure> {
    let mut folders = Vec::new();
    let entries = fs::read_dir(&options.dir);
    entries.map_err(|error| Failure::input_message(format!("{}: {error}", options.dir.display())))?;
    find(&options.dir, DEPTH, &mut folders);
    folders.sort_by_cached_key(|folder| natural(folder));
    let rows: Vec<Row> = folders.iter().map(|folder| Row::of(folder, &options.dir)).collect();
    if options.json {
        let text = serde_json::to_string_pretty(&rows).map_err(Failure::runtime)?;
        output::print(&(text + "\n"))?;
    } else if rows.is_empty() {
        output::print(&format!("no run in {}\n", options.dir.display()))?;
    } else {
        output::print(&table(&rows))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// A run in the list.
#[derive(Debug, PartialEq, Serialize)]
struct Row {
    /// Where it lies, from the folder that is listed.
    run: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    task_set: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    algorithm: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    seed: Option<u64>,
    /// running, how it ended, or "broken off": it can be gone on with; "unreadable", with the reason.
    state: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    env_steps: u64,
    /// Steps that it is to make.
    #[serde(skip_serializing_if = "Option::is_none")]
    t_max: Option<u64>,
    /// What the evaluations measure: mean over training tasks.
    #[serde(skip_serializing_if = "Option::is_none")]
    metric: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    last_evaluation: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    best_evaluation: Option<f64>,
}

impl Row {
    fn of(folder: &Path, listed: &Path) -> Self {
        let name = folder.strip_prefix(listed).unwrap_or(folder).display().to_string();
        let run = if name.is_empty() { folder.display().to_string() } else { name };
        let (run_dir, config) = match RunDir::open(folder) {
            Ok(opened) => opened,
            Err(error) => {
                return Self {
                    run,
                    task_set: None,
                    algorithm: None,
                    seed: None,
                    state: "unreadable".to_owned(),
                    reason: Some(error.to_string()),
                    env_steps: 0,
                    t_max: None,
                    metric: None,
                    last_evaluation: None,
                    best_evaluation: None,
                };
            }
        };
        let (env_steps, evaluations) = read(&run_dir);
        let finished = if run_dir.is_in_use() { Ok(None) } else { Finished::of(&run_dir) };
        let state = match &finished {
            _ if run_dir.is_in_use() => "running",
            Ok(Some(finished)) => finished.ended().word(),
            Ok(None) => "broken off",
            Err(_) => "unreadable",
        };
        let (state, reason) = (state.to_owned(), finished.as_ref().err().map(ToString::to_string));
        let finished = finished.ok().flatten();
        let (metric, values) = measured(&evaluations);
        Self {
            run,
            task_set: Some(config.environment.task_set.to_string()),
            algorithm: Some(config.algorithm.name.to_string()),
            seed: Some(config.seed.0),
            state,
            reason,
            env_steps: finished.as_ref().map_or(env_steps, Finished::env_steps),
            t_max: Some(config.training.t_max),
            metric,
            last_evaluation: values.last().copied(),
            best_evaluation: values.into_iter().max_by(f64::total_cmp),
        }
    }

    /// The columns of the table.
    fn cells(&self) -> [String; 8] {
        let dash = || "-".to_owned();
        let text = |text: &Option<String>| text.clone().unwrap_or_else(dash);
        let value = |value: Option<f64>| match (self.metric, value) {
            (Some("win_rate"), Some(value)) => format!("{:.0} % won", 100.0 * value),
            (_, Some(value)) => format!("{value:.1}"),
            (_, None) => dash(),
        };
        let state = match &self.reason {
            Some(reason) => format!("{}: {}", self.state, report::printable(reason)),
            None => self.state.clone(),
        };
        [
            self.run.clone(),
            text(&self.task_set),
            text(&self.algorithm),
            self.seed.map_or_else(dash, |seed| seed.to_string()),
            report::grouped(self.env_steps),
            value(self.last_evaluation),
            value(self.best_evaluation),
            state,
        ]
    }
}

/// What an evaluation reached on each task: mean return, and win rate where there is one.
type Results = Vec<(f64, Option<f64>)>;

/// How far a run has come, and its scheduled evaluations of training tasks. One that was killed before its first line has
/// measured nothing.
fn read(run_dir: &RunDir) -> (u64, Vec<Results>) {
    let (mut env_steps, mut evaluations) = (0, Vec::new());
    let Ok(mut lines) = Lines::open(&run_dir.metrics()) else { return (env_steps, evaluations) };
    while let Ok(Some(line)) = lines.next_line() {
        env_steps = line.progress().map_or(env_steps, |progress| progress.env_steps);
        if let Line::Evaluation(Evaluation {
            split: Split::Training,
            occasion: Occasion::Scheduled,
            tasks,
            ..
        }) = line
        {
            let results = tasks.into_values().map(|result| (result.mean_return, result.win_rate));
            evaluations.push(results.collect());
        }
    }
    (env_steps, evaluations)
}

/// The mean over tasks of each evaluation, and what it measures: win rates where all tasks know them, else returns.
fn measured(evaluations: &[Results]) -> (Option<&'static str>, Vec<f64>) {
    let evaluations: Vec<_> = evaluations.iter().filter(|results| !results.is_empty()).collect();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
    let wins: Option<Vec<f64>> = evaluations
        .iter()
        .map(|results| results.iter().map(|(_, win_rate)| *win_rate).collect::<Option<Vec<_>>>().map(mean))
        .collect();
    match wins {
        _ if evaluations.is_empty() => (None, Vec::new()),
        Some(wins) => (Some("win_rate"), wins),
        None => {
            let returns =
                evaluations.iter().map(|results| mean(results.iter().map(|(total, _)| *total).collect()));
            (Some("mean_return"), returns.collect())
        }
    }
}

const HEAD: [&str; 8] = ["run", "task set", "algorithm", "seed", "steps", "last", "best", "state"];
/// Columns of numbers, which are set to the right.
const NUMBERS: std::ops::Range<usize> = 3..7;

fn table(rows: &[Row]) -> String {
    let mut lines = vec![HEAD.map(str::to_owned)];
    lines.extend(rows.iter().map(Row::cells));
    let width = |column: usize| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..HEAD.len()).map(width).collect();
    let mut text = String::new();
    for line in &lines {
        let cells = line.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| {
            if NUMBERS.contains(&column) { format!("{cell:>width$}") } else { format!("{cell:width$}") }
        });
        text += cells.collect::<Vec<_>>().join("  ").trim_end();
        text.push('\n');
    }
    text
}

/// The runs in a folder and, down to a depth, in folders of it.
fn find(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) {
    if folder.join("config.toml").exists() && folder.join("run_id").exists() {
        found.push(folder.to_owned());
        return;
    }
    // Folders that may not be looked into hold no runs of this user's.
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if depth > 0 && entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            find(&entry.path(), depth - 1, found);
        }
    }
}

/// A path to sort by, so that run-10 comes after run-9.
fn natural(path: &Path) -> Vec<(String, u64)> {
    let text = path.display().to_string();
    let mut parts = Vec::new();
    let mut rest = text.as_str();
    while !rest.is_empty() {
        let digits = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
        let (words, numbers) = rest.split_at(digits);
        let end = numbers.find(|c: char| !c.is_ascii_digit()).unwrap_or(numbers.len());
        parts.push((words.to_owned(), numbers[..end].parse().unwrap_or(u64::MAX)));
        rest = &numbers[end..];
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_in_the_order_of_their_numbers() {
        let mut paths = ["runs/a-10", "runs/a-9", "runs/b-1", "runs/a-9-2"].map(PathBuf::from);
        paths.sort_by_cached_key(|path| natural(path));
        assert_eq!(paths, ["runs/a-9", "runs/a-9-2", "runs/a-10", "runs/b-1"].map(PathBuf::from));
    }

    #[test]
    fn evaluations_are_means_over_tasks() {
        let won = |rate| (10.0, Some(rate));
        assert_eq!(
            measured(&[vec![won(0.5), won(1.0)], vec![won(0.0), won(0.5)]]),
            (Some("win_rate"), vec![0.75, 0.25])
        );
        assert_eq!(measured(&[vec![(-4.0, None), (-2.0, None)]]), (Some("mean_return"), vec![-3.0]));
        assert_eq!(measured(&[]), (None, vec![]));
    }
}
