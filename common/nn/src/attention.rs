//! Multi-head attention over small groups of rows (paper, equations 12-14), no output projection.
//!
//! Groups are ragged: each has its own numbers of queries and keys, and only keys that exist. A query that
//! sees nothing gets zeros, exactly, and passes no gradient.

use crate::{
    LayoutBuilder, Linear, Scratch, View, ViewMut, fit, for_lanes, linear,
    math::{self, LANES, Lanes, each, load, store},
    matmul, vectorized,
};
use faer::Accum;
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
    /// `[Q, a]`.
    queries: Vec<f32>,
    /// Keys and ReLU'd values, `[K, 2a]`.
    key_values: Vec<f32>,
    /// Softmax weights; the groups' `[heads, queries, keys]` one after another.
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

    /// Queries, keys (without their bias) and values of all rows. `x_queries` (Q, h), `x_keys` (K, h).
    pub fn project(&self, params: &[f32], x_queries: View<'_>, x_keys: View<'_>, state: &mut AttentionState) {
        let a = self.dim;
        let queries = ViewMut::dense(fit(&mut state.queries, x_queries.rows * a), a);
        self.query.forward(params, x_queries, queries);
        let mut key_values = ViewMut::dense(fit(&mut state.key_values, x_keys.rows * 2 * a), 2 * a);
        matmul::x_wt(x_keys, self.key_value.weight(params), key_values.reborrow(), Accum::Replace);
        // The key's bias adds the same to all scores of a query, which softmax does not see: it is left out, and
        // its gradient is zero.
        linear::add_row_relu(key_values.columns(a..2 * a), &self.key_value.bias(params)[a..]);
    }

    /// Writes `out` (Q, a) from what [`Attention::project`] left.
    pub fn attend(
        &self,
        groups: &[Group],
        visible: Visible<'_>,
        state: &mut AttentionState,
        out: ViewMut<'_>,
    ) {
        let AttentionState { queries, key_values, weights } = state;
        let pairs: usize = groups.iter().map(Group::pairs).sum();
        let weights = fit(weights, pairs * self.heads);
        let queries = View::dense(queries, self.dim);
        score(queries, key_values, groups, visible, weights, self.head_dim());
        exponentiate(weights);
        blend(key_values, groups, weights, out, self.head_dim());
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
        state: &AttentionState,
        d_out: View<'_>,
        dx_queries: ViewMut<'_>,
        dx_keys: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let a = self.dim;
        let AttentionState { queries, key_values, weights } = state;
        // Every query and every key belongs to one group, so all of these are written.
        let (mut d_queries, mut d_key_values) = (scratch.take(queries.len()), scratch.take(key_values.len()));
        let d = (&mut d_queries[..], &mut d_key_values[..]);
        attend_backward(d_out, View::dense(queries, a), key_values, groups, weights, d, self.head_dim());
        self.query.backward(params, x_queries, View::dense(&d_queries, a), Some(dx_queries), grads);
        let d_key_values_view = View::dense(&d_key_values, 2 * a);
        linear::add_column_sums(
            d_key_values_view.columns(a..2 * a),
            &mut self.key_value.bias_mut(grads)[a..],
        );
        matmul::dyt_x(d_key_values_view, x_keys, self.key_value.weight_mut(grads), Accum::Add);
        matmul::dy_w(d_key_values_view, self.key_value.weight(params), dx_keys, Accum::Replace);
        scratch.give(d_key_values);
        scratch.give(d_queries);
    }

    /// Size of one head.
    fn head_dim(&self) -> usize {
        self.dim / self.heads
    }
}

/// What a score is scaled with: 1/√(a / heads).
#[inline(always)]
fn scale(head_dim: usize) -> f32 {
    1.0 / (head_dim as f32).sqrt()
}

vectorized! {
    /// Every query's scores less the largest of them, group by group and head by head; −∞ where unseen.
    fn score<'a>(
        queries: View<'a>,
        key_values: &'a [f32],
        groups: &'a [Group],
        visible: Visible<'a>,
        scores: &'a mut [f32],
        head_dim: usize,
    ) {
        for group in groups {
            let pairs = group.pairs();
            let (keys, _) = keys_and_values(key_values, group, queries.cols);
            let seen = visible.take(pairs);
            for head in (0..queries.cols).step_by(head_dim) {
                let scores = take(&mut scores, pairs);
                for (at, scores) in scores.chunks_exact_mut(keys.rows).enumerate() {
                    let q = &queries.row(group.queries.start + at)[head..head + head_dim];
                    let mut largest = f32::NEG_INFINITY;
                    for (key, score) in scores.iter_mut().enumerate() {
                        let sees = seen.is_none_or(|seen| seen[at * keys.rows + key] != 0);
                        let product = scale(head_dim) * math::dot(q, &keys.row(key)[head..head + head_dim]);
                        *score = if sees { product } else { f32::NEG_INFINITY };
                        largest = largest.max(*score);
                    }
                    // Who sees nothing keeps −∞, which less itself is no number.
                    if largest > f32::NEG_INFINITY {
                        scores.iter_mut().for_each(|score| *score -= largest);
                    }
                }
            }
        }
    }
}

vectorized! {
    /// Shares of a softmax before their division, in place.
    fn exponentiate<'a>(x: &'a mut [f32]) {
        for x in x {
            *x = math::exp_share(*x);
        }
    }
}

vectorized! {
    /// Makes softmax weights of exponentials, in place, and `out` of the values by these weights.
    fn blend<'a>(
        key_values: &'a [f32],
        groups: &'a [Group],
        weights: &'a mut [f32],
        out: ViewMut<'a>,
        head_dim: usize,
    ) {
        for group in groups {
            let (_, values) = keys_and_values(key_values, group, out.cols);
            for head in (0..out.cols).step_by(head_dim) {
                let weights = take(&mut weights, group.pairs());
                for (query, weights) in group.queries.clone().zip(weights.chunks_exact_mut(values.rows)) {
                    let total: f32 = weights.iter().sum();
                    // Who sees nothing keeps the zeros.
                    if total > 0.0 {
                        weights.iter_mut().for_each(|weight| *weight /= total);
                    }
                    let to = out.row(query);
                    for_lanes!(head..head + head_dim, |at, len| {
                        store(weighted_sum(weights, 1, values, at, len), to, at, len);
                    });
                }
            }
        }
    }
}

vectorized! {
    /// From the gradient by the output to those by queries and by keys and values: `d`, all of it written. With w
    /// the weights: d_value = wᵀ d_out where ReLU let it pass, d_w = d_out valueᵀ, d_score = w (d_w − Σ w d_w),
    /// d_query = d_score key and d_key = d_scoreᵀ query.
    fn attend_backward<'a>(
        d_out: View<'a>,
        queries: View<'a>,
        key_values: &'a [f32],
        groups: &'a [Group],
        weights: &'a [f32],
        d: (&'a mut [f32], &'a mut [f32]),
        head_dim: usize,
    ) {
        let a = queries.cols;
        let (d_queries, d_key_values) = d;
        let mut d_scores = Vec::new();
        for group in groups {
            let (keys, values) = keys_and_values(key_values, group, a);
            let (queries, d_out) = (queries.rows(group.queries.clone()), d_out.rows(group.queries.clone()));
            let d_queries = &mut d_queries[group.queries.start * a..group.queries.end * a];
            let d_key_values = &mut d_key_values[group.keys.start * 2 * a..group.keys.end * 2 * a];
            for head in (0..a).step_by(head_dim) {
                let (weights_here, behind) = weights.split_at(group.pairs());
                weights = behind;
                d_scores.clear();
                for (query, weights) in weights_here.chunks_exact(keys.rows).enumerate() {
                    let d_out = &d_out.row(query)[head..head + head_dim];
                    let mut mean = 0.0;
                    for (key, weight) in weights.iter().enumerate() {
                        let d_weight = math::dot(d_out, &values.row(key)[head..head + head_dim]);
                        mean += weight * d_weight;
                        d_scores.push(d_weight);
                    }
                    let d_scores = &mut d_scores[query * keys.rows..];
                    for (d_score, weight) in d_scores.iter_mut().zip(weights) {
                        *d_score = weight * (*d_score - mean) * scale(head_dim);
                    }
                    for_lanes!(head..head + head_dim, |at, len| {
                        let d_query = weighted_sum(d_scores, 1, keys, at, len);
                        store(d_query, &mut d_queries[query * a..][..a], at, len);
                    });
                }
                for key in 0..keys.rows {
                    let d_key_value = &mut d_key_values[key * 2 * a..][..2 * a];
                    for_lanes!(head..head + head_dim, |at, len| {
                        let d_key = weighted_sum(&d_scores[key..], keys.rows, queries, at, len);
                        store(d_key, d_key_value, at, len);
                        let d_value = weighted_sum(&weights_here[key..], keys.rows, d_out, at, len);
                        let value = load(values.row(key), at, len);
                        let d_value = each(|lane| if value[lane] > 0.0 { d_value[lane] } else { 0.0 });
                        store(d_value, d_key_value, a + at, len);
                    });
                }
            }
        }
    }
}

/// One group's keys and values, (keys, a) each.
#[inline(always)]
fn keys_and_values<'a>(key_values: &'a [f32], group: &Group, a: usize) -> (View<'a>, View<'a>) {
    let both = View { data: key_values, rows: key_values.len() / (2 * a), cols: 2 * a, stride: 2 * a };
    let both = both.rows(group.keys.clone());
    (both.columns(0..a), both.columns(a..2 * a))
}

/// Σ weights[i · stride] · row i, in the `len` columns from `at` on.
#[inline(always)]
fn weighted_sum(weights: &[f32], stride: usize, rows: View<'_>, at: usize, len: usize) -> Lanes {
    let mut sum = [0.0; LANES];
    for (row, &weight) in weights.iter().step_by(stride).enumerate() {
        let x = load(rows.row(row), at, len);
        sum = each(|lane| weight.mul_add(x[lane], sum[lane]));
    }
    sum
}

/// Splits the next `len` elements off the front.
#[inline(always)]
fn take<'a>(rest: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    let (front, back) = std::mem::take(rest).split_at_mut(len);
    *rest = back;
    front
}

impl<'a> Visible<'a> {
    /// The next group's flags, `[queries, keys]`; `None` where all is seen.
    #[inline(always)]
    fn take(&mut self, pairs: usize) -> Option<&'a [u8]> {
        match self {
            Self::All => None,
            Self::Where(flags) => {
                let (front, back) = flags.split_at(pairs);
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
        attention.project(params, xq, xk, &mut state);
        attention.attend(&groups(), visible, &mut state, ViewMut::dense(&mut out, DIM));
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

    /// Gradients of queries, keys and parameters. The first two are written over, whatever lay there.
    fn backward(
        attention: &Attention,
        params: &[f32],
        xq: &[f32],
        xk: &[f32],
        state: &AttentionState,
        d_out: &[f32],
    ) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let (mut dxq, mut dxk, mut grads) =
            (vec![9.0; xq.len()], vec![9.0; xk.len()], vec![0.0; params.len()]);
        attention.backward(
            params,
            View::dense(xq, INPUTS),
            View::dense(xk, INPUTS),
            &groups(),
            state,
            View::dense(d_out, DIM),
            ViewMut::dense(&mut dxq, INPUTS),
            ViewMut::dense(&mut dxk, INPUTS),
            &mut grads,
            &mut Scratch::default(),
        );
        (dxq, dxk, grads)
    }

    #[test]
    fn who_sees_nothing_gets_exactly_zero_and_passes_no_gradient() {
        let (attention, len) = unit(2);
        let (params, xq, xk) = (noise(1, len), noise(2, 3 * INPUTS), noise(3, 5 * INPUTS));
        let (out, state) = run(&attention, &params, &xq, &xk, Visible::Where(&SEEN));
        assert_eq!(out[2 * DIM..], [0.0; DIM]);
        let (dxq, dxk, _) = backward(&attention, &params, &xq, &xk, &state, &noise(4, 3 * DIM));
        assert_eq!(dxq[2 * INPUTS..], [0.0; INPUTS]);
        assert_eq!(dxk[3 * INPUTS..], [0.0; 2 * INPUTS]);
    }

    /// Weights as those of trained networks, which are sure of where to look: what else there is gets exactly nothing,
    /// and no gradient of it is subnormal.
    #[test]
    fn what_weighs_next_to_nothing_weighs_nothing() {
        let (attention, len) = unit(1);
        let large = |seed, len| -> Vec<f32> { noise(seed, len).iter().map(|x| 12.0 * x).collect() };
        let (params, xq, xk) = (large(1, len), large(2, 3 * INPUTS), large(3, 5 * INPUTS));
        let (_, state) = run(&attention, &params, &xq, &xk, Visible::All);
        assert!(state.weights.contains(&0.0) && state.weights.iter().all(|&w| w == 0.0 || w > 1e-21));
        let d_out: Vec<f32> = noise(4, 3 * DIM).iter().map(|d| 1e-6 * d).collect();
        let (dxq, dxk, grads) = backward(&attention, &params, &xq, &xk, &state, &d_out);
        assert!([dxq, dxk, grads].concat().iter().all(|d| !d.is_subnormal()));
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
            let (_, state) = run(&attention, &params, &xq, &xk, visible);
            let (dxq, dxk, grads) = backward(&attention, &params, &xq, &xk, &state, &to);
            check("params", &params, &grads, |params| loss(params, &xq, &xk));
            check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
            check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
        }
    }
}
