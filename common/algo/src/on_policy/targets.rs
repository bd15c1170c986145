//! Once per batch, with the weights that rolled it: what the losses compare with.

use super::{ValueRows, loss::Buffers};
use crate::{
    Rows, UpdateConfig,
    estimators::{gae, value_norm::ValueNorm},
};
use rit_episode::{End, Episode};
use rit_nn::View;

/// What one set of weights said about an episode. With v values a state: 1, or one for each agent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Said {
    /// `[T, n, A]`.
    pub logits: Vec<f32>,
    /// log π of the actions taken, `[T, n]`.
    pub log_probs: Vec<f32>,
    /// `[T, n]`.
    pub entropies: Vec<f32>,
    /// In normalised units, `[T + 1, v]`: 0 after the last step where no target needs them.
    pub values: Vec<f32>,
}

/// What an episode's losses compare with, fixed for all epochs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Targets {
    /// What the weights said that rolled the episode.
    pub old: Said,
    /// A of each value, `[T, v]`.
    pub advantages: Vec<f64>,
    /// A + V, `[T, v]`.
    pub returns: Vec<f64>,
    /// Â: A normalised over the batch, `[T, v]`.
    pub normalized_advantages: Vec<f32>,
    /// Returns in the value network's units, `[T, v]`.
    pub value_targets: Vec<f32>,
    /// Whether there was a choice: two actions at least, `[T, n]`.
    pub chooses: Vec<bool>,
    /// Agents.
    pub n_agents: usize,
}

impl Targets {
    /// Values a state.
    pub(super) fn values_per_state(&self) -> usize {
        self.value_targets.len() * self.n_agents / self.chooses.len()
    }
}

/// What was said about each of a shard's episodes, put together from its rows.
pub(super) fn said(
    episodes: &[&Episode],
    rows: &Rows,
    value_rows: ValueRows,
    logits: View<'_>,
    values: &[f32],
    policy: &Buffers,
) -> Vec<Said> {
    let mut all = vec![Said::default(); episodes.len()];
    // Groups lie in the order of time, so every episode's states come in theirs.
    for (at, (group, step)) in rows.groups.iter().zip(&rows.steps).enumerate() {
        let said = &mut all[step.episode];
        match value_rows {
            ValueRows::States => said.values.push(values[at]),
            ValueRows::Agents => said.values.extend_from_slice(&values[group.queries.clone()]),
        }
        if step.filled {
            for row in group.queries.clone() {
                said.logits.extend_from_slice(logits.row(row));
                said.log_probs.push(policy.log_prob(rows, row));
                said.entropies.push(policy.entropies[row]);
            }
        }
    }
    for (said, episode) in all.iter_mut().zip(episodes) {
        let per_state = match value_rows {
            ValueRows::States => 1,
            ValueRows::Agents => episode.n_agents,
        };
        said.values.resize((episode.steps() + 1) * per_state, 0.0);
    }
    all
}

/// Advantages, returns and value targets of a batch; takes its returns into the value normaliser.
pub(super) fn of_batch(
    batch: &[&Episode],
    said: Vec<Said>,
    n_actions: usize,
    config: &UpdateConfig,
    value_norm: &mut ValueNorm,
) -> Vec<Targets> {
    let mut all: Vec<Targets> = batch
        .iter()
        .zip(said)
        .map(|(episode, said)| of_episode(episode, said, n_actions, config, value_norm))
        .collect();

    // Averages are taken in f64, in the batch's order.
    let returns = all.iter().flat_map(|targets| &targets.returns);
    let count = returns.clone().count().max(1) as f64;
    let average = returns.clone().sum::<f64>() / count;
    let average_square = returns.map(|x| x * x).sum::<f64>() / count;
    value_norm.update(average, average_square, config.ppo.value_norm_beta);

    let moments = gae::mean_and_deviation(all.iter().flat_map(choosing_advantages));
    for targets in &mut all {
        let normalized =
            targets.advantages.iter().map(|&advantage| gae::normalized(advantage, moments) as f32);
        targets.normalized_advantages = normalized.collect();
        targets.value_targets = targets.returns.iter().map(|&x| value_norm.normalized(x) as f32).collect();
    }
    all
}

/// The advantage of each choice.
fn choosing_advantages(targets: &Targets) -> impl Iterator<Item = f64> + Clone {
    let (n, steps) = (targets.n_agents, targets.chooses.len() / targets.n_agents);
    let per_state = targets.advantages.len() / steps;
    let choosing = targets.chooses.iter().enumerate().filter(|(_, chooses)| **chooses);
    choosing.map(move |(row, _)| targets.advantages[row / n * per_state + (row % n).min(per_state - 1)])
}

/// All that needs no other episode; values are still in the normaliser's units as it stands.
fn of_episode(
    episode: &Episode,
    old: Said,
    n_actions: usize,
    config: &UpdateConfig,
    value_norm: &ValueNorm,
) -> Targets {
    let (n, steps) = (episode.n_agents, episode.steps());
    let per_state = old.values.len() / (steps + 1);
    let rewards: Vec<f32> = episode.rewards.iter().zip(&episode.shaping).map(|(a, b)| a + b).collect();
    let (mut advantages, mut returns) = (vec![0.0; steps * per_state], vec![0.0; steps * per_state]);
    for of_agent in 0..per_state {
        let value = |time: usize| value_norm.denormalized(old.values[time * per_state + of_agent]);
        let values: Vec<f64> = (0..steps).map(value).collect();
        let bootstrap = if episode.end == End::Terminated { 0.0 } else { value(steps) };
        let along = gae::advantages(&rewards, &values, bootstrap, config.gamma.into(), config.ppo.gae_lambda);
        for (time, (advantage, value)) in along.into_iter().zip(values).enumerate() {
            advantages[time * per_state + of_agent] = advantage;
            returns[time * per_state + of_agent] = gae::lambda_return(advantage, value);
        }
    }
    let available = episode.available.chunks_exact(n_actions).take(steps * n);
    let chooses = available.map(|flags| flags.iter().filter(|&&flag| flag != 0).count() >= 2);
    Targets { chooses: chooses.collect(), old, advantages, returns, n_agents: n, ..Targets::default() }
}
