//! Evaluations between updates: on schedule, at the end, and what they say of the best policy so far.

use super::{TrainError, Trainer, acting_params};
use rit_algo::Acting;
use rit_config::{Config, KeepBest};
use rit_env::{Split, rollout::LostEpisode};
use rit_episode::{Policy, RunSeed};
use rit_policy::weights_file;
use rit_record::{Best, Evaluation, Line, Occasion, TaskResult, in_words};

impl Trainer {
    /// The scheduled evaluation of the training tasks: always the same episodes, so that one curve's points
    /// differ by the weights alone.
    pub(super) fn evaluate(&mut self) -> Result<(), TrainError> {
        let progress = self.standing.progress;
        let results = self.greedy(Split::Training)?;
        self.record_evaluation(Occasion::Scheduled, Split::Training, &results)?;
        tracing::info!(env_steps = progress.env_steps, results = %in_words(&results), "evaluated");
        self.keep_if_best(&results);
        self.standing.evaluation = Some((progress, results.iter().map(TaskResult::means).collect()));
        self.evaluated = Some((progress, results));
        Ok(())
    }

    /// Keeps the policy if it is better than all before it; of equals the first is kept.
    fn keep_if_best(&mut self, results: &[TaskResult]) {
        let keep_best = self.config.checkpoints.keep_best;
        let Some(value) = measure(keep_best, results) else { return };
        if self.best.as_ref().is_some_and(|(best, _)| best.value >= value) {
            return;
        }
        let (measure, progress) = (keep_best.name().to_owned(), self.standing.progress);
        tracing::info!(env_steps = progress.env_steps, measure, value, "the best policy so far");
        let params = self.learner.params().to_vec();
        let weights_digest = weights_file::digest(&params);
        self.best = Some((Best { measure, value, progress, weights_digest, ..Best::default() }, params));
    }

    /// The scheduled evaluation of the testing tasks, if there are any: nothing is decided by it.
    pub(super) fn evaluate_testing(&mut self) -> Result<(), TrainError> {
        let results = self.greedy(Split::Testing)?;
        if !results.is_empty() {
            self.record_evaluation(Occasion::Scheduled, Split::Testing, &results)?;
            let env_steps = self.standing.progress.env_steps;
            tracing::info!(env_steps, results = %in_words(&results), "evaluated testing tasks");
        }
        Ok(())
    }

    pub(super) fn record_evaluation(
        &mut self,
        occasion: Occasion,
        split: Split,
        results: &[TaskResult],
    ) -> Result<(), TrainError> {
        let (progress, wall_s) = (self.standing.progress, self.metrics.wall_s());
        self.measured(&Line::Evaluation(Evaluation::new(progress, wall_s, occasion, split, results)))
    }

    /// The run's own greedy episodes of one split's tasks with the present weights.
    pub(super) fn greedy(&self, split: Split) -> Result<Vec<TaskResult>, LostEpisode> {
        self.roll(acting_params(&*self.learner), split, None, evaluation_seed(&self.config))
    }

    /// Greedy episodes, on all threads of updates, which have nothing to do meanwhile.
    pub(super) fn roll(
        &self,
        acting_params: &[f32],
        split: Split,
        episodes: Option<usize>,
        seed: RunSeed,
    ) -> Result<Vec<TaskResult>, LostEpisode> {
        let new = |_| Acting::new(&self.model, acting_params);
        let mut policies: Vec<_> = (0..self.config.learner.threads).map(new).collect();
        let mut policies: Vec<_> = policies.iter_mut().map(|policy| policy as &mut dyn Policy).collect();
        self.evaluator.evaluate(&mut policies, &self.config.tasks(split), episodes, seed)
    }
}

/// What a policy is the best by: the mean over tasks. None where none is kept, or what is no number.
fn measure(keep_best: KeepBest, results: &[TaskResult]) -> Option<f64> {
    let of_task = |result: &TaskResult| match keep_best {
        KeepBest::Never => None,
        KeepBest::MeanReturn => Some(result.mean_return),
        KeepBest::WinRate => result.win_rate,
    };
    let sum: f64 = results.iter().map(of_task).sum::<Option<f64>>()?;
    Some(sum / results.len() as f64).filter(|value| value.is_finite())
}

/// The seed of a run's own evaluations, scheduled or asked for without one.
pub fn evaluation_seed(config: &Config) -> RunSeed {
    config.seed.derive("evaluation", 0)
}
