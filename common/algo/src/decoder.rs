//! The decoder of the utility function (paper, figure 1 a2 and appendix F): each agent attends over the
//! actions of those that decided before it, then values its own.
//!
//! Tokens are a start token and the A actions, nothing else, so their keys and values are a table of A + 1
//! rows, and so is everything that follows linearly from them. With τ the history, q = W_q τ + b_q:
//!
//! - score(τ, token) = q · key(token) / √dim = τ · `scores`(token) + `score_bias`(token)
//! - the context μ enters the head linearly: W_μ μ = Σ weight(token) `contexts`(token), with
//!   `contexts`(token) = W_μ value(token)
//!
//! and tokens seen more than once count as often as they are seen. This is exact, and it makes a decision so
//! cheap that acting, the greedy pass and training share one row of code, [`Decoder::decide`].

use crate::Rows;
use rit_nn::{
    Accum, Attention, Buffer, LayoutBuilder, Linear, Scratch, View, ViewMut, activation, linear, math,
    matmul, vectorized,
};
use std::ops::Range;

/// Action embedding, action attention and head.
#[derive(Clone, Debug)]
pub struct Decoder {
    /// (h, A + 1): a column per token, column 0 the start token's.
    action_embed: Range<usize>,
    action_attention: Attention,
    /// [τ ‖ μ ‖ z], h + a + h_z → h.
    head_hidden: Linear,
    /// h → A.
    head: Linear,
    /// A.
    n_actions: usize,
    /// h.
    hidden_dim: usize,
    /// h_z; 0 without task representations.
    representation_dim: usize,
}

/// What the decoder knows of its tokens, for one set of weights. K = A + 1 tokens, H heads.
#[derive(Clone, Debug, Default)]
pub struct Tables {
    /// ReLU'd embeddings, `[K, h]`.
    tokens: Vec<f32>,
    /// Keys and ReLU'd values, `[K, 2a]`.
    key_values: Vec<f32>,
    /// `[H, K, h]`, scaled.
    scores: Vec<f32>,
    /// `[H, K]`, scaled.
    score_bias: Vec<f32>,
    /// `[H, K, h]`.
    contexts: Vec<f32>,
}

/// What forward leaves for backward. With R agent rows:
#[derive(Debug, Default)]
pub struct DecoderState {
    /// The head's hidden layer before the context is added, `[R, h]`.
    base: Buffer,
    /// Scores of every token, `[R, H K]`.
    scores: Buffer,
    /// Softmax weights, `[R, H K]`.
    weights: Buffer,
    /// The head's hidden layer, `[R, h]`.
    hidden: Buffer,
    /// Q, `[R, A]`.
    pub utilities: Buffer,
}

/// How often each token stands before an agent: the start token and its predecessors' actions.
#[derive(Debug)]
pub struct Seen {
    counts: Vec<f32>,
}

impl Seen {
    /// What the first to decide sees: the start token.
    pub fn start(n_actions: usize) -> Self {
        let mut counts = vec![0.0; n_actions + 1];
        counts[0] = 1.0;
        Self { counts }
    }

    /// Begins another group.
    pub fn restart(&mut self) {
        self.counts.fill(0.0);
        self.counts[0] = 1.0;
    }

    /// The next to decide sees this action too.
    pub fn push(&mut self, action: u8) {
        self.counts[1 + usize::from(action)] += 1.0;
    }
}

impl Decoder {
    /// Declares `{name}.action_embed`, `.action_attention`, `.head_hidden` and `.head`.
    #[allow(clippy::too_many_arguments, reason = "sizes, each named")]
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        n_actions: usize,
        hidden_dim: usize,
        attention_dim: usize,
        heads: usize,
        representation_dim: usize,
    ) -> Self {
        let tokens = n_actions + 1;
        let bound = 1.0 / (tokens as f32).sqrt();
        let action_embed = layout.add(format!("{name}.action_embed.weight"), &[hidden_dim, tokens], bound);
        let action_attention =
            Attention::new(layout, &format!("{name}.action_attention"), hidden_dim, attention_dim, heads);
        let inputs = hidden_dim + attention_dim + representation_dim;
        let head_hidden = Linear::new(layout, &format!("{name}.head_hidden"), inputs, hidden_dim);
        let head = Linear::new(layout, &format!("{name}.head"), hidden_dim, n_actions);
        Self { action_embed, action_attention, head_hidden, head, n_actions, hidden_dim, representation_dim }
    }

    /// A.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    fn tokens(&self) -> usize {
        self.n_actions + 1
    }

    /// Columns of the head's input: (τ, one head's μ, z).
    fn head_columns(&self, head: usize) -> (Range<usize>, Range<usize>, Range<usize>) {
        let (h, a) = (self.hidden_dim, self.action_attention.dim);
        let head_dim = a / self.action_attention.heads;
        let context = h + head * head_dim..h + (head + 1) * head_dim;
        (0..h, context, h + a..h + a + self.representation_dim)
    }

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
    fn tables_backward(&self, params: &[f32], tables: &Tables, d: &mut Tables, grads: &mut [f32]) {
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
            add_weighted_rows(&mut attention.query.bias_mut(grads)[columns.clone()], d_bias, keys);
            let weight = self.head_hidden.weight_mut(grads).columns(context.clone());
            matmul::dyt_x(d_contexts, values, weight, Accum::Add);

            let mut d_keys = ViewMut::dense(&mut d.key_values, 2 * a).columns(columns.clone());
            let query = attention.query.weight(params).rows(columns.clone());
            matmul::x_wt(d_scores, query, d_keys.reborrow(), Accum::Replace);
            add_outer_product(d_keys, d_bias, &attention.query.bias(params)[columns.clone()]);
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

    /// All that does not depend on predecessors, for all rows at once: the head's hidden layer without the
    /// context and the bias, and every token's score without its bias. `history` (R, h), `representation`
    /// (R, h_z).
    pub fn prepare(
        &self,
        params: &[f32],
        tables: &Tables,
        history: View<'_>,
        representation: View<'_>,
        state: &mut DecoderState,
    ) {
        let (h, width) = (self.hidden_dim, tables.score_bias.len());
        let (tau, _, z) = self.head_columns(0);
        let weight = self.head_hidden.weight(params);
        let mut base = ViewMut::dense(state.base.fit(history.rows * h), h);
        matmul::x_wt(history, weight.columns(tau), base.reborrow(), Accum::Replace);
        if self.representation_dim > 0 {
            matmul::x_wt(representation, weight.columns(z), base, Accum::Add);
        }
        let scores = ViewMut::dense(state.scores.fit(history.rows * width), width);
        matmul::x_wt(history, View::dense(&tables.scores, h), scores, Accum::Replace);
        state.weights.fit(history.rows * width);
        state.hidden.fit(history.rows * h);
        state.utilities.fit(history.rows * self.n_actions);
    }

    /// One agent's decision: Q (A) from what its predecessors did. `row` has been prepared.
    #[inline(always)]
    pub fn decide<'s>(
        &self,
        params: &[f32],
        tables: &Tables,
        row: usize,
        seen: &Seen,
        state: &'s mut DecoderState,
    ) -> &'s [f32] {
        let (h, k, width) = (self.hidden_dim, self.tokens(), tables.score_bias.len());
        let head = self.head.weight(params);
        let scores = state.scores[row * width..][..width].chunks_exact(k);
        let weights = state.weights[row * width..][..width].chunks_exact_mut(k);
        let hidden = &mut state.hidden[row * h..][..h];
        let utilities = &mut state.utilities[row * self.n_actions..][..self.n_actions];
        let base = &state.base[row * h..][..h];
        for (hidden, (base, bias)) in hidden.iter_mut().zip(base.iter().zip(self.head_hidden.bias(params))) {
            *hidden = base + bias;
        }
        let of_head = tables.score_bias.chunks_exact(k).zip(tables.contexts.chunks_exact(k * h));
        for ((scores, weights), (bias, contexts)) in scores.zip(weights).zip(of_head) {
            counted_softmax(scores, bias, &seen.counts, weights);
            for (&weight, context) in weights.iter().zip(contexts.chunks_exact(h)) {
                if weight != 0.0 {
                    math::add_scaled(hidden, weight, context);
                }
            }
        }
        hidden.iter_mut().for_each(|x| *x = x.max(0.0));
        for (action, (utility, bias)) in utilities.iter_mut().zip(self.head.bias(params)).enumerate() {
            *utility = bias + math::dot(hidden, head.row(action));
        }
        utilities
    }

    /// Q of every prepared row given the actions taken, the masked parallel pass: row k sees tokens 0..k.
    pub fn forward(
        &self,
        params: &[f32],
        tables: &Tables,
        rows: &Rows,
        actions: &[u8],
        state: &mut DecoderState,
    ) {
        decide_all(self, params, tables, rows, actions, state);
    }

    /// The greedy joint action of every group, row after row, each given the greedy actions before it;
    /// unavailable actions are excluded and ties go to the lowest index. `actions` (R).
    pub fn greedy(
        &self,
        params: &[f32],
        tables: &Tables,
        rows: &Rows,
        state: &mut DecoderState,
        actions: &mut [u8],
    ) {
        decide_greedily(self, params, tables, rows, state, actions);
    }

    /// Takes `d_utilities` (R, A). Writes `d_history` (R, h), adds to `d_representation` (R, h_z) and to the
    /// parameters' gradients.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        tables: &Tables,
        history: View<'_>,
        representation: View<'_>,
        state: &DecoderState,
        d_utilities: View<'_>,
        mut d_history: ViewMut<'_>,
        d_representation: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (h, k, width) = (self.hidden_dim, self.tokens(), tables.score_bias.len());
        let rows = history.rows;
        let hidden = View::dense(&state.hidden, h);
        let mut d_hidden = scratch.take(rows * h);
        let to = ViewMut::dense(&mut d_hidden, h);
        self.head.backward(params, hidden, d_utilities, Some(to), grads);
        activation::relu_backward(hidden, ViewMut::dense(&mut d_hidden, h));
        let d_hidden_view = View::dense(&d_hidden, h);

        let mut d = Tables {
            contexts: vec![0.0; width * h],
            scores: vec![0.0; width * h],
            score_bias: vec![0.0; width],
            ..Tables::default()
        };
        let weights = View::dense(&state.weights, width);
        matmul::dyt_x(weights, d_hidden_view, ViewMut::dense(&mut d.contexts, h), Accum::Add);
        let mut d_scores = scratch.take(rows * width);
        let to = ViewMut::dense(&mut d_scores, width);
        matmul::x_wt(d_hidden_view, View::dense(&tables.contexts, h), to, Accum::Replace);
        softmax_backward(&state.weights, &mut d_scores, k);
        let d_scores_view = View::dense(&d_scores, width);
        matmul::dyt_x(d_scores_view, history, ViewMut::dense(&mut d.scores, h), Accum::Add);
        linear::add_column_sums(d_scores_view, &mut d.score_bias);
        matmul::dy_w(d_scores_view, View::dense(&tables.scores, h), d_history.reborrow(), Accum::Replace);

        let (tau, _, z) = self.head_columns(0);
        let weight = self.head_hidden.weight(params);
        matmul::dy_w(d_hidden_view, weight.columns(tau.clone()), d_history, Accum::Add);
        matmul::dyt_x(d_hidden_view, history, self.head_hidden.weight_mut(grads).columns(tau), Accum::Add);
        if self.representation_dim > 0 {
            matmul::dy_w(d_hidden_view, weight.columns(z.clone()), d_representation, Accum::Add);
            matmul::dyt_x(
                d_hidden_view,
                representation,
                self.head_hidden.weight_mut(grads).columns(z),
                Accum::Add,
            );
        }
        linear::add_column_sums(d_hidden_view, self.head_hidden.bias_mut(grads));
        self.tables_backward(params, tables, &mut d, grads);
        scratch.give(d_hidden);
        scratch.give(d_scores);
    }
}

vectorized! {
    fn decide_all<'a>(
        decoder: &'a Decoder,
        params: &'a [f32],
        tables: &'a Tables,
        rows: &'a Rows,
        actions: &'a [u8],
        state: &'a mut DecoderState,
    ) {
        let mut seen = Seen::start(decoder.n_actions);
        for group in &rows.groups {
            seen.restart();
            for row in group.queries.clone() {
                decoder.decide(params, tables, row, &seen, state);
                seen.push(actions[row]);
            }
        }
    }
}

vectorized! {
    fn decide_greedily<'a>(
        decoder: &'a Decoder,
        params: &'a [f32],
        tables: &'a Tables,
        rows: &'a Rows,
        state: &'a mut DecoderState,
        actions: &'a mut [u8],
    ) {
        let mut seen = Seen::start(decoder.n_actions);
        for group in &rows.groups {
            seen.restart();
            for row in group.queries.clone() {
                let available = &rows.available[row * decoder.n_actions..][..decoder.n_actions];
                actions[row] = best(decoder.decide(params, tables, row, &seen, state), available);
                seen.push(actions[row]);
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

vectorized! {
    /// sum += Σ weight · row.
    fn add_weighted_rows<'a>(sum: &'a mut [f32], weights: &'a [f32], rows: View<'a>) {
        for (row, &weight) in weights.iter().enumerate() {
            math::add_scaled(sum, weight, rows.row(row));
        }
    }
}

vectorized! {
    /// row += weight · vector, for every row.
    fn add_outer_product<'a>(rows: ViewMut<'a>, weights: &'a [f32], vector: &'a [f32]) {
        for (row, &weight) in weights.iter().enumerate() {
            math::add_scaled(rows.row(row), weight, vector);
        }
    }
}

/// The keys and the values of one head's columns, (K, head dim) each.
fn keys_and_values(key_values: &[f32], a: usize, columns: Range<usize>) -> (View<'_>, View<'_>) {
    let both = View::dense(key_values, 2 * a);
    (both.columns(columns.clone()), both.columns(a + columns.start..a + columns.end))
}

/// The available action of the largest utility, the lowest index among equals; 0 where none is available.
pub fn best(utilities: &[f32], available: &[u8]) -> u8 {
    let mut best: Option<(usize, f32)> = None;
    for (action, (&utility, &available)) in utilities.iter().zip(available).enumerate() {
        if available != 0 && best.is_none_or(|(_, most)| utility > most) {
            best = Some((action, utility));
        }
    }
    best.map_or(0, |(action, _)| action as u8)
}

/// Softmax over tokens that stand `counts` times each: weight = count · e^(score + bias) / Σ.
#[inline(always)]
fn counted_softmax(scores: &[f32], bias: &[f32], counts: &[f32], weights: &mut [f32]) {
    let mut largest = f32::NEG_INFINITY;
    for ((weight, (&score, &bias)), &count) in weights.iter_mut().zip(scores.iter().zip(bias)).zip(counts) {
        *weight = score + bias;
        if count > 0.0 {
            largest = largest.max(*weight);
        }
    }
    let mut total = 0.0;
    for (weight, &count) in weights.iter_mut().zip(counts) {
        *weight = if count > 0.0 { count * math::exp_share(*weight - largest) } else { 0.0 };
        total += *weight;
    }
    // The start token is always seen, so the total is not zero.
    weights.iter_mut().for_each(|weight| *weight /= total);
}

vectorized! {
    /// d_score = w (d_w − Σ w d_w) in place, for every k weights that are one softmax.
    fn softmax_backward<'a>(weights: &'a [f32], d_weights: &'a mut [f32], k: usize) {
        for (d_weights, weights) in d_weights.chunks_exact_mut(k).zip(weights.chunks_exact(k)) {
            let mean: f32 = weights.iter().zip(&*d_weights).map(|(w, d)| w * d).sum();
            for (d, w) in d_weights.iter_mut().zip(weights) {
                *d = w * (*d - mean);
            }
        }
    }
}
