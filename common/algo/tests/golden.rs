//! Parity with an independent implementation, tensor by tensor.
//!
//! Reads every case under `RIT_GOLDEN_DIR`, at any depth, by default the copies beside this file. All sizes come from the
//! case's own `case.json`. The references were computed in float64 and stored as f32.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

#[path = "golden/cases.rs"]
mod cases;
#[path = "golden/harness.rs"]
mod harness;
#[path = "golden/on_policy.rs"]
mod on_policy;
#[path = "golden/rivals.rs"]
mod rivals;
#[path = "golden/value.rs"]
mod value;

use cases::{Cells, Padding, Tensors, cases_under, described};
use rit_algo::TerminalStates;
use rit_nn::{Layout, Optimizer, OptimizerKind, optimizer};
use serde::Deserialize;
use std::{
    collections::HashMap,
    ops::Range,
    panic::{AssertUnwindSafe, catch_unwind},
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

/// A case, and how its batch is cut. However that is, the sums are the same within rounding.
#[derive(Clone, Copy)]
struct Cut<'a> {
    folder: &'a Path,
    shards: usize,
    terminal_states: TerminalStates,
}

#[test]
fn every_case_agrees_with_the_reference() {
    let root = std::env::var_os("RIT_GOLDEN_DIR")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden"), PathBuf::from);
    let folders = cases_under(&root);
    assert!(!folders.is_empty(), "{} holds no case", root.display());
    let differences: Vec<String> = folders.iter().flat_map(|folder| differences(folder)).collect();
    assert!(differences.is_empty(), "{} differences:\n{}", differences.len(), differences.join("\n"));
}

/// Where a case differs, or why it cannot be compared.
fn differences(folder: &Path) -> Vec<String> {
    let mut differences = Vec::new();
    for (shards, terminal_states) in
        [(1, TerminalStates::Kept), (3, TerminalStates::Kept), (2, TerminalStates::LeftOut)]
    {
        let case = format!("{}, {shards} shards, terminal states {terminal_states:?}", folder.display());
        let mut report = Report { case, differences: vec![] };
        let cut = Cut { folder, shards, terminal_states };
        // Whatever cannot be read or made sense of says which case it belongs to, and the others are compared.
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| compare(cut, &mut report))) {
            let words = panic.downcast_ref::<String>().map(String::as_str);
            let words = words.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            report.differences.push(format!("{}: cannot be compared: {words}", report.case));
        }
        println!("{}: {} differences", report.case, report.differences.len());
        differences.extend(report.differences);
    }
    differences
}

fn compare(cut: Cut<'_>, report: &mut Report) {
    let case: Algorithm = described(cut.folder);
    match case.algorithm.or(case.config.algorithm).as_deref() {
        Some(algorithm @ ("mappo" | "mat")) => on_policy::compare(cut, algorithm, report),
        algorithm => value::compare(cut, algorithm.unwrap_or("rit"), report),
    }
}

/// The reference's gradients. A parameter that it has none of is one that nothing led to.
fn stored_gradients(folder: &Path, layout: &Layout) -> Vec<f32> {
    let gradients = Tensors::read(folder, "gradients");
    for (name, _) in gradients.shapes() {
        let is_ours = layout.params().iter().any(|param| param.name == name);
        assert!(is_ours, "gradients.safetensors: there is no parameter {name}");
    }
    gradients.params(layout.params(), Some(0.0))
}

/// Every parameter's gradient.
fn compare_gradients(layout: &Layout, ours: &[f32], theirs: &[f32], report: &mut Report) {
    for param in layout.params() {
        let range = param.range.clone();
        report.gradients(&format!("gradient of {}", param.name), &ours[range.clone()], &theirs[range]);
    }
}

/// One clipped step from the stored gradients, where the case has one. `parts` of them are clipped each by its own norm.
fn compare_step(
    folder: &Path,
    layout: &Layout,
    weights: &[f32],
    mut gradients: Vec<f32>,
    parts: &[Range<usize>],
    (optimizer, grad_norm_clip): (&OptimizerConfig, f64),
    report: &mut Report,
) {
    let Some(after) = Tensors::read_if_there(folder, "weights_after_step") else { return };
    for part in parts {
        let norm = optimizer::sum_of_squares(&gradients[part.clone()]).sqrt();
        let scale = optimizer::clip_scale(norm, grad_norm_clip);
        gradients[part.clone()].iter_mut().for_each(|gradient| *gradient *= scale);
    }
    let (kind, lr) = optimizer.kind();
    let mut stepped = weights.to_vec();
    Optimizer::new(kind, lr, stepped.len()).step(&mut stepped, &gradients, 1.0);
    for param in layout.params() {
        let name = format!("{} after one step", param.name);
        report.values(&name, &stepped[param.range.clone()], &after.f32(&param.name));
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

    /// A loss, or another number of a whole update.
    fn scalar(&mut self, name: &str, ours: &HashMap<&str, f64>, theirs: f64) {
        let Some(ours) = ours.get(name) else {
            panic!("case.json or expected.safetensors: {name} is no number that an update reports")
        };
        self.values(name, &[*ours as f32], &[theirs as f32]);
    }

    /// a = b.
    fn equal(&mut self, name: &str, ours: &[f32], theirs: &[f32]) {
        assert!(!ours.is_empty(), "{name} compares nothing");
        if ours != theirs {
            self.differences.push(format!("{}: {name}: {ours:?} and not {theirs:?}", self.case));
        }
    }

    fn within(&mut self, relative: f32, name: &str, ours: &[f32], theirs: &[f32]) {
        assert_eq!(ours.len(), theirs.len(), "numbers of {name}");
        assert!(!ours.is_empty(), "{name} compares nothing");
        let largest = theirs.iter().fold(0.0_f32, |largest, b| largest.max(b.abs()));
        let tolerance = relative * largest + 1e-6;
        // What is no number is within no tolerance.
        let is_within = |a: f32, b: f32| (a - b).abs() <= tolerance;
        let differing = ours.iter().zip(theirs).enumerate().find(|(_, (a, b))| !is_within(**a, **b));
        if let Some((at, (a, b))) = differing {
            let case = &self.case;
            self.differences
                .push(format!("{case}: {name}[{at}] is {a}, reference {b}, tolerance {tolerance}"));
        }
    }
}
