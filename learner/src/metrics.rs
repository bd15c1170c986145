//! What is measured while training: `metrics.jsonl`, one object a line, and how episodes went of late.

use crate::{checkpoint::Progress, evaluation::TaskResult};
use rit_algo::Losses;
use rit_episode::Episode;
use serde::Serialize;
use std::{
    collections::{BTreeMap, VecDeque},
    fs::{File, OpenOptions},
    io::{self, Seek as _, SeekFrom, Write as _},
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

    /// What is counted: (return, won), the newest last, by task.
    pub fn windows(&self) -> Vec<Vec<(f64, bool)>> {
        self.episodes.iter().map(|recent| recent.iter().copied().collect()).collect()
    }

    /// Goes on with what was counted before.
    pub fn restore(&mut self, windows: Vec<Vec<(f64, bool)>>) {
        for (recent, window) in self.episodes.iter_mut().zip(windows) {
            *recent = window.into();
        }
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
    len: u64,
    started: Instant,
    /// Seconds that learners before this one ran.
    before_s: f64,
}

impl MetricsFile {
    /// Begins the file, or goes on behind its first `len` bytes: what lies behind them was written by a learner
    /// that died, and will be written again. `before_s` are the seconds that learners ran before.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn open(path: &Path, len: u64, before_s: f64) -> io::Result<Self> {
        let mut file = OpenOptions::new().create(true).truncate(false).write(true).open(path)?;
        file.set_len(len.min(file.metadata()?.len()))?;
        let len = file.seek(SeekFrom::End(0))?;
        Ok(Self { file, len, started: Instant::now(), before_s })
    }

    /// Seconds that learners have run, this one and those before.
    pub fn wall_s(&self) -> f64 {
        self.before_s + self.started.elapsed().as_secs_f64()
    }

    /// Bytes written.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether nothing is written yet.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Writes a line at once, so that whoever follows the file sees it whole. A failed write leaves the file as
    /// it was.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&mut self, line: &Line<'_>) -> io::Result<()> {
        let mut text = serde_json::to_vec(line)?;
        text.push(b'\n');
        if let Err(error) = self.file.write_all(&text) {
            self.file.set_len(self.len)?;
            self.file.seek(SeekFrom::Start(self.len))?;
            return Err(error);
        }
        self.len += text.len() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_resumed_file_forgets_what_the_dead_learner_wrote_last() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let line = |env_steps| Line::Evaluation {
            progress: Progress { env_steps, ..Progress::default() },
            wall_s: 0.0,
            tasks: BTreeMap::new(),
        };
        let mut first = MetricsFile::open(file.path(), 0, 0.0).unwrap();
        first.write(&line(1)).unwrap();
        let at_checkpoint = first.len();
        first.write(&line(2)).unwrap();
        let mut second = MetricsFile::open(file.path(), at_checkpoint, 100.0).unwrap();
        second.write(&line(3)).unwrap();
        assert!(second.wall_s() >= 100.0);
        let text = fs::read_to_string(file.path()).unwrap();
        let steps: Vec<_> =
            text.lines().map(|line| line.contains("\"env_steps\":1") || line.contains(":3")).collect();
        assert_eq!(steps, [true, true]);
        assert_eq!(second.len(), text.len() as u64);
    }
}
