//! Episodes as tensors; `deploy/docs/export.md` lists them.

use crate::player::Player;
use rit_env::Task;
use rit_episode::{End, Episode, RunSeed};
use rit_policy::TaskNames;
use safetensors::{Dtype, SafeTensorError, tensor::TensorView};
use serde_json::json;
use std::collections::HashMap;

/// What this build writes. Raise it when a tensor or a key changes its meaning.
const FORMAT_VERSION: u32 = 1;

/// Episodes of one task, one after another. With N episodes of T_i steps, S = Σ T_i, and n agents, m entities, f features
/// and A actions of the task. Agents are in the environment's own order.
pub struct Recorded {
    task: Task,
    /// `[S + N, m, f]`: an episode has a state more than steps.
    features: Vec<f32>,
    /// `[S + N, n, m]`.
    observable: Vec<u8>,
    /// `[S + N, n, A]`.
    available: Vec<u8>,
    /// `[S, n]`.
    actions: Vec<u8>,
    /// `[S]`.
    rewards: Vec<f32>,
    /// `[N]`.
    steps: Vec<i64>,
    /// `[N]`.
    terminated: Vec<u8>,
    /// `[N]`.
    won: Vec<u8>,
    /// `[N, n]`.
    decision_order: Vec<u8>,
}

impl Recorded {
    /// No episode yet.
    pub fn new(task: Task) -> Self {
        Self {
            task,
            features: Vec::new(),
            observable: Vec::new(),
            available: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            steps: Vec::new(),
            terminated: Vec::new(),
            won: Vec::new(),
            decision_order: Vec::new(),
        }
    }

    /// Adds an episode.
    pub fn push(&mut self, episode: &Episode) {
        let mut rows: Vec<usize> = (0..episode.n_agents).collect();
        rows.sort_by_key(|&row| episode.decision_order[row]);
        let own = episode.reordered(&rows);
        let spec = self.task.spec();
        // Last actions follow the features; they are among the actions already.
        let features = own.entities.chunks_exact(spec.entity_dim()).flat_map(|row| &row[..spec.feature_dim]);
        self.features.extend(features);
        self.observable.extend(&own.observable);
        self.available.extend(&own.available);
        self.actions.extend(&own.actions);
        self.rewards.extend(&own.rewards);
        self.steps.push(own.steps() as i64);
        self.terminated.push(u8::from(own.end == End::Terminated));
        self.won.push(u8::from(own.won));
        self.decision_order.extend(&episode.decision_order);
    }

    /// Steps of all episodes.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }

    /// Mean over episodes of what the team earned.
    pub fn mean_return(&self) -> f64 {
        let total: f64 = self.rewards.iter().map(|&reward| f64::from(reward)).sum();
        total / self.steps.len().max(1) as f64
    }

    /// Name, type, shape and bytes of each tensor.
    fn tensors(&self) -> [(&'static str, Dtype, Vec<usize>, Vec<u8>); 9] {
        let (spec, episodes, steps) = (self.task.spec(), self.steps.len(), self.steps());
        let (n, m, states) = (spec.n_agents, spec.n_entities, steps + episodes);
        let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let counts = self.steps.iter().flat_map(|steps| steps.to_le_bytes()).collect();
        [
            ("features", Dtype::F32, vec![states, m, spec.feature_dim], floats(&self.features)),
            ("observable", Dtype::BOOL, vec![states, n, m], self.observable.clone()),
            ("available", Dtype::BOOL, vec![states, n, spec.n_actions], self.available.clone()),
            ("actions", Dtype::U8, vec![steps, n], self.actions.clone()),
            ("rewards", Dtype::F32, vec![steps], floats(&self.rewards)),
            ("steps", Dtype::I64, vec![episodes], counts),
            ("terminated", Dtype::BOOL, vec![episodes], self.terminated.clone()),
            ("won", Dtype::BOOL, vec![episodes], self.won.clone()),
            ("decision_order", Dtype::U8, vec![episodes, n], self.decision_order.clone()),
        ]
    }
}

/// The file's bytes.
///
/// # Errors
/// Never for episodes of our own making.
pub fn encode(all: &[Recorded], player: &Player, seed: RunSeed) -> Result<Vec<u8>, SafeTensorError> {
    let TaskNames { task_set, features, actions } = TaskNames::of(&player.config);
    let description = json!({
        "format_version": FORMAT_VERSION,
        "task_set": task_set,
        "tasks": all.iter().map(|recorded| recorded.task.to_string()).collect::<Vec<_>>(),
        "feature_names": features,
        "action_names": actions,
        "policy": player.name,
        "weights_digest": player.weights_digest,
        "seed": seed.0,
    });
    let named: Vec<_> = all
        .iter()
        .flat_map(|recorded| {
            recorded
                .tensors()
                .map(|(name, kind, shape, bytes)| (format!("{}.{name}", recorded.task), kind, shape, bytes))
        })
        .collect();
    let views = named.iter().map(|(name, kind, shape, bytes)| {
        TensorView::new(*kind, shape.clone(), bytes).map(|view| (name.as_str(), view))
    });
    let metadata = HashMap::from([("rit".to_owned(), description.to_string())]);
    safetensors::serialize(views.collect::<Result<Vec<_>, _>>()?, Some(metadata))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_env::TaskSet;

    /// Two steps of matrix game 2 with agent 1 deciding first: rows of the episode are agents 1 and 0.
    #[test]
    fn rows_are_the_environments_agents_without_their_last_actions() {
        let task = TaskSet::MatrixGame.task("game-2").unwrap();
        let row = |player: usize, step: f32, last: Option<usize>| {
            let mut row = vec![0.0; 6];
            row[player] = 1.0;
            row[2] = step;
            last.into_iter().for_each(|action| row[3 + action] = 1.0);
            row
        };
        let states = [
            [row(1, 0.0, None), row(0, 0.0, None)],
            [row(1, 1.0, Some(2)), row(0, 1.0, Some(0))],
            [row(1, 2.0, Some(1)), row(0, 2.0, Some(0))],
        ];
        let episode = Episode {
            number: 0,
            weights_version: 0,
            task: 0,
            n_agents: 2,
            n_entities: 2,
            decision_order: vec![1, 0],
            entities: states.concat().concat(),
            observable: [[1, 0, 1, 1]; 3].concat(),
            available: [[1, 1, 1, 1, 1, 0]; 3].concat(),
            actions: vec![2, 0, 1, 0],
            rewards: vec![-6.0, -12.0],
            shaping: vec![0.0; 2],
            end: End::Terminated,
            won: false,
        };
        let mut recorded = Recorded::new(task);
        recorded.push(&episode);
        recorded.push(&episode);
        assert_eq!(recorded.features[..6], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert_eq!(recorded.features[12..18], [1.0, 0.0, 2.0, 0.0, 1.0, 2.0]);
        assert_eq!(recorded.observable[..4], [1, 1, 0, 1], "agent 1 does not see agent 0");
        assert_eq!(recorded.available[..6], [1, 1, 0, 1, 1, 1]);
        assert_eq!(recorded.actions, [0, 2, 0, 1, 0, 2, 0, 1]);
        assert_eq!((recorded.steps(), recorded.mean_return()), (4, -18.0));
        for (name, kind, shape, bytes) in recorded.tensors() {
            let size = kind.bitsize() / 8;
            assert_eq!(shape.iter().product::<usize>() * size, bytes.len(), "{name}");
        }
    }
}
