//! What tests of blocks share: a few rows, and the specification's formulas, one number at a time and in f64.

use crate::{Rows, TerminalStates};
use rit_episode::{End, Episode, decision_order};
use rit_nn::{Layout, LayoutBuilder, attention::Group, gradcheck::noise};

/// Features of an entity.
pub const D: usize = 3;

/// Actions.
pub const A: usize = 3;

/// Three agents among five entities for two steps, and one agent beside another entity for one. An entity does not move;
/// an agent sees nothing at first, another one not itself; two choose alike.
pub fn rows() -> Rows {
    let [large, small] = [(3, 5, 2), (1, 2, 1)].map(|(n, m, steps)| episode(n, m, steps));
    Rows::of_episodes(&[&large, &small], TerminalStates::LeftOut)
}

fn episode(n: usize, m: usize, steps: usize) -> Episode {
    let mut entities = noise(11, (steps + 1) * m * D);
    let unmoved = entities[(m - 1) * D..m * D].to_vec();
    for state in entities.chunks_mut(m * D) {
        state[(m - 1) * D..].copy_from_slice(&unmoved);
    }
    let mut observable: Vec<u8> = (0..(steps + 1) * n * m).map(|pair| u8::from(pair % 4 != 3)).collect();
    if n > 1 {
        // Agent 1, which comes after agent 0's flags, sees nothing; agent 2 does not see itself.
        observable[m..2 * m].fill(0);
        observable[2 * m + 2] = 0;
    }
    Episode {
        number: 0,
        weights_version: 0,
        task: 0,
        n_agents: n,
        n_entities: m,
        decision_order: decision_order::identity(n),
        entities,
        observable,
        available: (0..(steps + 1) * n * A).map(|flag| u8::from(flag % 4 != 2)).collect(),
        actions: [1, 1, 0, 2, 0, 1][..steps * n].to_vec(),
        rewards: noise(12, steps),
        shaping: vec![0.0; steps],
        end: End::Terminated,
        won: false,
    }
}

/// An agent row: its group, its place there, and whom it sees.
pub struct AgentRow<'r> {
    pub group: &'r Group,
    pub place: usize,
    pub sees: &'r [u8],
}

impl AgentRow<'_> {
    /// What it sees of the group's entities.
    pub fn visible(&self, entities: &[Vec<f64>]) -> Vec<Vec<f64>> {
        shown(self.sees, entities)
    }

    /// The same without itself.
    pub fn visible_others(&self, entities: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let mut sees = self.sees.to_vec();
        sees[self.place] = 0;
        shown(&sees, entities)
    }
}

/// The entities whose flag is set.
pub fn shown(flags: &[u8], entities: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let seen = flags.iter().zip(entities).filter(|(flag, _)| **flag == 1);
    seen.map(|(_, entity)| entity.clone()).collect()
}

/// Every agent row.
pub fn agent_rows(rows: &Rows) -> Vec<AgentRow<'_>> {
    let mut flags = &rows.observable[..];
    let mut all = Vec::new();
    for group in &rows.groups {
        for place in 0..group.queries.len() {
            let (sees, behind) = flags.split_at(group.keys.len());
            flags = behind;
            all.push(AgentRow { group, place, sees });
        }
    }
    all
}

/// A block's parameters by name, and the layers derived of them behind.
pub struct Named {
    layout: Layout,
    pub params: Vec<f32>,
}

impl Named {
    /// A block with parameters of noise.
    pub fn of<T>(declare: impl Fn(&mut LayoutBuilder) -> T) -> (T, Self) {
        let (block, layout) = Layout::of(declare);
        let mut params = Vec::new();
        layout.derived().extend(&noise(1, layout.len()), &mut params);
        (block, Self { layout, params })
    }

    fn find(&self, name: &str) -> Option<&[f32]> {
        let param = self.layout.params().iter().find(|param| param.name == name)?;
        Some(&self.params[param.range.clone()])
    }

    /// W x + b by the names of both; b may be missing.
    fn affine(&self, weight: &str, bias: &str, x: &[f64]) -> Vec<f64> {
        let (weight, bias) = (self.find(weight).unwrap(), self.find(bias));
        assert!(weight.len().is_multiple_of(x.len()));
        let rows = weight.chunks(x.len()).enumerate();
        rows.map(|(row, weight)| {
            let product: f64 = weight.iter().zip(x).map(|(&w, x)| f64::from(w) * x).sum();
            product + bias.map_or(0.0, |bias| f64::from(bias[row]))
        })
        .collect()
    }

    /// A linear layer, with a bias or without.
    pub fn linear(&self, name: &str, x: &[f64]) -> Vec<f64> {
        self.affine(&format!("{name}.weight"), &format!("{name}.bias"), x)
    }

    /// ReLU(`{name}.embed`) of each of a group's entities.
    pub fn embedded(&self, name: &str, rows: &Rows, group: &Group) -> Vec<Vec<f64>> {
        let features = |row: usize| wide(&rows.entities[row * D..(row + 1) * D]);
        group.keys.clone().map(|row| relu(self.linear(&format!("{name}.embed"), &features(row)))).collect()
    }

    /// Equations 12 to 14: zeros where there is no key.
    pub fn attention(&self, name: &str, heads: usize, query: &[f64], keys: &[Vec<f64>]) -> Vec<f64> {
        let of = |part: &str, x: &[f64]| self.linear(&format!("{name}.{part}"), x);
        let q = of("query", query);
        let width = q.len() / heads;
        let attended = |column: usize| {
            let head = column / width * width..(column / width + 1) * width;
            let weight = |key: &[f64]| {
                let k = of("key", key);
                let score: f64 = head.clone().map(|at| q[at] * k[at]).sum();
                (score / (width as f64).sqrt()).exp()
            };
            let total: f64 = keys.iter().map(|key| weight(key)).sum();
            let sum: f64 = keys.iter().map(|key| weight(key) * of("value", key)[column].max(0.0)).sum();
            if keys.is_empty() { 0.0 } else { sum / total }
        };
        (0..q.len()).map(attended).collect()
    }

    /// A GRU's state after x, h before.
    pub fn gru(&self, name: &str, x: &[f64], h: &[f64]) -> Vec<f64> {
        let gates = |side: &str, x: &[f64]| {
            self.affine(&format!("{name}.weight_{side}"), &format!("{name}.bias_{side}"), x)
        };
        let (of_x, of_h, n) = (gates("ih", x), gates("hh", h), h.len());
        let unit = |at: usize| {
            let reset = sigmoid(of_x[at] + of_h[at]);
            let update = sigmoid(of_x[n + at] + of_h[n + at]);
            let new = (of_x[2 * n + at] + reset * of_h[2 * n + at]).tanh();
            (1.0 - update) * new + update * h[at]
        };
        (0..n).map(unit).collect()
    }

    /// Mean 0, biased variance 1, then weight and bias.
    pub fn layer_norm(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let of = |part: &str| wide(self.find(&format!("{name}.{part}")).unwrap());
        let (weight, bias, count) = (of("weight"), of("bias"), x.len() as f64);
        let mean = x.iter().sum::<f64>() / count;
        let variance = x.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / count;
        let normal = |x: f64| (x - mean) / (variance + 1e-5).sqrt();
        x.iter().zip(weight.iter().zip(&bias)).map(|(&x, (w, b))| normal(x) * w + b).collect()
    }
}

pub fn relu(x: Vec<f64>) -> Vec<f64> {
    x.into_iter().map(|x| x.max(0.0)).collect()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// In f64.
pub fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|&x| x.into()).collect()
}

/// Compares what a block made with the same in f64.
pub fn assert_close(what: &str, ours: &[f32], theirs: &[f64]) {
    assert_eq!(ours.len(), theirs.len(), "{what}");
    for (at, (&a, &b)) in ours.iter().zip(theirs).enumerate() {
        assert!((f64::from(a) - b).abs() <= 2e-5 * b.abs().max(1.0), "{what}[{at}]: {a}, by hand {b}");
    }
}
