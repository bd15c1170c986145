//! What the decoder knows of its tokens, for one set of weights.

use super::Decoder;
use rit_nn::{Accum, View, ViewMut, activation, linear, math, matmul, vectorized};
use std::ops::Range;

/// What the decoder knows of its tokens, for one set of weights. K = A + 1 tokens, H heads.
#[derive(Clone, Debug, Default)]
pub struct Tables {
    /// ReLU'd embeddings, `[K, h]`.
    tokens: Vec<f32>,
    /// Keys and ReLU'd values, `[K, 2a]`.
    key_values: Vec<f32>,
    /// `[H, K, h]`, scaled.
    pub(super) scores: Vec<f32>,
    /// `[H, K]`, scaled.
    pub(super) score_bias: Vec<f32>,
    /// `[H, K, h]`.
    pub(super) contexts: Vec<f32>,
}

impl Tables {
    /// Zeros to add the gradients by scores and contexts to.
    pub(super) fn gradient(&self) -> Self {
        Self {
            contexts: vec![0.0; self.contexts.len()],
            scores: vec![0.0; self.scores.len()],
            score_bias: vec![0.0; self.score_bias.len()],
            ..Self::default()
        }
    }
}

impl Decoder {
    /// The tables for these weights.
    pub fn tables(&self, params: &[f32]) -> Tables {
        let (h, k) = (self.hidden_dim, self.tokens());
        let attention = &self.action_attention;
        let (a, heads) = (attention.dim, attention.heads);
        let head_dim = a / heads;
        let scale = 1.0 / (head_dim as f32).sqrt();
        let embed = View::dense(&params[self.action_embed.clone()], k);
        let mut tables = Tables::default();
        for token in 0..k {
            tables.tokens.extend((0..h).map(|i| embed.row(i)[token].max(0.0)));
        }
        tables.key_values = vec![0.0; k * 2 * a];
        let mut key_values = ViewMut::dense(&mut tables.key_values, 2 * a);
        attention.key_value.forward(params, View::dense(&tables.tokens, h), key_values.reborrow());
        activation::relu(key_values.columns(a..2 * a));

        tables.scores = vec![0.0; heads * k * h];
        tables.contexts = vec![0.0; heads * k * h];
        for head in 0..heads {
            let columns = head * head_dim..(head + 1) * head_dim;
            let (keys, values) = keys_and_values(&tables.key_values, a, columns.clone());
            let part = head * k * h..(head + 1) * k * h;
            let query = attention.query.weight(params).rows(columns.clone());
            let scores = ViewMut::dense(&mut tables.scores[part.clone()], h);
            matmul::dy_w(keys, query, scores, Accum::Replace);
            push_products(
                &mut tables.score_bias,
                scale,
                keys,
                &attention.query.bias(params)[columns.clone()],
            );
            let (_, context, _) = self.head_columns(head);
            let weight = self.head_hidden.weight(params).columns(context);
            let contexts = ViewMut::dense(&mut tables.contexts[part], h);
            matmul::x_wt(values, weight, contexts, Accum::Replace);
        }
        tables.scores.iter_mut().for_each(|score| *score *= scale);
        tables
    }

    /// From gradients of `scores`, `score_bias` and `contexts` to those of the parameters they come from.
    pub(super) fn tables_backward(&self, params: &[f32], tables: &Tables, d: &mut Tables, grads: &mut [f32]) {
        let (h, k) = (self.hidden_dim, self.tokens());
        let attention = &self.action_attention;
        let (a, heads) = (attention.dim, attention.heads);
        let head_dim = a / heads;
        let scale = 1.0 / (head_dim as f32).sqrt();
        d.scores.iter_mut().for_each(|score| *score *= scale);
        d.score_bias.iter_mut().for_each(|bias| *bias *= scale);
        d.key_values = vec![0.0; k * 2 * a];
        for head in 0..heads {
            let columns = head * head_dim..(head + 1) * head_dim;
            let (keys, values) = keys_and_values(&tables.key_values, a, columns.clone());
            let part = head * k * h..(head + 1) * k * h;
            let d_scores = View::dense(&d.scores[part.clone()], h);
            let d_contexts = View::dense(&d.contexts[part], h);
            let d_bias = &d.score_bias[head * k..(head + 1) * k];
            let (_, context, _) = self.head_columns(head);

            matmul::dyt_x(
                keys,
                d_scores,
                attention.query.weight_mut(grads).rows(columns.clone()),
                Accum::Add,
            );
            linear::add_weighted_rows(&mut attention.query.bias_mut(grads)[columns.clone()], d_bias, keys);
            let weight = self.head_hidden.weight_mut(grads).columns(context.clone());
            matmul::dyt_x(d_contexts, values, weight, Accum::Add);

            let mut d_keys = ViewMut::dense(&mut d.key_values, 2 * a).columns(columns.clone());
            let query = attention.query.weight(params).rows(columns.clone());
            matmul::x_wt(d_scores, query, d_keys.reborrow(), Accum::Replace);
            linear::add_outer_product(d_keys, d_bias, &attention.query.bias(params)[columns.clone()]);
            let d_values =
                ViewMut::dense(&mut d.key_values, 2 * a).columns(a + columns.start..a + columns.end);
            let weight = self.head_hidden.weight(params).columns(context);
            matmul::dy_w(d_contexts, weight, d_values, Accum::Replace);
        }
        let values = View::dense(&tables.key_values, 2 * a).columns(a..2 * a);
        activation::relu_backward(values, ViewMut::dense(&mut d.key_values, 2 * a).columns(a..2 * a));
        d.tokens = vec![0.0; k * h];
        let d_tokens = ViewMut::dense(&mut d.tokens, h);
        let tokens = View::dense(&tables.tokens, h);
        attention.key_value.backward(
            params,
            tokens,
            View::dense(&d.key_values, 2 * a),
            Some(d_tokens),
            grads,
        );
        activation::relu_backward(tokens, ViewMut::dense(&mut d.tokens, h));
        let embed = &mut grads[self.action_embed.clone()];
        for token in 0..k {
            for i in 0..h {
                embed[i * k + token] += d.tokens[token * h + i];
            }
        }
    }
}

vectorized! {
    /// Appends scale · row · vector for every row.
    fn push_products<'a>(to: &'a mut Vec<f32>, scale: f32, rows: View<'a>, vector: &'a [f32]) {
        to.extend((0..rows.rows).map(|row| scale * math::dot(rows.row(row), vector)));
    }
}

/// The keys and the values of one head's columns, (K, head dim) each.
fn keys_and_values(key_values: &[f32], a: usize, columns: Range<usize>) -> (View<'_>, View<'_>) {
    let both = View::dense(key_values, 2 * a);
    (both.columns(columns.clone()), both.columns(a + columns.start..a + columns.end))
}
