//! The losses of a minibatch's rows, and their gradients by logits and values.

use super::{Targets, ValueRows};
use crate::{
    PpoConfig, Rows,
    estimators::{ppo, value_loss},
};
use rit_nn::{View, ViewMut, categorical};

/// How many rows a minibatch's means are over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counts {
    /// (Step, agent) pairs with a choice.
    choosing: usize,
    /// Values.
    values: usize,
}

impl Counts {
    pub(super) fn of<'a>(targets: impl Iterator<Item = &'a Targets>) -> Self {
        targets.fold(Self::default(), |sum, targets| Self {
            choosing: sum.choosing + targets.chooses.iter().filter(|&&chooses| chooses).count(),
            values: sum.values + targets.value_targets.len(),
        })
    }
}

/// Sums over rows, or means over them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sums {
    /// Clipped surrogate.
    pub policy_loss: f64,
    /// −Σ π log π.
    pub entropy: f64,
    /// Clipped Huber loss.
    pub value_loss: f64,
    /// ρ.
    pub ratio: f64,
    /// 1 where ρ is outside the clip.
    pub clipped: f64,
    /// Divergence of the policy from the one that acted.
    pub kl: f64,
}

impl Sums {
    pub(super) fn to_vec(self) -> Vec<f64> {
        vec![self.policy_loss, self.entropy, self.value_loss, self.ratio, self.clipped, self.kl]
    }

    /// From what [`Sums::to_vec`] made; zeros where there is less.
    pub(super) fn from_slice(numbers: &[f64]) -> Self {
        let number = |at: usize| numbers.get(at).copied().unwrap_or(0.0);
        Self {
            policy_loss: number(0),
            entropy: number(1),
            value_loss: number(2),
            ratio: number(3),
            clipped: number(4),
            kl: number(5),
        }
    }

    fn add(&mut self, other: &Self) {
        self.policy_loss += other.policy_loss;
        self.entropy += other.entropy;
        self.value_loss += other.value_loss;
        self.ratio += other.ratio;
        self.clipped += other.clipped;
        self.kl += other.kl;
    }

    /// From sums to means; a mean over no rows is 0.
    pub(super) fn divide(&mut self, counts: Counts) {
        let choosing = counts.choosing.max(1) as f64;
        let of_choices =
            [&mut self.policy_loss, &mut self.entropy, &mut self.ratio, &mut self.clipped, &mut self.kl];
        of_choices.into_iter().for_each(|sum| *sum /= choosing);
        self.value_loss /= counts.values.max(1) as f64;
    }
}

/// A shard's losses and what they are made of.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    pub(super) sums: Sums,
    n_actions: usize,
    /// π, `[R, A]`.
    probabilities: Vec<f32>,
    /// log π, `[R, A]`.
    log_probabilities: Vec<f32>,
    /// `[R]`.
    pub(super) entropies: Vec<f32>,
    d_log_prob: Vec<f32>,
    d_entropy: Vec<f32>,
    d_logits: Vec<f32>,
    d_values: Vec<f32>,
}

impl Buffers {
    /// The rows' policies. `logits` (R, A).
    pub(super) fn distribution(&mut self, rows: &Rows, logits: View<'_>) {
        let Self { n_actions, probabilities, log_probabilities, entropies, .. } = self;
        *n_actions = logits.cols;
        probabilities.resize(logits.rows * logits.cols, 0.0);
        log_probabilities.resize(logits.rows * logits.cols, 0.0);
        entropies.resize(logits.rows, 0.0);
        let probabilities = ViewMut::dense(probabilities, logits.cols);
        let log_probabilities = ViewMut::dense(log_probabilities, logits.cols);
        categorical::distribution(logits, &rows.available, probabilities, log_probabilities, entropies);
    }

    /// log π of the action taken.
    pub(super) fn log_prob(&self, rows: &Rows, row: usize) -> f32 {
        self.log_probabilities[row * self.n_actions + usize::from(rows.actions[row])]
    }

    /// The policy loss and the entropy, with the gradient by the logits.
    pub(super) fn policy(&mut self, rows: &Rows, targets: &[&Targets], config: &PpoConfig, counts: Counts) {
        let count = counts.choosing.max(1) as f64;
        self.d_log_prob.clear();
        self.d_entropy.clear();
        for (group, step) in rows.groups.iter().zip(&rows.steps) {
            let (targets, n) = (targets[step.episode], group.queries.len());
            for (agent, row) in group.queries.clone().enumerate() {
                if !(step.filled && targets.chooses[step.time * n + agent]) {
                    self.d_log_prob.push(0.0);
                    self.d_entropy.push(0.0);
                    continue;
                }
                let per_state = targets.values_per_state();
                let advantage = step.time * per_state + agent.min(per_state - 1);
                let advantage = targets.normalized_advantages[advantage];
                let old_log_prob = targets.old.log_probs[step.time * n + agent];
                let of_row = ppo::surrogate(self.log_prob(rows, row), old_log_prob, advantage, config.clip);
                self.sums.add(&Sums {
                    policy_loss: of_row.loss,
                    entropy: f64::from(self.entropies[row]),
                    value_loss: 0.0,
                    ratio: of_row.ratio,
                    clipped: f64::from(u8::from(of_row.clipped)),
                    kl: of_row.kl,
                });
                self.d_log_prob.push((of_row.slope / count) as f32);
                self.d_entropy.push((-config.entropy_coef / count) as f32);
            }
        }
        self.d_logits.resize(self.probabilities.len(), 0.0);
        categorical::distribution_backward(
            View::dense(&self.probabilities, self.n_actions),
            View::dense(&self.log_probabilities, self.n_actions),
            &self.entropies,
            &rows.actions,
            &self.d_log_prob,
            &self.d_entropy,
            ViewMut::dense(&mut self.d_logits, self.n_actions),
        );
    }

    /// The value loss, with its gradient by the values.
    pub(super) fn value(
        &mut self,
        rows: &Rows,
        value_rows: ValueRows,
        values: &[f32],
        targets: &[&Targets],
        config: &PpoConfig,
        counts: Counts,
    ) {
        let count = counts.values.max(1) as f64;
        self.d_values.clear();
        for (at, (group, step)) in rows.groups.iter().zip(&rows.steps).enumerate() {
            let of_group = match value_rows {
                ValueRows::States => at..at + 1,
                ValueRows::Agents => group.queries.clone(),
            };
            let first = step.time * of_group.len();
            for (agent, row) in of_group.enumerate() {
                if !step.filled {
                    self.d_values.push(0.0);
                    continue;
                }
                let (targets, index) = (targets[step.episode], first + agent);
                let (old_value, target) = (targets.old.values[index], targets.value_targets[index]);
                let (loss, slope) =
                    value_loss::clipped(values[row], old_value, target, config.clip, config.huber_delta);
                self.sums.value_loss += loss;
                self.d_values.push((config.value_coef * slope / count) as f32);
            }
        }
    }

    /// (R, A).
    pub(super) fn d_logits(&self) -> View<'_> {
        View::dense(&self.d_logits, self.n_actions)
    }

    /// (values, 1).
    pub(super) fn d_values(&self) -> View<'_> {
        View::dense(&self.d_values, 1)
    }
}
