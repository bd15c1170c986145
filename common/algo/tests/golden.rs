//! Parity with an independent implementation, tensor by tensor.
//!
//! Reads every folder under `RIT_GOLDEN_DIR`, by default the copy beside this file. All sizes come from the
//! case's own `case.json`. The references were computed in float64 and stored as f32.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

#[path = "golden/on_policy.rs"]
mod on_policy;

use rit_algo::{
    Losses, Mixing, Rit, RitConfig, Seen, TaskRepresentations, TerminalStates, Update, UpdateConfig,
};
use rit_episode::{End, Episode, decision_order};
use rit_nn::{Layout, Optimizer, OptimizerKind, optimizer};
use safetensors::SafeTensors;
use serde::Deserialize;
use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

/// Which algorithm a case is of: RIT where it does not say.
#[derive(Deserialize)]
struct Algorithm {
    algorithm: Option<String>,
}

#[derive(Deserialize)]
struct Case {
    config: Sizes,
    gamma: f32,
    grad_norm_clip: f64,
    optimizer: OptimizerConfig,
    scalars: Scalars,
}

#[derive(Deserialize)]
struct Sizes {
    entity_dim: usize,
    n_actions: usize,
    agents_max: usize,
    entities_max: usize,
    hidden_dim: usize,
    attention_dim: usize,
    n_heads: usize,
    task_representation_dim: usize,
    reward_embed_dim: usize,
    mixing_embed_dim: usize,
    hypernet_embed_dim: usize,
}

#[derive(Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
enum OptimizerConfig {
    RmsProp { lr: f32, eps: f32, alpha: f32 },
    Adam { lr: f32, eps: f32, betas: Option<[f32; 2]> },
}

impl OptimizerConfig {
    /// Which optimiser, and its learning rate.
    fn kind(&self) -> (OptimizerKind, f32) {
        match *self {
            Self::RmsProp { lr, eps, alpha } => (OptimizerKind::RmsProp { alpha, eps }, lr),
            Self::Adam { lr, eps, betas } => {
                let [beta1, beta2] = betas.unwrap_or([0.9, 0.999]);
                (OptimizerKind::Adam { beta1, beta2, eps }, lr)
            }
        }
    }
}

#[derive(Deserialize)]
struct Scalars {
    td_loss: f64,
    contrastive_loss: f64,
    loss: f64,
    grad_norm: f64,
}

#[test]
fn every_case_agrees_with_the_reference() {
    let root = std::env::var_os("RIT_GOLDEN_DIR")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden"), PathBuf::from);
    let entries = fs::read_dir(&root).unwrap_or_else(|error| panic!("{}: {error}", root.display()));
    let mut folders: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    folders.retain(|folder| folder.join("case.json").is_file());
    folders.sort();
    assert!(!folders.is_empty(), "{} holds no case", root.display());
    let mut differences = Vec::new();
    for folder in &folders {
        // However the batch is cut, the sums are the same within rounding.
        for (shards, terminal_states) in
            [(1, TerminalStates::Kept), (3, TerminalStates::Kept), (2, TerminalStates::LeftOut)]
        {
            let case = format!("{}, {shards} shards, terminal states {terminal_states:?}", folder.display());
            let mut report = Report { case, differences: vec![] };
            let bytes = fs::read(folder.join("case.json")).unwrap();
            match serde_json::from_slice::<Algorithm>(&bytes).unwrap().algorithm.as_deref() {
                Some(algorithm @ ("mappo" | "mat")) => {
                    on_policy::compare(folder, algorithm, shards, terminal_states, &mut report);
                }
                _ => compare(folder, shards, terminal_states, &mut report),
            }
            println!("{}: {} differences", report.case, report.differences.len());
            differences.extend(report.differences);
        }
    }
    assert!(differences.is_empty(), "{} differences:\n{}", differences.len(), differences.join("\n"));
}

fn compare(folder: &Path, shards: usize, terminal_states: TerminalStates, report: &mut Report) {
    let case: Case = serde_json::from_slice(&fs::read(folder.join("case.json")).unwrap()).unwrap();
    let read = |name: &str| Tensors(fs::read(folder.join(name).with_extension("safetensors")).unwrap());
    let (batch, expected, gradients) = (read("batch"), read("expected"), read("gradients"));
    let sizes = &case.config;
    let rit = Rit::new(RitConfig {
        entity_dim: sizes.entity_dim,
        n_actions: sizes.n_actions,
        hidden_dim: sizes.hidden_dim,
        attention_dim: sizes.attention_dim,
        n_heads: sizes.n_heads,
        task_representations: Some(TaskRepresentations {
            dim: sizes.task_representation_dim,
            reward_embed_dim: sizes.reward_embed_dim,
        }),
        mixing: Mixing::Network {
            mixing_embed_dim: sizes.mixing_embed_dim,
            hypernet_embed_dim: sizes.hypernet_embed_dim,
        },
    });
    let rit = Arc::new(rit.unwrap());
    let (kind, lr) = case.optimizer.kind();
    let config = UpdateConfig {
        gamma: case.gamma,
        lr,
        optimizer: kind,
        grad_norm_clip: case.grad_norm_clip,
        shards,
        threads: 2,
        terminal_states,
    };
    let weights = flat(&rit.layout, &read("weights"), 0..rit.layout.len());
    let mut update = Update::new(Arc::clone(&rit), config, weights.clone()).unwrap();
    update.target = flat(&rit.layout, &read("target_weights"), rit.target());

    let cells = Cells::read(&batch, sizes.padding());
    let episodes: Vec<Episode> = (0..cells.episodes()).map(|index| cells.episode(&batch, index)).collect();
    let pairing: Vec<usize> = batch.i32("pairing").iter().map(|&row| row as usize).collect();
    let said = Mutex::new(HashMap::new());
    let losses = update.gradients_seen(
        &episodes.iter().collect::<Vec<_>>(),
        |rows| {
            assert_eq!(rows, pairing.len(), "one pair for each filled agent row");
            pairing
        },
        |states| {
            said.lock().unwrap().extend(states.map(|seen| ((seen.episode, seen.time), Said::new(&seen))));
        },
    );

    compare_losses(&losses, &case.scalars, report);
    // What training leaves out cannot be compared one by one: losses and gradients show that it does not count.
    if terminal_states == TerminalStates::Kept {
        compare_networks(&said.into_inner().unwrap(), &cells, sizes, &expected, report);
    }
    for param in rit.layout.params() {
        let name = format!("gradient of {}", param.name);
        report.gradients(&name, &update.grads()[param.range.clone()], &gradients.f32(&param.name));
    }

    // The optimiser, fed with the stored gradients.
    let stored = flat(&rit.layout, &gradients, 0..rit.layout.len());
    let scale = optimizer::clip_scale(optimizer::sum_of_squares(&stored).sqrt(), case.grad_norm_clip);
    let mut stepped = weights;
    Optimizer::new(kind, lr, stepped.len()).step(&mut stepped, &stored, scale);
    let after = read("weights_after_step");
    for param in rit.layout.params() {
        let name = format!("{} after one step", param.name);
        report.values(&name, &stepped[param.range.clone()], &after.f32(&param.name));
    }
}

fn compare_losses(losses: &Losses, scalars: &Scalars, report: &mut Report) {
    let pairs = [
        ("td_loss", losses.td_loss, scalars.td_loss),
        ("contrastive_loss", losses.contrastive_loss, scalars.contrastive_loss),
        ("loss", losses.td_loss + losses.contrastive_loss, scalars.loss),
        ("grad_norm", losses.grad_norm, scalars.grad_norm),
    ];
    for (name, ours, theirs) in pairs {
        report.values(name, &[ours as f32], &[theirs as f32]);
    }
}

/// What the networks said in one state.
struct Said {
    history: Vec<f32>,
    task_representation: Vec<f32>,
    utilities: Vec<f32>,
    greedy_actions: Vec<u8>,
    q_total: f32,
    target_q_total: f32,
    td_target: f32,
}

impl Said {
    fn new(seen: &Seen<'_>) -> Self {
        Self {
            history: seen.history.to_vec(),
            task_representation: seen.task_representation.to_vec(),
            utilities: seen.utilities.to_vec(),
            greedy_actions: seen.greedy_actions.to_vec(),
            q_total: seen.q_total,
            target_q_total: seen.target_q_total,
            td_target: seen.td_target,
        }
    }
}

/// Compares what is filled and real. `said` by (episode, time).
fn compare_networks(
    said: &HashMap<(usize, usize), Said>,
    cells: &Cells,
    sizes: &Sizes,
    expected: &Tensors,
    report: &mut Report,
) {
    let (h, z, a) = (sizes.hidden_dim, sizes.task_representation_dim, sizes.n_actions);
    let mut tensors: [(&str, Vec<f32>, Vec<f32>); 7] = [
        "history",
        "task_representation",
        "utilities",
        "q_total",
        "target_q_total",
        "td_target",
        "greedy_actions",
    ]
    .map(|name| (name, vec![], vec![]));
    let greedy = expected.i32("greedy_actions");
    for (episode, &steps) in cells.steps.iter().enumerate() {
        for time in 0..steps {
            let (now, next) = (&said[&(episode, time)], &said[&(episode, time + 1)]);
            let cell = episode * cells.steps_max + time;
            let state = episode * (cells.steps_max + 1) + time;
            for (k, &row) in cells.agents[episode].iter().enumerate() {
                let mut compare = |tensor: usize, ours: &[f32], cell: usize, width: usize| {
                    let (name, all, reference) = &mut tensors[tensor];
                    let theirs = expected.f32(name);
                    all.extend_from_slice(&ours[k * width..][..width]);
                    reference.extend_from_slice(&theirs[(cell * sizes.agents_max + row) * width..][..width]);
                };
                compare(0, &now.history, state, h);
                compare(1, &now.task_representation, state, z);
                compare(2, &now.utilities, cell, a);
                tensors[6].1.push(f32::from(next.greedy_actions[k]));
                tensors[6].2.push(greedy[cell * sizes.agents_max + row] as f32);
            }
            for (tensor, ours) in [(3, now.q_total), (4, next.target_q_total), (5, now.td_target)] {
                tensors[tensor].1.push(ours);
                let theirs = expected.f32(tensors[tensor].0)[cell];
                tensors[tensor].2.push(theirs);
            }
        }
    }
    for (name, ours, theirs) in &tensors {
        report.values(name, ours, theirs);
    }
}

impl Sizes {
    fn padding(&self) -> Padding {
        Padding {
            entity_dim: self.entity_dim,
            n_actions: self.n_actions,
            agents_max: self.agents_max,
            entities_max: self.entities_max,
        }
    }
}

/// Sizes of a padded batch.
#[derive(Clone, Copy)]
struct Padding {
    entity_dim: usize,
    n_actions: usize,
    agents_max: usize,
    entities_max: usize,
}

/// Which cells of the padded batch are real.
struct Cells {
    padding: Padding,
    steps_max: usize,
    /// Filled steps of each episode.
    steps: Vec<usize>,
    /// Rows of real agents and of all real entities, by episode.
    agents: Vec<Vec<usize>>,
    entities: Vec<Vec<usize>>,
}

impl Cells {
    fn read(batch: &Tensors, padding: Padding) -> Self {
        let (filled, present) = (batch.f32("filled"), batch.f32("present"));
        let episodes = present.len() / padding.entities_max;
        let steps_max = filled.len() / episodes;
        let steps = filled.chunks(steps_max).map(|filled| {
            let steps = filled.iter().filter(|&&filled| filled == 1.0).count();
            assert!(filled[..steps].iter().all(|&filled| filled == 1.0), "filled steps come first");
            steps
        });
        let real = |present: &[f32], rows: usize| (0..rows).filter(|&row| present[row] == 1.0).collect();
        let present = || present.chunks(padding.entities_max);
        Self {
            padding,
            steps_max,
            steps: steps.collect(),
            agents: present().map(|present| real(present, padding.agents_max)).collect(),
            entities: present().map(|present| real(present, padding.entities_max)).collect(),
        }
    }

    fn episodes(&self) -> usize {
        self.steps.len()
    }

    /// The real rows of one episode.
    fn episode(&self, batch: &Tensors, index: usize) -> Episode {
        let Padding { entity_dim: d, n_actions: a, agents_max: n_max, entities_max: m_max } = self.padding;
        let (agents, others, steps) = (&self.agents[index], &self.entities[index], self.steps[index]);
        let state = |time: usize| index * (self.steps_max + 1) + time;
        let (entities, observable, available) =
            (batch.f32("entities"), batch.f32("observable"), batch.f32("available"));
        let (actions, rewards, terminated) =
            (batch.i32("actions"), batch.f32("rewards"), batch.f32("terminated"));
        let mut episode = Episode {
            number: index as u64,
            weights_version: 0,
            task: batch.i32("task")[index] as usize,
            n_agents: agents.len(),
            n_entities: others.len(),
            decision_order: decision_order::identity(agents.len()),
            entities: vec![],
            observable: vec![],
            available: vec![],
            actions: vec![],
            rewards: rewards[index * self.steps_max..][..steps].to_vec(),
            shaping: vec![0.0; steps],
            end: if terminated[index * self.steps_max + steps - 1] == 1.0 {
                End::Terminated
            } else {
                End::Truncated
            },
            won: false,
        };
        for time in 0..=steps {
            for &row in others {
                episode.entities.extend_from_slice(&entities[(state(time) * m_max + row) * d..][..d]);
            }
            for &agent in agents {
                let row = &observable[(state(time) * n_max + agent) * m_max..][..m_max];
                episode.observable.extend(others.iter().map(|&entity| row[entity] as u8));
                let row = &available[(state(time) * n_max + agent) * a..][..a];
                episode.available.extend(row.iter().map(|&flag| flag as u8));
            }
            if time < steps {
                let row = &actions[(index * self.steps_max + time) * n_max..][..n_max];
                episode.actions.extend(agents.iter().map(|&agent| row[agent] as u8));
            }
        }
        episode
    }
}

/// Parameters by name, in the layout's order.
fn flat(layout: &Layout, tensors: &Tensors, range: std::ops::Range<usize>) -> Vec<f32> {
    let mut flat = Vec::new();
    for param in layout.params().iter().filter(|param| param.range.end <= range.end) {
        let values = tensors.f32(&param.name);
        assert_eq!(values.len(), param.range.len(), "{}", param.name);
        flat.extend(values);
    }
    flat
}

/// A safetensors file's bytes.
struct Tensors(Vec<u8>);

impl Tensors {
    fn words(&self, name: &str) -> Vec<[u8; 4]> {
        let tensors = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = tensors.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
        tensor.data().as_chunks::<4>().0.to_vec()
    }

    fn f32(&self, name: &str) -> Vec<f32> {
        self.words(name).into_iter().map(f32::from_le_bytes).collect()
    }

    fn i32(&self, name: &str) -> Vec<i32> {
        self.words(name).into_iter().map(i32::from_le_bytes).collect()
    }
}

/// What was compared, and where it differed.
struct Report {
    case: String,
    differences: Vec<String>,
}

impl Report {
    /// |a − b| ≤ 1e-4 · max|b| + 1e-6.
    fn values(&mut self, name: &str, ours: &[f32], theirs: &[f32]) {
        self.within(1e-4, name, ours, theirs);
    }

    /// |a − b| ≤ 5e-4 · max|b| + 1e-6.
    fn gradients(&mut self, name: &str, ours: &[f32], theirs: &[f32]) {
        self.within(5e-4, name, ours, theirs);
    }

    /// a = b.
    fn equal(&mut self, name: &str, ours: &[f32], theirs: &[f32]) {
        assert!(!ours.is_empty(), "{}: {name} compares nothing", self.case);
        if ours != theirs {
            self.differences.push(format!("{}: {name}: {ours:?} and not {theirs:?}", self.case));
        }
    }

    fn within(&mut self, relative: f32, name: &str, ours: &[f32], theirs: &[f32]) {
        assert_eq!(ours.len(), theirs.len(), "{}: {name}", self.case);
        assert!(!ours.is_empty(), "{}: {name} compares nothing", self.case);
        let largest = theirs.iter().fold(0.0_f32, |largest, b| largest.max(b.abs()));
        let tolerance = relative * largest + 1e-6;
        let differs = |(_, (a, b)): &(usize, (&f32, &f32))| !matches!((*a - *b).abs().partial_cmp(&tolerance), Some(order) if order.is_le());
        if let Some((at, (a, b))) = ours.iter().zip(theirs).enumerate().find(differs) {
            let case = &self.case;
            self.differences
                .push(format!("{case}: {name}[{at}] is {a}, reference {b}, tolerance {tolerance}"));
        }
    }
}
