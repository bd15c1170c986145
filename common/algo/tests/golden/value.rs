//! Cases of methods that learn utilities by temporal differences.

use super::{
    Cells, Cut, OptimizerConfig, Padding, Report, Tensors, compare_gradients, compare_step, described,
    rivals, stored_gradients,
};
use rit_algo::{
    Method, ModelConfig, PpoConfig, TerminalStates, UpdateConfig,
    drive::{SeenShard, TdLearner, ValueNetwork},
    method::Encoder,
    methods::{Recurrent, Refil, Roma, Updet},
};
use rit_episode::Episode;
use serde::Deserialize;
use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
    slice,
    sync::{Arc, Mutex},
};

#[derive(Deserialize)]
struct Case {
    config: Sizes,
    gamma: f32,
    grad_norm_clip: f64,
    optimizer: OptimizerConfig,
    scalars: BTreeMap<String, f64>,
}

#[derive(Deserialize)]
struct Sizes {
    encoder: Option<String>,
    entity_dim: usize,
    n_actions: usize,
    agents_max: usize,
    entities_max: usize,
    hidden_dim: usize,
    attention_dim: usize,
    n_heads: usize,
    #[serde(default)]
    task_representation_dim: usize,
    #[serde(default)]
    reward_embed_dim: usize,
    #[serde(default)]
    mixing_embed_dim: usize,
    #[serde(default)]
    hypernet_embed_dim: usize,
    #[serde(default)]
    feedforward_dim: usize,
    imagined_weight: Option<f32>,
    #[serde(flatten)]
    role: Option<rivals::Role>,
}

/// Values of one state, by the names of golden data: numbers of every agent, of every ordered pair, or of the group.
type Said = HashMap<&'static str, Vec<f32>>;

/// A method under comparison.
struct Compared<'a> {
    folder: &'a Path,
    case: Case,
    update: UpdateConfig,
    batch: Tensors,
    cells: Cells,
    episodes: Vec<Episode>,
}

/// Compares a case.
pub fn compare(cut: Cut<'_>, algorithm: &str, report: &mut Report) {
    let Cut { folder, shards, terminal_states } = cut;
    let case: Case = described(folder);
    let method: Method = algorithm.parse().unwrap_or_else(|error| panic!("{error}"));
    let config = model_config(method, &case.config);
    let (optimizer, lr) = case.optimizer.kind();
    let update = UpdateConfig {
        gamma: case.gamma,
        reward_scale: 1.0,
        lr,
        optimizer,
        grad_norm_clip: case.grad_norm_clip,
        shards,
        threads: 2,
        terminal_states,
        ppo: PpoConfig::default(),
    };
    let batch = Tensors::read(folder, "batch");
    let ModelConfig { entity_dim, n_actions, agents_max, entities_max, .. } = config;
    let cells = Cells::read(&batch, Padding { entity_dim, n_actions, agents_max, entities_max });
    let episodes = (0..cells.episodes()).map(|index| cells.episode(&batch, index)).collect();
    config.validate().unwrap_or_else(|error| panic!("case.json: {algorithm}: {error}"));
    let compared = Compared { folder, case, update, batch, cells, episodes };
    match method {
        Method::Rit
        | Method::RitVdn
        | Method::RitNoTaskRepresentations
        | Method::QmixAttn
        | Method::VdnAttn
        | Method::QmixInt
        | Method::VdnInt => compared.run(
            Recurrent::new(&config),
            &(),
            |losses| losses["td_loss"] + losses.get("contrastive_loss").unwrap_or(&0.0),
            report,
        ),
        Method::UpdetMix | Method::UpdetVdn => {
            compared.run(Updet::new(&config), &(), |losses| losses["td_loss"], report);
        }
        Method::Refil => {
            let weight = f64::from(config.imagined_weight);
            let loss = |losses: &HashMap<&str, f64>| {
                (1.0 - weight) * losses["td_loss"] + weight * losses["imagined_loss"]
            };
            let groups = rivals::groups(&compared.batch, &compared.cells);
            compared.run(Refil::new(&config), &groups, loss, report);
        }
        Method::Roma => {
            let weight = f64::from(config.role.dissimilarity_weight);
            let loss = |losses: &HashMap<&str, f64>| {
                losses["td_loss"] + losses["role_loss"] + weight * losses["dissimilarity_loss"]
            };
            let noise = rivals::noise(&compared.batch, &compared.cells, config.role.dim);
            compared.run(Roma::new(&config), &noise, loss, report);
        }
        Method::Mappo | Method::Mat => panic!("{method} has no utilities"),
    }
}

fn model_config(method: Method, sizes: &Sizes) -> ModelConfig {
    let role = sizes.role.as_ref().map(rivals::Role::config);
    assert!(role.is_some() || method != Method::Roma, "case.json: config lacks sizes or weights of roles");
    ModelConfig {
        method,
        encoder: match sizes.encoder.as_deref() {
            Some("within") => Encoder::Within,
            Some("beside") => Encoder::Beside,
            Some("tokens") => Encoder::Tokens,
            Some(other) => panic!("case.json: encoder {other}"),
            None => method.facts().encoder,
        },
        entity_dim: sizes.entity_dim,
        n_actions: sizes.n_actions,
        hidden_dim: sizes.hidden_dim,
        attention_dim: sizes.attention_dim,
        agents_max: sizes.agents_max,
        entities_max: sizes.entities_max,
        n_heads: sizes.n_heads,
        n_blocks: 1,
        task_representation_dim: sizes.task_representation_dim,
        reward_embed_dim: sizes.reward_embed_dim,
        mixing_embed_dim: sizes.mixing_embed_dim,
        hypernet_embed_dim: sizes.hypernet_embed_dim,
        feedforward_dim: sizes.feedforward_dim,
        imagined_weight: sizes.imagined_weight.unwrap_or(0.5),
        role: role.unwrap_or_default(),
    }
}

impl Compared<'_> {
    /// Compares values, losses, gradients and a step; `loss` makes the whole loss of its parts.
    fn run<N: ValueNetwork>(
        &self,
        network: N,
        draws: &N::Draws,
        loss: impl Fn(&HashMap<&str, f64>) -> f64,
        report: &mut Report,
    ) {
        let network = Arc::new(network);
        let parts = network.parts().clone();
        let params = parts.layout.params();
        let weights = Tensors::read(self.folder, "weights").params(params, None);
        let mut learner = TdLearner::new(Arc::clone(&network), self.update, weights.clone()).unwrap();
        // The target's pass may use less than the target covers: what it does not use may be anything.
        let covered = params.partition_point(|param| param.range.end <= parts.target.end);
        learner.target =
            Tensors::read(self.folder, "target_weights").params(&params[..covered], Some(f32::NAN));

        let pairing = self.batch.holds("pairing").then(|| self.batch.i32("pairing"));
        let said = Mutex::new(HashMap::new());
        let values = learner.gradients_seen(
            &self.episodes.iter().collect::<Vec<_>>(),
            draws,
            |rows| {
                let pairing: Vec<usize> = pairing.iter().flatten().map(|&row| row as usize).collect();
                assert_eq!(rows, pairing.len(), "batch.safetensors: one pairing for each filled agent row");
                pairing
            },
            |seen| said.lock().unwrap().extend(states(seen)),
        );
        let said = said.into_inner().unwrap();

        let mut losses: HashMap<&str, f64> =
            network.measures().iter().map(|measure| measure.name).zip(values).collect();
        losses.insert("loss", loss(&losses));
        for (name, &theirs) in &self.case.scalars {
            report.scalar(name, &losses, theirs);
        }
        // What training leaves out cannot be compared one by one: losses and gradients show that it does not count.
        if self.update.terminal_states == TerminalStates::Kept {
            self.compare_values(&losses, &said, report);
        }
        let stored = stored_gradients(self.folder, &parts.layout);
        compare_gradients(&parts.layout, learner.grads(), &stored, report);
        let optimizer = (&self.case.optimizer, self.case.grad_norm_clip);
        let whole = 0..parts.layout.len();
        compare_step(
            self.folder,
            &parts.layout,
            &weights,
            stored,
            slice::from_ref(&whole),
            optimizer,
            report,
        );
    }

    /// Compares every tensor that is expected, where filled and real. `said` by (episode, time).
    fn compare_values(
        &self,
        losses: &HashMap<&str, f64>,
        said: &HashMap<(usize, usize), Said>,
        report: &mut Report,
    ) {
        let expected = Tensors::read(self.folder, "expected");
        for (name, shape) in expected.shapes() {
            let theirs = expected.f32(&name);
            if shape.len() < 2 {
                report.scalar(&name, losses, theirs[0].into());
                continue;
            }
            // Of the state after a step: they say what its target is made of.
            let behind = usize::from(matches!(name.as_str(), "greedy_actions" | "target_q_total"));
            let (mut ours, mut reference) = (vec![], vec![]);
            for (episode, &steps) in self.cells.steps.iter().enumerate() {
                for time in 0..steps {
                    let state = &said[&(episode, time + behind)];
                    let Some(numbers) = state.get(name.as_str()) else {
                        panic!("expected.safetensors: the learner reports no {name}")
                    };
                    ours.extend_from_slice(numbers);
                    let cell = episode * shape[1] + time;
                    reference.extend(of_cell(&name, &shape, &theirs, cell, &self.cells.agents[episode]));
                }
            }
            report.values(&name, &ours, &reference);
        }
    }
}

/// The real numbers of one cell (episode, time) of an expected tensor. Its shape says what it has: (B, T) a number of each
/// state, (B, T, n, …) some of each agent; or one of each ordered pair, (B, T, n, n).
fn of_cell(name: &str, shape: &[usize], numbers: &[f32], cell: usize, agents: &[usize]) -> Vec<f32> {
    let [_, _, of_agents @ ..] = shape else { panic!("{name} has no cells") };
    let [n, of_agent @ ..] = of_agents else { return vec![numbers[cell]] };
    let width: usize = of_agent.iter().product();
    let of_agent = |agent: usize| &numbers[(cell * n + agent) * width..][..width];
    if rivals::of_pairs(name) {
        let pairs = agents.iter().flat_map(|&first| agents.iter().map(move |&second| (first, second)));
        return pairs.map(|(first, second)| of_agent(first)[second]).collect();
    }
    agents.iter().flat_map(|&agent| of_agent(agent)).copied().collect()
}

/// What was said of a shard, by (episode, time).
fn states(seen: &SeenShard<'_>) -> Vec<((usize, usize), Said)> {
    let rows = seen.rows;
    let groups = rows.steps.iter().zip(&rows.groups).enumerate();
    // Ordered pairs of agents in steps that were taken.
    let mut pairs = 0..0;
    let states = groups.map(|(group, (step, members))| {
        let members = members.queries.clone();
        pairs = pairs.end..pairs.end + if step.filled { members.len() * members.len() } else { 0 };
        let mut said = Said::new();
        for (name, view) in seen.values() {
            // Where every agent is alone, a row of its own is its group's too.
            let of_state = match view.rows == rows.agent_rows() {
                _ if rivals::of_pairs(name) => pairs.clone(),
                true => members.clone(),
                false => group..group + 1,
            };
            said.insert(name, of_state.flat_map(|row| view.row(row).to_vec()).collect());
        }
        said.insert("target_q_total", vec![seen.target_q_total[group]]);
        said.insert("td_target", vec![seen.td_targets[group]]);
        let greedy = seen.greedy_actions[members].iter().map(|&action| f32::from(action));
        said.insert("greedy_actions", greedy.collect());
        ((seen.first_episode + step.episode, step.time), said)
    });
    states.collect()
}
