//! MAPPO and MAT: acting equals the parallel pass, batches change nothing, threads change no bit; and they learn what can
//! be learnt.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

use rand::RngExt as _;
use rit_algo::{
    Learner, Mappo, MappoActing, MappoConfig, Mat, MatActing, MatConfig, Method, Model, ModelConfig,
    PpoConfig, RoleConfig, TerminalStates, UpdateConfig,
    flat::Slots,
    learner::{Draw, NamedState},
    on_policy::{ActorCritic, Ppo},
};
use rit_episode::{
    Choice, End, Episode, EpisodeBuilder, Exploration, Observation, Policy, Rng, RunSeed, Stream, Turn,
    decision_order,
};
use rit_nn::OptimizerKind;
use std::sync::Arc;

const SLOTS: Slots = Slots { agents_max: 9, entities_max: 11, entity_dim: 7 };
const A: usize = 4;

/// A policy whose logits can be read.
trait Acting: Policy {
    fn logits(&self) -> &[f32];
}

impl Acting for MappoActing {
    fn logits(&self) -> &[f32] {
        self.logits()
    }
}

impl Acting for MatActing {
    fn logits(&self) -> &[f32] {
        self.logits()
    }
}

fn mappo(slots: Slots, n_actions: usize, width: usize) -> Arc<Mappo> {
    Arc::new(Mappo::new(MappoConfig { slots, n_actions, hidden_dim: width }))
}

fn mat(slots: Slots, n_actions: usize, width: usize) -> Arc<Mat> {
    Arc::new(Mat::new(MatConfig { slots, n_actions, embed_dim: width, n_heads: 2, n_blocks: 2 }))
}

fn mappo_acting(network: &Arc<Mappo>, params: &[f32]) -> Box<dyn Acting> {
    Box::new(MappoActing::new(Arc::clone(network), &params[network.acting()]))
}

fn mat_acting(network: &Arc<Mat>, params: &[f32]) -> Box<dyn Acting> {
    Box::new(MatActing::new(Arc::clone(network), &params[network.acting()]))
}

fn config(threads: usize) -> UpdateConfig {
    UpdateConfig {
        gamma: 0.99,
        reward_scale: 1.0,
        lr: 5e-4,
        optimizer: OptimizerKind::Adam { beta1: 0.9, beta2: 0.999, eps: 1e-5 },
        grad_norm_clip: 10.0,
        shards: 3,
        threads,
        terminal_states: TerminalStates::LeftOut,
        ppo: PpoConfig { epochs: 2, minibatches: 2, ..PpoConfig::default() },
    }
}

fn rng(index: u64) -> Rng {
    RunSeed(1).stream(Stream::Environment, index)
}

/// Larger than initial ones, so that what depends on anything shows it.
fn params(network: &impl ActorCritic) -> Vec<f32> {
    let mut params = network.layout().initial(&mut rng(99));
    params
        .iter_mut()
        .zip(rit_nn::gradcheck::noise(5, network.layout().len()))
        .for_each(|(p, n)| *p += 0.2 * n);
    params
}

/// A state of noise: some agents have no choice, some see nothing, themselves included.
fn observation(n: usize, m: usize, rng: &mut Rng) -> Observation {
    let mut seen = Observation::new(n, m, SLOTS.entity_dim, A);
    for entity in 0..m {
        seen.entity_mut(entity).fill_with(|| rng.random_range(-1.0..1.0));
    }
    for agent in 0..n {
        seen.observable_mut(agent).fill_with(|| u8::from(rng.random_bool(0.7)));
        seen.observable_mut(agent)[agent] = 1;
        if rng.random_bool(0.2) {
            seen.observable_mut(agent).fill(0);
        }
        seen.available_mut(agent).fill_with(|| u8::from(rng.random_bool(0.6)));
        seen.available_mut(agent)[0] = 1;
    }
    seen
}

/// Plays a policy in states of noise, several episodes of teams of these sizes side by side, its actions sampled.
/// Returns the episodes and the logits that each agent chose by, `[T, n, A]`.
fn play(policy: &mut dyn Acting, teams: &[(usize, usize)]) -> (Vec<Episode>, Vec<Vec<f32>>) {
    const STEPS: usize = 4;
    let mut rngs: Vec<Rng> = teams.iter().map(|&(n, m)| rng((100 * n + m) as u64)).collect();
    let state = |at: usize, rngs: &mut [Rng]| observation(teams[at].0, teams[at].1, &mut rngs[at]);
    let mut seen: Vec<Observation> = (0..teams.len()).map(|at| state(at, &mut rngs)).collect();
    let mut explorations: Vec<Exploration> = teams
        .iter()
        .map(|&(n, m)| {
            Exploration::new(
                Choice::Sampled,
                0.0,
                n,
                RunSeed(2).stream(Stream::Exploration, (100 * n + m) as u64),
            )
        })
        .collect();
    let mut builders: Vec<EpisodeBuilder> = (0..teams.len())
        .map(|at| EpisodeBuilder::new(0, 0, 0, decision_order::identity(teams[at].0), &seen[at]))
        .collect();
    let mut logits = vec![vec![]; teams.len()];
    (0..teams.len()).for_each(|slot| policy.begin(slot, teams[slot].0));
    for _ in 0..STEPS {
        let mut actions: Vec<Vec<u8>> = teams.iter().map(|&(n, _)| vec![0; n]).collect();
        let all = seen.iter().zip(&mut explorations).zip(&mut actions).enumerate();
        let mut turns: Vec<Turn<'_>> = all
            .map(|(slot, ((observation, exploration), actions))| Turn {
                slot,
                observation,
                previous_reward: 0.0,
                exploration,
                actions,
            })
            .collect();
        policy.act(&mut turns);
        let mut rows = policy.logits();
        for at in 0..teams.len() {
            let (own, rest) = rows.split_at(teams[at].0 * A);
            logits[at].extend_from_slice(own);
            rows = rest;
            seen[at] = state(at, &mut rngs);
            let reward = rngs[at].random_range(-1.0..1.0);
            builders[at].step(&actions[at], reward, 0.0, &seen[at]);
        }
    }
    let ends = [End::Terminated, End::Truncated].into_iter().cycle();
    (builders.into_iter().zip(ends).map(|(builder, end)| builder.finish(end, false)).collect(), logits)
}

/// Teams of one, of a few, and of so many that attention takes its products elsewhere.
const TEAMS: [(usize, usize); 4] = [(3, 5), (1, 1), (9, 11), (2, 4)];

/// Acting step by step and agent by agent says what one parallel pass over the actions taken says.
fn acting_equals_the_parallel_pass<N: ActorCritic>(
    network: &Arc<N>,
    acting: fn(&Arc<N>, &[f32]) -> Box<dyn Acting>,
) {
    let params = params(&**network);
    let (episodes, logits) = play(&mut *acting(network, &params), &TEAMS);
    let mut ppo = Ppo::new(Arc::clone(network), config(2), params).unwrap();
    let said = ppo.said(&episodes.iter().collect::<Vec<_>>());
    for (said, logits) in said.iter().zip(&logits) {
        assert_eq!(said.logits.len(), logits.len());
        for (a, b) in said.logits.iter().zip(logits) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }
}

/// Other episodes, acted beside it or in its batch, change no bit of an episode.
fn company_changes_no_bit<N: ActorCritic>(network: &Arc<N>, acting: fn(&Arc<N>, &[f32]) -> Box<dyn Acting>) {
    let params = params(&**network);
    let (episodes, logits) = play(&mut *acting(network, &params), &TEAMS);
    let mut ppo = Ppo::new(Arc::clone(network), config(2), params.clone()).unwrap();
    let together = ppo.said(&episodes.iter().collect::<Vec<_>>());
    for (at, team) in TEAMS.into_iter().enumerate() {
        let (alone, logits_alone) = play(&mut *acting(network, &params), &[team]);
        assert_eq!((&alone[0].actions, &logits_alone[0]), (&episodes[at].actions, &logits[at]));
        assert_eq!(ppo.said(&[&episodes[at]])[0], together[at]);
    }
}

fn threads_change_no_bit<N: ActorCritic>(network: &Arc<N>, acting: fn(&Arc<N>, &[f32]) -> Box<dyn Acting>) {
    let params = params(&**network);
    let (episodes, _) = play(&mut *acting(network, &params), &TEAMS);
    let updated = |threads| {
        let mut ppo = Ppo::new(Arc::clone(network), config(threads), params.clone()).unwrap();
        let losses = ppo.update(&episodes.iter().collect::<Vec<_>>(), rng);
        assert_eq!(losses.len(), 4, "two epochs of two minibatches");
        assert!(losses.iter().all(|losses| losses.loss.is_finite()));
        (ppo.params, ppo.value_norm, losses)
    };
    assert!(updated(1) == updated(4));
}

/// With the weights that rolled the batch, every probability ratio is 1.
fn ratios_are_one_at_first<N: ActorCritic>(network: &Arc<N>, acting: fn(&Arc<N>, &[f32]) -> Box<dyn Acting>) {
    let params = params(&**network);
    let (episodes, _) = play(&mut *acting(network, &params), &TEAMS);
    let ppo = PpoConfig { minibatches: 1, ..PpoConfig::default() };
    let config = UpdateConfig { ppo, ..config(2) };
    let mut ppo = Ppo::new(Arc::clone(network), config, params).unwrap();
    let first = ppo.update(&episodes.iter().collect::<Vec<_>>(), rng)[0].sums;
    assert_eq!((first.ratio, first.clipped, first.kl), (1.0, 0.0, 0.0));
}

macro_rules! for_both {
    ($($check:ident),+) => {
        mod of_mappo {
            $(#[test]
            fn $check() {
                super::$check(&super::mappo(super::SLOTS, super::A, 8), super::mappo_acting);
            })+
        }
        mod of_mat {
            $(#[test]
            fn $check() {
                super::$check(&super::mat(super::SLOTS, super::A, 8), super::mat_acting);
            })+
        }
    };
}

for_both!(
    acting_equals_the_parallel_pass,
    company_changes_no_bit,
    threads_change_no_bit,
    ratios_are_one_at_first,
    learns_to_tell_visible_games_apart_and_no_others
);

/// The multi matrix game (spec §6) in features player (2), step (1), game (4; zeros where it is hidden), last
/// action (3).
struct MatrixGame {
    game: usize,
    visible: bool,
}

impl MatrixGame {
    const ENTITY_DIM: usize = 10;
    const ACTIONS: usize = 3;
    const FIRST_REWARDS: [f32; 4] = [-12.0, -6.0, 0.0, 6.0];
    const OPTIMAL: [[u8; 2]; 4] = [[0, 2], [2, 2], [0, 1], [0, 0]];

    fn observe(&self, step: usize, last: Option<&[u8]>) -> Observation {
        let mut seen = Observation::new(2, 2, Self::ENTITY_DIM, Self::ACTIONS);
        seen.see_and_allow_all();
        for player in 0..2 {
            let features = seen.entity_mut(player);
            features[player] = 1.0;
            features[2] = step as f32;
            features[3 + self.game] = f32::from(u8::from(self.visible));
            if let Some(last) = last {
                features[7 + usize::from(last[player])] = 1.0;
            }
        }
        seen
    }

    /// Plays an episode in each of these games, side by side.
    fn play(
        policy: &mut dyn Policy,
        games: &[Self],
        mut exploration: impl FnMut(usize) -> Exploration,
    ) -> Vec<Episode> {
        let mut explorations: Vec<Exploration> = (0..games.len()).map(&mut exploration).collect();
        let mut seen: Vec<Observation> = games.iter().map(|game| game.observe(0, None)).collect();
        let mut builders: Vec<EpisodeBuilder> = seen
            .iter()
            .zip(games)
            .map(|(seen, game)| EpisodeBuilder::new(0, 0, game.game, decision_order::identity(2), seen))
            .collect();
        let mut won = vec![false; games.len()];
        (0..games.len()).for_each(|slot| policy.begin(slot, 2));
        for step in 0..2 {
            let mut actions = vec![[0; 2]; games.len()];
            let all = seen.iter().zip(&mut explorations).zip(&mut actions).enumerate();
            let mut turns: Vec<Turn<'_>> = all
                .map(|(slot, ((observation, exploration), actions))| Turn {
                    slot,
                    observation,
                    previous_reward: 0.0,
                    exploration,
                    actions,
                })
                .collect();
            policy.act(&mut turns);
            for (at, (game, actions)) in games.iter().zip(&actions).enumerate() {
                won[at] = step == 1 && *actions == Self::OPTIMAL[game.game];
                let reward = match (step, won[at]) {
                    (0, _) => Self::FIRST_REWARDS[game.game],
                    (_, true) => 100.0,
                    (_, false) => -12.0,
                };
                seen[at] = game.observe(step + 1, Some(actions));
                builders[at].step(actions, reward, 0.0, &seen[at]);
            }
        }
        builders.into_iter().zip(won).map(|(builder, won)| builder.finish(End::Terminated, won)).collect()
    }
}

/// Reference of the specification (onpolicy §8): with the game visible both methods win every game by 2560 steps; hidden,
/// they end at one of four, which is the best there is without knowing the game. A mistake in acting or in the loss shows
/// here.
fn learns_to_tell_visible_games_apart_and_no_others<N: Matrix>(
    _: &Arc<N>,
    acting: fn(&Arc<N>, &[f32]) -> Box<dyn Acting>,
) {
    const BATCH: usize = 32;
    const STEPS: usize = 2560;
    let slots = Slots { agents_max: 2, entities_max: 2, entity_dim: MatrixGame::ENTITY_DIM };
    let network = N::matrix(slots, MatrixGame::ACTIONS);
    for (visible, wins) in [(true, 4), (false, 1)] {
        let seed = RunSeed(1);
        let params = network.layout().initial(&mut seed.stream(Stream::Weights, 0));
        let config = UpdateConfig { ppo: PpoConfig { clip: N::CLIP, ..PpoConfig::default() }, ..config(2) };
        let mut ppo = Ppo::new(Arc::clone(&network), config, params).unwrap();
        for update in 0..STEPS / (2 * BATCH) {
            let number = |slot: usize| (update * BATCH + slot) as u64;
            let games: Vec<MatrixGame> = (0..BATCH)
                .map(|slot| {
                    let game = seed.stream(Stream::Task, number(slot)).random_range(0..4);
                    MatrixGame { game, visible }
                })
                .collect();
            let stream = |slot| seed.stream(Stream::Exploration, number(slot));
            let sampling = |slot| Exploration::new(Choice::Sampled, 0.0, 2, stream(slot));
            let batch = MatrixGame::play(&mut *acting(&network, &ppo.params), &games, sampling);
            ppo.update(&batch.iter().collect::<Vec<_>>(), rng);
        }
        let games = [0, 1, 2, 3].map(|game| MatrixGame { game, visible });
        let greedy = |_| Exploration::new(Choice::Greedy, 0.0, 2, rng(0));
        let played = MatrixGame::play(&mut *acting(&network, &ppo.params), &games, greedy);
        assert_eq!(played.iter().filter(|episode| episode.won).count(), wins, "visible: {visible}");
    }
}

/// The method as the specification has it for the matrix game.
trait Matrix: ActorCritic + Sized {
    const CLIP: f64;

    fn matrix(slots: Slots, n_actions: usize) -> Arc<Self>;
}

impl Matrix for Mappo {
    const CLIP: f64 = 0.2;

    fn matrix(slots: Slots, n_actions: usize) -> Arc<Self> {
        mappo(slots, n_actions, 64)
    }
}

impl Matrix for Mat {
    const CLIP: f64 = 0.05;

    fn matrix(slots: Slots, n_actions: usize) -> Arc<Self> {
        Arc::new(Self::new(MatConfig { slots, n_actions, embed_dim: 64, n_heads: 1, n_blocks: 1 }))
    }
}

/// A learner at its beginning, with weights as above, and a batch of episodes.
fn under_training(method: Method) -> (Box<dyn Learner>, Vec<Episode>) {
    let model = Model::new(sizes(method)).unwrap();
    let (mappo, mat) = (mappo(SLOTS, A, 8), mat(SLOTS, A, 8));
    let (params, mut acting) = match method {
        Method::Mappo => (params(&*mappo), mappo_acting(&mappo, &params(&*mappo))),
        _ => (params(&*mat), mat_acting(&mat, &params(&*mat))),
    };
    let learner = model.learner(config(2), params).unwrap();
    (learner, play(&mut *acting, &TEAMS).0)
}

fn sizes(method: Method) -> ModelConfig {
    ModelConfig {
        method,
        encoder: method.facts().encoder,
        entity_dim: SLOTS.entity_dim,
        n_actions: A,
        agents_max: SLOTS.agents_max,
        entities_max: SLOTS.entities_max,
        hidden_dim: 8,
        attention_dim: 0,
        n_heads: 2,
        n_blocks: 2,
        task_representation_dim: 0,
        reward_embed_dim: 0,
        mixing_embed_dim: 0,
        hypernet_embed_dim: 0,
        feedforward_dim: 0,
        imagined_weight: 0.0,
        role: RoleConfig::default(),
    }
}

fn draw(update: u64) -> Draw {
    Draw { seed: RunSeed(1), update }
}

/// Weights and the rest, in bits.
fn everything(learner: &dyn Learner) -> (Vec<u32>, Vec<NamedState<'static>>) {
    let params = learner.params().iter().map(|param| param.to_bits()).collect();
    (params, learner.state().into_iter().map(NamedState::into_owned).collect())
}

#[test]
fn a_learner_goes_on_from_its_state_as_if_it_had_never_stopped() {
    for method in [Method::Mappo, Method::Mat] {
        let (mut first, episodes) = under_training(method);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let values = first.learn(&batch, draw(0)).unwrap();
        assert_eq!(values.len(), first.measures().len());
        let (params, state) = (first.params().to_vec(), everything(&*first).1);
        let (mut second, _) = under_training(method);
        second.restore(&params, &state).unwrap();
        assert!(everything(&*first) == everything(&*second), "{method}");
        assert_eq!(first.learn(&batch, draw(1)).unwrap(), second.learn(&batch, draw(1)).unwrap());
        assert!(everything(&*first) == everything(&*second), "{method}");
        // The order of minibatches is the update's own.
        let (mut third, _) = under_training(method);
        third.restore(&params, &state).unwrap();
        third.learn(&batch, draw(2)).unwrap();
        assert!(everything(&*first) != everything(&*third), "{method}");
    }
}

#[test]
fn what_is_not_finite_leaves_everything_as_it_was() {
    for method in [Method::Mappo, Method::Mat] {
        let (mut learner, mut episodes) = under_training(method);
        let before = everything(&*learner);
        episodes[1].rewards[0] = f32::NAN;
        let error = learner.learn(&episodes.iter().collect::<Vec<_>>(), draw(0)).unwrap_err();
        assert_eq!(error.to_string(), "policy_loss is not finite");
        assert!(before == everything(&*learner), "{method}");
        // And it goes on.
        episodes[1].rewards[0] = 0.0;
        learner.learn(&episodes.iter().collect::<Vec<_>>(), draw(0)).unwrap();
    }
}

#[test]
fn a_model_says_which_size_it_cannot_have() {
    let config = |change: fn(&mut ModelConfig)| {
        let mut config = sizes(Method::Mat);
        change(&mut config);
        Model::new(config).map(|_| ()).map_err(|error| error.to_string())
    };
    assert_eq!(
        config(|config| config.n_heads = 3).unwrap_err(),
        "network.hidden_dim = 8 is not a multiple of network.n_heads = 3"
    );
    assert_eq!(
        config(|config| config.n_blocks = 0).unwrap_err(),
        "network.n_blocks is 0; it must be at least 1"
    );
    // MAPPO has no heads.
    assert!(config(|config| (config.method, config.n_heads) = (Method::Mappo, 3)).is_ok());
}
