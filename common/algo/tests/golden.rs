//! Parity with an independent implementation, tensor by tensor.
//!
//! Reads every folder under `RIT_GOLDEN_DIR`, by default the copy beside this file. All sizes come from the
//! case's own `case.json`. The references were computed in float64 and stored as f32.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

#[path = "golden/on_policy.rs"]
mod on_policy;
#[path = "golden/rivals.rs"]
mod rivals;
#[path = "golden/value.rs"]
mod value;

use rit_algo::TerminalStates;
use rit_episode::{End, Episode, decision_order};
use rit_nn::{Layout, Optimizer, OptimizerKind, optimizer};
use safetensors::SafeTensors;
use serde::Deserialize;
use std::{
    fs,
    path::{Path, PathBuf},
};

/// Which algorithm a case is of: at the top or in its configuration; RIT where it does not say.
#[derive(Deserialize)]
struct Algorithm {
    algorithm: Option<String>,
    config: AlgorithmConfig,
}

#[derive(Deserialize)]
struct AlgorithmConfig {
    algorithm: Option<String>,
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
            let case: Algorithm = serde_json::from_slice(&bytes).unwrap();
            match case.algorithm.or(case.config.algorithm).as_deref() {
                Some(algorithm @ ("mappo" | "mat")) => {
                    on_policy::compare(folder, algorithm, shards, terminal_states, &mut report);
                }
                algorithm => {
                    let algorithm = algorithm.unwrap_or("rit");
                    value::compare(folder, algorithm, shards, terminal_states, &mut report);
                }
            }
            println!("{}: {} differences", report.case, report.differences.len());
            differences.extend(report.differences);
        }
    }
    assert!(differences.is_empty(), "{} differences:\n{}", differences.len(), differences.join("\n"));
}

/// One clipped step from the stored gradients, where the case has one.
fn compare_step(
    folder: &Path,
    layout: &Layout,
    weights: &[f32],
    (kind, lr): (OptimizerKind, f32),
    grad_norm_clip: f64,
    report: &mut Report,
) {
    let Ok(after) = fs::read(folder.join("weights_after_step.safetensors")).map(Tensors) else { return };
    let stored = flat(layout, &Tensors::read(folder, "gradients"), 0..layout.len());
    let scale = optimizer::clip_scale(optimizer::sum_of_squares(&stored).sqrt(), grad_norm_clip);
    let mut stepped = weights.to_vec();
    Optimizer::new(kind, lr, stepped.len()).step(&mut stepped, &stored, scale);
    for param in layout.params() {
        let name = format!("{} after one step", param.name);
        report.values(&name, &stepped[param.range.clone()], &after.f32(&param.name));
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
        flat.extend(tensors.f32(&param.name));
        assert_eq!(flat.len(), param.range.end, "{}", param.name);
    }
    flat
}

/// A safetensors file's bytes.
struct Tensors(Vec<u8>);

impl Tensors {
    fn read(folder: &Path, name: &str) -> Self {
        let path = folder.join(name).with_extension("safetensors");
        Self(fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
    }

    fn holds(&self, name: &str) -> bool {
        SafeTensors::deserialize(&self.0).unwrap().tensor(name).is_ok()
    }

    /// Every tensor's name and shape.
    fn shapes(&self) -> Vec<(String, Vec<usize>)> {
        let tensors = SafeTensors::deserialize(&self.0).unwrap();
        tensors.tensors().into_iter().map(|(name, tensor)| (name, tensor.shape().to_vec())).collect()
    }

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
