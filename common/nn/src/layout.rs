//! Names and shapes of all parameters, declared once, in the order in which they lie in the flat buffer.

use rand::{Rng, RngExt as _};
use std::ops::Range;

/// One parameter: where it lies and how it begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Param {
    /// Its name in a checkpoint, such as `utility.gru.weight_ih`.
    pub name: String,
    /// Its shape as PyTorch has it: (out, in) for a weight.
    pub shape: Vec<usize>,
    /// Where it lies in the flat buffer.
    pub range: Range<usize>,
    /// Initial values are uniform in ± this.
    pub bound: f32,
}

/// All parameters of a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layout {
    params: Vec<Param>,
    len: usize,
}

impl Layout {
    /// Every parameter, in the buffer's order.
    pub fn params(&self) -> &[Param] {
        &self.params
    }

    /// Numbers in the flat buffer.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Initial values, PyTorch's: uniform in ± 1/√fan_in for linear layers, ± 1/√h for a GRU.
    pub fn initial(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut values = vec![0.0; self.len];
        for param in &self.params {
            for value in &mut values[param.range.clone()] {
                *value = rng.random_range(-param.bound..=param.bound);
            }
        }
        values
    }
}

/// Collects parameters while layers declare themselves.
#[derive(Debug, Default)]
pub struct LayoutBuilder {
    layout: Layout,
}

impl LayoutBuilder {
    /// Adds a parameter behind those declared so far.
    pub fn add(&mut self, name: impl Into<String>, shape: &[usize], bound: f32) -> Range<usize> {
        let start = self.layout.len;
        self.layout.len += shape.iter().product::<usize>();
        let range = start..self.layout.len;
        self.layout.params.push(Param {
            name: name.into(),
            shape: shape.to_vec(),
            range: range.clone(),
            bound,
        });
        range
    }

    /// Numbers declared so far: where the next parameter will begin.
    pub fn len(&self) -> usize {
        self.layout.len
    }

    /// Whether nothing is declared yet.
    pub fn is_empty(&self) -> bool {
        self.layout.is_empty()
    }

    /// The whole layout.
    pub fn finish(self) -> Layout {
        self.layout
    }
}
