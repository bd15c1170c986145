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

mod tables;

pub use tables::Tables;

use crate::{Rows, estimators::greedy::greedy_action};
use rit_nn::{
    Accum, Attention, Buffer, LayoutBuilder, Linear, Tape, Var, View, ViewMut, activation, linear, math,
    matmul, tape::Backward, vectorized,
};
use std::{mem, ops::Range};

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

/// The decoder's part that needs no actions, and where decisions go. With R agent rows:
pub struct DecoderPass<'a> {
    tables: &'a Tables,
    /// τ, (R, h).
    history: Var,
    /// z, (R, h_z).
    representation: Option<Var>,
    /// The head's hidden layer before the context is added, `[R, h]`.
    base: Buffer,
    /// Scores of every token, `[R, H K]`.
    scores: Buffer,
    /// Softmax weights, `[R, H K]`.
    weights: Buffer,
    /// The head's hidden layer, `[R, h]`.
    hidden: Buffer,
    /// Q, `[R, A]`.
    utilities: Buffer,
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

    /// All that does not depend on predecessors, for all rows at once: the head's hidden layer without the context and
    /// the bias, and every token's score without its bias. `history` (R, h), `representation` (R, h_z).
    pub fn prepare<'a>(
        &self,
        tape: &mut Tape<'a>,
        tables: &'a Tables,
        history: Var,
        representation: Option<Var>,
    ) -> DecoderPass<'a> {
        let (h, width, rows) = (self.hidden_dim, tables.score_bias.len(), history.rows);
        let (tau, _, z) = self.head_columns(0);
        let weight = self.head_hidden.weight(tape.params);
        let mut base = tape.take(rows * h);
        matmul::x_wt(tape.view(history), weight.columns(tau), ViewMut::dense(&mut base, h), Accum::Replace);
        if let Some(representation) = representation {
            let to = ViewMut::dense(&mut base, h);
            matmul::x_wt(tape.view(representation), weight.columns(z), to, Accum::Add);
        }
        let mut scores = tape.take(rows * width);
        let to = ViewMut::dense(&mut scores, width);
        matmul::x_wt(tape.view(history), View::dense(&tables.scores, h), to, Accum::Replace);
        let (weights, hidden) = (tape.take(rows * width), tape.take(rows * h));
        let utilities = tape.take(rows * self.n_actions);
        DecoderPass { tables, history, representation, base, scores, weights, hidden, utilities }
    }

    /// One agent's decision: Q (A) from what its predecessors did. `row` has been prepared.
    #[inline(always)]
    pub fn decide<'s>(
        &self,
        params: &[f32],
        row: usize,
        seen: &Seen,
        pass: &'s mut DecoderPass<'_>,
    ) -> &'s [f32] {
        let tables = pass.tables;
        let (h, k, width) = (self.hidden_dim, self.tokens(), tables.score_bias.len());
        let head = self.head.weight(params);
        let scores = pass.scores[row * width..][..width].chunks_exact(k);
        let weights = pass.weights[row * width..][..width].chunks_exact_mut(k);
        let hidden = &mut pass.hidden[row * h..][..h];
        let utilities = &mut pass.utilities[row * self.n_actions..][..self.n_actions];
        let base = &pass.base[row * h..][..h];
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

    /// The greedy joint action of every group, row after row, each given the greedy actions before it; unavailable
    /// actions are excluded and ties go to the lowest index. Returns the actions (R).
    pub fn greedy(&self, params: &[f32], rows: &Rows, pass: &mut DecoderPass<'_>) -> Vec<u8> {
        let mut actions = vec![0; rows.agent_rows()];
        decide_greedily(self, params, rows, pass, &mut actions);
        actions
    }

    /// Q (R, A) of every prepared row given the actions taken, the masked parallel pass: row k sees tokens 0..k.
    pub fn utilities<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &Rows,
        mut pass: DecoderPass<'a>,
        actions: &[u8],
    ) -> Var {
        decide_all(self, tape.params, rows, actions, &mut pass);
        let utilities = tape.push(mem::take(&mut pass.utilities), self.n_actions);
        if tape.is_recording() {
            let decoder = self.clone();
            tape.record(move |back| decoder.backward(back, pass, utilities));
        } else {
            pass.free(tape);
        }
        utilities
    }

    fn backward(&self, back: &mut Backward<'_>, pass: DecoderPass<'_>, utilities: Var) {
        let DecoderPass { tables, history, representation, .. } = pass;
        let (h, k, width, rows) = (self.hidden_dim, self.tokens(), tables.score_bias.len(), history.rows);
        let Some(d_utilities) = back.gradients.take(utilities) else { return };
        let hidden = View::dense(&pass.hidden, h);
        let mut d_hidden = back.gradients.work.take(rows * h);
        let to = ViewMut::dense(&mut d_hidden, h);
        self.head.backward(back.params, hidden, d_utilities.view(), Some(to), back.grads);
        back.gradients.done(d_utilities);
        activation::relu_backward(hidden, ViewMut::dense(&mut d_hidden, h));
        let d_hidden_view = View::dense(&d_hidden, h);

        let of_history = back.values.view(history);
        let mut d = tables.gradient();
        let weights = View::dense(&pass.weights, width);
        matmul::dyt_x(weights, d_hidden_view, ViewMut::dense(&mut d.contexts, h), Accum::Add);
        let mut d_scores = back.gradients.work.take(rows * width);
        let to = ViewMut::dense(&mut d_scores, width);
        matmul::x_wt(d_hidden_view, View::dense(&tables.contexts, h), to, Accum::Replace);
        softmax_backward(&pass.weights, &mut d_scores, k);
        let d_scores_view = View::dense(&d_scores, width);
        matmul::dyt_x(d_scores_view, of_history, ViewMut::dense(&mut d.scores, h), Accum::Add);
        linear::add_column_sums(d_scores_view, &mut d.score_bias);

        let (tau, _, z) = self.head_columns(0);
        let weight = self.head_hidden.weight(back.params);
        if let Some(mut d_history) = back.gradients.begin(history) {
            let accum = d_history.accum;
            matmul::dy_w(d_scores_view, View::dense(&tables.scores, h), d_history.view_mut(), accum);
            matmul::dy_w(d_hidden_view, weight.columns(tau.clone()), d_history.view_mut(), Accum::Add);
            back.gradients.end(d_history);
        }
        let of_weight = self.head_hidden.weight_mut(back.grads).columns(tau);
        matmul::dyt_x(d_hidden_view, of_history, of_weight, Accum::Add);
        if let Some(representation) = representation {
            if let Some(mut d_z) = back.gradients.begin(representation) {
                let accum = d_z.accum;
                matmul::dy_w(d_hidden_view, weight.columns(z.clone()), d_z.view_mut(), accum);
                back.gradients.end(d_z);
            }
            let of_weight = self.head_hidden.weight_mut(back.grads).columns(z);
            matmul::dyt_x(d_hidden_view, back.values.view(representation), of_weight, Accum::Add);
        }
        linear::add_column_sums(d_hidden_view, self.head_hidden.bias_mut(back.grads));
        self.tables_backward(back.params, tables, &mut d, back.grads);
        back.gradients.work.give(d_hidden);
        back.gradients.work.give(d_scores);
        for buffer in [pass.base, pass.scores, pass.weights, pass.hidden] {
            back.stock.give(buffer);
        }
    }
}

impl DecoderPass<'_> {
    /// Q as decided last, `[R, A]`.
    pub fn decided(&self) -> &[f32] {
        &self.utilities
    }

    /// Gives its memory back.
    pub fn free(self, tape: &mut Tape<'_>) {
        for buffer in [self.base, self.scores, self.weights, self.hidden, self.utilities] {
            tape.give(buffer);
        }
    }
}

vectorized! {
    fn decide_all<'a, 'b>(
        decoder: &'a Decoder,
        params: &'a [f32],
        rows: &'a Rows,
        actions: &'a [u8],
        pass: &'a mut DecoderPass<'b>,
    ) {
        let mut seen = Seen::start(decoder.n_actions);
        for group in &rows.groups {
            seen.restart();
            for row in group.queries.clone() {
                decoder.decide(params, row, &seen, pass);
                seen.push(actions[row]);
            }
        }
    }
}

vectorized! {
    fn decide_greedily<'a, 'b>(
        decoder: &'a Decoder,
        params: &'a [f32],
        rows: &'a Rows,
        pass: &'a mut DecoderPass<'b>,
        actions: &'a mut [u8],
    ) {
        let mut seen = Seen::start(decoder.n_actions);
        for group in &rows.groups {
            seen.restart();
            for row in group.queries.clone() {
                let available = &rows.available[row * decoder.n_actions..][..decoder.n_actions];
                actions[row] = greedy_action(decoder.decide(params, row, &seen, pass), available);
                seen.push(actions[row]);
            }
        }
    }
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

#[cfg(test)]
mod tests;
