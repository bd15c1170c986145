//! `rit runs`: which runs there are, how they stand, and what they have reached.

use crate::{cli::RunsOptions, failure::Failure, output, report};
use rit_config::RunDir;
use rit_env::Split;
use rit_record::{Occasion, Record, RecordError, discover};
use serde::Serialize;
use std::{fs, path::Path, process::ExitCode};

/// `rit runs`.
pub fn run(options: &RunsOptions) -> Result<ExitCode, Failure> {
    let entries = fs::read_dir(&options.dir);
    entries.map_err(|error| Failure::input_message(format!("{}: {error}", options.dir.display())))?;
    let mut folders = match discover(std::slice::from_ref(&options.dir)) {
        Err(RecordError::None(_)) => Vec::new(),
        found => found.map_err(Failure::input)?,
    };
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
#[derive(Debug, Default, PartialEq, Serialize)]
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
        let record = match Record::read(folder) {
            Ok(record) => record,
            Err(error) => {
                let (state, reason) = ("unreadable".to_owned(), Some(error.to_string()));
                return Self { run, state, reason, ..Self::default() };
            }
        };
        let in_use = RunDir::open(folder).is_ok_and(|(run_dir, _)| run_dir.is_in_use());
        let state = match record.ended {
            _ if in_use => "running",
            Some(ended) => ended.word(),
            None => "broken off",
        };
        let (metric, values) = measured(&evaluations(&record));
        Self {
            run,
            task_set: record.task_set().map(str::to_owned),
            algorithm: record.method().map(str::to_owned),
            seed: record.seed,
            state: state.to_owned(),
            reason: None,
            env_steps: record.progress.env_steps,
            t_max: record.env_steps_max(),
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

/// Those of the training tasks, the one at a run's end included; what its best policy came to afterwards is of another kind.
fn evaluations(record: &Record) -> Vec<Results> {
    let of_the_run =
        |it: &&rit_record::Evaluation| it.split == Split::Training && it.occasion != Occasion::Best;
    let results = |it: &rit_record::Evaluation| {
        it.tasks.values().map(|result| (result.mean_return, result.win_rate)).collect()
    };
    record.evaluations.iter().filter(of_the_run).map(results).collect()
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
    use std::path::PathBuf;

    #[test]
    fn runs_are_in_the_order_of_their_numbers() {
        let mut paths = ["runs/a-10", "runs/a-9", "runs/b-1", "runs/a-9-2"].map(PathBuf::from);
        paths.sort_by_cached_key(|path| natural(path));
        assert_eq!(paths, ["runs/a-9", "runs/a-9-2", "runs/a-10", "runs/b-1"].map(PathBuf::from));
    }

    /// A run may be shorter than the way to its first evaluation on schedule, or end between two.
    #[test]
    fn the_evaluation_at_the_end_counts() {
        let evaluation = |occasion, split, mean_return| {
            let result = rit_record::TaskResult { mean_return, ..Default::default() };
            rit_record::Evaluation {
                occasion,
                split,
                tasks: [("a".to_owned(), result)].into(),
                ..Default::default()
            }
        };
        let made = [
            evaluation(Occasion::Scheduled, Split::Training, 1.0),
            evaluation(Occasion::Scheduled, Split::Testing, 9.0),
            evaluation(Occasion::Final, Split::Training, 2.0),
            evaluation(Occasion::Final, Split::Testing, 9.0),
            evaluation(Occasion::Best, Split::Training, 9.0),
        ];
        let record = Record { evaluations: made.to_vec(), ..Record::default() };
        assert_eq!(measured(&evaluations(&record)), (Some("mean_return"), vec![1.0, 2.0]));
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
