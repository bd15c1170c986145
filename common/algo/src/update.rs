//! One training step: from a batch of episodes to new weights (paper, algorithm 1 and equation 5).
//!
//! The batch is cut into a fixed number of shards. Threads work on shards; sums over shards are taken in
//! their order. So the result depends on the number of shards, which is configuration, and not on threads.

use crate::{
    Before, Networks, Rit, Rows,
    contrastive::{self, DiscriminatorState},
    decoder::Tables,
    td,
};
use rand::Rng;
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder, prelude::*};
use rit_episode::Episode;
use rit_nn::{Optimizer, OptimizerKind, View, ViewMut, optimizer};
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
    contrastive: Contrastive,
}

/// A part of the batch.
#[derive(Default)]
pub(crate) struct Shard {
    pub(crate) rows: Rows,
    pub(crate) online: Networks,
    pub(crate) target: Networks,
    /// The online network's greedy action of each agent row.
    pub(crate) greedy: Vec<u8>,
    /// TD target of each group; 0 where not filled.
    pub(crate) td_targets: Vec<f32>,
    /// Loss's gradient by Q_total of each group.
    d_total: Vec<f32>,
    d_q: Vec<f32>,
    d_utilities: Vec<f32>,
    d_representation: Vec<f32>,
    grads: Vec<f32>,
    td_loss: f64,
    q_total_sum: f64,
    target_sum: f64,
}

/// Scratch of the contrastive loss, over the whole batch. With N filled agent rows:
#[derive(Default)]
struct Contrastive {
    /// (shard, agent row, task) in the order (episode, step, agent).
    rows: Vec<(usize, usize, usize)>,
    /// `inverse[pairing[i]] = i`.
    inverse: Vec<usize>,
    /// [z_i ‖ z_π(i)], `[N, 2 h_z]`.
    pairs: Vec<f32>,
    same: Vec<bool>,
    parts: Vec<(DiscriminatorState, Vec<f32>, f64)>,
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
            contrastive: Contrastive::default(),
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
        let scale = optimizer::clip_scale(losses.grad_norm, self.config.grad_norm_clip);
        self.optimizer.step(&mut self.params, &self.grads, scale);
        losses
    }

    /// Losses and gradients of a batch, without a step; `pairing` makes a permutation of so many rows.
    pub fn gradients(
        &mut self,
        batch: &[&Episode],
        pairing: impl FnOnce(usize) -> Vec<usize> + Send,
    ) -> Losses {
        let filled: usize = batch.iter().map(|episode| episode.steps()).sum();
        let share = batch.len().div_ceil(self.shards.len()).max(1);
        let Self { rit, config, pool, params, target, shards, contrastive, grads, .. } = self;
        let tables = [rit.utility.decoder.tables(params), rit.utility.decoder.tables(target)];
        let networks = [(&params[..], &tables[0]), (&target[..], &tables[1])];
        let parts = || batch.chunks(share).chain(std::iter::repeat(&[][..]));
        let work: Vec<_> = shards.iter_mut().zip(parts()).collect();
        pool.install(|| {
            work.into_par_iter().for_each(|(shard, episodes)| {
                shard.forward(rit, networks, config.gamma, episodes, filled);
            });
        });
        let contrastive_loss = pool.install(|| contrastive.loss(rit, params, shards, pairing));
        pool.install(|| {
            shards.par_iter_mut().for_each(|shard| shard.backward(rit, params, &tables[0]));
        });

        grads.fill(0.0);
        let mut losses = Losses { contrastive_loss, ..Losses::default() };
        let parts = contrastive.parts.iter().map(|(_, grads, _)| grads);
        for part in shards.iter().map(|shard| &shard.grads).chain(parts) {
            rit_nn::math::vectorized(|| rit_nn::math::add_scaled(grads, 1.0, part));
        }
        for shard in shards.iter() {
            losses.td_loss += shard.td_loss / filled as f64;
            losses.q_total_mean += shard.q_total_sum / filled as f64;
            losses.target_mean += shard.target_sum / filled as f64;
        }
        losses.grad_norm = optimizer::norm(grads);
        losses
    }

    /// The gradients that [`Update::gradients`] left, in the layout's order.
    pub fn grads(&self) -> &[f32] {
        &self.grads
    }

    /// What the last update's networks said of the batch's episode at a time: for comparison with other
    /// implementations.
    pub fn inspect(&self, episodes: usize, episode: usize, time: usize) -> Inspection<'_> {
        let share = episodes.div_ceil(self.shards.len()).max(1);
        Inspection { rit: &self.rit, shard: &self.shards[episode / share], episode: episode % share, time }
    }
}

impl Shard {
    /// Both networks forward, the greedy pass, targets, and the TD loss with its gradient by Q_total.
    fn forward(
        &mut self,
        rit: &Rit,
        [(online, online_tables), (target, target_tables)]: [(&[f32], &Tables); 2],
        gamma: f32,
        episodes: &[&Episode],
        filled: usize,
    ) {
        let rows = &mut self.rows;
        rows.fill_from_episodes(episodes);
        rit.prepare(online, online_tables, rows, Before::default(), &mut self.online);
        self.greedy.resize(rows.agent_rows(), 0);
        let decoder = &mut self.online.utility.decoder;
        rit.utility.decoder.greedy(online, online_tables, rows, decoder, &mut self.greedy);
        // The greedy pass's utilities make room for those of the actions taken, which backward needs.
        rit.value(online, online_tables, rows, &rows.actions, &mut self.online);
        rit.prepare(target, target_tables, rows, Before::default(), &mut self.target);
        rit.value(target, target_tables, rows, &self.greedy, &mut self.target);

        (self.td_loss, self.q_total_sum, self.target_sum) = (0.0, 0.0, 0.0);
        self.d_total.clear();
        self.td_targets.clear();
        for (group, step) in rows.steps.iter().enumerate() {
            if !step.filled {
                self.d_total.push(0.0);
                self.td_targets.push(0.0);
                continue;
            }
            let next = self.target.q_total[rows.next_group(group)];
            let td_target = td::target(step.reward, gamma, step.terminated, next);
            let q_total = self.online.q_total[group];
            let (loss, d_total) = td::squared_error(td_target, q_total, filled);
            self.td_loss += loss;
            self.q_total_sum += f64::from(q_total);
            self.target_sum += f64::from(td_target);
            self.d_total.push(d_total);
            self.td_targets.push(td_target);
        }
        // The contrastive loss adds to this before backward does.
        self.d_representation.clear();
        self.d_representation.resize(rows.agent_rows() * rit.config.representation_dim(), 0.0);
    }

    /// From the gradients by Q_total and by z to those of all parameters but the discriminator's.
    fn backward(&mut self, rit: &Rit, params: &[f32], tables: &Tables) {
        let Self { rows, online, d_total, d_q, d_utilities, d_representation, grads, .. } = self;
        grads.clear();
        grads.resize(params.len(), 0.0);
        if rows.groups.is_empty() {
            return;
        }
        let z = rit.config.representation_dim();
        d_q.resize(rows.agent_rows(), 0.0);
        if let Some(mixer) = &rit.mixer {
            let d_z = dense_mut(d_representation, z);
            mixer.backward(params, rows, &online.chosen, &mut online.mixer, d_total, d_q, d_z, grads);
        } else {
            for (group, &d_total) in rows.groups.iter().zip(&*d_total) {
                d_q[group.queries.clone()].fill(d_total);
            }
        }
        let n_actions = rit.config.n_actions;
        d_utilities.clear();
        d_utilities.resize(rows.agent_rows() * n_actions, 0.0);
        for (row, (&action, &d_q)) in rows.actions.iter().zip(&*d_q).enumerate() {
            d_utilities[row * n_actions + usize::from(action)] = d_q;
        }
        rit.utility.backward(
            params,
            tables,
            rows,
            rit.representation(&online.task_encoder),
            &mut online.utility,
            View::dense(d_utilities, n_actions),
            dense_mut(d_representation, z),
            grads,
        );
        if let Some(task_encoder) = &rit.task_encoder {
            let d_z = View::dense(d_representation, z);
            task_encoder.backward(params, rows, &mut online.task_encoder, d_z, grads);
        }
    }
}

impl Contrastive {
    /// L_C over all filled agent rows of the batch; adds its gradient by z to the shards'.
    fn loss(
        &mut self,
        rit: &Rit,
        params: &[f32],
        shards: &mut [Shard],
        pairing: impl FnOnce(usize) -> Vec<usize>,
    ) -> f64 {
        let Some(discriminator) = &rit.discriminator else {
            return 0.0;
        };
        let z = rit.config.representation_dim();
        self.rows.clear();
        for (index, shard) in shards.iter().enumerate() {
            self.rows.extend(shard.rows.filled_agent_rows().map(|(row, step)| (index, row, step.task)));
        }
        let rows = &self.rows;
        let count = rows.len();
        let pairing = pairing(count);
        self.inverse.resize(count, 0);
        for (i, &partner) in pairing.iter().enumerate() {
            self.inverse[partner] = i;
        }
        let representation = |i: usize| {
            let (shard, row, _) = rows[i];
            &shards[shard].online.task_encoder.representation[row * z..][..z]
        };
        self.pairs.clear();
        self.same.clear();
        for (i, &partner) in pairing.iter().enumerate() {
            self.pairs.extend_from_slice(representation(i));
            self.pairs.extend_from_slice(representation(partner));
            self.same.push(rows[i].2 == rows[partner].2);
        }

        // Parts as many as shards, in the pairs' order.
        self.parts.resize_with(shards.len(), Default::default);
        let share = count.div_ceil(shards.len()).max(1);
        let pairs = View::dense(&self.pairs, 2 * z);
        let same = &self.same;
        self.parts.par_iter_mut().enumerate().for_each(|(part, (state, grads, loss))| {
            let range = (part * share).min(count)..((part + 1) * share).min(count);
            grads.clear();
            grads.resize(params.len(), 0.0);
            *loss = discriminator.loss(params, pairs.rows(range.clone()), &same[range], count, state, grads);
        });

        let d_pair = |i: usize| &self.parts[i / share].0.d_pairs[i % share * 2 * z..][..2 * z];
        for (i, &(shard, row, _)) in rows.iter().enumerate() {
            // Row i is the first of its own pair and the second of another.
            let (first, second) = (&d_pair(i)[..z], &d_pair(self.inverse[i])[z..]);
            let d_z = &mut shards[shard].d_representation[row * z..][..z];
            for ((d_z, first), second) in d_z.iter_mut().zip(first).zip(second) {
                *d_z += first + second;
            }
        }
        self.parts.iter().map(|(_, _, loss)| loss).sum::<f64>() / count as f64
    }
}

/// What the networks said of one episode at one time of the last update.
#[derive(Clone, Copy)]
pub struct Inspection<'a> {
    rit: &'a Rit,
    shard: &'a Shard,
    episode: usize,
    time: usize,
}

impl<'a> Inspection<'a> {
    fn group(&self) -> usize {
        self.shard.rows.group_of(self.episode, self.time)
    }

    fn agent_rows<T>(&self, data: &'a [T], width: usize) -> &'a [T] {
        let rows = &self.shard.rows.groups[self.group()].queries;
        &data[rows.start * width..rows.end * width]
    }

    /// τ, `[n, h]`.
    pub fn history(&self) -> &'a [f32] {
        self.agent_rows(self.shard.online.utility.history(), self.rit.config.hidden_dim)
    }

    /// z, `[n, h_z]`.
    pub fn task_representation(&self) -> &'a [f32] {
        let z = &self.shard.online.task_encoder.representation;
        self.agent_rows(z, self.rit.config.representation_dim())
    }

    /// Q given the actions taken, `[n, A]`.
    pub fn utilities(&self) -> &'a [f32] {
        self.agent_rows(&self.shard.online.utility.decoder.utilities, self.rit.config.n_actions)
    }

    /// The online network's greedy joint action, `[n]`.
    pub fn greedy_actions(&self) -> &'a [u8] {
        self.agent_rows(&self.shard.greedy, 1)
    }

    /// Q_total of the actions taken.
    pub fn q_total(&self) -> f32 {
        self.shard.online.q_total[self.group()]
    }

    /// The target network's Q_total of the greedy joint action.
    pub fn target_q_total(&self) -> f32 {
        self.shard.target.q_total[self.group()]
    }

    /// The TD target.
    pub fn td_target(&self) -> f32 {
        self.shard.td_targets[self.group()]
    }
}

/// A dense matrix that may have no columns.
fn dense_mut(data: &mut [f32], cols: usize) -> ViewMut<'_> {
    if cols == 0 {
        ViewMut { data: &mut [], rows: 0, cols: 0, stride: 0 }
    } else {
        ViewMut::dense(data, cols)
    }
}
