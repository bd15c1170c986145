//! A whole run, as it is read again.

use crate::{
    Best, Build, Ended, Evaluation, Header, Host, Line, Lines, MeasureHelp, Occasion, Progress, RecordError,
    Run, Shapley, Summary, TrainingPoint,
    committed::{self, Committed},
    shapley,
};
use rit_config::{Config, RunDir, completed, is_free};
use rit_env::Split;
use serde_json::{Map, Value};
use std::{
    collections::BTreeMap,
    fmt,
    path::{Path, PathBuf},
};

/// From one evaluation of the training tasks to the next, in environment steps.
const INTERVAL: &str = "evaluation.every_env_steps";
/// The same of the testing tasks; 0 for never.
const TESTING_INTERVAL: &str = "evaluation.testing_every_env_steps";

/// What a run has left, in a run directory or as a committed record.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Record {
    /// Where it lies: the run directory, or the committed record's `.jsonl`.
    pub path: PathBuf,
    /// As it was given.
    pub name: String,
    /// The folder that a committed record lies in, by its name; the run directory's name otherwise.
    pub folder: String,
    /// Whose metrics file it is, in hexadecimal; of a copied run the first one's. Older files do not say so.
    pub run_id: Option<String>,
    /// Every `section.key` with its value, texts without quotation marks; empty where a record does not say.
    pub settings: BTreeMap<String, String>,
    /// What makes runs comparable, key by key: the settings that results follow from, but for the seed, and how often the
    /// run is evaluated. Of a record without settings what it shows of that: its folder, its tasks, how often.
    pub kind: BTreeMap<String, String>,
    /// The run's seed; where no settings say it, that of a name such as `seed-3`.
    pub seed: Option<u64>,
    /// The program that trained last, as far as is known.
    pub build: Option<Build>,
    /// Where it trained.
    pub host: Option<Host>,
    /// Numbers that are trained.
    pub parameters: Option<u64>,
    /// What updates report.
    pub measures: Vec<MeasureHelp>,
    /// How far training came.
    pub progress: Progress,
    /// Seconds that learners ran.
    pub wall_s: Option<f64>,
    /// Seconds of processor time that all processes took.
    pub cpu_s: Option<f64>,
    /// How the run ended; none of one that is alive or was killed.
    pub ended: Option<Ended>,
    /// Why it failed, if it did.
    pub reason: Option<String>,
    /// SHA-256 of the final weights.
    pub weights_digest: Option<String>,
    /// How training went.
    pub training: Vec<TrainingPoint>,
    /// All evaluations, in the order they were made.
    pub evaluations: Vec<Evaluation>,
    /// The best policy, where it is kept.
    pub best: Option<Best>,
    /// Utilities beside Shapley values, for each task that was compared.
    pub shapley: Vec<Shapley>,
    /// Lines that cannot be read.
    pub broken_lines: usize,
    /// Lines of kinds that this build does not know.
    pub other_lines: Vec<Map<String, Value>>,
    /// What the summary says that this build does not know.
    pub other: Map<String, Value>,
}

impl Record {
    /// Reads a run directory or its metrics.jsonl, or a committed record by either of its files.
    ///
    /// # Errors
    /// When there is none, or it is of another format.
    pub fn read(given: &Path) -> Result<Self, RecordError> {
        let name = given.display().to_string();
        let record = if given.is_dir() {
            Self::of_run_dir(given)?
        } else {
            let metrics = given.with_extension("jsonl");
            let folder = metrics.parent().filter(|folder| !folder.as_os_str().is_empty());
            match folder.unwrap_or(Path::new(".")) {
                folder if folder.join("config.toml").exists() => Self::of_run_dir(folder)?,
                _ if metrics.exists() => Self::committed(&metrics)?,
                _ => return Err(RecordError::None(given.to_owned())),
            }
        };
        Ok(Self { name, ..record })
    }

    fn of_run_dir(root: &Path) -> Result<Self, RecordError> {
        let (run_dir, config) = RunDir::open(root)?;
        let mut record = Self { path: run_dir.root().to_owned(), ..Self::default() };
        let metrics = run_dir.metrics();
        if metrics.exists() {
            record.take_lines(&metrics)?;
        }
        record.take_settings(settings(&run_dir, &config)?);
        let summary = Summary::read(&run_dir).map_err(RecordError::io(run_dir.summary()))?;
        summary.into_iter().for_each(|summary| record.take_summary(summary));
        record.folder = file_name(&record.path);
        record.shapley = shapley::of_run_dir(root)?;
        Ok(record)
    }

    fn committed(metrics: &Path) -> Result<Self, RecordError> {
        let path = metrics.canonicalize().map_err(RecordError::io(metrics))?;
        let folder = path.parent().map(file_name).unwrap_or_default();
        let mut record = Self { path, folder, ..Self::default() };
        record.take_lines(metrics)?;
        let Committed { summary, testing } = committed::read(&metrics.with_extension("json"))?;
        for tasks in testing {
            let progress = summary.as_ref().map_or(record.progress, |summary| summary.progress);
            let (occasion, split) = (Occasion::Final, Split::Testing);
            record.evaluations.push(Evaluation { progress, occasion, split, tasks, ..Evaluation::default() });
        }
        summary.into_iter().for_each(|summary| record.take_summary(summary));
        record.shapley = shapley::of_committed(metrics)?;
        let stem = metrics.file_stem().unwrap_or_default().to_string_lossy();
        if record.settings.is_empty() {
            record.take_settings(committed::folder_settings(metrics)?);
        }
        if record.settings.is_empty() {
            record.kind = record.shown_kind();
        }
        record.seed = record.seed.or_else(|| stem.rsplit_once("seed-")?.1.parse().ok());
        Ok(record)
    }

    fn take_lines(&mut self, metrics: &Path) -> Result<(), RecordError> {
        let mut lines = Lines::open(metrics)?;
        if let Some(Header { run_id, run, .. }) = lines.header().cloned() {
            self.run_id = Some(run_id);
            if let Some(Run { settings, build, host, parameters, measures }) = run {
                (self.build, self.host, self.parameters) = (Some(build), Some(host), Some(parameters));
                self.measures = measures;
                self.take_settings(settings);
            }
        }
        while let Some(line) = lines.next_line()? {
            self.progress = line.progress().unwrap_or(self.progress);
            match line {
                Line::Training(point) => {
                    self.wall_s = Some(point.wall_s);
                    self.training.push(point);
                }
                Line::Evaluation(evaluation) => self.evaluations.push(evaluation),
                Line::Other(line) => self.other_lines.push(line),
            }
        }
        self.broken_lines = lines.broken();
        Ok(())
    }

    fn take_settings(&mut self, settings: BTreeMap<String, String>) {
        self.seed = settings.get("seed").and_then(|seed| seed.parse().ok());
        let of_kind = |(key, _): &(&String, &String)| (!is_free(key) && *key != "seed") || *key == INTERVAL;
        let kind = completed(settings.clone()).into_iter();
        self.kind = kind.filter(|(key, value)| of_kind(&(key, value))).collect();
        self.settings = settings;
    }

    fn take_summary(&mut self, summary: Summary) {
        let Summary { ended, reason, progress, wall_s, cpu_s, build, host, .. } = summary;
        (self.ended, self.reason, self.progress) = (Some(ended), reason, progress);
        (self.wall_s, self.cpu_s) = (Some(wall_s), cpu_s);
        self.build = build.or_else(|| self.build.take());
        self.host = host.or_else(|| self.host.take());
        (self.weights_digest, self.best, self.other) = (summary.weights_digest, summary.best, summary.other);
        // Builds that did not write the final evaluations one by one wrote their means here.
        for (split, tasks) in [(Split::Training, summary.evaluation), (Split::Testing, summary.testing)] {
            if !tasks.is_empty() && self.latest(Occasion::Final, split).is_none() {
                let (wall_s, occasion) = (wall_s, Occasion::Final);
                self.evaluations.push(Evaluation {
                    progress,
                    wall_s,
                    occasion,
                    split,
                    tasks,
                    ..Evaluation::default()
                });
            }
        }
    }

    /// `algorithm.name`, where the record says it.
    pub fn method(&self) -> Option<&str> {
        self.settings.get("algorithm.name").map(String::as_str)
    }

    /// `environment.task_set`, where the record says it.
    pub fn task_set(&self) -> Option<&str> {
        self.settings.get("environment.task_set").map(String::as_str)
    }

    /// `training.t_max`, where the record says it.
    pub fn env_steps_max(&self) -> Option<u64> {
        self.settings.get("training.t_max")?.parse().ok()
    }

    /// Whether all was done that was to be done.
    pub fn is_whole(&self) -> bool {
        self.ended.is_some_and(Ended::is_whole)
    }

    /// Names of the tasks of one split that were ever evaluated.
    pub fn tasks(&self, split: Split) -> Vec<&str> {
        let of_split = self.evaluations.iter().filter(|evaluation| evaluation.split == split);
        let mut names: Vec<&str> =
            of_split.flat_map(|evaluation| evaluation.tasks.keys().map(String::as_str)).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Scheduled evaluations of one split, each with the environment steps that it was due at: episodes that end early make
    /// it a few steps later, and differently from run to run.
    pub fn curve(&self, split: Split) -> Vec<(u64, &Evaluation)> {
        let scheduled: Vec<&Evaluation> = self
            .evaluations
            .iter()
            .filter(|it| it.split == split && it.occasion == Occasion::Scheduled)
            .collect();
        let interval = self.interval(split).unwrap_or_else(|| usual_gap(&scheduled)).max(1);
        let due = |env_steps: u64| env_steps - env_steps % interval;
        scheduled.into_iter().map(|it| (due(it.progress.env_steps), it)).collect()
    }

    /// The newest evaluation of one split that was made for this reason.
    pub fn latest(&self, occasion: Occasion, split: Split) -> Option<&Evaluation> {
        self.evaluations.iter().rfind(|it| (it.occasion, it.split) == (occasion, split))
    }

    fn interval(&self, split: Split) -> Option<u64> {
        let interval = match split {
            Split::Training => self.kind.get(INTERVAL),
            Split::Testing => self.settings.get(TESTING_INTERVAL),
        };
        interval?.parse().ok()
    }

    /// What a file alone shows of its run: runs of one experiment lie in one folder, play the same tasks, and are
    /// evaluated as often.
    fn shown_kind(&self) -> BTreeMap<String, String> {
        let of_training: Vec<&Evaluation> =
            self.evaluations.iter().filter(|it| it.split == Split::Training).collect();
        let interval = usual_gap(&of_training).to_string();
        let tasks = self.tasks(Split::Training).join(", ");
        let facts = [("folder", self.folder.clone()), ("tasks", tasks), (INTERVAL, interval)];
        facts.map(|(key, value)| (key.to_owned(), value)).into()
    }
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

/// Every setting of a run as it is now.
pub(crate) fn settings(run_dir: &RunDir, config: &Config) -> Result<BTreeMap<String, String>, RecordError> {
    config
        .settings()
        .map_err(|error| rit_config::RunDirError::Config { path: run_dir.config_path(), error }.into())
}

fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}

/// Environment steps from most evaluations to the next; 1 where there is no next.
fn usual_gap(evaluations: &[&Evaluation]) -> u64 {
    let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
    for (before, after) in evaluations.iter().zip(evaluations.iter().skip(1)) {
        let gap = after.progress.env_steps.saturating_sub(before.progress.env_steps);
        *counts.entry(gap).or_default() += 1;
    }
    let most = counts.into_iter().max_by_key(|&(gap, count)| (count, std::cmp::Reverse(gap)));
    most.map_or(1, |(gap, _)| gap.max(1))
}
