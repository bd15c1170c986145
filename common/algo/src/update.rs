//! One training step: from a batch of episodes to new weights (paper, algorithm 1 and equation 5).
//!
//! The batch is cut into a fixed number of shards. Threads work on shards; sums over shards are taken in
//! their order. So the result depends on the number of shards, which is configuration, and not on threads.

use crate::{
    Before, Networks, Rit, Rows, TerminalStates,
    contrastive::{self, Discriminator},
    decoder::Tables,
    td,
};
use rand::Rng;
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder, prelude::*};
use rit_episode::Episode;
use rit_nn::{Optimizer, OptimizerKind, Scratch, View, ViewMut, math, optimizer, vectorized};
use std::sync::{Arc, Mutex, PoisonError};

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
    contrastive: Contrastive,
    workers: Workers,
}

/// A part of the batch.
#[derive(Default)]
struct Shard {
    rows: Rows,
    online: Networks,
    /// The online network's greedy action of each agent row.
    greedy: Vec<u8>,
    /// The target network's Q_total of the greedy joint actions, by group.
    target_q_total: Vec<f32>,
    /// TD target of each group; 0 where not filled.
    td_targets: Vec<f32>,
    /// Loss's gradient by Q_total of each group.
    d_total: Vec<f32>,
    /// Loss's gradient by z, (agent rows, h_z): the contrastive loss adds its own before backward does.
    d_representation: Vec<f32>,
    grads: Vec<f32>,
    td_loss: f64,
    contrastive_loss: f64,
    q_total_sum: f64,
    target_sum: f64,
}

/// What a thread needs while it works on a shard, whichever that is.
#[derive(Default)]
struct Worker {
    target: Networks,
    scratch: Scratch,
}

/// As many workers as threads have worked at once.
#[derive(Default)]
struct Workers(Mutex<Vec<Worker>>);

impl Workers {
    fn with<T>(&self, work: impl FnOnce(&mut Worker) -> T) -> T {
        // Nothing that could panic happens under the lock.
        let idle = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = idle().pop();
        let mut worker = taken.unwrap_or_default();
        let result = work(&mut worker);
        idle().push(worker);
        result
    }
}

/// Buffers of the contrastive loss, over the whole batch. With N filled agent rows:
#[derive(Default)]
struct Contrastive {
    /// (shard, agent row, task) in the order (episode, step, agent).
    rows: Vec<(usize, usize, usize)>,
    /// `inverse[pairing[i]] = i`.
    inverse: Vec<usize>,
    /// [z_i ‖ z_π(i)], `[N, 2 h_z]`.
    pairs: Vec<f32>,
    d_pairs: Vec<f32>,
    same: Vec<bool>,
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
        let Self { rit, config, pool, params, target, grads, shards, contrastive, workers, .. } = self;
        let tables = [rit.utility.decoder.tables(params), rit.utility.decoder.tables(target)];
        let networks = [(&params[..], &tables[0]), (&target[..], &tables[1])];
        let part =
            |shard: usize| &batch[(shard * share).min(batch.len())..((shard + 1) * share).min(batch.len())];
        pool.install(|| {
            shards.par_iter_mut().enumerate().for_each(|(index, shard)| {
                let episodes = part(index);
                workers.with(|worker| shard.forward(rit, networks, config, episodes, filled, worker));
            });
            if let Some(discriminator) = &rit.discriminator {
                let dim = rit.config.representation_dim();
                contrastive.loss(discriminator, dim, params, shards, workers, pairing);
            }
            shards.par_iter_mut().for_each(|shard| {
                workers.with(|worker| shard.backward(rit, params, &tables[0], &mut worker.scratch));
            });
        });

        grads.fill(0.0);
        let mut losses = Losses::default();
        for shard in shards.iter() {
            add(grads, &shard.grads);
            losses.td_loss += shard.td_loss / filled as f64;
            losses.contrastive_loss += shard.contrastive_loss;
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

    /// What the last update's networks said of one of its batch's `episodes` at a time: for comparison with
    /// other implementations.
    pub fn inspect(&self, episodes: usize, episode: usize, time: usize) -> Inspection<'_> {
        let share = episodes.div_ceil(self.shards.len()).max(1);
        Inspection { rit: &self.rit, shard: &self.shards[episode / share], episode: episode % share, time }
    }
}

vectorized! {
    fn add<'a>(sums: &'a mut [f32], part: &'a [f32]) {
        math::add_scaled(sums, 1.0, part);
    }
}

impl Shard {
    /// Both networks forward, the greedy pass, targets, and the TD loss with its gradient by Q_total.
    fn forward(
        &mut self,
        rit: &Rit,
        [(online, online_tables), (target, target_tables)]: [(&[f32], &Tables); 2],
        config: &UpdateConfig,
        episodes: &[&Episode],
        filled: usize,
        Worker { target: target_networks, scratch }: &mut Worker,
    ) {
        self.grads.clear();
        self.grads.resize(online.len(), 0.0);
        (self.td_loss, self.contrastive_loss, self.q_total_sum, self.target_sum) = (0.0, 0.0, 0.0, 0.0);
        self.d_total.clear();
        self.td_targets.clear();
        let rows = &mut self.rows;
        rows.fill_from_episodes(episodes, config.terminal_states);

        rit.prepare(online, online_tables, rows, Before::default(), &mut self.online, scratch);
        self.greedy.resize(rows.agent_rows(), 0);
        let decoder = &mut self.online.utility.decoder;
        rit.utility.decoder.greedy(online, online_tables, rows, decoder, &mut self.greedy);
        // The greedy pass's utilities make room for those of the actions taken, which backward needs.
        rit.value(online, online_tables, rows, &rows.actions, &mut self.online);
        rit.prepare(target, target_tables, rows, Before::default(), target_networks, scratch);
        rit.value(target, target_tables, rows, &self.greedy, target_networks);
        self.target_q_total.clone_from(&target_networks.q_total);

        for (group, step) in rows.steps.iter().enumerate() {
            if !step.filled {
                self.d_total.push(0.0);
                self.td_targets.push(0.0);
                continue;
            }
            let next = rows.next_group(group).map_or(0.0, |next| self.target_q_total[next]);
            let td_target = td::target(step.reward, config.gamma, step.terminated, next);
            let q_total = self.online.q_total[group];
            let (loss, d_total) = td::squared_error(td_target, q_total, filled);
            self.td_loss += loss;
            self.q_total_sum += f64::from(q_total);
            self.target_sum += f64::from(td_target);
            self.d_total.push(d_total);
            self.td_targets.push(td_target);
        }
        self.d_representation.clear();
        self.d_representation.resize(rows.agent_rows() * rit.config.representation_dim(), 0.0);
    }

    /// From the gradients by Q_total and by z to those of all parameters but the discriminator's.
    fn backward(&mut self, rit: &Rit, params: &[f32], tables: &Tables, scratch: &mut Scratch) {
        let Self { rows, online, d_total, d_representation, grads, .. } = self;
        if rows.groups.is_empty() {
            return;
        }
        let (z, n_actions) = (rit.config.representation_dim(), rit.config.n_actions);
        let mut d_q = scratch.take(rows.agent_rows());
        if let Some(mixer) = &rit.mixer {
            let d_z = dense_mut(d_representation, z);
            let (chosen, state) = (&online.chosen, &mut online.mixer);
            mixer.backward(params, rows, chosen, state, d_total, &mut d_q, d_z, grads, scratch);
        } else {
            for (group, &d_total) in rows.groups.iter().zip(&*d_total) {
                d_q[group.queries.clone()].fill(d_total);
            }
        }
        let mut d_utilities = scratch.take_zeros(rows.agent_rows() * n_actions);
        for (row, (&action, &d_q)) in rows.actions.iter().zip(d_q.iter()).enumerate() {
            d_utilities[row * n_actions + usize::from(action)] = d_q;
        }
        rit.utility.backward(
            params,
            tables,
            rows,
            rit.representation(&online.task_encoder),
            &mut online.utility,
            View::dense(&d_utilities, n_actions),
            dense_mut(d_representation, z),
            grads,
            scratch,
        );
        scratch.give(d_q);
        scratch.give(d_utilities);
        if let Some(task_encoder) = &rit.task_encoder {
            let d_z = View::dense(d_representation, z);
            task_encoder.backward(params, rows, &mut online.task_encoder, d_z, grads, scratch);
        }
    }
}

impl Contrastive {
    /// L_C over all filled agent rows of the batch, left in the shards' parts of it together with its gradients
    /// by the discriminator's parameters and by z, which is of `z` columns.
    fn loss(
        &mut self,
        discriminator: &Discriminator,
        z: usize,
        params: &[f32],
        shards: &mut [Shard],
        workers: &Workers,
        pairing: impl FnOnce(usize) -> Vec<usize>,
    ) {
        let Self { rows, inverse, pairs, d_pairs, same } = self;
        rows.clear();
        for (index, shard) in shards.iter().enumerate() {
            rows.extend(shard.rows.filled_agent_rows().map(|(row, step)| (index, row, step.task)));
        }
        let count = rows.len();
        let pairing = pairing(count);
        inverse.resize(count, 0);
        pairs.clear();
        same.clear();
        let representation = |i: usize| {
            let (shard, row, _) = rows[i];
            &shards[shard].online.task_encoder.representation[row * z..][..z]
        };
        for (i, &partner) in pairing.iter().enumerate() {
            inverse[partner] = i;
            pairs.extend_from_slice(representation(i));
            pairs.extend_from_slice(representation(partner));
            same.push(rows[i].2 == rows[partner].2);
        }
        d_pairs.resize(count * 2 * z, 0.0);

        // Parts as many as shards, in the pairs' order; a part's gradients go into the shard of the same place.
        let share = count.div_ceil(shards.len()).max(1);
        let parts =
            pairs.chunks(share * 2 * z).zip(d_pairs.chunks_mut(share * 2 * z)).zip(same.chunks(share));
        let parts: Vec<_> = shards.iter_mut().zip(parts).collect();
        parts.into_par_iter().for_each(|(shard, ((pairs, d_pairs), same))| {
            let (from, to) = (View::dense(pairs, 2 * z), ViewMut::dense(d_pairs, 2 * z));
            let grads = &mut shard.grads;
            let sum = workers
                .with(|worker| discriminator.loss(params, from, same, count, to, grads, &mut worker.scratch));
            shard.contrastive_loss = sum / count as f64;
        });

        for (i, &(shard, row, _)) in rows.iter().enumerate() {
            // Row i is the first of its own pair and the second of another.
            let (first, second) = (&d_pairs[i * 2 * z..][..z], &d_pairs[inverse[i] * 2 * z + z..][..z]);
            let d_z = &mut shards[shard].d_representation[row * z..][..z];
            for ((d_z, first), second) in d_z.iter_mut().zip(first).zip(second) {
                *d_z += first + second;
            }
        }
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
        self.shard.target_q_total[self.group()]
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
