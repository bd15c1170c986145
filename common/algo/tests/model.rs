//! The whole model on small random batches: numeric gradients of every parameter, acting against training,
//! and independence of threads and of company.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]
#![allow(clippy::let_unit_value, reason = "some methods draw nothing")]

use rand::RngExt as _;
use rit_algo::{
    Learner as _, Method, Model, ModelConfig, PpoConfig, RoleConfig, TerminalStates, UpdateConfig,
    blocks::draw_pairing,
    drive::{SeenShard, TdLearner, ValueActing, ValueNetwork},
    learner::Draw,
    method::Encoder,
    methods::{Recurrent, Refil, Roma, Updet, refil::Groups, roma::RoleNoise},
};
use rit_episode::{
    Choice, End, Episode, Exploration, Observation, Policy, Rng, RunSeed, Stream, Turn, decision_order,
};
use rit_nn::{OptimizerKind, gradcheck};
use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

const D: usize = 5;
const A: usize = 3;

/// Every method of these networks, the encoder's option, and both numbers of heads.
const CASES: [Case; 15] = [
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

type Case = (Method, Encoder, usize);

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
struct Networks<N> {
    case: Case,
    model: Arc<Model>,
    network: Arc<N>,
}

/// How to treat what a method draws, and its losses.
trait Drawn: ValueNetwork {
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
const IMAGINED_WEIGHT: f32 = 0.4;
const ROLE: RoleConfig = RoleConfig {
    dim: 2,
    hidden_dim: 5,
    variance_floor: 0.002,
    entropy_weight: 0.3,
    kl_weight: 0.05,
    dissimilarity_weight: 0.5,
    soft_constraint: 0.7,
};

impl<N: Drawn> Networks<N> {
    fn new(case: Case, network: impl Fn(&ModelConfig) -> N) -> Self {
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
    fn params(&self, seed: u64) -> Vec<f32> {
        gradcheck::noise(seed, self.model.layout().len()).iter().map(|x| 0.7 * x).collect()
    }

    fn learner(&self, shards: usize, threads: usize, params: Vec<f32>) -> TdLearner<N> {
        let config = UpdateConfig {
            gamma: 0.9,
            lr: 1e-2,
            optimizer: OptimizerKind::Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 },
            grad_norm_clip: 10.0,
            shards,
            threads,
            terminal_states: TerminalStates::LeftOut,
            ppo: PpoConfig::default(),
        };
        TdLearner::new(Arc::clone(&self.model), Arc::clone(&self.network), config, params).unwrap()
    }

    /// What an update of these episodes draws.
    fn draws(&self, batch: &[&Episode]) -> N::Draws {
        self.network.draw(batch, Draw { seed: RunSeed(23), update: 0 })
    }

    fn quiet(&self, draws: &mut N::Draws) {
        N::quiet(draws);
    }

    fn reorder(&self, draws: &mut N::Draws, orders: &[Vec<usize>]) {
        N::reorder(draws, orders);
    }

    fn acting(&self, params: &[f32]) -> ValueActing<N> {
        ValueActing::new(Arc::clone(&self.network), &params[self.network.parts().acting.clone()])
    }
}

/// What a learner measures, by name; 0 where it does not.
fn measure<N: Drawn>(learner: &TdLearner<N>, values: &[f64], name: &str) -> f64 {
    let measures = learner.measures();
    let at = measures.iter().position(|measure| measure.name == name);
    at.map_or(0.0, |at| values[at])
}

/// An episode of random content: blind and partly blind agents, unavailable actions.
fn episode(task: usize, n: usize, m: usize, steps: usize, end: End, rng: &mut Rng) -> Episode {
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
fn batch(seed: u64) -> Vec<Episode> {
    let rng = &mut RunSeed(seed).stream(Stream::Environment, 0);
    vec![
        episode(0, 2, 3, 3, End::Terminated, rng),
        episode(1, 3, 5, 2, End::Truncated, rng),
        episode(0, 2, 3, 1, End::Terminated, rng),
        episode(2, 1, 1, 3, End::Truncated, rng),
        episode(1, 3, 5, 3, End::Truncated, rng),
    ]
}

#[test]
fn every_parameters_gradient_is_the_numeric_one() {
    // Half of the cases have every part.
    each!(CASES.iter().step_by(2), |networks| {
        let case = networks.case;
        let episodes = batch(7);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let draws = networks.draws(&batch);
        let pairing = |rows| draw_pairing(rows, &mut RunSeed(1).stream(Stream::Pairing, 0));
        let gradients = |seed| {
            let mut learner = networks.learner(2, 1, networks.params(seed));
            // The target stays where it is while the online parameters move.
            learner.target = gradcheck::noise(5, learner.target.len());
            learner.gradients(&batch, &draws, pairing);
            learner
        };
        // So small a layer's ReLUs may all be dead, which shows nothing.
        let shows = |learner: &TdLearner<_>| {
            let layout = networks.model.layout();
            let live = |name: &str| !name.ends_with("attention.key.bias");
            let mut params = layout.params().iter().filter(|param| live(&param.name));
            params.all(|param| learner.grads()[param.range.clone()].iter().any(|&g| g != 0.0))
        };
        let Some(mut learner) = (0..50).map(gradients).find(shows) else { panic!("{case:?}: dead") };
        let (at, grads) = (learner.params.clone(), learner.grads().to_vec());
        let mut moved = at.clone();
        for param in networks.model.layout().params() {
            let range = param.range.clone();
            if param.name.ends_with("attention.key.bias") {
                // Softmax does not see what is added to every score: the true gradient is zero.
                let largest = grads[range].iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
                assert!(largest < 1e-5, "{case:?} {}: {largest}", param.name);
                continue;
            }
            let cell = std::cell::RefCell::new((&mut learner, &mut moved));
            let name = format!("{case:?} {}", param.name);
            gradcheck::check(&name, &at[range.clone()], &grads[range.clone()], |values| {
                let (learner, moved) = &mut *cell.borrow_mut();
                moved[range.clone()].copy_from_slice(values);
                learner.params.copy_from_slice(moved);
                let values = learner.gradients(&batch, &draws, pairing);
                moved[range.clone()].copy_from_slice(&at[range.clone()]);
                whole_loss(learner, &values)
            });
        }
    });
}

fn whole_loss<N: Drawn>(learner: &TdLearner<N>, values: &[f64]) -> f64 {
    N::loss(|name| measure(learner, values, name))
}

/// Plays an episode's observations to a policy, step by step, and forces the recorded actions by making
/// nothing else available.
fn replay<N: ValueNetwork>(acting: &mut ValueActing<N>, slots: &[(usize, &Episode)]) -> Vec<Vec<f32>> {
    let mut utilities = vec![vec![]; slots.len()];
    for &(slot, episode) in slots {
        acting.begin(slot, episode.n_agents);
    }
    let longest = slots.iter().map(|(_, episode)| episode.steps()).max().unwrap_or(0);
    for time in 0..longest {
        let running: Vec<usize> = (0..slots.len()).filter(|&i| time < slots[i].1.steps()).collect();
        let mut seen: Vec<(Observation, Vec<u8>, Exploration)> = running
            .iter()
            .map(|&i| {
                let episode = slots[i].1;
                let (n, m) = (episode.n_agents, episode.n_entities);
                let mut observation = Observation::new(n, m, D, A);
                for row in 0..m {
                    observation
                        .entity_mut(row)
                        .copy_from_slice(&episode.entities[(time * m + row) * D..][..D]);
                }
                for agent in 0..n {
                    let row = time * n + agent;
                    observation.observable_mut(agent).copy_from_slice(&episode.observable[row * m..][..m]);
                    observation.available_mut(agent)[usize::from(episode.actions[row])] = 1;
                }
                (
                    observation,
                    vec![0; n],
                    Exploration::new(Choice::Greedy, 0.0, n, RunSeed(0).stream(Stream::Exploration, 0)),
                )
            })
            .collect();
        let mut turns: Vec<Turn<'_>> = seen
            .iter_mut()
            .zip(&running)
            .map(|((observation, actions, exploration), &i)| Turn {
                slot: slots[i].0,
                observation,
                previous_reward: if time == 0 { 0.0 } else { slots[i].1.rewards[time - 1] },
                exploration,
                actions,
            })
            .collect();
        acting.act(&mut turns);
        let mut rest = acting.utilities();
        for &i in &running {
            let (mine, others) = rest.split_at(slots[i].1.n_agents * A);
            utilities[i].extend_from_slice(mine);
            rest = others;
        }
    }
    utilities
}

/// What a learner's online network says of a batch, by (episode, time): utilities `[n, A]` and Q_total.
fn said<N: Drawn>(
    learner: &mut TdLearner<N>,
    batch: &[&Episode],
    draws: &N::Draws,
) -> HashMap<(usize, usize), (Vec<f32>, f32)> {
    let said = Mutex::new(HashMap::new());
    let see = |seen: &SeenShard<'_>| {
        let values: HashMap<_, _> = seen.values().collect();
        let groups = seen.rows.steps.iter().zip(&seen.rows.groups).enumerate();
        said.lock().unwrap().extend(groups.map(|(group, (step, rows))| {
            let utilities = rows.queries.clone().flat_map(|row| values["utilities"].row(row).to_vec());
            let q_total = values["q_total"].row(group)[0];
            ((seen.first_episode + step.episode, step.time), (utilities.collect(), q_total))
        }));
    };
    learner.gradients_seen(batch, draws, |rows| (0..rows).collect(), see);
    said.into_inner().unwrap()
}

#[test]
fn acting_step_by_step_equals_the_parallel_pass() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let at = networks.params(3);
        let episodes = batch(11);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let mut draws = networks.draws(&batch);
        networks.quiet(&mut draws);
        let trained = said(&mut networks.learner(1, 1, at.clone()), &batch, &draws);
        let slots: Vec<_> = batch.iter().copied().enumerate().collect();
        for ((index, episode), acted) in slots.iter().zip(replay(&mut networks.acting(&at), &slots)) {
            for time in 0..episode.steps() {
                let (trained, _) = &trained[&(*index, time)];
                let acted = &acted[time * episode.n_agents * A..][..episode.n_agents * A];
                for (a, b) in acted.iter().zip(trained) {
                    let close = (a - b).abs() <= 1e-5 * b.abs().max(1.0);
                    assert!(close, "{case:?} episode {index} step {time}: {a} {b}");
                }
            }
        }
    });
}

#[test]
fn acting_does_not_depend_on_company() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let at = networks.params(3);
        let episodes = batch(13);
        let together: Vec<_> = episodes.iter().enumerate().collect();
        let all = replay(&mut networks.acting(&at), &together);
        for (index, episode) in episodes.iter().enumerate() {
            let alone = replay(&mut networks.acting(&at), &[(3, episode)]);
            assert_eq!(alone[0], all[index], "{case:?} episode {index}, bit for bit");
        }
    });
}

/// Values of an episode that is over are those that acting had, and where utilities are summed, Q_total is their sum.
#[test]
fn values_of_an_episode_are_those_that_acting_had() {
    each!(&CASES, |networks| {
        let at = networks.params(3);
        let episodes = batch(17);
        let sums = [Method::RitVdn, Method::VdnAttn, Method::VdnInt, Method::UpdetVdn];
        let slots: Vec<_> = episodes.iter().enumerate().collect();
        for (episode, acted) in episodes.iter().zip(replay(&mut networks.acting(&at), &slots)) {
            let Some(values) = networks.model.value(&at, episode, &episode.actions) else {
                assert!([Method::Refil, Method::Roma].contains(&networks.case.0));
                continue;
            };
            let n = episode.n_agents;
            for (row, &action) in episode.actions.iter().enumerate() {
                let (a, b) = (values.utilities[row], acted[row * A + usize::from(action)]);
                assert!((a - b).abs() <= 1e-5 * b.abs().max(1.0), "{:?} row {row}: {a} {b}", networks.case);
            }
            let sum_of = |step: usize| values.utilities[step * n..][..n].iter().sum::<f32>();
            for (step, &q_total) in values.q_total.iter().enumerate() {
                let is_sum = (q_total - sum_of(step)).abs() < 1e-4;
                assert!(is_sum || !sums.contains(&networks.case.0), "{:?}: {q_total}", networks.case);
            }
            let has_tasks = networks.case.0.facts().task_representations;
            assert_eq!(values.representations.is_empty(), !has_tasks);
        }
    });
}

/// Where decisions are made at once, agents are alike: their order moves utilities with them, and Q_total and the loss
/// stay. Where they are made in order, the order shows.
#[test]
fn reordering_agents_reorders_utilities_and_no_more() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let mut learner = networks.learner(1, 1, networks.params(3));
        let episodes = batch(19);
        let orders: Vec<Vec<usize>> =
            episodes.iter().map(|episode| (0..episode.n_agents).rev().collect()).collect();
        let others: Vec<Episode> =
            episodes.iter().zip(&orders).map(|(episode, order)| episode.reordered(order)).collect();
        let (batch, other) = (episodes.iter().collect::<Vec<_>>(), others.iter().collect::<Vec<_>>());
        let draws = networks.draws(&batch);
        let mut of_other = networks.draws(&batch);
        networks.reorder(&mut of_other, &orders);
        let losses = [(&batch, &draws), (&other, &of_other)].map(|(batch, draws)| {
            let mut values = learner.gradients(batch, draws, |rows| (0..rows).collect());
            // Of how task representations are paired, and not of agents' order.
            let contrastive = learner.measures().iter().position(|it| it.name == "contrastive_loss");
            contrastive.into_iter().for_each(|at| values[at] = 0.0);
            values
        });
        let [ours, theirs] = [said(&mut learner, &batch, &draws), said(&mut learner, &other, &of_other)];
        let differences = losses[0].iter().zip(&losses[1]).map(|(a, b)| (a - b).abs() / a.abs().max(1.0));
        let mut largest = differences.fold(0.0, f64::max) as f32;
        for (&(episode, time), (utilities, q_total)) in
            ours.iter().filter(|((episode, time), _)| *time < episodes[*episode].steps())
        {
            let (reordered, other_total) = &theirs[&(episode, time)];
            largest = largest.max((q_total - other_total).abs());
            for (k, &row) in orders[episode].iter().enumerate() {
                for (a, b) in reordered[k * A..][..A].iter().zip(&utilities[row * A..]) {
                    largest = largest.max((a - b).abs());
                }
            }
        }
        if case.0.facts().ordered {
            assert!(largest > 1e-3, "{case:?}: the order of decisions does not show");
        } else {
            assert!(largest < 1e-5, "{case:?}: {largest}");
        }
    });
}

/// A batch need not fill every shard, nor fill them evenly.
#[test]
fn shards_without_episodes_add_nothing() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let episodes = batch(17);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let grads = |shards| {
            let mut learner = networks.learner(shards, 2, networks.params(4));
            let draws = networks.draws(&batch);
            let values = learner.gradients(&batch, &draws, |rows| (0..rows).rev().collect());
            (values[0], learner.grads().to_vec())
        };
        let (loss, five) = grads(5);
        // Eight shards of one episode at most; four, of two at most.
        for shards in [8, 4] {
            let (other, grads) = grads(shards);
            assert!((loss - other).abs() < 1e-6, "{case:?}: {loss} {other}");
            for (a, b) in grads.iter().zip(&five) {
                assert!((a - b).abs() < 1e-4 * b.abs().max(1.0), "{case:?}, {shards} shards: {a} {b}");
            }
        }
    });
}

#[test]
fn threads_change_no_bit() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let run = |threads| {
            let mut learner = networks.learner(3, threads, networks.params(3));
            for step in 0..5 {
                let episodes = batch(step);
                let draw = Draw { seed: RunSeed(9), update: step };
                let batch: Vec<&Episode> = episodes.iter().collect();
                learner.learn(&batch, draw).unwrap();
                learner.update_target();
            }
            learner.params
        };
        let alone = run(1);
        assert_eq!(alone, run(2), "{case:?}");
        assert_eq!(alone, run(4), "{case:?}");
    });
}
