//! Multi-head attention over small groups of rows (paper, equations 12-14), no output projection.
//!
//! Groups are ragged: each has its own numbers of queries and keys, and only keys that exist. A query that
//! sees nothing gets zeros, exactly, and passes no gradient.

use crate::{
    Accum, Buffer, LayoutBuilder, Linear, Scratch, View, ViewMut, activation, for_lanes, linear,
    math::{self, LANES, Lanes, each, load, store},
    matmul, vectorized,
};
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
    /// What becomes of a value behind its layer.
    values: Values,
}

/// What becomes of a value behind its layer.
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

/// What forward leaves for backward. With Q query rows and K key rows:
#[derive(Debug, Default)]
pub struct AttentionState {
    /// `[Q, a]`.
    queries: Buffer,
    /// Keys and values, `[K, 2a]`.
    key_values: Buffer,
    /// Softmax weights; the groups' `[heads, queries, masks, keys]` one after another.
    weights: Buffer,
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

    /// Queries, keys (without their bias) and values of all rows. `x_queries` (Q, h), `x_keys` (K, h).
    pub fn project(&self, params: &[f32], x_queries: View<'_>, x_keys: View<'_>, state: &mut AttentionState) {
        let a = self.dim;
        let queries = ViewMut::dense(state.queries.fit(x_queries.rows * a), a);
        self.query.forward(params, x_queries, queries);
        let key_values = ViewMut::dense(state.key_values.fit(x_keys.rows * 2 * a), 2 * a);
        self.project_keys(params, x_keys, key_values);
    }

    /// Writes `out` (Q, a) from what [`Attention::project`] left.
    pub fn attend(
        &self,
        groups: &[Group],
        visible: Visible<'_>,
        state: &mut AttentionState,
        out: ViewMut<'_>,
    ) {
        self.attend_masks(groups, &[visible], state, out);
    }

    /// The same queries under several masks, which share their projections and their scores. With M masks, row
    /// `q M + i` of `out` (Q M, a) is query q's under mask i.
    pub fn attend_masks(
        &self,
        groups: &[Group],
        masks: &[Visible<'_>],
        state: &mut AttentionState,
        out: ViewMut<'_>,
    ) {
        let AttentionState { queries, key_values, weights } = state;
        let weights = weights.fit(weights_len(groups, masks.len(), self.heads));
        self.attend_views(View::dense(queries, self.dim), key_values, groups, masks, weights, out);
    }

    /// Takes `d_out` (Q M, a). Writes `dx_queries` (Q, h) and `dx_keys` (K, h) and adds to the parameters'
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
        self.attend_views_backward(View::dense(queries, a), key_values, groups, weights, d_out, d);
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

    /// [`Attention::attend_masks`] of `queries` (Q, a) and `key_values` `[K, 2a]`, keys and values side by side;
    /// leaves the softmax `weights` for backward.
    pub(crate) fn attend_views(
        &self,
        queries: View<'_>,
        key_values: &[f32],
        groups: &[Group],
        masks: &[Visible<'_>],
        weights: &mut [f32],
        out: ViewMut<'_>,
    ) {
        score(queries, key_values, groups, masks, weights, self.head_dim());
        exponentiate(weights);
        attend(key_values, groups, weights, out, self.head_dim());
    }

    /// From `d_out` (Q M, a) to the gradients by queries `[Q, a]` and by keys and values, before the values' ReLU,
    /// `[K, 2a]`: `d`, all of both written.
    pub(crate) fn attend_views_backward(
        &self,
        queries: View<'_>,
        key_values: &[f32],
        groups: &[Group],
        weights: &[f32],
        d_out: View<'_>,
        d: (&mut [f32], &mut [f32]),
    ) {
        let (a, (d_queries, d_key_values)) = (self.dim, d);
        let d = (d_queries, &mut d_key_values[..]);
        attend_backward(d_out, queries, key_values, groups, weights, d, self.head_dim());
        if self.values == Values::Rectified {
            let values = View::dense(key_values, 2 * a).columns(a..2 * a);
            activation::relu_backward(values, ViewMut::dense(d_key_values, 2 * a).columns(a..2 * a));
        }
    }

    /// Size of one head.
    pub(crate) fn head_dim(&self) -> usize {
        self.dim / self.heads
    }

    /// Keys (without their bias, which softmax does not see and whose gradient is zero) and values of `x` (K, h).
    pub(crate) fn project_keys(&self, params: &[f32], x: View<'_>, mut key_values: ViewMut<'_>) {
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

/// What a score is scaled with: 1/√(a / heads).
#[inline(always)]
pub(crate) fn scale(head_dim: usize) -> f32 {
    1.0 / (head_dim as f32).sqrt()
}

vectorized! {
    /// Every query's scores under every mask less the largest of them, group by group and head by head; −∞ where
    /// unseen.
    fn score<'a>(
        queries: View<'a>,
        key_values: &'a [f32],
        groups: &'a [Group],
        masks: &'a [Visible<'a>],
        scores: &'a mut [f32],
        head_dim: usize,
    ) {
        let mut first = 0;
        for group in groups {
            let pairs = first..first + group.pairs();
            first = pairs.end;
            let (keys, _) = keys_and_values(key_values, group, queries.cols);
            let queries = queries.rows(group.queries.clone());
            for head in heads(queries.cols, head_dim) {
                let scores = take(&mut scores, pairs.len() * masks.len());
                dots(queries.columns(head.clone()), keys.columns(head), &mut scores[..pairs.len()]);
                repeat_rows(scores, keys.rows, masks.len());
                for (at, scores) in scores.chunks_exact_mut(keys.rows).enumerate() {
                    let (query, seen) = (at / masks.len(), masks[at % masks.len()].flags(&pairs));
                    let mut largest = f32::NEG_INFINITY;
                    for (key, score) in scores.iter_mut().enumerate() {
                        let sees = seen.is_none_or(|seen| seen[query * keys.rows + key] != 0);
                        *score = if sees { scale(head_dim) * *score } else { f32::NEG_INFINITY };
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
    pub(crate) fn exponentiate<'a>(x: &'a mut [f32]) {
        for x in x {
            *x = math::exp_share(*x);
        }
    }
}

vectorized! {
    /// Makes softmax weights of exponentials, in place, and `out` of the values by these weights.
    fn attend<'a>(
        key_values: &'a [f32],
        groups: &'a [Group],
        weights: &'a mut [f32],
        out: ViewMut<'a>,
        head_dim: usize,
    ) {
        let masks = masks(groups, out.rows);
        for group in groups {
            let (_, values) = keys_and_values(key_values, group, out.cols);
            for head in heads(out.cols, head_dim) {
                let weights = take(&mut weights, group.pairs() * masks);
                for weights in weights.chunks_exact_mut(values.rows) {
                    let total: f32 = weights.iter().sum();
                    // Who sees nothing keeps the zeros.
                    if total > 0.0 {
                        weights.iter_mut().for_each(|weight| *weight /= total);
                    }
                }
                let out = out.reborrow().rows(under_masks(group, masks)).columns(head.clone());
                blend(weights, values.columns(head), out);
            }
        }
    }
}

vectorized! {
    /// From the gradient by the output to those by queries and by keys and values: `d`, all of it written. With w
    /// the weights: d_w = d_out valueᵀ, d_score = w (d_w − Σ w d_w), d_query = d_score key, d_key = d_scoreᵀ query
    /// and d_value = wᵀ d_out.
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
        let mut d_scores = Buffer::default();
        let masks = masks(groups, d_out.rows);
        for group in groups {
            let (keys, values) = keys_and_values(key_values, group, a);
            let (queries, d_out) = (queries.rows(group.queries.clone()), d_out.rows(under_masks(group, masks)));
            let d_queries = &mut d_queries[group.queries.start * a..group.queries.end * a];
            let d_key_values = &mut d_key_values[group.keys.start * 2 * a..group.keys.end * 2 * a];
            let d_scores = d_scores.fit(group.pairs() * masks);
            for head in heads(a, head_dim) {
                let (weights_here, behind) = weights.split_at(group.pairs() * masks);
                weights = behind;
                let (keys, values) = (keys.columns(head.clone()), values.columns(head.clone()));
                let (queries, d_out) = (queries.columns(head.clone()), d_out.columns(head.clone()));
                dots(d_out, values, d_scores);
                for (d_scores, weights) in
                    d_scores.chunks_exact_mut(keys.rows).zip(weights_here.chunks_exact(keys.rows))
                {
                    let mean: f32 = weights.iter().zip(&*d_scores).fold(0.0, |sum, (w, d)| sum + w * d);
                    for (d_score, weight) in d_scores.iter_mut().zip(weights) {
                        *d_score = weight * (*d_score - mean) * scale(head_dim);
                    }
                }
                // Masks share the scores: their gradients meet before the products.
                sum_repeated_rows(d_scores, keys.rows, masks);
                let d_scores = &d_scores[..group.pairs()];
                blend(d_scores, keys, ViewMut::dense(d_queries, a).columns(head.clone()));
                let d_keys = ViewMut::dense(d_key_values, 2 * a).columns(head.clone());
                blend_transposed(d_scores, queries, d_keys);
                let d_values = ViewMut::dense(d_key_values, 2 * a).columns(a + head.start..a + head.end);
                blend_transposed(weights_here, d_out, d_values);
            }
        }
    }
}

/// One group's keys and values, (keys, a) each.
#[inline(always)]
pub(crate) fn keys_and_values<'a>(key_values: &'a [f32], group: &Group, a: usize) -> (View<'a>, View<'a>) {
    let both = View { data: key_values, rows: key_values.len() / (2 * a), cols: 2 * a, stride: 2 * a };
    let both = both.rows(group.keys.clone());
    (both.columns(0..a), both.columns(a..2 * a))
}

/// Each head's columns.
#[inline(always)]
pub(crate) fn heads(a: usize, head_dim: usize) -> impl Iterator<Item = Range<usize>> {
    (0..a).step_by(head_dim).map(move |at| at..at + head_dim)
}

/// How many masks each query stands under, by the rows of the output.
#[inline(always)]
fn masks(groups: &[Group], rows: usize) -> usize {
    rows / groups.last().map_or(1, |group| group.queries.end.max(1))
}

/// A group's rows of the output.
#[inline(always)]
fn under_masks(group: &Group, masks: usize) -> Range<usize> {
    group.queries.start * masks..group.queries.end * masks
}

/// Repeats each of the rows that stand at the front, in place, so that all is filled.
#[inline(always)]
fn repeat_rows(rows: &mut [f32], width: usize, times: usize) {
    if times == 1 {
        return;
    }
    // From behind: a row goes to where only rows stood that have gone already.
    for row in (0..rows.len() / width / times).rev() {
        for copy in (0..times).rev() {
            rows.copy_within(row * width..(row + 1) * width, (row * times + copy) * width);
        }
    }
}

/// Leaves each row's sum over its repetitions at the front: the backward of [`repeat_rows`].
#[inline(always)]
fn sum_repeated_rows(rows: &mut [f32], width: usize, times: usize) {
    if times == 1 {
        return;
    }
    for at in 0..rows.len() / times {
        let (row, column) = (at / width, at % width);
        rows[at] = (0..times).map(|copy| rows[(row * times + copy) * width + column]).sum();
    }
}

/// Queries from which on a group's products are faer's: to smaller ones the call costs more than the loops here.
const LARGE: usize = 8;

/// pairs = a bᵀ. `a` (queries, c), `b` (keys, c), `pairs` `[queries, keys]`.
#[inline(always)]
fn dots(a: View<'_>, b: View<'_>, pairs: &mut [f32]) {
    if a.rows >= LARGE {
        return matmul::x_wt(a, b, ViewMut::dense(pairs, b.rows), Accum::Replace);
    }
    for (query, pairs) in pairs.chunks_exact_mut(b.rows).enumerate() {
        for (key, pair) in pairs.iter_mut().enumerate() {
            *pair = math::dot(a.row(query), b.row(key));
        }
    }
}

/// a = pairs b. `pairs` `[queries, keys]`, `b` (keys, c), `a` (queries, c).
#[inline(always)]
fn blend(pairs: &[f32], b: View<'_>, mut a: ViewMut<'_>) {
    if a.rows >= LARGE {
        return matmul::dy_w(View::dense(pairs, b.rows), b, a, Accum::Replace);
    }
    for (query, weights) in pairs.chunks_exact(b.rows).enumerate() {
        let a = a.row(query);
        for_lanes!(0..b.cols, |at, len| {
            store(weighted_sum(weights, 1, b, at, len), a, at, len);
        });
    }
}

/// b = pairsᵀ a. `pairs` `[queries, keys]`, `a` (queries, c), `b` (keys, c).
#[inline(always)]
fn blend_transposed(pairs: &[f32], a: View<'_>, mut b: ViewMut<'_>) {
    if a.rows >= LARGE {
        return matmul::dyt_x(View::dense(pairs, b.rows), a, b, Accum::Replace);
    }
    let keys = b.rows;
    for key in 0..keys {
        let b = b.row(key);
        for_lanes!(0..a.cols, |at, len| {
            store(weighted_sum(&pairs[key..], keys, a, at, len), b, at, len);
        });
    }
}

/// Σ weights[i · stride] · row i, in the `len` columns from `at` on.
#[inline(always)]
pub(crate) fn weighted_sum(weights: &[f32], stride: usize, rows: View<'_>, at: usize, len: usize) -> Lanes {
    let mut sum = [0.0; LANES];
    for (row, &weight) in weights.iter().step_by(stride).enumerate() {
        let x = load(rows.row(row), at, len);
        sum = each(|lane| weight.mul_add(x[lane], sum[lane]));
    }
    sum
}

/// Splits the next `len` elements off the front.
#[inline(always)]
pub(crate) fn take<'a>(rest: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    let (front, back) = std::mem::take(rest).split_at_mut(len);
    *rest = back;
    front
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
