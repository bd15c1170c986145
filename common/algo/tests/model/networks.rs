//! Small networks of every method, and batches of random episodes for them.

use rand::RngExt as _;
use rit_algo::{
    Learner as _, Method, Model, ModelConfig, PpoConfig, RoleConfig, TerminalStates, UpdateConfig,
    drive::{TdLearner, ValueActing, ValueNetwork},
    learner::Draw,
    method::Encoder,
    methods::{Recurrent, Refil, Roma, Updet, refil::Groups, roma::RoleNoise},
};
use rit_episode::{End, Episode, Rng, RunSeed, Stream, decision_order};
use rit_nn::{OptimizerKind, gradcheck};
use std::sync::Arc;

pub const D: usize = 5;
pub const A: usize = 3;

/// Every method of these networks, the encoder's option, and both numbers of heads.
pub const CASES: [Case; 15] = [
    (Method::Rit, Encoder::Beside, 1),
    (Method::Rit, Encoder::Beside, 2),
    (Method::RitVdn, Encoder::Beside, 2),
    (Method::RitNoTaskRepresentations, Encoder::Beside, 2),
    (Method::QmixAttn, Encoder::Within, 2),
    (Method::QmixAttn, Encoder::Beside, 1),
    (Method::VdnAttn, Encoder::Within, 1),
    (Method::QmixInt, Encoder::Within, 1),
    (Method::UpdetMix, Encoder::Tokens, 2),
    (Method::UpdetVdn, Encoder::Tokens, 1),
    (Method::Refil, Encoder::Within, 2),
    (Method::Roma, Encoder::Beside, 1),
    (Method::Roma, Encoder::Within, 2),
    (Method::Refil, Encoder::Beside, 1),
    (Method::VdnInt, Encoder::Within, 2),
];

pub type Case = (Method, Encoder, usize);

/// Runs the block for each of the cases, with its [`Networks`] under the given name.
macro_rules! each {
    ($cases:expr, |$networks:ident| $body:block) => {
        for &case in $cases {
            match case.0 {
                Method::UpdetMix | Method::UpdetVdn => {
                    let $networks = Networks::new(case, Updet::new);
                    $body
                }
                Method::Refil => {
                    let $networks = Networks::new(case, Refil::new);
                    $body
                }
                Method::Roma => {
                    let $networks = Networks::new(case, Roma::new);
                    $body
                }
                _ => {
                    let $networks = Networks::new(case, Recurrent::new);
                    $body
                }
            }
        }
    };
}

/// A method's networks.
pub struct Networks<N> {
    pub case: Case,
    pub model: Arc<Model>,
    pub network: Arc<N>,
}

/// How to treat what a method draws, and its losses.
pub trait Drawn: ValueNetwork {
    /// As acting without exploration has it.
    fn quiet(_draws: &mut Self::Draws) {}

    /// As it is where agent k is the former agent `orders[episode][k]`.
    fn reorder(_draws: &mut Self::Draws, _orders: &[Vec<usize>]) {}

    /// The whole loss, of its named parts.
    fn loss(part: impl Fn(&str) -> f64) -> f64 {
        part("td_loss") + part("contrastive_loss")
    }
}

impl Drawn for Recurrent {}

impl Drawn for Updet {}

impl Drawn for Refil {
    fn reorder(groups: &mut Groups, orders: &[Vec<usize>]) {
        for (groups, order) in groups.iter_mut().zip(orders) {
            let agents: Vec<u8> = order.iter().map(|&row| groups[row]).collect();
            groups[..agents.len()].copy_from_slice(&agents);
        }
    }

    fn loss(part: impl Fn(&str) -> f64) -> f64 {
        let weight = f64::from(IMAGINED_WEIGHT);
        (1.0 - weight) * part("td_loss") + weight * part("imagined_loss")
    }
}

impl Drawn for Roma {
    fn quiet(noise: &mut RoleNoise) {
        noise.iter_mut().flatten().for_each(|noise| noise.fill(0.0));
    }

    fn reorder(noise: &mut RoleNoise, orders: &[Vec<usize>]) {
        for (noise, order) in noise.iter_mut().zip(orders) {
            for noise in noise {
                for step in noise.chunks_mut(order.len() * ROLE.dim) {
                    let before = step.to_vec();
                    for (to, &row) in step.chunks_mut(ROLE.dim).zip(order) {
                        to.copy_from_slice(&before[row * ROLE.dim..(row + 1) * ROLE.dim]);
                    }
                }
            }
        }
    }

    fn loss(part: impl Fn(&str) -> f64) -> f64 {
        let weight = f64::from(ROLE.dissimilarity_weight);
        part("td_loss") + part("role_loss") + weight * part("dissimilarity_loss")
    }
}

/// Large, so that a wrong gradient shows.
pub const IMAGINED_WEIGHT: f32 = 0.4;
pub const ROLE: RoleConfig = RoleConfig {
    dim: 2,
    hidden_dim: 5,
    variance_floor: 0.002,
    entropy_weight: 0.3,
    kl_weight: 0.05,
    dissimilarity_weight: 0.5,
    soft_constraint: 0.7,
};

impl<N: Drawn> Networks<N> {
    pub fn new(case: Case, network: impl Fn(&ModelConfig) -> N) -> Self {
        let (method, encoder, n_heads) = case;
        let config = ModelConfig {
            method,
            encoder,
            entity_dim: D,
            n_actions: A,
            hidden_dim: 6,
            attention_dim: 4,
            agents_max: 3,
            entities_max: 5,
            n_heads,
            n_blocks: 1,
            task_representation_dim: 3,
            reward_embed_dim: 2,
            mixing_embed_dim: 6,
            hypernet_embed_dim: 5,
            feedforward_dim: 7,
            imagined_weight: IMAGINED_WEIGHT,
            role: ROLE,
        };
        let network = Arc::new(network(&config));
        Self { case, model: Arc::new(Model::new(config).unwrap()), network }
    }

    /// Parameters large enough that no gradient hides in rounding.
    pub fn params(&self, seed: u64) -> Vec<f32> {
        gradcheck::noise(seed, self.model.layout().len()).iter().map(|x| 0.7 * x).collect()
    }

    pub fn learner(&self, shards: usize, threads: usize, params: Vec<f32>) -> TdLearner<N> {
        self.with(Self::update(shards, threads), params)
    }

    pub fn scaled_learner(&self, reward_scale: f32, params: Vec<f32>) -> TdLearner<N> {
        self.with(UpdateConfig { reward_scale, ..Self::update(2, 1) }, params)
    }

    fn with(&self, config: UpdateConfig, params: Vec<f32>) -> TdLearner<N> {
        TdLearner::new(Arc::clone(&self.network), config, params).unwrap()
    }

    fn update(shards: usize, threads: usize) -> UpdateConfig {
        UpdateConfig {
            gamma: 0.9,
            reward_scale: 1.0,
            lr: 1e-2,
            optimizer: OptimizerKind::Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 },
            grad_norm_clip: 10.0,
            shards,
            threads,
            terminal_states: TerminalStates::LeftOut,
            ppo: PpoConfig::default(),
        }
    }

    /// What an update of these episodes draws.
    pub fn draws(&self, batch: &[&Episode]) -> N::Draws {
        self.network.draw(batch, Draw { seed: RunSeed(23), update: 0 })
    }

    pub fn quiet(&self, draws: &mut N::Draws) {
        N::quiet(draws);
    }

    pub fn reorder(&self, draws: &mut N::Draws, orders: &[Vec<usize>]) {
        N::reorder(draws, orders);
    }

    pub fn acting(&self, params: &[f32]) -> ValueActing<N> {
        ValueActing::new(Arc::clone(&self.network), &params[self.network.parts().acting.clone()])
    }
}

/// What a learner measures, by name; 0 where it does not.
pub fn measure<N: Drawn>(learner: &TdLearner<N>, values: &[f64], name: &str) -> f64 {
    let measures = learner.measures();
    let at = measures.iter().position(|measure| measure.name == name);
    at.map_or(0.0, |at| values[at])
}

/// An episode of random content: blind and partly blind agents, unavailable actions.
pub fn episode(task: usize, n: usize, m: usize, steps: usize, end: End, rng: &mut Rng) -> Episode {
    let mut available: Vec<u8> = (0..(steps + 1) * n * A).map(|_| rng.random_range(0..2)).collect();
    let actions: Vec<u8> = (0..steps * n).map(|_| rng.random_range(0..A) as u8).collect();
    for (row, &action) in actions.iter().enumerate() {
        available[row * A + usize::from(action)] = 1;
    }
    Episode {
        number: 0,
        weights_version: 0,
        task,
        n_agents: n,
        n_entities: m,
        decision_order: decision_order::identity(n),
        entities: (0..(steps + 1) * m * D).map(|_| rng.random_range(-1.0..1.0)).collect(),
        observable: (0..(steps + 1) * n * m).map(|_| u8::from(rng.random_range(0..3) > 0)).collect(),
        available,
        actions,
        rewards: (0..steps).map(|_| rng.random_range(-1.0..1.0)).collect(),
        shaping: vec![0.0; steps],
        end,
        won: false,
    }
}

/// Tasks of different sizes, lengths and ends.
pub fn batch(seed: u64) -> Vec<Episode> {
    let rng = &mut RunSeed(seed).stream(Stream::Environment, 0);
    vec![
        episode(0, 2, 3, 3, End::Terminated, rng),
        episode(1, 3, 5, 2, End::Truncated, rng),
        episode(0, 2, 3, 1, End::Terminated, rng),
        episode(2, 1, 1, 3, End::Truncated, rng),
        episode(1, 3, 5, 3, End::Truncated, rng),
    ]
}
