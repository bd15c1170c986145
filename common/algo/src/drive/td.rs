//! Learning utilities by temporal differences with double Q (paper, equation 6; specification §4), for every method that
//! has utilities.
//!
//! A method says how a pass makes utilities of rows ([`ValueNetwork`]), and has its own losses beside the TD loss if it
//! likes. The contrastive loss couples all shards, so an update has three parts: task representations of every shard; the
//! contrastive loss over all of them; then everything else, shard by shard, forward and backward in one go, while what
//! the networks left is still in the cache. A method whose own losses are coupled ([`ValueNetwork::COUPLED`]) has its
//! backward passes wait for all forward passes.

mod learner;
pub mod measures;
mod shard;

pub use shard::{SeenShard, Totals};

use super::{
    pairs::{Pairs, PairsShard},
    shards::{Sums, Workers, part, pool, tree_sum},
};
use crate::{
    Rows, UpdateConfig,
    blocks::{Decoder, DecoderPass, Discriminator, Mixer, MixerWeights, TaskEncoder, decoder::Tables},
    estimators::greedy::greedy_action,
    learner::{Draw, Measure},
};
use rayon::{ThreadPool, ThreadPoolBuildError, prelude::*};
use rit_episode::{Episode, Turn};
use rit_nn::{Layout, Optimizer, Tape, Var, View, optimizer};
use shard::{Represented, Shard, ShardInputs, Update, Weights};
use std::{fmt::Debug, mem, ops::Range, sync::Arc};

/// What the engine must know of every network that has utilities.
#[derive(Clone, Debug)]
pub struct ValueParts {
    /// Names and shapes of all parameters.
    pub layout: Layout,
    /// The parameters that acting needs, the first ones.
    pub acting: Range<usize>,
    /// The parameters that the target network covers, the first ones.
    pub target: Range<usize>,
    /// A.
    pub n_actions: usize,
    /// Numbers that an agent remembers from step to step.
    pub memory_dim: usize,
    /// Whether they are a GRU's units, which lie within ±1.
    pub gru: bool,
    /// How utilities become Q_total; a sum without it.
    pub mixer: Option<Mixer>,
    /// The task encoder, and the discriminator of the contrastive loss that trains it; `None` without representations.
    pub task: Option<(TaskEncoder, Discriminator)>,
}

/// Whose pass it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The network under training.
    Online,
    /// Its copy that values the following states.
    Target,
    /// One step of running episodes.
    Acting,
}

/// What a pass is made over.
#[derive(Clone, Copy, Debug)]
pub struct Pass<'a, I> {
    /// Whose pass it is.
    pub role: Role,
    /// The rows.
    pub rows: &'a Rows,
    /// What the decoder makes of the weights.
    pub tables: &'a Tables,
    /// z, (R, h_z), where there are task representations.
    pub representation: Option<Var>,
    /// What agents remember, (rows of the first time, memory), or zeros.
    pub before: Option<Var>,
    /// What the method reads beside the rows.
    pub inputs: &'a I,
}

/// What a pass makes.
pub struct Utilities<'a, E> {
    /// What agents remember after each row, (R, memory): the history τ.
    pub memory: Var,
    /// Utilities, or what decides.
    pub head: Head<'a>,
    /// What the method's own losses read.
    pub extras: E,
}

/// Where utilities come from.
pub enum Head<'a> {
    /// All agents decide at once: Q, (R, A).
    Independent(Var),
    /// Agents decide one after another.
    Ordered(Box<(Decoder, DecoderPass<'a>)>),
}

impl<'a> Head<'a> {
    /// The greedy joint action of each group, `[R]`: unavailable actions are excluded, ties go to the lowest index.
    pub fn greedy(&mut self, tape: &Tape<'a>, rows: &Rows, n_actions: usize) -> Vec<u8> {
        match self {
            Self::Independent(utilities) => {
                let available = rows.available.chunks_exact(n_actions);
                let rows = (0..utilities.rows).map(|row| tape.view(*utilities).row(row));
                rows.zip(available)
                    .map(|(utilities, available)| greedy_action(utilities, available))
                    .collect()
            }
            Self::Ordered(ordered) => {
                let (decoder, pass) = &mut **ordered;
                decoder.greedy(tape.params, rows, pass)
            }
        }
    }

    /// Q (R, A) where these actions are taken.
    pub fn utilities(self, tape: &mut Tape<'a>, rows: &Rows, actions: &[u8]) -> Var {
        match self {
            Self::Independent(utilities) => utilities,
            Self::Ordered(ordered) => {
                let (decoder, pass) = *ordered;
                decoder.utilities(tape, rows, pass, actions)
            }
        }
    }
}

/// A shard's TD pass, as a method's own losses find it.
pub struct TdPass<'a, 'p, N: ValueNetwork> {
    /// Its rows.
    pub rows: &'a Rows,
    /// What the method reads beside them.
    pub inputs: &'a N::Inputs,
    /// What the whole batch's means divide by.
    pub totals: Totals,
    /// Targets y of each group; 0 where nothing was decided.
    pub td_targets: &'p [f32],
    /// The weights of the mixing network.
    pub mixing: Option<MixerWeights>,
    /// What agents remember, (R, memory).
    pub memory: Var,
    /// Q of the online pass, (R, A).
    pub utilities: Var,
    /// What the online pass left.
    pub extras: &'p N::Extras,
}

/// Intermediate values by name, for comparison with the golden data of an independent implementation.
pub type Said = Vec<(&'static str, Var)>;

/// A network that values actions: a method that learns by temporal differences.
pub trait ValueNetwork: Debug + Send + Sync + 'static {
    /// Random numbers of an update, beside the contrastive loss's pairing.
    type Draws: Send + Sync + Default;
    /// What passes over some rows read beside them: what was drawn, as the rows lie.
    type Inputs: Send + Sync + Default;
    /// What a pass leaves for the method's own losses.
    type Extras: Send;
    /// Whether the gradients of the method's own losses need sums over the whole batch.
    const COUPLED: bool = false;
    /// Whether a pass needs random numbers, so that an episode that is over cannot be valued anew.
    const DRAWS: bool = false;

    /// What the engine must know.
    fn parts(&self) -> &ValueParts;

    /// What an update reports: `td_loss`, `contrastive_loss` where there is one, the method's own, `grad_norm`,
    /// `q_total_mean`, `target_mean`, and `saturated_units` of a GRU. [`measures::measures`] puts them together.
    fn measures(&self) -> &'static [Measure];

    /// What the decoder makes of these weights; nothing without a decoder.
    fn tables(&self, _params: &[f32]) -> Tables {
        Tables::default()
    }

    /// Draws an update's random numbers.
    fn draw(&self, _batch: &[&Episode], _draw: Draw) -> Self::Draws {
        Self::Draws::default()
    }

    /// Draws a step's random numbers for episodes that run.
    fn draw_acting(&self, _turns: &mut [Turn<'_>]) -> Self::Draws {
        Self::Draws::default()
    }

    /// Lays out what was drawn. The rows' episode 0 is the `first_episode` of those that were drawn for.
    fn inputs(&self, _rows: &Rows, _draws: &Self::Draws, _first_episode: usize) -> Self::Inputs {
        Self::Inputs::default()
    }

    /// One pass over rows.
    fn forward<'a>(&self, tape: &mut Tape<'a>, pass: Pass<'a, Self::Inputs>) -> Utilities<'a, Self::Extras>;

    /// Weight of the TD loss; the method's own losses carry their weights themselves.
    fn td_weight(&self) -> f32 {
        1.0
    }

    /// The sums over a shard that the method's own losses are made of. Seeds the tape with the gradients of losses that
    /// are not [coupled](ValueNetwork::COUPLED), and adds to what is `said`. Shards without rows have no say: their sums
    /// are empty.
    fn sums<'a>(&self, _tape: &mut Tape<'a>, _pass: &TdPass<'a, '_, Self>, _said: &mut Said) -> Sums
    where
        Self: Sized,
    {
        Sums::new()
    }

    /// The method's own losses, from the sums over all shards, as reported.
    fn losses(&self, sums: &[f64]) -> Vec<f64> {
        sums.to_vec()
    }

    /// Seeds a shard's tape with the gradients of coupled losses, `sums` being those over all shards.
    fn seed(
        &self,
        _tape: &mut Tape<'_>,
        _rows: &Rows,
        _totals: Totals,
        _extras: &Self::Extras,
        _sums: &[f64],
    ) {
    }
}

/// Weights under training, with everything an update needs.
pub struct TdLearner<N: ValueNetwork> {
    network: Arc<N>,
    config: UpdateConfig,
    pool: ThreadPool,
    /// All parameters.
    pub params: Vec<f32>,
    /// The target network's copy of those it covers.
    pub target: Vec<f32>,
    /// The optimiser and its moments.
    pub optimizer: Optimizer,
    /// Extended by those of derived layers.
    grads: Vec<f32>,
    /// Of the parameters' gradients, before clipping.
    grad_norm: f64,
    /// Online and target parameters, with what is derived from them.
    extended: [Vec<f32>; 2],
    rows: Vec<Rows>,
    shards: Vec<Shard>,
    pairs: Pairs,
    workers: Workers,
}

impl<N: ValueNetwork> TdLearner<N> {
    /// Training from these parameters on, with a target network that equals them.
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
        let parts = network.parts();
        assert_eq!(params.len(), parts.layout.len(), "parameters of the layout's length");
        let shards = config.shards.max(1);
        Ok(Self {
            target: params[parts.target.clone()].to_vec(),
            optimizer: Optimizer::new(config.optimizer, config.lr, params.len()),
            grads: vec![0.0; parts.layout.derived().len()],
            grad_norm: 0.0,
            extended: Default::default(),
            rows: (0..shards).map(|_| Rows::default()).collect(),
            shards: (0..shards).map(|_| Shard::default()).collect(),
            pairs: Pairs::default(),
            workers: Workers::default(),
            pool: pool(config.threads)?,
            network,
            config,
            params,
        })
    }

    /// The gradients that [`TdLearner::gradients`] left, in the layout's order.
    pub fn grads(&self) -> &[f32] {
        &self.grads[..self.params.len()]
    }

    /// Losses and gradients of a batch, without a step: the measures' values. `pairing` makes a permutation of so many
    /// rows.
    pub fn gradients(
        &mut self,
        batch: &[&Episode],
        draws: &N::Draws,
        pairing: impl FnOnce(usize) -> Vec<usize> + Send,
    ) -> Vec<f64> {
        self.gradients_seen(batch, draws, pairing, |_| {})
    }

    /// As [`Self::gradients`], and shows `see` what the networks said: shard after shard in no particular order, from
    /// the threads that work on them.
    pub fn gradients_seen(
        &mut self,
        batch: &[&Episode],
        draws: &N::Draws,
        pairing: impl FnOnce(usize) -> Vec<usize> + Send,
        see: impl Fn(&SeenShard<'_>) + Sync,
    ) -> Vec<f64> {
        let Self { network, config, pool, grads, grad_norm, extended, rows, shards, pairs, workers, .. } =
            self;
        let (network, workers, count) = (&**network, &*workers, shards.len());
        let (derived, parameters) = (network.parts().layout.derived(), self.params.len());
        derived.extend(&self.params, &mut extended[0]);
        derived.extend(&self.target, &mut extended[1]);
        let tables = extended.each_ref().map(|params| network.tables(params));
        let [online, target] = [0, 1].map(|at| Weights { params: &extended[at], tables: &tables[at] });
        let (gamma, reward_scale) = (config.gamma, config.reward_scale);
        let update = Update { network, online, target, gamma, reward_scale, totals: totals(batch) };
        let sums = pool.install(|| {
            rows.par_iter_mut().zip(&mut *shards).enumerate().for_each(|(index, (rows, shard))| {
                rows.fill_from_episodes(&batch[part(batch.len(), count, index)], config.terminal_states);
                shard.clear(online.params.len());
            });
            let inputs = rows.par_iter().enumerate().map(|(index, rows)| {
                let first_episode = part(batch.len(), count, index).start;
                ShardInputs { first_episode, own: network.inputs(rows, draws, first_episode) }
            });
            let inputs: Vec<_> = inputs.collect();
            let mut represented = represent(&update, rows, shards, workers);
            if let Some((_, discriminator)) = &network.parts().task {
                contrast(discriminator, online, rows, shards, &mut represented, pairs, workers, pairing);
            }
            let sums = if N::COUPLED {
                update.run_coupled(rows, &inputs, shards, &mut represented, workers, &see)
            } else {
                update.run(rows, &inputs, shards, &mut represented, workers, &see)
            };
            for (shard, represented) in shards.iter_mut().zip(represented) {
                shard.stock =
                    represented.map_or_else(|| mem::take(&mut shard.stock), Represented::into_stock);
            }
            let parts: Vec<&[f32]> = shards.iter().map(|shard| &shard.grads[..]).collect();
            tree_sum(grads, &parts);
            sums
        });
        derived.backward(online.params, grads);
        *grad_norm = optimizer::sum_of_squares(&grads[..parameters]).sqrt();
        let filled = update.totals.filled as f64;
        let [td, contrastive, q_total, target, saturated] = sums.common;
        let mut measures = vec![td / filled];
        if network.parts().task.is_some() {
            measures.push(contrastive);
        }
        measures.extend(network.losses(&sums.own));
        measures.extend([*grad_norm, q_total / filled, target / filled]);
        if network.parts().gru {
            let units = update.totals.filled_agents * network.parts().memory_dim;
            measures.push(saturated / units as f64);
        }
        // Names are given to them by their places.
        debug_assert_eq!(measures.len(), network.measures().len(), "a value for each measure");
        measures
    }

    /// One step of the optimiser along the gradients that [`TdLearner::gradients`] left, clipped.
    fn apply(&mut self) {
        let scale = optimizer::clip_scale(self.grad_norm, self.config.grad_norm_clip);
        let parameters = self.params.len();
        self.optimizer.step(&mut self.params, &self.grads[..parameters], scale);
    }

    /// Copies the online weights into the target network.
    pub fn update_target(&mut self) {
        self.target.copy_from_slice(&self.params[self.network.parts().target.clone()]);
    }
}

/// What a whole batch's means divide by.
fn totals(batch: &[&Episode]) -> Totals {
    let steps = batch.iter().map(|episode| episode.steps());
    let agents = batch.iter().map(|episode| episode.steps() * episode.n_agents);
    Totals { filled: steps.sum(), filled_agents: agents.sum() }
}

/// The task representations of every shard that has rows.
fn represent<'a, N: ValueNetwork>(
    update: &Update<'a, N>,
    rows: &'a [Rows],
    shards: &mut [Shard],
    workers: &Workers,
) -> Vec<Option<Represented<'a>>> {
    let Some((task_encoder, _)) = &update.network.parts().task else {
        return rows.iter().map(|_| None).collect();
    };
    let represent = |(rows, shard): (&'a Rows, &mut Shard)| {
        (!rows.groups.is_empty()).then(|| {
            workers.with(|worker| {
                Represented::new(
                    task_encoder,
                    update.online.params,
                    rows,
                    mem::take(&mut shard.stock),
                    worker,
                )
            })
        })
    };
    rows.par_iter().zip(shards).map(represent).collect()
}

/// The contrastive loss of all shards, with its gradients.
#[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
fn contrast(
    discriminator: &Discriminator,
    online: Weights<'_>,
    rows: &[Rows],
    shards: &mut [Shard],
    represented: &mut [Option<Represented<'_>>],
    pairs: &mut Pairs,
    workers: &Workers,
    pairing: impl FnOnce(usize) -> Vec<usize>,
) {
    let parts = rows.iter().zip(shards).zip(represented).map(|((rows, shard), represented)| {
        let (representation, d_representation) = match represented {
            Some(Represented { tape, representation, d, .. }) => (tape.view(*representation), &mut d[..]),
            None => (View { data: &[], rows: 0, cols: 0, stride: 0 }, &mut [][..]),
        };
        let Shard { grads, sums, .. } = shard;
        PairsShard { rows, representation, d_representation, grads, loss: &mut sums.common[1] }
    });
    pairs.loss(discriminator, online.params, parts.collect(), workers, pairing);
}
