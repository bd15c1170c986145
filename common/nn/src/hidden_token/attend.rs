//! Attention of rows that see their group's entities, by a mask, and a token of their own.

use crate::{
    View, ViewMut,
    attention::{Group, Visible, exponentiate, heads, keys_and_values, scale, take, weighted_sum},
    for_lanes,
    math::{self, Lanes, each, load, store},
    vectorized,
};
use std::ops::Range;

/// The queries, and the tokens that they attend to.
#[derive(Clone, Copy)]
pub(super) struct Tokens<'a> {
    /// (R, a), one row for each of the groups' queries.
    pub(super) queries: View<'a>,
    /// Keys and values of entities, `[E, 2a]`.
    pub(super) entities: &'a [f32],
    /// Keys and values of the queries' own tokens, `[R, 2a]`.
    pub(super) hidden: &'a [f32],
}

/// Writes the groups' rows of `out` (R, a), and the softmax weights that backward needs: the groups'
/// `[heads, queries, keys + 1]` one after another, the query's own token last.
pub(super) fn attend(
    tokens: Tokens<'_>,
    groups: &[Group],
    visible: Visible<'_>,
    weights: &mut [f32],
    out: ViewMut<'_>,
    head_dim: usize,
) {
    score(tokens, groups, visible, weights, head_dim);
    exponentiate(weights);
    blend(tokens, groups, weights, out, head_dim);
}

vectorized! {
    /// Every query's scores less the largest of them; −∞ where unseen.
    fn score<'a>(
        tokens: Tokens<'a>,
        groups: &'a [Group],
        visible: Visible<'a>,
        scores: &'a mut [f32],
        head_dim: usize,
    ) {
        let (a, mut first) = (tokens.queries.cols, 0);
        for group in groups {
            let pairs = first..first + group.pairs();
            first = pairs.end;
            let seen = visible.flags(&pairs);
            let (keys, _) = keys_and_values(tokens.entities, group, a);
            for head in heads(a, head_dim) {
                let keys = keys.columns(head.clone());
                for (at, row) in group.queries.clone().enumerate() {
                    let scores = take(&mut scores, keys.rows + 1);
                    let query = &tokens.queries.row(row)[head.clone()];
                    let (own, others) = (math::dot(query, &tokens.key(row)[head.clone()]), &mut scores[..keys.rows]);
                    let mut largest = own;
                    for (key, score) in others.iter_mut().enumerate() {
                        let sees = seen.is_none_or(|seen| seen[at * keys.rows + key] != 0);
                        *score = if sees { math::dot(query, keys.row(key)) } else { f32::NEG_INFINITY };
                        largest = largest.max(*score);
                    }
                    scores[keys.rows] = own;
                    scores.iter_mut().for_each(|score| *score = scale(head_dim) * (*score - largest));
                }
            }
        }
    }
}

vectorized! {
    /// Makes softmax weights of exponentials, in place, and `out` of the values by these weights.
    fn blend<'a>(
        tokens: Tokens<'a>,
        groups: &'a [Group],
        weights: &'a mut [f32],
        out: ViewMut<'a>,
        head_dim: usize,
    ) {
        let a = tokens.queries.cols;
        for group in groups {
            let (_, values) = keys_and_values(tokens.entities, group, a);
            for head in heads(a, head_dim) {
                for row in group.queries.clone() {
                    let weights = take(&mut weights, values.rows + 1);
                    let total: f32 = weights.iter().sum();
                    weights.iter_mut().for_each(|weight| *weight /= total);
                    let (out, own) = (out.row(row), tokens.value(row));
                    for_lanes!(head.clone(), |at, len| {
                        let sum = weighted_sum(&weights[..values.rows], 1, values, at, len);
                        store(plus(sum, weights[values.rows], own, at, len), out, at, len);
                    });
                }
            }
        }
    }
}

vectorized! {
    /// From the gradient by the output to those by queries (written), by entities' keys and values and by the queries'
    /// own tokens (both added to): `d`. See [`crate::attention`] for the equations. What ReLU does not let pass is the
    /// caller's.
    pub(super) fn attend_backward<'a>(
        tokens: Tokens<'a>,
        groups: &'a [Group],
        weights: &'a [f32],
        d_out: View<'a>,
        d: [&'a mut [f32]; 3],
        head_dim: usize,
    ) {
        let a = tokens.queries.cols;
        let [d_queries, d_entities, d_hidden] = d;
        for group in groups {
            let (keys, values) = keys_and_values(tokens.entities, group, a);
            let d_entities = &mut d_entities[group.keys.start * 2 * a..group.keys.end * 2 * a];
            let others = keys.rows;
            for head in heads(a, head_dim) {
                for row in group.queries.clone() {
                    let (weights_here, behind) = weights.split_at(others + 1);
                    weights = behind;
                    let (query, d_out) = (tokens.queries.row(row), d_out.row(row));
                    let (own_key, own_value) = (tokens.key(row), tokens.value(row));
                    let d_hidden = &mut d_hidden[row * 2 * a..][..2 * a];
                    let d_query = &mut d_queries[row * a..][..a];
                    let own = along(d_out, own_value, &head);
                    let mut mean = weights_here[others] * own;
                    for (key, weight) in weights_here[..others].iter().enumerate() {
                        // Worked out again below: shorter than to keep it.
                        mean = weight.mul_add(along(d_out, values.row(key), &head), mean);
                    }
                    let d_own = weights_here[others] * (own - mean) * scale(head_dim);
                    for_lanes!(head.clone(), |at, len| {
                        let key = load(own_key, at, len);
                        store(each(|lane| d_own * key[lane]), d_query, at, len);
                        add_to(d_hidden, at, len, d_own, query, at);
                        add_to(d_hidden, a + at, len, weights_here[others], d_out, at);
                    });
                    for (key, &weight) in weights_here[..others].iter().enumerate() {
                        // Nothing passes through what has no weight, unseen or too small to count.
                        if weight == 0.0 {
                            continue;
                        }
                        let d_score = weight * (along(d_out, values.row(key), &head) - mean) * scale(head_dim);
                        let d_entity = &mut d_entities[key * 2 * a..][..2 * a];
                        for_lanes!(head.clone(), |at, len| {
                            add_to(d_query, at, len, d_score, keys.row(key), at);
                            add_to(d_entity, at, len, d_score, query, at);
                            add_to(d_entity, a + at, len, weight, d_out, at);
                        });
                    }
                }
            }
        }
    }
}

impl<'a> Tokens<'a> {
    /// The key of a query's own token, (a).
    #[inline(always)]
    fn key(&self, row: usize) -> &'a [f32] {
        let a = self.queries.cols;
        &self.hidden[row * 2 * a..][..a]
    }

    /// The value of a query's own token, (a).
    #[inline(always)]
    fn value(&self, row: usize) -> &'a [f32] {
        let a = self.queries.cols;
        &self.hidden[row * 2 * a + a..][..a]
    }
}

/// d_out · value, over a head's columns.
#[inline(always)]
fn along(d_out: &[f32], value: &[f32], head: &Range<usize>) -> f32 {
    math::dot(&d_out[head.clone()], &value[head.clone()])
}

/// sum + weight · x, in the `len` columns from `at` on.
#[inline(always)]
fn plus(sum: Lanes, weight: f32, x: &[f32], at: usize, len: usize) -> Lanes {
    let x = load(x, at, len);
    each(|lane| weight.mul_add(x[lane], sum[lane]))
}

/// to += weight · x, `len` columns of them from `at` and `from` on.
#[inline(always)]
fn add_to(to: &mut [f32], at: usize, len: usize, weight: f32, x: &[f32], from: usize) {
    let (sum, x) = (load(to, at, len), load(x, from, len));
    store(each(|lane| weight.mul_add(x[lane], sum[lane])), to, at, len);
}
