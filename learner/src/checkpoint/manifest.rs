//! `checkpoint.json`, and what it has to say for training to go on from it.

use super::Origin;
use crate::{ledger::Terms, metrics::RECENT, tensorboard::Position};
use rit_config::Algorithm;
use rit_record::{Best, Exploring, Progress, TaskResult};
use serde::{Deserialize, Serialize};

/// Beyond all that is trained: sums of so many steps do not overflow.
const ENV_STEPS_LIMIT: u64 = 1 << 53;

/// The small part of a checkpoint, as it stands in `checkpoint.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Whose checkpoint it is.
    #[serde(default)]
    pub origin: Origin,
    /// How far training has come. Optimiser steps are updates.
    #[serde(flatten)]
    pub progress: Progress,
    /// Environment steps before the last batch.
    #[serde(default)]
    pub env_steps_before: u64,
    /// Collected episodes when the target network was last copied.
    pub target_copied_at: u64,
    /// What the next batches are rolled with, in order.
    pub terms: Vec<Terms>,
    /// Versions and environment steps of the acting weights kept.
    pub snapshots: Vec<SnapshotMark>,
    /// (return, won) of exploring episodes of late, by task.
    pub recent: Vec<Vec<(f64, bool)>>,
    /// Exploring episodes on the whole, by task.
    #[serde(default)]
    pub exploring: Vec<Exploring>,
    /// Length of `metrics.jsonl`, in bytes.
    pub metrics_len: u64,
    /// How far TensorBoard's event files go.
    #[serde(default)]
    pub tensorboard: Position,
    /// Seconds the learner has run.
    pub wall_s: f64,
    /// Seconds of processor time that the run's processes have taken.
    #[serde(default)]
    pub cpu_s: f64,
    /// The newest scheduled evaluation: task by task, means alone.
    pub evaluation: Option<(Progress, Vec<(String, TaskResult)>)>,
    /// The best policy so far, where it is kept.
    #[serde(default)]
    pub best: Option<Best>,
    /// Digest of the weights.
    pub weights_digest: String,
}

/// Names one of the acting weights kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SnapshotMark {
    /// Updates that made them.
    pub version: u64,
    /// Environment steps collected by then.
    pub env_steps: u64,
}

impl Manifest {
    /// Whether training of so many tasks can go on from here: what it says is said in SHA256SUMS too, but a person
    /// may have written both.
    ///
    /// # Errors
    /// What does not fit.
    pub fn check(&self, tasks: usize, algorithm: &Algorithm) -> Result<(), String> {
        let Progress { env_steps, episodes, updates } = self.progress;
        let batches = episodes / algorithm.n_rollout_threads as u64;
        let fits = |holds: bool, what: String| if holds { Ok(()) } else { Err(what) };
        fits(
            env_steps <= ENV_STEPS_LIMIT,
            format!("env_steps = {env_steps} is out of range 0..={ENV_STEPS_LIMIT}"),
        )?;
        fits(episodes <= env_steps, format!("{episodes} episodes do not fit into {env_steps} steps"))?;
        fits(
            episodes.is_multiple_of(algorithm.n_rollout_threads as u64),
            format!("{episodes} episodes are no whole batches of {}", algorithm.n_rollout_threads),
        )?;
        fits(updates <= batches, format!("{updates} updates are more than {batches} batches"))?;
        fits(
            self.target_copied_at <= episodes,
            format!("target_copied_at = {} lies after {episodes} episodes", self.target_copied_at),
        )?;
        self.check_snapshots(algorithm.policy_lag + 1)?;
        fits(self.recent.len() == tasks, format!("recent has {} tasks, not {tasks}", self.recent.len()))?;
        fits(
            self.recent.iter().all(|window| window.len() <= RECENT),
            format!("recent has more than {RECENT} episodes of a task"),
        )?;
        fits(
            self.exploring.iter().all(|task| task.episodes_total <= episodes),
            format!("exploring has more episodes of a task than {episodes}"),
        )
    }

    /// Each open batch's acting weights are kept, and no others than those of the last updates.
    fn check_snapshots(&self, open_batches: usize) -> Result<(), String> {
        let versions: Vec<u64> = self.snapshots.iter().map(|mark| mark.version).collect();
        if versions.len() > open_batches
            || !versions.is_sorted_by(|a, b| a < b)
            || versions.last() != Some(&self.progress.updates)
        {
            let updates = self.progress.updates;
            return Err(format!("snapshots are not the last, up to {open_batches}, of {updates} updates"));
        }
        if self.terms.len() != open_batches {
            return Err(format!("terms are those of {} batches, not {open_batches}", self.terms.len()));
        }
        for Terms { weights_version, epsilon } in &self.terms {
            if !versions.contains(weights_version) {
                return Err(format!("terms name weights {weights_version}, which snapshots do not"));
            }
            if !(0.0..=1.0).contains(epsilon) {
                return Err(format!("epsilon = {epsilon} is out of range 0..=1"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Six episodes in batches of two, the last three with an update each, one batch ahead.
    fn manifest() -> Manifest {
        let terms = |weights_version| Terms { weights_version, epsilon: 0.5 };
        let mark = |version| SnapshotMark { version, env_steps: 4 * version };
        Manifest {
            progress: Progress { env_steps: 12, episodes: 6, updates: 3 },
            target_copied_at: 4,
            terms: vec![terms(2), terms(3)],
            snapshots: vec![mark(2), mark(3)],
            recent: vec![vec![(1.0, true); RECENT], vec![]],
            ..Manifest::default()
        }
    }

    fn check(change: impl FnOnce(&mut Manifest)) -> Result<(), String> {
        let settings = ["n_rollout_threads=2", "policy_lag=1"].map(|key| format!("algorithm.{key}"));
        let settings = settings.map(|setting| rit_config::set(&setting).unwrap());
        let config = rit_config::resolve("environment.task_set = 'matrix-game'", "test", &settings).unwrap();
        let mut manifest = manifest();
        change(&mut manifest);
        manifest.check(2, &config.algorithm)
    }

    #[test]
    fn what_training_cannot_go_on_from_is_named() {
        assert_eq!(check(|_| ()), Ok(()));
        let refused = |change: fn(&mut Manifest)| check(change).unwrap_err();
        assert_eq!(
            refused(|m| m.progress.env_steps = u64::MAX),
            format!("env_steps = {} is out of range 0..={ENV_STEPS_LIMIT}", u64::MAX)
        );
        assert_eq!(refused(|m| m.progress.episodes = 14), "14 episodes do not fit into 12 steps");
        assert_eq!(refused(|m| m.progress.episodes = 7), "7 episodes are no whole batches of 2");
        assert_eq!(refused(|m| m.progress.updates = 4), "4 updates are more than 3 batches");
        assert_eq!(refused(|m| m.target_copied_at = 7), "target_copied_at = 7 lies after 6 episodes");
        assert_eq!(refused(|m| m.recent.clear()), "recent has 0 tasks, not 2");
        assert_eq!(
            refused(|m| m.recent[0].push((0.0, false))),
            "recent has more than 100 episodes of a task"
        );
        assert_eq!(
            refused(|m| m.exploring = vec![Exploring { episodes_total: 7, policy_lag: 1 }]),
            "exploring has more episodes of a task than 6"
        );
        assert_eq!(refused(|m| m.terms.clear()), "terms are those of 0 batches, not 2");
        assert_eq!(
            refused(|m| m.terms[0].weights_version = 1),
            "terms name weights 1, which snapshots do not"
        );
        assert_eq!(refused(|m| m.terms[1].epsilon = 1.5), "epsilon = 1.5 is out of range 0..=1");
        let snapshots = "snapshots are not the last, up to 2, of 3 updates";
        assert_eq!(refused(|m| m.snapshots.clear()), snapshots);
        assert_eq!(refused(|m| m.snapshots.reverse()), snapshots);
        assert_eq!(refused(|m| m.snapshots[0].version = 3), snapshots);
        assert_eq!(refused(|m| m.snapshots.insert(0, SnapshotMark { version: 0, env_steps: 0 })), snapshots);
    }
}
