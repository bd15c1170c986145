//! Multi-head attention over small groups of rows (paper, equations 12-14), no output projection.
//!
//! Groups are ragged: each has its own numbers of queries and keys, and only keys that exist. A query that
//! sees nothing gets zeros, exactly, and passes no gradient.

mod kernels;

pub use kernels::{backward, forward};
pub(crate) use kernels::{exponentiate, heads, keys_and_values, scale, take, weighted_sum};

use crate::{Accum, LayoutBuilder, Linear, View, ViewMut, activation, linear, matmul};
use std::ops::Range;

/// Query, key and value layers, h → a, with bias; the value goes through ReLU unless it is to stay linear; heads
/// split a evenly; score = q·k / √(a / heads).
#[derive(Clone, Debug)]
pub struct Attention {
    /// h → a.
    pub query: Linear,
    /// Key and value side by side, h → 2a.
    pub key_value: Linear,
    /// How many heads.
    pub heads: usize,
    /// a: size of all heads together.
    pub dim: usize,
    /// What becomes of a value after its layer.
    values: Values,
}

/// What becomes of a value after its layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Values {
    /// It goes through ReLU (the paper's attention).
    Rectified,
    /// Nothing (a transformer's attention).
    Linear,
}

/// Queries that look at the same keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Group {
    /// Rows of the query input.
    pub queries: Range<usize>,
    /// Rows of the key input.
    pub keys: Range<usize>,
}

impl Group {
    /// Query–key pairs.
    pub fn pairs(&self) -> usize {
        self.queries.len() * self.keys.len()
    }
}

/// Which keys the queries see.
#[derive(Clone, Copy, Debug)]
pub enum Visible<'a> {
    /// All of their group's.
    All,
    /// 1 where seen; the groups' `[queries, keys]` one after another.
    Where(&'a [u8]),
}

/// What attention is made of. With Q query rows, K keys, H heads of width k in scores and a / H in values:
#[derive(Clone, Copy, Debug)]
pub struct Sides<'a> {
    /// (Q, H k).
    pub queries: View<'a>,
    /// (K, H k), or (K, k) where all heads look at the same keys.
    pub keys: View<'a>,
    /// (K, a).
    pub values: View<'a>,
    /// Which row of keys and values each of the groups' keys stands for, if several may stand for one.
    pub rows: Option<&'a [usize]>,
    /// H.
    pub heads: usize,
    /// What scores are scaled with, 1/√(a / H).
    pub scale: f32,
}

/// Gradients by [`Sides`]. The gradient by queries is overwritten. Those by keys and values are added to where `adds` is
/// true and overwritten otherwise; overwriting is allowed only if no two keys share a row ([`Sides::rows`] is `None`).
#[derive(Debug)]
pub struct SidesMut<'a> {
    /// (Q, H k).
    pub queries: ViewMut<'a>,
    /// By keys and values.
    pub keys: KeysMut<'a>,
    /// Whether gradients by keys, and by values, hold contributions already.
    pub adds: [bool; 2],
}

/// Gradients by keys and values.
#[derive(Debug)]
pub enum KeysMut<'a> {
    /// Side by side, (K, 2a).
    Together(ViewMut<'a>),
    /// As [`Sides::keys`] and [`Sides::values`].
    Apart(ViewMut<'a>, ViewMut<'a>),
}

impl KeysMut<'_> {
    #[inline(always)]
    fn keys(&mut self) -> ViewMut<'_> {
        match self {
            Self::Together(both) => {
                let a = both.cols / 2;
                both.reborrow().columns(0..a)
            }
            Self::Apart(keys, _) => keys.reborrow(),
        }
    }

    #[inline(always)]
    fn values(&mut self) -> ViewMut<'_> {
        match self {
            Self::Together(both) => {
                let a = both.cols / 2;
                both.reborrow().columns(a..2 * a)
            }
            Self::Apart(_, values) => values.reborrow(),
        }
    }
}

impl Attention {
    /// Declares `{name}.query`, `{name}.key` and `{name}.value`.
    pub fn new(layout: &mut LayoutBuilder, name: &str, inputs: usize, dim: usize, heads: usize) -> Self {
        let query = Linear::new(layout, &format!("{name}.query"), inputs, dim);
        let (key, value) = (format!("{name}.key"), format!("{name}.value"));
        let key_value = Linear::side_by_side(layout, inputs, &[(&key, dim), (&value, dim)]);
        Self { query, key_value, heads, dim, values: Values::Rectified }
    }

    /// The same without ReLU on the values.
    pub fn linear(layout: &mut LayoutBuilder, name: &str, inputs: usize, dim: usize, heads: usize) -> Self {
        Self { values: Values::Linear, ..Self::new(layout, name, inputs, dim, heads) }
    }

    /// Queries (Q, a), and keys and values of all rows side by side, `[K, 2a]`, as attention's sides.
    pub fn sides<'a>(&self, queries: View<'a>, key_values: View<'a>) -> Sides<'a> {
        let a = self.dim;
        let (keys, values) = (key_values.columns(0..a), key_values.columns(a..2 * a));
        Sides { queries, keys, values, rows: None, heads: self.heads, scale: scale(self.head_dim()) }
    }

    /// The ReLU's backward for the values, in place; does nothing if values stay linear. `key_values` and
    /// `d_key_values` (K, 2a).
    pub fn rectify_backward(&self, key_values: View<'_>, d_key_values: ViewMut<'_>) {
        let a = self.dim;
        if self.values == Values::Rectified {
            activation::relu_backward(key_values.columns(a..2 * a), d_key_values.columns(a..2 * a));
        }
    }

    /// The value layer alone, h → a, without what follows it.
    pub fn value(&self) -> Linear {
        self.key_value.output_rows(self.dim..2 * self.dim)
    }

    /// The key layer alone, h → a.
    pub fn key(&self) -> Linear {
        self.key_value.output_rows(0..self.dim)
    }

    /// Size of one head.
    pub(crate) fn head_dim(&self) -> usize {
        self.dim / self.heads
    }

    /// Keys (without their bias, which adds the same to all scores of a query: softmax does not see it, and its gradient
    /// is zero) and values of `x` (K, h).
    pub fn project_keys(&self, params: &[f32], x: View<'_>, mut key_values: ViewMut<'_>) {
        let a = self.dim;
        matmul::x_wt(x, self.key_value.weight(params), key_values.reborrow(), Accum::Replace);
        let (values, bias) = (key_values.columns(a..2 * a), &self.key_value.bias(params)[a..]);
        match self.values {
            Values::Rectified => linear::add_row_relu(values, bias),
            Values::Linear => linear::add_row(values, bias),
        }
    }
}

/// Softmax weights of these groups: `[heads, queries, masks, keys]` of one after another.
pub fn weights_len(groups: &[Group], masks: usize, heads: usize) -> usize {
    groups.iter().map(Group::pairs).sum::<usize>() * masks * heads
}

impl<'a> Visible<'a> {
    /// The flags of these pairs, one group's `[queries, keys]`; `None` where all is seen.
    #[inline(always)]
    pub(crate) fn flags(self, pairs: &Range<usize>) -> Option<&'a [u8]> {
        match self {
            Self::All => None,
            Self::Where(flags) => Some(&flags[pairs.clone()]),
        }
    }
}

#[cfg(test)]
mod tests;
