//! Proximal policy optimisation over batches that the present weights rolled: MAPPO and MAT under training.
//!
//! An update has two parts. Once per batch the networks say what they thought when they acted, and advantages, value
//! targets and the value normaliser follow (`on_policy/targets.rs`). Then come `epochs` × `minibatches` optimiser steps
//! on the clipped losses (`on_policy/loss.rs`). Between batches nothing is kept but weights, moments and the normaliser.

mod by_policy;
mod learner;
mod loss;
mod targets;

pub(crate) use by_policy::ByPolicy;
pub use learner::PpoLearner;
pub(crate) use learner::measures;
pub use loss::Sums;
pub use targets::{Said, Targets};

use crate::{
    PpoConfig, Rows, TerminalStates, UpdateConfig,
    drive::{shards, tree_sum, tree_sum_f64},
    estimators::{greedy::greedy_action, value_norm::ValueNorm},
    learner::Measure,
    networks::Actor,
};
use loss::Counts;
use rand::{Rng, seq::SliceRandom as _};
use rayon::{ThreadPool, ThreadPoolBuildError, prelude::*};
use rit_episode::{Action, Episode, Exploration};
use rit_nn::{
    Layout, Optimizer,
    attention::Group,
    categorical, optimizer,
    tape::{Stock, Tape, Var},
};
use std::{fmt::Debug, ops::Range, sync::Arc};

/// An actor-critic's networks: all that this objective knows of a method.
pub trait ActorCritic: Debug + Send + Sync + 'static {
    /// Names and shapes of all parameters.
    fn layout(&self) -> &Layout;

    /// The parameters that acting needs.
    fn acting(&self) -> Range<usize>;

    /// The parts of the parameters whose gradients are clipped each by its own norm.
    fn clipped_apart(&self) -> Vec<Range<usize>>;

    /// A.
    fn n_actions(&self) -> usize;

    /// What a value belongs to.
    fn value_rows(&self) -> ValueRows;

    /// What an update reports: the measures of all such methods, then the norms of the gradients that are clipped apart.
    fn measures(&self) -> &'static [Measure];

    /// Makes what [`ActorCritic::forward`] reads from `inputs.rows`.
    fn fill(&self, inputs: &mut Inputs);

    /// Logits and values of all rows, given the actions taken.
    fn forward<'a>(&self, tape: &mut Tape<'a>, inputs: &'a Inputs) -> Outputs;

    /// The networks choosing joint actions with these acting parameters.
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    fn actor(self: Arc<Self>, params: &[f32]) -> Box<dyn Actor>;
}

/// What a value belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ValueRows {
    /// A state: one value for the team.
    States,
    /// An agent in a state.
    Agents,
}

/// What the networks read. Each fills what it has a use for.
#[derive(Debug, Default)]
pub struct Inputs {
    /// The states.
    pub rows: Rows,
    /// What each agent sees, `[R, m d]`.
    pub observations: Vec<f32>,
    /// What there is, `[groups, m d]`.
    pub states: Vec<f32>,
    /// Each group's agent rows, as queries and as keys.
    pub teams: Vec<Group>,
    /// Which tokens each agent's choice is given: the groups' `[n, n]`.
    pub before: Vec<u8>,
    /// Each agent row's token: 0 for the first to choose, then the action of the one before, plus 1.
    pub tokens: Vec<usize>,
    /// The tokens' one-hots, `[A + 1, A + 1]`.
    pub one_hots: Vec<f32>,
}

/// What the networks say.
#[derive(Clone, Copy, Debug)]
pub struct Outputs {
    /// (R, A).
    pub logits: Var,
    /// In normalised units: (groups, 1) or (R, 1), see [`ValueRows`].
    pub values: Var,
}

/// Weights under training, with everything an update needs.
pub struct Ppo<N> {
    network: Arc<N>,
    config: UpdateConfig,
    pool: ThreadPool,
    /// All parameters.
    pub params: Vec<f32>,
    /// The optimiser and its moments.
    pub optimizer: Optimizer,
    /// Running mean and deviation of returns: the critic's outputs are in its normalised units.
    pub value_norm: ValueNorm,
    grads: Vec<f32>,
    shards: Vec<Shard>,
}

/// What one optimiser step saw.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Losses {
    /// Means over the minibatch.
    pub sums: Sums,
    /// policy_loss − entropy_coef · entropy + value_coef · value_loss.
    pub loss: f64,
    /// Norms of the gradients that are clipped apart, before clipping.
    pub grad_norms: Vec<f64>,
}

/// A part of a minibatch.
#[derive(Default)]
struct Shard {
    inputs: Inputs,
    stock: Stock,
    grads: Vec<f32>,
    loss: loss::Buffers,
}

impl<N: ActorCritic> Ppo<N> {
    /// Training from these parameters on.
    ///
    /// # Errors
    /// When the threads cannot be started.
    ///
    /// # Panics
    /// When `params` is not of the layout's length.
    pub fn new(
        network: Arc<N>,
        config: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Self, ThreadPoolBuildError> {
        assert_eq!(params.len(), network.layout().len(), "parameters of the layout's length");
        let pool = shards::pool(config.threads)?;
        Ok(Self {
            optimizer: Optimizer::new(config.optimizer, config.lr, params.len()),
            value_norm: ValueNorm::default(),
            grads: vec![0.0; params.len()],
            shards: (0..config.shards.max(1)).map(|_| Shard::default()).collect(),
            network,
            config,
            pool,
            params,
        })
    }

    /// One update on a batch: `stream(epoch)` draws the order in which that epoch's minibatches take the episodes. Returns
    /// the losses of each optimiser step. Stops at the first step whose losses are not finite, without taking it: `params`,
    /// optimiser and normaliser then hold the state after the steps before it, so the caller must restore them.
    pub fn update<R: Rng>(&mut self, batch: &[&Episode], stream: impl Fn(u64) -> R) -> Vec<Losses> {
        let said = self.said(batch);
        let targets = self.targets(batch, said);
        let mut all = Vec::with_capacity(self.config.ppo.epochs * self.config.ppo.minibatches);
        let mut order: Vec<usize> = (0..batch.len()).collect();
        for epoch in 0..self.config.ppo.epochs {
            if self.config.ppo.minibatches > 1 {
                order.sort_unstable();
                order.shuffle(&mut stream(epoch as u64));
            }
            for minibatch in 0..self.config.ppo.minibatches {
                let losses = self.gradients(batch, &targets, self.minibatch(&order, minibatch));
                let finite = losses.is_finite();
                all.push(losses);
                if !finite {
                    return all;
                }
                self.step(all[all.len() - 1].grad_norms.clone());
            }
        }
        all
    }

    /// The episodes of a minibatch: a slice of the epoch's order.
    fn minibatch<'o>(&self, order: &'o [usize], minibatch: usize) -> &'o [usize] {
        let bound = |index: usize| index * order.len() / self.config.ppo.minibatches;
        &order[bound(minibatch)..bound(minibatch + 1)]
    }

    /// What the networks say about each episode of a batch with the present weights.
    pub fn said(&mut self, batch: &[&Episode]) -> Vec<Said> {
        let Self { network, config, pool, params, shards, .. } = self;
        let (network, params) = (&**network, &params[..]);
        let count = shards.len();
        let parts = pool.install(|| {
            let parts = shards.par_iter_mut().enumerate().map(|(index, shard)| {
                let episodes = &batch[shards::part(batch.len(), count, index)];
                shard.fill(network, episodes, config.terminal_states);
                shard.said(network, params, episodes)
            });
            parts.collect::<Vec<_>>()
        });
        parts.into_iter().flatten().collect()
    }

    /// What the losses of a batch compare with, and the value normaliser after it.
    pub fn targets(&mut self, batch: &[&Episode], said: Vec<Said>) -> Vec<Targets> {
        let Self { network, config, value_norm, .. } = self;
        targets::of_batch(batch, said, network.n_actions(), config, value_norm)
    }

    /// Losses and gradients of these episodes of a batch, without a step.
    pub fn gradients(&mut self, batch: &[&Episode], targets: &[Targets], episodes: &[usize]) -> Losses {
        let Self { network, config, pool, params, grads, shards, .. } = self;
        let (network, params) = (&**network, &params[..]);
        let counts = Counts::of(episodes.iter().map(|&episode| &targets[episode]));
        let count = shards.len();
        pool.install(|| {
            shards.par_iter_mut().enumerate().for_each(|(index, shard)| {
                let part = &episodes[shards::part(episodes.len(), count, index)];
                let of_part: Vec<&Episode> = part.iter().map(|&episode| batch[episode]).collect();
                let targets: Vec<&Targets> = part.iter().map(|&episode| &targets[episode]).collect();
                shard.fill(network, &of_part, config.terminal_states);
                shard.gradients(network, params, &targets, config, counts);
            });
            let parts: Vec<&[f32]> = shards.iter().map(|shard| &shard.grads[..]).collect();
            tree_sum(grads, &parts);
        });
        let sums: Vec<_> = shards.iter().map(|shard| shard.loss.sums.to_vec()).collect();
        let mut losses = Losses { sums: Sums::from_slice(&tree_sum_f64(&sums)), ..Losses::default() };
        losses.sums.divide(counts);
        let Sums { policy_loss, entropy, value_loss, .. } = losses.sums;
        let PpoConfig { entropy_coef, value_coef, .. } = config.ppo;
        losses.loss = policy_loss - entropy_coef * entropy + value_coef * value_loss;
        let norm = |part: Range<usize>| optimizer::sum_of_squares(&grads[part]).sqrt();
        losses.grad_norms = network.clipped_apart().into_iter().map(norm).collect();
        losses
    }

    /// The gradients that [`Ppo::gradients`] left, in the layout's order.
    pub fn grads(&self) -> &[f32] {
        &self.grads
    }

    /// Clips the gradients and takes a step along them.
    fn step(&mut self, grad_norms: Vec<f64>) {
        for (part, norm) in self.network.clipped_apart().into_iter().zip(grad_norms) {
            let scale = optimizer::clip_scale(norm, self.config.grad_norm_clip);
            self.grads[part].iter_mut().for_each(|grad| *grad *= scale);
        }
        self.optimizer.step(&mut self.params, &self.grads, 1.0);
    }
}

impl Losses {
    fn is_finite(&self) -> bool {
        self.loss.is_finite() && self.grad_norms.iter().all(|norm| norm.is_finite())
    }
}

/// An agent's choice: sampled where the episode's actions are, else the most likely action; by its logits.
pub fn choose(logits: &[f32], available: &[u8], exploration: &mut Exploration) -> Action {
    match exploration.sample() {
        Some(u) => categorical::sample(logits, available, u),
        None => greedy_action(logits, available),
    }
}

impl Shard {
    fn fill(&mut self, network: &impl ActorCritic, episodes: &[&Episode], terminal_states: TerminalStates) {
        self.inputs.rows.fill_from_episodes(episodes, terminal_states);
        network.fill(&mut self.inputs);
    }

    fn said(&mut self, network: &impl ActorCritic, params: &[f32], episodes: &[&Episode]) -> Vec<Said> {
        if self.inputs.rows.groups.is_empty() {
            return Vec::new();
        }
        let mut tape = Tape::inference(params, std::mem::take(&mut self.stock));
        let Outputs { logits, values } = network.forward(&mut tape, &self.inputs);
        let (rows, values) = (&self.inputs.rows, tape.slice(values));
        self.loss.distribution(rows, tape.view(logits));
        let said = targets::said(episodes, rows, network.value_rows(), tape.view(logits), values, &self.loss);
        self.stock = tape.into_stock();
        said
    }

    /// Losses and gradients of what [`Shard::fill`] laid out.
    fn gradients(
        &mut self,
        network: &impl ActorCritic,
        params: &[f32],
        targets: &[&Targets],
        config: &UpdateConfig,
        counts: Counts,
    ) {
        self.grads.clear();
        self.grads.resize(params.len(), 0.0);
        self.loss.sums = Sums::default();
        if self.inputs.rows.groups.is_empty() {
            return;
        }
        let mut tape = Tape::recording(params, std::mem::take(&mut self.stock));
        let Outputs { logits, values } = network.forward(&mut tape, &self.inputs);
        let rows = &self.inputs.rows;
        self.loss.distribution(rows, tape.view(logits));
        self.loss.policy(rows, targets, &config.ppo, counts);
        self.loss.value(rows, network.value_rows(), tape.slice(values), targets, &config.ppo, counts);
        tape.seed(logits, self.loss.d_logits());
        tape.seed(values, self.loss.d_values());
        tape.backward(&mut self.grads);
        self.stock = tape.into_stock();
    }
}
