//! Multi-head attention over small groups of rows (paper, equations 12-14), no output projection.
//!
//! Groups are ragged: each has its own numbers of queries and keys, and only keys that exist. A query that
//! sees nothing gets zeros, exactly, and passes no gradient.

use crate::{LayoutBuilder, Linear, View, ViewMut, fit, math};
use std::ops::Range;

/// Query, key and value layers, h → a, with bias; the value goes through ReLU; heads split a evenly;
/// score = q·k / √(a / heads).
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

/// What forward leaves for backward. With Q query rows and K key rows:
#[derive(Debug, Default)]
pub struct AttentionState {
    /// `[Q, a]`; backward leaves its gradient here.
    queries: Vec<f32>,
    /// Keys and ReLU'd values, `[K, 2a]`; backward leaves their gradient here.
    key_values: Vec<f32>,
    d_key_values: Vec<f32>,
    /// Softmax weights; the groups' `[queries, heads, keys]` one after another.
    weights: Vec<f32>,
}

impl Attention {
    /// Declares `{name}.query`, `{name}.key` and `{name}.value`.
    pub fn new(layout: &mut LayoutBuilder, name: &str, inputs: usize, dim: usize, heads: usize) -> Self {
        let query = Linear::new(layout, &format!("{name}.query"), inputs, dim);
        let (key, value) = (format!("{name}.key"), format!("{name}.value"));
        let key_value = Linear::side_by_side(layout, inputs, &[(&key, dim), (&value, dim)]);
        Self { query, key_value, heads, dim }
    }

    /// Writes `out` (Q, a) from `x_queries` (Q, h) and `x_keys` (K, h).
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn forward(
        &self,
        params: &[f32],
        x_queries: View<'_>,
        x_keys: View<'_>,
        groups: &[Group],
        visible: Visible<'_>,
        state: &mut AttentionState,
        mut out: ViewMut<'_>,
    ) {
        let (a, head_dim) = (self.dim, self.dim / self.heads);
        let scale = 1.0 / (head_dim as f32).sqrt();
        let queries = ViewMut::dense(fit(&mut state.queries, x_queries.rows * a), a);
        self.query.forward(params, x_queries, queries);
        let mut key_values = ViewMut::dense(fit(&mut state.key_values, x_keys.rows * 2 * a), 2 * a);
        self.key_value.forward(params, x_keys, key_values.reborrow());
        crate::activation::relu(key_values.columns(a..2 * a));

        let pairs: usize = groups.iter().map(Group::pairs).sum();
        let mut weights = fit(&mut state.weights, pairs * self.heads);
        let mut visible = visible;
        let (queries, key_values) = (&state.queries, &state.key_values);
        math::vectorized(|| {
            for group in groups {
                let keys = group.keys.len();
                let key_values = &key_values[group.keys.start * 2 * a..group.keys.end * 2 * a];
                for query in group.queries.clone() {
                    let seen = visible.take(keys);
                    let out = out.row(query);
                    for head in 0..self.heads {
                        let columns = head * head_dim..(head + 1) * head_dim;
                        let weights = take(&mut weights, keys);
                        let out = &mut out[columns.clone()];
                        let q = &queries[query * a..][columns];
                        attend(q, key_values, head * head_dim, a, seen, scale, weights, out);
                    }
                }
            }
        });
    }

    /// Takes `d_out` (Q, a). Writes `dx_queries` (Q, h) and `dx_keys` (K, h) and adds to the parameters'
    /// gradients.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        x_queries: View<'_>,
        x_keys: View<'_>,
        groups: &[Group],
        state: &mut AttentionState,
        d_out: View<'_>,
        dx_queries: ViewMut<'_>,
        dx_keys: ViewMut<'_>,
        grads: &mut [f32],
    ) {
        let (a, head_dim) = (self.dim, self.dim / self.heads);
        let scale = 1.0 / (head_dim as f32).sqrt();
        let (queries, key_values) = (&mut state.queries, &state.key_values);
        let d_key_values = fit(&mut state.d_key_values, key_values.len());
        d_key_values.fill(0.0);
        let mut weights = &mut state.weights[..];
        math::vectorized(|| {
            for group in groups {
                let keys = group.keys.len();
                let rows = group.keys.start * 2 * a..group.keys.end * 2 * a;
                let (key_values, d_key_values) = (&key_values[rows.clone()], &mut d_key_values[rows]);
                for query in group.queries.clone() {
                    for head in 0..self.heads {
                        let columns = head * head_dim..(head + 1) * head_dim;
                        let weights = take(&mut weights, keys);
                        let q = &mut queries[query * a..][columns.clone()];
                        let d_out = &d_out.row(query)[columns];
                        attend_backward(
                            q,
                            key_values,
                            d_key_values,
                            head * head_dim,
                            a,
                            scale,
                            weights,
                            d_out,
                        );
                    }
                }
            }
        });
        let values = View::dense(key_values, 2 * a).columns(a..2 * a);
        crate::activation::relu_backward(values, ViewMut::dense(d_key_values, 2 * a).columns(a..2 * a));
        let (d_queries, d_key_values) = (View::dense(queries, a), View::dense(d_key_values, 2 * a));
        self.query.backward(params, x_queries, d_queries, Some(dx_queries), grads);
        self.key_value.backward(params, x_keys, d_key_values, Some(dx_keys), grads);
    }
}

/// One head of one query. `key_values` (keys, 2a); the head's keys begin at column `first`, its values at
/// `a + first`. Leaves the softmax in `weights` (keys), zero where unseen.
#[allow(clippy::too_many_arguments, reason = "a row and its companions, each named")]
#[inline(always)]
fn attend(
    q: &[f32],
    key_values: &[f32],
    first: usize,
    a: usize,
    seen: Option<&[u8]>,
    scale: f32,
    weights: &mut [f32],
    out: &mut [f32],
) {
    let sees = |key: usize| seen.is_none_or(|seen| seen[key] != 0);
    let mut largest = f32::NEG_INFINITY;
    for key in 0..weights.len() {
        if sees(key) {
            weights[key] = scale * math::dot(q, &key_values[key * 2 * a + first..][..q.len()]);
            largest = largest.max(weights[key]);
        }
    }
    out.fill(0.0);
    let mut total = 0.0;
    for (key, weight) in weights.iter_mut().enumerate() {
        // An unseen key weighs exactly nothing; a query that sees none keeps its zeros.
        *weight = if sees(key) { math::exp(*weight - largest) } else { 0.0 };
        total += *weight;
    }
    if total == 0.0 {
        return;
    }
    for (key, weight) in weights.iter_mut().enumerate() {
        *weight /= total;
        if *weight != 0.0 {
            math::add_scaled(out, *weight, &key_values[key * 2 * a + a + first..][..q.len()]);
        }
    }
}

/// One head of one query backward: d_value = w d_out, d_score = w (d_w − Σ w d_w), d_key = d_score q,
/// d_query = Σ d_score key, which replaces the query.
#[allow(clippy::too_many_arguments, reason = "a row and its companions, each named")]
#[inline(always)]
fn attend_backward(
    q: &mut [f32],
    key_values: &[f32],
    d_key_values: &mut [f32],
    first: usize,
    a: usize,
    scale: f32,
    weights: &mut [f32],
    d_out: &[f32],
) {
    let mut mean = 0.0;
    let value = |key: usize| key * 2 * a + a + first..key * 2 * a + a + first + d_out.len();
    for (key, &weight) in weights.iter().enumerate() {
        if weight != 0.0 {
            mean += weight * math::dot(d_out, &key_values[value(key)]);
        }
    }
    // The scores' gradient needs the weight once more, so it is made in a second pass that ends with the
    // query: d_query may only replace it when no key needs it any more.
    for (key, weight) in weights.iter_mut().enumerate() {
        if *weight == 0.0 {
            continue;
        }
        let d_weight = math::dot(d_out, &key_values[value(key)]);
        math::add_scaled(&mut d_key_values[value(key)], *weight, d_out);
        let d_score = *weight * (d_weight - mean) * scale;
        math::add_scaled(&mut d_key_values[key * 2 * a + first..][..q.len()], d_score, q);
        *weight = d_score;
    }
    q.fill(0.0);
    for (key, &d_score) in weights.iter().enumerate() {
        math::add_scaled(q, d_score, &key_values[key * 2 * a + first..][..q.len()]);
    }
}

/// Splits the next `len` elements off the front.
#[inline(always)]
fn take<'a>(rest: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    let (front, back) = std::mem::take(rest).split_at_mut(len);
    *rest = back;
    front
}

impl<'a> Visible<'a> {
    /// The next query's row; `None` where it sees all.
    #[inline(always)]
    fn take(&mut self, keys: usize) -> Option<&'a [u8]> {
        match self {
            Self::All => None,
            Self::Where(flags) => {
                let (front, back) = flags.split_at(keys);
                *flags = back;
                Some(front)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

    const INPUTS: usize = 5;
    const DIM: usize = 6;
    /// Two groups: 2 queries over 3 keys, then 1 query over 2 keys. Query 1 does not see key 0, query 2 none.
    const SEEN: [u8; 8] = [1, 1, 1, 0, 1, 1, 0, 0];

    fn groups() -> [Group; 2] {
        [Group { queries: 0..2, keys: 0..3 }, Group { queries: 2..3, keys: 3..5 }]
    }

    fn unit(heads: usize) -> (Attention, usize) {
        let mut layout = LayoutBuilder::default();
        let attention = Attention::new(&mut layout, "attention", INPUTS, DIM, heads);
        (attention, layout.len())
    }

    fn run(
        attention: &Attention,
        params: &[f32],
        xq: &[f32],
        xk: &[f32],
        visible: Visible<'_>,
    ) -> (Vec<f32>, AttentionState) {
        let (mut out, mut state) = (vec![9.0; 3 * DIM], AttentionState::default());
        let (xq, xk) = (View::dense(xq, INPUTS), View::dense(xk, INPUTS));
        attention.forward(params, xq, xk, &groups(), visible, &mut state, ViewMut::dense(&mut out, DIM));
        (out, state)
    }

    /// Equations 12-14, one number at a time.
    fn reference(attention: &Attention, params: &[f32], xq: &[f32], xk: &[f32], seen: &[u8]) -> Vec<f32> {
        let project = |linear: &Linear, x: &[f32]| -> Vec<f32> {
            let mut y = vec![0.0; x.len() / INPUTS * linear.outputs];
            linear.forward(params, View::dense(x, INPUTS), ViewMut::dense(&mut y, linear.outputs));
            y
        };
        let (q, kv) = (project(&attention.query, xq), project(&attention.key_value, xk));
        let head_dim = DIM / attention.heads;
        let mut out = vec![0.0; 3 * DIM];
        let mut at = 0;
        for group in groups() {
            for query in group.queries.clone() {
                let flags = &seen[at..at + group.keys.len()];
                at += group.keys.len();
                for column in 0..DIM {
                    let head = column / head_dim * head_dim..(column / head_dim + 1) * head_dim;
                    let weight = |key: usize| -> f32 {
                        let score: f32 =
                            head.clone().map(|c| q[query * DIM + c] * kv[key * 2 * DIM + c]).sum();
                        (score / (head_dim as f32).sqrt()).exp()
                    };
                    let keys =
                        || group.keys.clone().zip(flags).filter(|(_, seen)| **seen == 1).map(|(key, _)| key);
                    let total: f32 = keys().map(weight).sum();
                    let sum: f32 =
                        keys().map(|key| weight(key) * kv[key * 2 * DIM + DIM + column].max(0.0)).sum();
                    out[query * DIM + column] = if total > 0.0 { sum / total } else { 0.0 };
                }
            }
        }
        out
    }

    #[test]
    fn follows_the_equations_with_any_number_of_heads() {
        for heads in [1, 2, 3] {
            let (attention, len) = unit(heads);
            let (params, xq, xk) = (noise(1, len), noise(2, 3 * INPUTS), noise(3, 5 * INPUTS));
            for (visible, seen) in [(Visible::All, [1; 8]), (Visible::Where(&SEEN), SEEN)] {
                let (out, _) = run(&attention, &params, &xq, &xk, visible);
                for (a, b) in out.iter().zip(reference(&attention, &params, &xq, &xk, &seen)) {
                    assert!((a - b).abs() < 1e-5, "{heads} heads: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn who_sees_nothing_gets_exactly_zero_and_passes_no_gradient() {
        let (attention, len) = unit(2);
        let (params, xq, xk) = (noise(1, len), noise(2, 3 * INPUTS), noise(3, 5 * INPUTS));
        let (out, mut state) = run(&attention, &params, &xq, &xk, Visible::Where(&SEEN));
        assert_eq!(out[2 * DIM..], [0.0; DIM]);
        let (mut dxq, mut dxk, mut grads) = (vec![9.0; xq.len()], vec![9.0; xk.len()], vec![0.0; len]);
        let d_out = noise(4, 3 * DIM);
        let views = (View::dense(&xq, INPUTS), View::dense(&xk, INPUTS), View::dense(&d_out, DIM));
        let (to_q, to_k) = (ViewMut::dense(&mut dxq, INPUTS), ViewMut::dense(&mut dxk, INPUTS));
        attention.backward(&params, views.0, views.1, &groups(), &mut state, views.2, to_q, to_k, &mut grads);
        assert_eq!(dxq[2 * INPUTS..], [0.0; INPUTS]);
        assert_eq!(dxk[3 * INPUTS..], [0.0; 2 * INPUTS]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        for (heads, visible) in [(1, Visible::All), (2, Visible::Where(&SEEN)), (3, Visible::All)] {
            let (attention, len) = unit(heads);
            let (params, xq, xk, to) =
                (noise(1, len), noise(2, 3 * INPUTS), noise(3, 5 * INPUTS), noise(4, 3 * DIM));
            let loss = |params: &[f32], xq: &[f32], xk: &[f32]| {
                let (out, _) = run(&attention, params, xq, xk, visible);
                out.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
            };
            let (_, mut state) = run(&attention, &params, &xq, &xk, visible);
            let (mut dxq, mut dxk, mut grads) = (vec![0.0; xq.len()], vec![0.0; xk.len()], vec![0.0; len]);
            let views = (View::dense(&xq, INPUTS), View::dense(&xk, INPUTS), View::dense(&to, DIM));
            let (to_q, to_k) = (ViewMut::dense(&mut dxq, INPUTS), ViewMut::dense(&mut dxk, INPUTS));
            attention.backward(
                &params,
                views.0,
                views.1,
                &groups(),
                &mut state,
                views.2,
                to_q,
                to_k,
                &mut grads,
            );
            check("params", &params, &grads, |params| loss(params, &xq, &xk));
            check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
            check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
        }
    }
}
