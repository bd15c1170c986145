//! Scores, softmax and blends, group by group.

use super::{Group, Sides, SidesMut, Visible};
use crate::{
    Accum, Buffer, View, ViewMut, for_lanes,
    math::{self, LANES, Lanes, each, load, store},
    matmul, vectorized,
};
use std::ops::Range;

/// What a score is scaled with: 1/√(a / heads).
#[inline(always)]
pub(crate) fn scale(head_dim: usize) -> f32 {
    1.0 / (head_dim as f32).sqrt()
}

/// `out` (Q M, a) under M masks, row `q M + i` being query q's under mask i, and the softmax weights for backward.
pub fn forward(
    sides: Sides<'_>,
    groups: &[Group],
    masks: &[Visible<'_>],
    weights: &mut [f32],
    out: ViewMut<'_>,
) {
    score(sides, groups, masks, weights);
    exponentiate(weights);
    attend(sides, groups, weights, out);
}

vectorized! {
    /// Every query's scores under every mask less the largest of them, group by group and head by head; −∞ where
    /// unseen.
    fn score<'a>(sides: Sides<'a>, groups: &'a [Group], masks: &'a [Visible<'a>], scores: &'a mut [f32]) {
        let mut first = 0;
        for group in groups {
            let pairs = first..first + group.pairs();
            first = pairs.end;
            let keys = group.keys.len();
            let queries = sides.queries.rows(group.queries.clone());
            for head in 0..sides.heads {
                let scores = take(&mut scores, pairs.len() * masks.len());
                let of_queries = queries.columns(sides.query_columns(head));
                dots(of_queries, sides.keys_of(group, head), &mut scores[..pairs.len()]);
                repeat_rows(scores, keys, masks.len());
                for (at, scores) in scores.chunks_exact_mut(keys).enumerate() {
                    let (query, seen) = (at / masks.len(), masks[at % masks.len()].flags(&pairs));
                    let mut largest = f32::NEG_INFINITY;
                    for (key, score) in scores.iter_mut().enumerate() {
                        let sees = seen.is_none_or(|seen| seen[query * keys + key] != 0);
                        *score = if sees { sides.scale * *score } else { f32::NEG_INFINITY };
                        largest = largest.max(*score);
                    }
                    // A query that sees no key keeps −∞ everywhere: −∞ − (−∞) would be NaN.
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
    fn attend<'a>(sides: Sides<'a>, groups: &'a [Group], weights: &'a mut [f32], out: ViewMut<'a>) {
        let masks = masks(groups, out.rows);
        for group in groups {
            for head in 0..sides.heads {
                let weights = take(&mut weights, group.pairs() * masks);
                for weights in weights.chunks_exact_mut(group.keys.len()) {
                    let total: f32 = weights.iter().sum();
                    // A query that sees no key has weights of zero: dividing by their sum would give NaN.
                    if total > 0.0 {
                        weights.iter_mut().for_each(|weight| *weight /= total);
                    }
                }
                let out = out.reborrow().rows(under_masks(group, masks)).columns(sides.value_columns(head));
                blend(weights, sides.values_of(group, head), out);
            }
        }
    }
}

vectorized! {
    /// From the gradient by the output, `d_out` (Q M, a), to those by queries, keys and values. With w the weights: d_w
    /// = d_out valueᵀ, d_score = w (d_w − Σ w d_w), d_query = d_score key, d_key = d_scoreᵀ query and d_value = wᵀ
    /// d_out.
    pub fn backward<'a>(
        sides: Sides<'a>,
        groups: &'a [Group],
        weights: &'a [f32],
        d_out: View<'a>,
        d: SidesMut<'a>,
    ) {
        let mut d_scores = Buffer::default();
        let masks = masks(groups, d_out.rows);
        for group in groups {
            let queries = sides.queries.rows(group.queries.clone());
            let d_out = d_out.rows(under_masks(group, masks));
            let keys = group.keys.len();
            let d_scores = d_scores.fit(group.pairs() * masks);
            for head in 0..sides.heads {
                let (weights_here, behind) = weights.split_at(group.pairs() * masks);
                weights = behind;
                let (of_queries, of_values) = (sides.query_columns(head), sides.value_columns(head));
                let d_out = d_out.columns(of_values.clone());
                dots(d_out, sides.values_of(group, head), d_scores);
                for (d_scores, weights) in d_scores.chunks_exact_mut(keys).zip(weights_here.chunks_exact(keys)) {
                    let mean: f32 = weights.iter().zip(&*d_scores).fold(0.0, |sum, (w, d)| sum + w * d);
                    for (d_score, weight) in d_scores.iter_mut().zip(weights) {
                        *d_score = weight * (*d_score - mean) * sides.scale;
                    }
                }
                // Masks share the scores: their gradients meet before the products.
                sum_repeated_rows(d_scores, keys, masks);
                let d_scores = &d_scores[..group.pairs()];
                let d_queries = d.queries.reborrow().rows(group.queries.clone()).columns(of_queries.clone());
                blend(d_scores, sides.keys_of(group, head), d_queries);
                let adds = d.adds[0] || head > 0 && sides.shares_keys();
                let to = d.keys.keys().columns(sides.key_columns(head));
                blend_transposed(d_scores, queries.columns(of_queries), sides.picked(group), to, adds);
                let to = d.keys.values().columns(of_values);
                blend_transposed(weights_here, d_out, sides.picked(group), to, d.adds[1]);
            }
        }
    }
}

/// Rows of a matrix that a group's keys stand for.
#[derive(Clone, Copy)]
struct Picked<'a> {
    /// The first of them, where they follow each other.
    first: usize,
    /// How many.
    len: usize,
    /// Each by itself, where they do not.
    rows: Option<&'a [usize]>,
}

impl Picked<'_> {
    #[inline(always)]
    fn row(self, key: usize) -> usize {
        self.rows.map_or(self.first + key, |rows| rows[key])
    }
}

impl<'a> Sides<'a> {
    /// Whether all heads look at the same keys.
    #[inline(always)]
    fn shares_keys(&self) -> bool {
        self.keys.cols < self.queries.cols
    }

    #[inline(always)]
    fn query_columns(&self, head: usize) -> Range<usize> {
        let width = self.queries.cols / self.heads;
        head * width..(head + 1) * width
    }

    #[inline(always)]
    fn key_columns(&self, head: usize) -> Range<usize> {
        if self.shares_keys() { 0..self.keys.cols } else { self.query_columns(head) }
    }

    #[inline(always)]
    fn value_columns(&self, head: usize) -> Range<usize> {
        let width = self.values.cols / self.heads;
        head * width..(head + 1) * width
    }

    #[inline(always)]
    fn picked(&self, group: &Group) -> Picked<'a> {
        let rows = self.rows.map(|rows| &rows[group.keys.clone()]);
        Picked { first: group.keys.start, len: group.keys.len(), rows }
    }

    #[inline(always)]
    fn keys_of(&self, group: &Group, head: usize) -> (View<'a>, Picked<'a>) {
        (self.keys.columns(self.key_columns(head)), self.picked(group))
    }

    #[inline(always)]
    fn values_of(&self, group: &Group, head: usize) -> (View<'a>, Picked<'a>) {
        (self.values.columns(self.value_columns(head)), self.picked(group))
    }
}

/// The picked rows one after another, for products that want them so.
fn gathered((view, picked): (View<'_>, Picked<'_>)) -> Vec<f32> {
    let mut rows = Vec::with_capacity(picked.len * view.cols);
    for key in 0..picked.len {
        rows.extend_from_slice(view.row(picked.row(key)));
    }
    rows
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
    // From the last: a row goes to where only rows stood that have gone already.
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
pub(super) const LARGE: usize = 8;

/// pairs = a bᵀ. `a` (queries, c), `b` (keys, c), `pairs` `[queries, keys]`.
#[inline(always)]
fn dots(a: View<'_>, (b, picked): (View<'_>, Picked<'_>), pairs: &mut [f32]) {
    let keys = picked.len;
    if a.rows >= LARGE {
        let to = ViewMut::dense(pairs, keys);
        if picked.rows.is_none() {
            return matmul::x_wt(a, b.rows(picked.first..picked.first + keys), to, Accum::Replace);
        }
        return matmul::x_wt(a, View::dense(&gathered((b, picked)), b.cols), to, Accum::Replace);
    }
    for (query, pairs) in pairs.chunks_exact_mut(keys).enumerate() {
        for (key, pair) in pairs.iter_mut().enumerate() {
            *pair = math::dot(a.row(query), b.row(picked.row(key)));
        }
    }
}

/// a = pairs b. `pairs` `[queries, keys]`, `b` (keys, c), `a` (queries, c).
#[inline(always)]
fn blend(pairs: &[f32], (b, picked): (View<'_>, Picked<'_>), mut a: ViewMut<'_>) {
    let keys = picked.len;
    if a.rows >= LARGE {
        let pairs = View::dense(pairs, keys);
        if picked.rows.is_none() {
            return matmul::dy_w(pairs, b.rows(picked.first..picked.first + keys), a, Accum::Replace);
        }
        return matmul::dy_w(pairs, View::dense(&gathered((b, picked)), b.cols), a, Accum::Replace);
    }
    for (query, weights) in pairs.chunks_exact(keys).enumerate() {
        let (a, row) = (a.row(query), |key| b.row(picked.row(key)));
        let wide = b.cols - b.cols % WIDE;
        for at in (0..wide).step_by(WIDE) {
            let sums: [Lanes; WIDE / LANES] = weighted_sums(weights.iter(), row, at);
            a[at..at + WIDE].copy_from_slice(sums.as_flattened());
        }
        for_lanes!(wide..b.cols, |at, len| {
            let mut sum = [0.0; LANES];
            for (key, &weight) in weights.iter().enumerate() {
                let x = load(row(key), at, len);
                sum = each(|lane| weight.mul_add(x[lane], sum[lane]));
            }
            store(sum, a, at, len);
        });
    }
}

/// b = pairsᵀ a, or b += pairsᵀ a where it `adds`, in the picked rows of b. `pairs` `[queries, keys]`, `a` (queries, c).
#[inline(always)]
fn blend_transposed(pairs: &[f32], a: View<'_>, picked: Picked<'_>, mut b: ViewMut<'_>, adds: bool) {
    let keys = picked.len;
    if a.rows >= LARGE && picked.rows.is_none() {
        let accum = if adds { Accum::Add } else { Accum::Replace };
        let to = b.rows(picked.first..picked.first + keys);
        return matmul::dyt_x(View::dense(pairs, keys), a, to, accum);
    }
    for key in 0..keys {
        let b = b.row(picked.row(key));
        let wide = a.cols - a.cols % WIDE;
        for at in (0..wide).step_by(WIDE) {
            let weights = pairs[key..].iter().step_by(keys);
            let sums: [Lanes; WIDE / LANES] = weighted_sums(weights, |query| a.row(query), at);
            for (b, sum) in b[at..at + WIDE].iter_mut().zip(sums.as_flattened()) {
                *b = if adds { *b + sum } else { *sum };
            }
        }
        for_lanes!(wide..a.cols, |at, len| {
            let sum = weighted_sum(&pairs[key..], keys, a, at, len);
            if adds {
                let before = load(b, at, len);
                store(each(|lane| before[lane] + sum[lane]), b, at, len);
            } else {
                store(sum, b, at, len);
            }
        });
    }
}

/// Columns that are summed side by side: one sum waits for its own last addition.
const WIDE: usize = 4 * LANES;

/// Σ weight i · row i, in the columns from `at` on: N times [`LANES`] of them.
#[inline(always)]
fn weighted_sums<'r, 'w, const N: usize>(
    weights: impl Iterator<Item = &'w f32>,
    row: impl Fn(usize) -> &'r [f32],
    at: usize,
) -> [Lanes; N] {
    let mut sums = [[0.0; LANES]; N];
    for (i, &weight) in weights.enumerate() {
        let (row, _) = row(i)[at..at + N * LANES].as_chunks::<LANES>();
        for (sum, x) in sums.iter_mut().zip(row) {
            *sum = each(|lane| weight.mul_add(x[lane], sum[lane]));
        }
    }
    sums
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::noise;

    /// Every sum adds its products one after another, however many columns are worked on at once.
    #[test]
    fn blends_are_sums_of_weighted_rows_at_any_width() {
        let (queries, keys) = (LARGE - 1, 5);
        let rows = [4, 0, 3, 1, 2];
        for cols in [6, LANES, WIDE, WIDE + 6, 2 * WIDE + LANES] {
            let (pairs, b) = (noise(1, queries * keys), noise(2, keys * cols));
            let picked = Picked { first: 0, len: keys, rows: Some(&rows) };
            let mut a = vec![9.0; queries * cols];
            blend(&pairs, (View::dense(&b, cols), picked), ViewMut::dense(&mut a, cols));
            for (at, &found) in a.iter().enumerate() {
                let (query, column) = (at / cols, at % cols);
                let expected = (0..keys).fold(0.0, |sum: f32, key| {
                    pairs[query * keys + key].mul_add(b[rows[key] * cols + column], sum)
                });
                assert_eq!(found, expected, "query {query}, column {column} of {cols}");
            }
            for adds in [false, true] {
                let mut back = vec![0.5; keys * cols];
                let to = ViewMut::dense(&mut back, cols);
                blend_transposed(&pairs, View::dense(&a, cols), picked, to, adds);
                for key in 0..keys {
                    for column in 0..cols {
                        let sum = (0..queries).fold(0.0, |sum: f32, query| {
                            pairs[query * keys + key].mul_add(a[query * cols + column], sum)
                        });
                        let expected = if adds { 0.5 + sum } else { sum };
                        assert_eq!(back[rows[key] * cols + column], expected, "key {key}, column {column}");
                    }
                }
            }
        }
    }
}
