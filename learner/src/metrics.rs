//! What is measured while training: `metrics.jsonl`, one object a line, and how episodes went of late.

use crate::{checkpoint::Progress, evaluation::TaskResult};
use rit_algo::Losses;
use rit_episode::Episode;
use serde::Serialize;
use std::{
    collections::{BTreeMap, VecDeque},
    fs::{File, OpenOptions},
    io::{self, Write as _},
    path::Path,
    time::Instant,
};

/// Episodes of each task that count as of late.
const RECENT: usize = 100;

/// How exploring episodes of each training task went of late.
#[derive(Debug)]
pub struct Recent {
    tasks: Vec<String>,
    has_wins: bool,
    /// (return, won), the newest last, by task.
    episodes: Vec<VecDeque<(f64, bool)>>,
}

impl Recent {
    /// Of tasks with these names, which know winning or not.
    pub fn new(tasks: Vec<String>, has_wins: bool) -> Self {
        let episodes = tasks.iter().map(|_| VecDeque::with_capacity(RECENT)).collect();
        Self { tasks, has_wins, episodes }
    }

    /// Counts an episode.
    pub fn push(&mut self, episode: &Episode) {
        let Some(recent) = self.episodes.get_mut(episode.task) else { return };
        if recent.len() == RECENT {
            recent.pop_front();
        }
        recent.push_back((episode.total_reward(), episode.won));
    }

    /// Means by task, of those that had an episode.
    pub fn results(&self) -> Vec<TaskResult> {
        let tasks = self.tasks.iter().zip(&self.episodes).filter(|(_, recent)| !recent.is_empty());
        tasks
            .map(|(task, recent)| {
                let count = recent.len() as f64;
                let won = recent.iter().filter(|(_, won)| *won).count() as f64;
                TaskResult {
                    task: task.clone(),
                    episodes: recent.len() as u64,
                    mean_return: recent.iter().map(|(total, _)| total).sum::<f64>() / count,
                    win_rate: self.has_wins.then_some(won / count),
                }
            })
            .collect()
    }
}

/// Results by task, as they stand in metrics and in the summary.
pub fn by_task(results: &[TaskResult]) -> BTreeMap<&str, &TaskResult> {
    results.iter().map(|result| (result.task.as_str(), result)).collect()
}

/// One line of `metrics.jsonl`.
#[derive(Debug, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Line<'a> {
    /// How training goes.
    Training {
        /// How far it has come.
        #[serde(flatten)]
        progress: Progress,
        /// Seconds since the learner started.
        wall_s: f64,
        /// ε of the episodes handed out now.
        epsilon: f64,
        /// Losses of the last update.
        #[serde(flatten)]
        losses: LossLine,
        /// Exploring episodes of late.
        tasks: BTreeMap<&'a str, &'a TaskResult>,
    },
    /// A greedy evaluation.
    Evaluation {
        /// How far training had come.
        #[serde(flatten)]
        progress: Progress,
        /// Seconds since the learner started.
        wall_s: f64,
        /// Its results.
        tasks: BTreeMap<&'a str, &'a TaskResult>,
    },
}

/// Losses as they stand in a line.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct LossLine {
    td_loss: f64,
    contrastive_loss: f64,
    grad_norm: f64,
    q_total_mean: f64,
    target_mean: f64,
}

impl From<Losses> for LossLine {
    fn from(losses: Losses) -> Self {
        let Losses { td_loss, contrastive_loss, grad_norm, q_total_mean, target_mean } = losses;
        Self { td_loss, contrastive_loss, grad_norm, q_total_mean, target_mean }
    }
}

/// Writes `metrics.jsonl`.
#[derive(Debug)]
pub struct MetricsFile {
    file: File,
    started: Instant,
}

impl MetricsFile {
    /// Begins or continues the file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self { file: OpenOptions::new().create(true).append(true).open(path)?, started: Instant::now() })
    }

    /// Seconds since it was opened.
    pub fn wall_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Writes a line at once, so that whoever follows the file sees it whole.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&mut self, line: &Line<'_>) -> io::Result<()> {
        let mut text = serde_json::to_vec(line)?;
        text.push(b'\n');
        self.file.write_all(&text)
    }
}
