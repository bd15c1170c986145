//! MAPPO and MAT: what a batch's weights said, what the losses compare with, the losses, their gradients.

use super::{
    Cells, Cut, OptimizerConfig, Padding, Report, Tensors, compare_gradients, compare_step, described,
    stored_gradients,
};
use rit_algo::{
    Mappo, MappoActing, MappoConfig, Mat, MatActing, MatConfig, PpoConfig, TerminalStates, UpdateConfig,
    estimators::value_norm::ValueNorm,
    flat::Slots,
    on_policy::{ActorCritic, Losses, Ppo, Said, Targets},
};
use rit_episode::{Choice, Episode, Exploration, Observation, Policy, RunSeed, Stream, Turn};
use rit_nn::categorical;
use serde::Deserialize;
use std::{collections::HashMap, sync::Arc};

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

/// Compares a case.
pub fn compare(cut: Cut<'_>, algorithm: &str, report: &mut Report) {
    let case: Case = described(cut.folder);
    let size = |name: &str| match case.config[name].as_u64() {
        Some(size) => size as usize,
        None => panic!("case.json: config.{name} is no size"),
    };
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
            compare_method(cut, &case, Method { network, greedy, norms }, slots, report);
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
            compare_method(cut, &case, Method { network, greedy, norms: &["grad_norm"] }, slots, report);
        }
        other => panic!("unknown algorithm {other}"),
    }
}

fn update_config(case: &Case, shards: usize, terminal_states: TerminalStates) -> UpdateConfig {
    let (optimizer, lr) = case.optimizer.kind();
    UpdateConfig {
        gamma: case.gamma,
        reward_scale: 1.0,
        lr,
        optimizer,
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
    }
}

fn compare_method<N: ActorCritic>(
    cut: Cut<'_>,
    case: &Case,
    method: Method<N>,
    slots: Slots,
    report: &mut Report,
) {
    let Cut { folder, shards, terminal_states } = cut;
    let (batch, expected) = (Tensors::read(folder, "batch"), Tensors::read(folder, "expected"));
    let network = Arc::new(method.network);
    let (layout, n_actions) = (network.layout(), network.n_actions());
    let Slots { agents_max, entities_max, entity_dim } = slots;
    let cells = Cells::read(&batch, Padding { entity_dim, n_actions, agents_max, entities_max });
    cells.assert_in_slots();
    let episodes: Vec<Episode> = (0..cells.episodes()).map(|index| cells.episode(&batch, index)).collect();
    let batch_of: Vec<&Episode> = episodes.iter().collect();
    let weights = |name: &str| Tensors::read(folder, name).params(layout.params(), None);

    // Once per batch, with the weights that rolled it.
    let config = update_config(case, shards, terminal_states);
    let mut ppo = Ppo::new(Arc::clone(&network), config, weights("start_weights")).unwrap();
    let Averages { mean, mean_square, debias } = case.value_norm.before;
    ppo.value_norm = ValueNorm { mean, mean_square, debias };
    let sampled = expected
        .holds("sampled_actions")
        .then(|| sampled_actions(&mut ppo, &cells, &batch, &episodes, n_actions));
    let said = ppo.said(&batch_of);
    let targets = ppo.targets(&batch_of, said);
    compare_value_norm(&ppo.value_norm, &case.value_norm.after, report);

    // Somewhere in the epochs.
    ppo.params = weights("weights");
    let said = ppo.said(&batch_of);
    let greedy: Vec<Vec<u8>> = episodes
        .iter()
        .map(|episode| (method.greedy)(&network, &ppo.params[network.acting()], episode, n_actions))
        .collect();
    let losses =
        ppo.gradients(&batch_of, &targets, &first_minibatch(&batch, episodes.len(), case.minibatches));
    let scalars = scalars(&losses, method.norms);
    for (name, &theirs) in &case.scalars {
        report.scalar(name, &scalars, theirs);
    }
    let sampled = sampled.unwrap_or_default();
    let networks = Networks { targets: &targets, said: &said, sampled: &sampled, greedy: &greedy };
    networks.compare(&cells, &expected, &scalars, terminal_states, report);
    let stored = stored_gradients(folder, layout);
    compare_gradients(layout, ppo.grads(), &stored, report);
    let optimizer = (&case.optimizer, case.grad_norm_clip);
    compare_step(folder, layout, &ppo.params, stored, &network.clipped_apart(), optimizer, report);
}

fn compare_value_norm(ours: &ValueNorm, theirs: &Averages, report: &mut Report) {
    for (name, ours, theirs) in [
        ("mean", ours.mean, theirs.mean),
        ("mean_square", ours.mean_square, theirs.mean_square),
        ("debias", ours.debias, theirs.debias),
    ] {
        report.values(&format!("value_norm.{name}"), &[ours as f32], &[theirs as f32]);
    }
}

/// The episodes whose losses the case has. Where the batch does not say, they are in order.
fn first_minibatch(batch: &Tensors, episodes: usize, minibatches: usize) -> Vec<usize> {
    let permutation: Vec<usize> = if batch.holds("permutation") {
        batch.i32("permutation").into_iter().map(|episode| episode as usize).collect()
    } else {
        (0..episodes).collect()
    };
    permutation[..episodes / minibatches].to_vec()
}

/// What a step reports, by name.
fn scalars(losses: &Losses, norms: &'static [&'static str]) -> HashMap<&'static str, f64> {
    let whole = losses.grad_norms.iter().map(|norm| norm * norm).sum::<f64>().sqrt();
    let of_losses = [
        ("policy_loss", losses.sums.policy_loss),
        ("entropy", losses.sums.entropy),
        ("value_loss", losses.sums.value_loss),
        ("loss", losses.loss),
        ("ratio_mean", losses.sums.ratio),
        ("clipped_share", losses.sums.clipped),
        ("kl", losses.sums.kl),
        ("grad_norm", whole),
    ];
    let of_norms = norms.iter().copied().zip(losses.grad_norms.iter().copied());
    of_losses.into_iter().chain(of_norms).collect()
}

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
        scalars: &HashMap<&str, f64>,
        terminal_states: TerminalStates,
        report: &mut Report,
    ) {
        for (name, shape) in expected.shapes() {
            let theirs = expected.f32(&name);
            if shape.len() < 2 {
                report.scalar(&name, scalars, theirs[0].into());
                continue;
            }
            // The states after the last step are there where they are kept.
            let of_states = matches!(name.as_str(), "old_values" | "values");
            if of_states && terminal_states == TerminalStates::LeftOut {
                continue;
            }
            let ours = cells.padded(|at| self.of_episode(&name, at), theirs.len(), usize::from(of_states));
            match name.as_str() {
                "chooses" | "sampled_actions" | "greedy_actions" => report.equal(&name, &ours, &theirs),
                _ => report.values(&name, &ours, &theirs),
            }
        }
    }

    /// An expected tensor's part of an episode.
    fn of_episode(&self, name: &str, at: usize) -> Vec<f32> {
        let (targets, said) = (&self.targets[at], &self.said[at]);
        let of_f64 = |numbers: &[f64]| numbers.iter().map(|&number| number as f32).collect();
        let of_actions = |actions: &[u8]| actions.iter().map(|&action| f32::from(action)).collect();
        match name {
            "old_log_probs" => targets.old.log_probs.clone(),
            "old_values" => targets.old.values.clone(),
            "advantages" => of_f64(&targets.advantages),
            "returns" => of_f64(&targets.returns),
            "value_targets" => targets.value_targets.clone(),
            "normalized_advantages" => targets.normalized_advantages.clone(),
            "chooses" => targets.chooses.iter().map(|&flag| f32::from(u8::from(flag))).collect(),
            "logits" => said.logits.clone(),
            "log_probs" => said.log_probs.clone(),
            "entropies" => said.entropies.clone(),
            "values" => said.values.clone(),
            "sampled_actions" => of_actions(&self.sampled[at]),
            "greedy_actions" => of_actions(&self.greedy[at]),
            _ => panic!("expected.safetensors: nothing says {name}"),
        }
    }
}

impl Cells {
    /// Inputs of fixed length have a slot for each row, so rows must lie where the specification puts them.
    fn assert_in_slots(&self) {
        let first = self.padding.agents_max;
        for (agents, entities) in self.agents.iter().zip(&self.entities) {
            let (n, m) = (agents.len(), entities.len());
            let in_order = (0..n).chain(first..first + m - n);
            assert!(entities.iter().copied().eq(in_order), "batch.safetensors: rows between absent ones");
        }
    }

    /// A tensor of `len` numbers over the batch's steps and so many more, from each episode's own; zeros elsewhere.
    fn padded(&self, of_episode: impl Fn(usize) -> Vec<f32>, len: usize, more_steps: usize) -> Vec<f32> {
        let times = self.steps_max + more_steps;
        let width = len / (self.episodes() * times);
        let mut padded = vec![0.0; len];
        for (index, padded) in padded.chunks_exact_mut(times * width).enumerate() {
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
