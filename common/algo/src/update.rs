//! One training step: from a batch of episodes to new weights (paper, algorithm 1 and equation 5).
//!
//! The batch is cut into a fixed number of shards. Threads work on shards; sums over shards are taken in
//! their order. So the result depends on the number of shards, which is configuration, and not on threads.
//!
//! The contrastive loss couples all shards. So a step has three parts: task representations of every shard;
//! the contrastive loss over all of them; then everything else, shard by shard, forward and backward in one
//! go, while what the networks left is still in the cache.

mod pairs;
mod shard;

pub use shard::Seen;

use crate::{Rit, TerminalStates, contrastive};
use pairs::Pairs;
use rand::Rng;
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder, prelude::*};
use rit_episode::Episode;
use rit_nn::{Optimizer, OptimizerKind, math, optimizer, vectorized};
use shard::{Model, Shard, Workers};
use std::sync::Arc;

/// Constants of the update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateConfig {
    /// γ.
    pub gamma: f32,
    /// Learning rate.
    pub lr: f32,
    /// Which optimiser.
    pub optimizer: OptimizerKind,
    /// Gradients are scaled down to this norm.
    pub grad_norm_clip: f64,
    /// Parts the batch is cut into; at least 1. Part of the result.
    pub shards: usize,
    /// Threads that work on them; at least 1. Not part of the result.
    pub threads: usize,
    /// Whether states that no target needs are worked on. Not part of the result.
    pub terminal_states: TerminalStates,
}

/// What one update saw.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// L_TD.
    pub td_loss: f64,
    /// L_C; 0 without task representations.
    pub contrastive_loss: f64,
    /// ‖g‖ over all parameters, before clipping.
    pub grad_norm: f64,
    /// Mean Q_total over filled steps.
    pub q_total_mean: f64,
    /// Mean target over filled steps.
    pub target_mean: f64,
}

/// Weights under training, with everything an update needs.
pub struct Update {
    rit: Arc<Rit>,
    config: UpdateConfig,
    pool: ThreadPool,
    /// θ, ω, σ, φ.
    pub params: Vec<f32>,
    /// The target network's copy of θ, ω, σ.
    pub target: Vec<f32>,
    /// The optimiser and its moments.
    pub optimizer: Optimizer,
    grads: Vec<f32>,
    shards: Vec<Shard>,
    pairs: Pairs,
    workers: Workers,
}

impl Update {
    /// Training from these parameters on, with a target network that equals them.
    ///
    /// # Errors
    /// When the threads cannot be started.
    ///
    /// # Panics
    /// When `params` is not of the layout's length.
    pub fn new(rit: Arc<Rit>, config: UpdateConfig, params: Vec<f32>) -> Result<Self, ThreadPoolBuildError> {
        assert_eq!(params.len(), rit.layout.len(), "parameters of the layout's length");
        let pool = ThreadPoolBuilder::new()
            .num_threads(config.threads.max(1))
            .thread_name(|index| format!("update-{index}"))
            .build()?;
        Ok(Self {
            target: params[rit.target()].to_vec(),
            optimizer: Optimizer::new(config.optimizer, config.lr, params.len()),
            grads: vec![0.0; params.len()],
            shards: (0..config.shards.max(1)).map(|_| Shard::default()).collect(),
            pairs: Pairs::default(),
            workers: Workers::default(),
            rit,
            config,
            pool,
            params,
        })
    }

    /// The model.
    pub fn rit(&self) -> &Arc<Rit> {
        &self.rit
    }

    /// Copies the online weights into the target network.
    pub fn update_target(&mut self) {
        self.target.copy_from_slice(&self.params[self.rit.target()]);
    }

    /// One update on a batch; `rng` draws the contrastive loss's pairing.
    pub fn step(&mut self, batch: &[&Episode], rng: &mut (impl Rng + Send)) -> Losses {
        let losses = self.gradients(batch, |rows| contrastive::draw_pairing(rows, rng));
        self.apply(losses.grad_norm);
        losses
    }

    /// One step of the optimiser along the gradients that [`Update::gradients`] left, which are of this norm.
    pub fn apply(&mut self, grad_norm: f64) {
        let scale = optimizer::clip_scale(grad_norm, self.config.grad_norm_clip);
        self.optimizer.step(&mut self.params, &self.grads, scale);
    }

    /// Losses and gradients of a batch, without a step; `pairing` makes a permutation of so many rows.
    pub fn gradients(
        &mut self,
        batch: &[&Episode],
        pairing: impl FnOnce(usize) -> Vec<usize> + Send,
    ) -> Losses {
        self.gradients_seen(batch, pairing, |_| {})
    }

    /// As [`Self::gradients`], and shows `see` what the networks said: shard after shard in no particular order,
    /// from the threads that work on them.
    pub fn gradients_seen(
        &mut self,
        batch: &[&Episode],
        pairing: impl FnOnce(usize) -> Vec<usize> + Send,
        see: impl Fn(&mut dyn Iterator<Item = Seen<'_>>) + Sync,
    ) -> Losses {
        let filled: usize = batch.iter().map(|episode| episode.steps()).sum();
        let share = batch.len().div_ceil(self.shards.len()).max(1);
        let Self { rit, config, pool, params, target, grads, shards, pairs, workers, .. } = self;
        let (rit, config) = (&**rit, &*config);
        let tables = [rit.utility.decoder.tables(params), rit.utility.decoder.tables(target)];
        let online = Model { rit, params, tables: &tables[0] };
        let target = Model { rit, params: target, tables: &tables[1] };
        let part = |shard: usize| (shard * share).min(batch.len())..((shard + 1) * share).min(batch.len());
        pool.install(|| {
            shards.par_iter_mut().enumerate().for_each(|(index, shard)| {
                let episodes = &batch[part(index)];
                workers.with(|worker| shard.represent(online, episodes, config.terminal_states, worker));
            });
            if let Some(discriminator) = &rit.discriminator {
                pairs.loss(discriminator, rit.config.representation_dim(), params, shards, workers, pairing);
            }
            shards.par_iter_mut().enumerate().for_each(|(index, shard)| {
                workers.with(|worker| {
                    shard.forward([online, target], config.gamma, filled, worker);
                    see(&mut shard.seen(rit, part(index).start, worker));
                    shard.backward(online, worker);
                });
            });
        });

        let grad_norm = pool.install(|| sum_shards(grads, shards));
        let mut losses = Losses { grad_norm, ..Losses::default() };
        for shard in shards.iter() {
            losses.td_loss += shard.td_loss / filled as f64;
            losses.contrastive_loss += shard.contrastive_loss;
            losses.q_total_mean += shard.q_total_sum / filled as f64;
            losses.target_mean += shard.target_sum / filled as f64;
        }
        losses
    }

    /// The gradients that [`Update::gradients`] left, in the layout's order.
    pub fn grads(&self) -> &[f32] {
        &self.grads
    }
}

/// Sums the shards' gradients in their order, part by part so that a sum stays in the cache, and returns the sum's
/// Euclidean norm.
fn sum_shards(sums: &mut [f32], shards: &[Shard]) -> f64 {
    const PART: usize = 1 << 13;
    let parts = sums.par_chunks_mut(PART).enumerate().map(|(index, sums)| {
        sums.fill(0.0);
        // As many as there are sums: the last part is shorter.
        shards.iter().for_each(|shard| add(sums, &shard.grads[index * PART..]));
        optimizer::sum_of_squares(sums)
    });
    // Collected first: a parallel sum would take them in whatever order.
    parts.collect::<Vec<f64>>().iter().sum::<f64>().sqrt()
}

vectorized! {
    fn add<'a>(sums: &'a mut [f32], part: &'a [f32]) {
        math::add_scaled(sums, 1.0, part);
    }
}
