//! MAPPO and MAT: what a batch's weights said, what the losses compare with, the losses, their gradients.

use super::{Cells, OptimizerConfig, Padding, Report, Tensors};
use rit_algo::{
    Mappo, MappoActing, MappoConfig, Mat, MatActing, MatConfig, PpoConfig, TerminalStates, UpdateConfig,
    estimators::value_norm::ValueNorm,
    flat::Slots,
    on_policy::{ActorCritic, Losses, Ppo, Said, Targets},
};
use rit_episode::{Choice, Episode, Exploration, Observation, Policy, RunSeed, Stream, Turn};
use rit_nn::{Optimizer, categorical, optimizer};
use serde::Deserialize;
use std::{collections::HashMap, fs, path::Path, sync::Arc};

#[derive(Deserialize)]
struct Case {
    config: serde_json::Value,
    gamma: f32,
    gae_lambda: f64,
    clip: f64,
    entropy_coef: f64,
    value_coef: f64,
    huber_delta: f64,
    minibatches: usize,
    grad_norm_clip: f64,
    optimizer: OptimizerConfig,
    value_norm: ValueNorms,
    scalars: HashMap<String, f64>,
}

#[derive(Deserialize)]
struct ValueNorms {
    beta: f64,
    before: Averages,
    after: Averages,
}

#[derive(Deserialize)]
struct Averages {
    mean: f64,
    mean_square: f64,
    debias: f64,
}

/// What of an on-policy case is told by its algorithm.
struct Method<N> {
    network: N,
    /// Greedy actions of one episode, `[T, n]`.
    greedy: fn(&Arc<N>, &[f32], &Episode, usize) -> Vec<u8>,
    /// Names of the gradients' norms.
    norms: &'static [&'static str],
}

/// Compares a case, cut into so many shards.
pub fn compare(
    folder: &Path,
    algorithm: &str,
    shards: usize,
    terminal_states: TerminalStates,
    report: &mut Report,
) {
    let case: Case = serde_json::from_slice(&fs::read(folder.join("case.json")).unwrap()).unwrap();
    let size = |name: &str| case.config[name].as_u64().unwrap_or_else(|| panic!("config.{name}")) as usize;
    let slots = Slots {
        agents_max: size("agents_max"),
        entities_max: size("entities_max"),
        entity_dim: size("entity_dim"),
    };
    let n_actions = size("n_actions");
    match algorithm {
        "mappo" => {
            let network = Mappo::new(MappoConfig { slots, n_actions, hidden_dim: size("hidden_dim") });
            let greedy = |network: &Arc<Mappo>, params: &[f32], episode: &Episode, n_actions| {
                act(&mut MappoActing::new(Arc::clone(network), params), episode, n_actions)
            };
            let norms = &["actor_grad_norm", "critic_grad_norm"];
            compare_method(
                folder,
                &case,
                Method { network, greedy, norms },
                (shards, terminal_states),
                slots,
                report,
            );
        }
        "mat" => {
            let network = Mat::new(MatConfig {
                slots,
                n_actions,
                embed_dim: size("embed_dim"),
                n_heads: size("n_heads"),
                n_blocks: size("n_blocks"),
            });
            let greedy = |network: &Arc<Mat>, params: &[f32], episode: &Episode, n_actions| {
                act(&mut MatActing::new(Arc::clone(network), params), episode, n_actions)
            };
            let norms = &["grad_norm"];
            compare_method(
                folder,
                &case,
                Method { network, greedy, norms },
                (shards, terminal_states),
                slots,
                report,
            );
        }
        other => panic!("{}: unknown algorithm {other}", folder.display()),
    }
}

fn compare_method<N: ActorCritic>(
    folder: &Path,
    case: &Case,
    method: Method<N>,
    (shards, terminal_states): (usize, TerminalStates),
    slots: Slots,
    report: &mut Report,
) {
    let read = |name: &str| Tensors(fs::read(folder.join(name).with_extension("safetensors")).unwrap());
    let (batch, expected, gradients) = (read("batch"), read("expected"), read("gradients"));
    let network = Arc::new(method.network);
    let n_actions = network.n_actions();
    let (kind, lr) = case.optimizer.kind();
    let config = UpdateConfig {
        gamma: case.gamma,
        reward_scale: 1.0,
        lr,
        optimizer: kind,
        grad_norm_clip: case.grad_norm_clip,
        shards,
        threads: 2,
        terminal_states,
        ppo: PpoConfig {
            gae_lambda: case.gae_lambda,
            clip: case.clip,
            entropy_coef: case.entropy_coef,
            value_coef: case.value_coef,
            huber_delta: case.huber_delta,
            epochs: 1,
            minibatches: case.minibatches,
            value_norm_beta: case.value_norm.beta,
        },
    };
    let padding = Padding {
        entity_dim: slots.entity_dim,
        n_actions,
        agents_max: slots.agents_max,
        entities_max: slots.entities_max,
    };
    let cells = Cells::read(&batch, padding);
    let episodes: Vec<Episode> = (0..cells.episodes()).map(|index| cells.episode(&batch, index)).collect();
    let batch_of: Vec<&Episode> = episodes.iter().collect();
    let flat = |tensors: &Tensors| super::flat(network.layout(), tensors, 0..network.layout().len());

    // Once per batch, with the weights that rolled it.
    let mut ppo = Ppo::new(Arc::clone(&network), config, flat(&read("start_weights"))).unwrap();
    let Averages { mean, mean_square, debias } = case.value_norm.before;
    ppo.value_norm = ValueNorm { mean, mean_square, debias };
    let sampled = sampled_actions(&mut ppo, &cells, &batch, &episodes, n_actions);
    let said = ppo.said(&batch_of);
    let targets = ppo.targets(&batch_of, said);
    let after = &case.value_norm.after;
    report.values("value_norm.mean", &[ppo.value_norm.mean as f32], &[after.mean as f32]);
    report.values(
        "value_norm.mean_square",
        &[ppo.value_norm.mean_square as f32],
        &[after.mean_square as f32],
    );
    report.values("value_norm.debias", &[ppo.value_norm.debias as f32], &[after.debias as f32]);

    // Somewhere in the epochs.
    ppo.params = flat(&read("weights"));
    let said = ppo.said(&batch_of);
    let greedy: Vec<Vec<u8>> = episodes
        .iter()
        .map(|episode| (method.greedy)(&network, &ppo.params[network.acting()], episode, n_actions))
        .collect();
    let networks = Networks { targets: &targets, said: &said, sampled: &sampled, greedy: &greedy };
    networks.compare(&cells, &expected, terminal_states, report);

    let permutation = batch.i32("permutation");
    let first: Vec<usize> =
        permutation[..episodes.len() / case.minibatches].iter().map(|&episode| episode as usize).collect();
    let losses = ppo.gradients(&batch_of, &targets, &first);
    compare_losses(&losses, &case.scalars, method.norms, report);
    for param in network.layout().params() {
        let name = format!("gradient of {}", param.name);
        report.gradients(&name, &ppo.grads()[param.range.clone()], &gradients.f32(&param.name));
    }

    // The optimiser, fed with the stored gradients.
    let mut stored = flat(&gradients);
    for part in network.clipped_apart() {
        let norm = optimizer::sum_of_squares(&stored[part.clone()]).sqrt();
        let scale = optimizer::clip_scale(norm, case.grad_norm_clip);
        stored[part].iter_mut().for_each(|grad| *grad *= scale);
    }
    let mut stepped = ppo.params.clone();
    Optimizer::new(kind, lr, stepped.len()).step(&mut stepped, &stored, 1.0);
    let after = read("weights_after_step");
    for param in network.layout().params() {
        let name = format!("{} after one step", param.name);
        report.values(&name, &stepped[param.range.clone()], &after.f32(&param.name));
    }
}

fn compare_losses(
    losses: &Losses,
    scalars: &HashMap<String, f64>,
    norms: &'static [&'static str],
    report: &mut Report,
) {
    let of_losses = [
        ("policy_loss", losses.sums.policy_loss),
        ("entropy", losses.sums.entropy),
        ("value_loss", losses.sums.value_loss),
        ("loss", losses.loss),
    ];
    let of_norms = norms.iter().copied().zip(losses.grad_norms.iter().copied());
    let ours: HashMap<&str, f64> = of_losses.into_iter().chain(of_norms).collect();
    assert_eq!(ours.len(), scalars.len(), "as many as the reference has");
    for (name, theirs) in scalars {
        report.values(name, &[ours[name.as_str()] as f32], &[*theirs as f32]);
    }
}

/// A tensor's part of an episode.
type OfEpisode<'a> = &'a dyn Fn(usize) -> Vec<f32>;

/// What the networks said of each episode, and what follows.
struct Networks<'a> {
    targets: &'a [Targets],
    said: &'a [Said],
    sampled: &'a [Vec<u8>],
    greedy: &'a [Vec<u8>],
}

impl Networks<'_> {
    /// Compares every tensor of `expected`, zeros where nothing is included.
    fn compare(
        &self,
        cells: &Cells,
        expected: &Tensors,
        terminal_states: TerminalStates,
        report: &mut Report,
    ) {
        let Self { targets, said, sampled, greedy } = *self;
        let f32s = |values: &[f64]| values.iter().map(|&x| x as f32).collect();
        let of_values: [(&str, OfEpisode<'_>); 8] = [
            ("old_log_probs", &|at| targets[at].old.log_probs.clone()),
            ("advantages", &|at| f32s(&targets[at].advantages)),
            ("returns", &|at| f32s(&targets[at].returns)),
            ("value_targets", &|at| targets[at].value_targets.clone()),
            ("normalized_advantages", &|at| targets[at].normalized_advantages.clone()),
            ("logits", &|at| said[at].logits.clone()),
            ("log_probs", &|at| said[at].log_probs.clone()),
            ("entropies", &|at| said[at].entropies.clone()),
        ];
        for (name, of_episode) in of_values {
            let theirs = expected.f32(name);
            report.values(name, &cells.padded(of_episode, theirs.len(), 0), &theirs);
        }
        // The states after the last step are there where they are kept.
        if terminal_states == TerminalStates::Kept {
            let of_states: [(&str, OfEpisode<'_>); 2] = [
                ("old_values", &|at| targets[at].old.values.clone()),
                ("values", &|at| said[at].values.clone()),
            ];
            for (name, of_episode) in of_states {
                let theirs = expected.f32(name);
                report.values(name, &cells.padded(of_episode, theirs.len(), 1), &theirs);
            }
        }
        let chooses = |at: usize| targets[at].chooses.iter().map(|&flag| f32::from(u8::from(flag))).collect();
        let theirs = expected.f32("chooses");
        report.equal("chooses", &cells.padded(&chooses, theirs.len(), 0), &theirs);
        for (name, actions) in [("sampled_actions", sampled), ("greedy_actions", greedy)] {
            let of_episode = |at: usize| actions[at].iter().map(|&action| f32::from(action)).collect();
            let theirs: Vec<f32> = expected.i32(name).into_iter().map(|action| action as f32).collect();
            report.equal(name, &cells.padded(&of_episode, theirs.len(), 0), &theirs);
        }
    }
}

impl Cells {
    /// A tensor of `len` numbers over the batch's steps and so many more, from each episode's own; zeros elsewhere.
    fn padded(&self, of_episode: OfEpisode<'_>, len: usize, more_steps: usize) -> Vec<f32> {
        let times = self.steps_max + more_steps;
        let width = len / (self.episodes() * times);
        let mut padded = vec![0.0; len];
        for (index, padded) in padded.chunks_exact_mut(times * width).enumerate() {
            assert!(self.agents[index].iter().copied().eq(0..self.agents[index].len()), "agents come first");
            let own = of_episode(index);
            let own = own.chunks_exact(own.len() / (self.steps[index] + more_steps));
            for (own, padded) in own.zip(padded.chunks_exact_mut(width)) {
                padded[..own.len()].copy_from_slice(own);
            }
        }
        padded
    }
}

/// The actions that the batch's uniform numbers sample, row after row, each given those sampled before it.
fn sampled_actions<N: ActorCritic>(
    ppo: &mut Ppo<N>,
    cells: &Cells,
    batch: &Tensors,
    episodes: &[Episode],
    n_actions: usize,
) -> Vec<Vec<u8>> {
    let uniforms = batch.f32("uniforms");
    let mut episodes = episodes.to_vec();
    let most = episodes.iter().map(|episode| episode.n_agents).max().unwrap();
    for agent in 0..most {
        let said = ppo.said(&episodes.iter().collect::<Vec<_>>());
        for (index, (episode, said)) in episodes.iter_mut().zip(said).enumerate() {
            let n = episode.n_agents;
            for time in (0..episode.steps()).filter(|_| agent < n) {
                let of_row = (time * n + agent) * n_actions..(time * n + agent + 1) * n_actions;
                let cell = (index * cells.steps_max + time) * cells.padding.agents_max + agent;
                episode.actions[time * n + agent] = categorical::sample(
                    &said.logits[of_row.clone()],
                    &episode.available[of_row],
                    uniforms[cell],
                );
            }
        }
    }
    episodes.into_iter().map(|episode| episode.actions).collect()
}

/// What a greedy policy does in the states of an episode, `[T, n]`.
fn act(policy: &mut dyn Policy, episode: &Episode, n_actions: usize) -> Vec<u8> {
    let (n, m) = (episode.n_agents, episode.n_entities);
    let d = episode.entities.len() / ((episode.steps() + 1) * m);
    let mut actions = vec![0; episode.steps() * n];
    policy.begin(0, n);
    for (time, actions) in actions.chunks_exact_mut(n).enumerate() {
        let mut observation = Observation::new(n, m, d, n_actions);
        for entity in 0..m {
            let features = &episode.entities[(time * m + entity) * d..][..d];
            observation.entity_mut(entity).copy_from_slice(features);
        }
        for agent in 0..n {
            let seen = &episode.observable[(time * n + agent) * m..][..m];
            observation.observable_mut(agent).copy_from_slice(seen);
            let available = &episode.available[(time * n + agent) * n_actions..][..n_actions];
            observation.available_mut(agent).copy_from_slice(available);
        }
        let mut exploration =
            Exploration::new(Choice::Greedy, 0.0, n, RunSeed(0).stream(Stream::Exploration, 0));
        policy.act(&mut [Turn {
            slot: 0,
            observation: &observation,
            previous_reward: 0.0,
            exploration: &mut exploration,
            actions,
        }]);
    }
    actions
}
