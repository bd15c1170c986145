//! Cases of methods that learn utilities by temporal differences.

use super::{Cells, OptimizerConfig, Padding, Report, Tensors, compare_step, flat, rivals};
use rit_algo::{
    Method, Model, ModelConfig, PpoConfig, RoleConfig, TerminalStates, UpdateConfig,
    drive::{SeenShard, TdLearner, ValueNetwork},
    method::Encoder,
    methods::{Recurrent, Refil, Roma, Updet},
};
use rit_episode::Episode;
use serde::Deserialize;
use std::{
    collections::{BTreeMap, HashMap},
    fs,
    path::Path,
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
    #[serde(default)]
    imagined_weight: f32,
    #[serde(flatten)]
    role: Option<rivals::Role>,
}

/// Values of one state, by the names of golden data: numbers of every agent, or of the group.
type Said = HashMap<&'static str, Values>;

struct Values {
    per_agent: bool,
    numbers: Vec<f32>,
}

/// A method under comparison.
struct Compared<'a> {
    folder: &'a Path,
    case: Case,
    model: Arc<Model>,
    update: UpdateConfig,
    batch: Tensors,
    cells: Cells,
    episodes: Vec<Episode>,
}

pub fn compare(
    folder: &Path,
    algorithm: &str,
    shards: usize,
    terminal_states: TerminalStates,
    report: &mut Report,
) {
    let case: Case = serde_json::from_slice(&fs::read(folder.join("case.json")).unwrap()).unwrap();
    let (method, sizes) = (algorithm.parse::<Method>().unwrap(), &case.config);
    let config = ModelConfig {
        method,
        encoder: match sizes.encoder.as_deref() {
            Some("within") => Encoder::Within,
            Some("beside") => Encoder::Beside,
            Some("tokens") => Encoder::Tokens,
            Some(other) => panic!("encoder {other}"),
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
        imagined_weight: sizes.imagined_weight,
        role: sizes.role.as_ref().map_or_else(RoleConfig::default, rivals::Role::config),
    };
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
    let padding = Padding {
        entity_dim: sizes.entity_dim,
        n_actions: sizes.n_actions,
        agents_max: sizes.agents_max,
        entities_max: sizes.entities_max,
    };
    let cells = Cells::read(&batch, padding);
    let episodes = (0..cells.episodes()).map(|index| cells.episode(&batch, index)).collect();
    let model = Arc::new(Model::new(config.clone()).unwrap_or_else(|error| panic!("{algorithm}: {error}")));
    let compared = Compared { folder, case, model, update, batch, cells, episodes };
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
        let weights = flat(&parts.layout, &Tensors::read(self.folder, "weights"), 0..parts.layout.len());
        let mut learner =
            TdLearner::new(Arc::clone(&self.model), Arc::clone(&network), self.update, weights.clone())
                .unwrap();
        // The target's pass may use less than the target covers: what it does not use may be anything.
        let target_weights = Tensors::read(self.folder, "target_weights");
        for param in parts.layout.params().iter().filter(|param| param.range.end <= parts.target.end) {
            let of_param = &mut learner.target[param.range.clone()];
            if target_weights.holds(&param.name) {
                of_param.copy_from_slice(&target_weights.f32(&param.name));
            } else {
                of_param.fill(f32::NAN);
            }
        }

        let pairing = self.batch.holds("pairing").then(|| self.batch.i32("pairing"));
        let said = Mutex::new(HashMap::new());
        let values = learner.gradients_seen(
            &self.episodes.iter().collect::<Vec<_>>(),
            draws,
            |rows| {
                let pairing: Vec<usize> = pairing.iter().flatten().map(|&row| row as usize).collect();
                assert_eq!(rows, pairing.len(), "one pair for each filled agent row");
                pairing
            },
            |seen| said.lock().unwrap().extend(states(seen)),
        );

        let mut losses: HashMap<&str, f64> =
            network.measures().iter().map(|measure| measure.name).zip(values).collect();
        losses.insert("loss", loss(&losses));
        for (name, &theirs) in &self.case.scalars {
            let ours = losses.get(name.as_str()).unwrap_or_else(|| panic!("{name} is not measured"));
            report.values(name, &[*ours as f32], &[theirs as f32]);
        }
        // What training leaves out cannot be compared one by one: losses and gradients show that it does not count.
        if self.update.terminal_states == TerminalStates::Kept {
            self.compare_values(&said.into_inner().unwrap(), report);
        }
        let gradients = Tensors::read(self.folder, "gradients");
        let names: Vec<&str> = parts.layout.params().iter().map(|param| param.name.as_str()).collect();
        for (name, _) in gradients.shapes() {
            assert!(names.contains(&name.as_str()), "{}: there is no parameter {name}", report.case);
        }
        for param in parts.layout.params() {
            let name = format!("gradient of {}", param.name);
            report.gradients(&name, &learner.grads()[param.range.clone()], &gradients.f32(&param.name));
        }
        let optimizer = (self.update.optimizer, self.update.lr);
        compare_step(self.folder, &parts.layout, &weights, optimizer, self.update.grad_norm_clip, report);
    }

    /// Compares every tensor that is expected, where filled and real. `said` by (episode, time).
    fn compare_values(&self, said: &HashMap<(usize, usize), Said>, report: &mut Report) {
        let expected = Tensors::read(self.folder, "expected");
        let (cells, agents_max) = (&self.cells, self.case.config.agents_max);
        let scalars = &self.case.scalars;
        for (name, shape) in expected.shapes().into_iter().filter(|(name, _)| !scalars.contains_key(name)) {
            // Of the state after a step: they say what its target is made of.
            let behind = matches!(name.as_str(), "greedy_actions" | "target_q_total");
            let theirs: Vec<f32> = if name == "greedy_actions" {
                expected.i32(&name).into_iter().map(|action| action as f32).collect()
            } else {
                expected.f32(&name)
            };
            let (mut ours, mut reference) = (vec![], vec![]);
            for (episode, &steps) in cells.steps.iter().enumerate() {
                for time in 0..steps {
                    let state = &said[&(episode, time + usize::from(behind))];
                    let Some(values) = state.get(name.as_str()) else {
                        panic!("{}: the learner reports no {name}", report.case)
                    };
                    let cell = episode * shape[1] + time;
                    ours.extend_from_slice(&values.numbers);
                    if rivals::of_pairs(&name) {
                        for &row in &cells.agents[episode] {
                            let row = &theirs[(cell * agents_max + row) * agents_max..][..agents_max];
                            reference.extend(cells.agents[episode].iter().map(|&other| row[other]));
                        }
                    } else if values.per_agent {
                        let width: usize = shape[3..].iter().product();
                        for &row in &cells.agents[episode] {
                            reference
                                .extend_from_slice(&theirs[(cell * agents_max + row) * width..][..width]);
                        }
                    } else {
                        reference.push(theirs[cell]);
                    }
                }
            }
            report.values(&name, &ours, &reference);
        }
    }
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
            let per_agent = view.rows == rows.agent_rows() && view.cols > 0 && name != "q_total";
            let of_state = match per_agent {
                _ if rivals::of_pairs(name) => pairs.clone(),
                true => members.clone(),
                false => group..group + 1,
            };
            let numbers = of_state.flat_map(|row| view.row(row).to_vec()).collect();
            said.insert(name, Values { per_agent, numbers });
        }
        let of_group = [("target_q_total", seen.target_q_total), ("td_target", seen.td_targets)];
        for (name, values) in of_group {
            said.insert(name, Values { per_agent: false, numbers: vec![values[group]] });
        }
        let greedy = seen.greedy_actions[members].iter().map(|&action| f32::from(action)).collect();
        said.insert("greedy_actions", Values { per_agent: true, numbers: greedy });
        ((seen.first_episode + step.episode, step.time), said)
    });
    states.collect()
}
