//! The task representation function f^ω: z^k from each agent's observations, actions and the rewards of the
//! steps before (paper, section IV-B and figure 1 b).

use crate::{
    Rows,
    encoder::{Encoder, EncoderState},
    rit::{RitConfig, TaskRepresentations},
};
use faer::Accum;
use rit_nn::{
    Gru, LayoutBuilder, Linear, View, ViewMut, activation, attention::Visible, fit, gru::GruState, linear,
    math, matmul,
};
use std::ops::Range;

/// The task representation function.
#[derive(Clone, Debug)]
pub struct TaskEncoder {
    encoder: Encoder,
    /// 1 → r.
    reward_embed: Linear,
    /// Over [x_k ‖ attention ‖ reward].
    gru: Gru,
    /// h → h_z.
    out: Linear,
}

/// What forward leaves for backward.
#[derive(Debug, Default)]
pub struct TaskEncoderState {
    encoder: EncoderState,
    /// ReLU'd reward embeddings, `[groups, r]`: the reward is the team's, so it is embedded once per group.
    rewards: Vec<f32>,
    /// The rewards' share of the gates, `[groups, 3h]`; backward leaves its gradient here.
    reward_gates: Vec<f32>,
    gru: GruState,
    /// z, `[R, h_z]`.
    pub representation: Vec<f32>,
    d_rewards: Vec<f32>,
    d_history: Vec<f32>,
    d_encoded: Vec<f32>,
}

impl TaskEncoder {
    /// Declares all parameters named `task_encoder.…`.
    pub fn new(layout: &mut LayoutBuilder, config: &RitConfig, representations: TaskRepresentations) -> Self {
        let TaskRepresentations { dim, reward_embed_dim: r } = representations;
        let (h, a) = (config.hidden_dim, config.attention_dim);
        let encoder = Encoder::new(layout, "task_encoder", config.entity_dim, h, a, config.n_heads);
        let reward_embed = Linear::new(layout, "task_encoder.reward_embed", 1, r);
        let gru = Gru::new(layout, "task_encoder.gru", h + a + r, h);
        let out = Linear::new(layout, "task_encoder.out", h, dim);
        Self { encoder, reward_embed, gru, out }
    }

    /// Columns of the GRU's input: ([x_k ‖ attention], reward).
    fn columns(&self) -> (Range<usize>, Range<usize>) {
        let width = self.encoder.width();
        (0..width, width..width + self.reward_embed.outputs)
    }

    /// z of all rows. `before` (rows of the first time, h) is the GRU's state before the first time, or zeros.
    pub fn forward(
        &self,
        params: &[f32],
        rows: &Rows,
        before: Option<View<'_>>,
        state: &mut TaskEncoderState,
    ) {
        let (h, r) = (self.gru.hidden_dim, self.reward_embed.outputs);
        let (encoded_columns, reward_columns) = self.columns();
        let weight = self.gru.input.weight(params);
        self.encoder.forward(params, rows, Visible::Where(&rows.others), &mut state.encoder);

        let groups = rows.groups.len();
        let rewards = ViewMut::dense(fit(&mut state.rewards, groups * r), r);
        self.reward_embed.forward_relu(params, View::dense(&rows.previous_rewards, 1), rewards);
        let mut reward_gates = ViewMut::dense(fit(&mut state.reward_gates, groups * 3 * h), 3 * h);
        linear::fill_rows(reward_gates.reborrow(), self.gru.input.bias(params));
        let rewards = View::dense(&state.rewards, r);
        matmul::x_wt(rewards, weight.columns(reward_columns), reward_gates, Accum::Add);

        let gates = fit(&mut state.gru.gates, rows.agent_rows() * 3 * h);
        for (group, reward_gates) in rows.groups.iter().zip(state.reward_gates.chunks_exact(3 * h)) {
            for row in group.queries.clone() {
                gates[row * 3 * h..][..3 * h].copy_from_slice(reward_gates);
            }
        }
        let encoded = View::dense(&state.encoder.encoded, self.encoder.width());
        matmul::x_wt(encoded, weight.columns(encoded_columns), ViewMut::dense(gates, 3 * h), Accum::Add);
        self.gru.forward(params, &rows.agent_times, before, &mut state.gru);

        let z = self.out.outputs;
        let representation = ViewMut::dense(fit(&mut state.representation, rows.agent_rows() * z), z);
        self.out.forward(params, View::dense(&state.gru.history, h), representation);
    }

    /// Takes `d_representation` (R, h_z) and adds to the parameters' gradients.
    pub fn backward(
        &self,
        params: &[f32],
        rows: &Rows,
        state: &mut TaskEncoderState,
        d_representation: View<'_>,
        grads: &mut [f32],
    ) {
        let (h, r, width) = (self.gru.hidden_dim, self.reward_embed.outputs, self.encoder.width());
        let (encoded_columns, reward_columns) = self.columns();
        let weight = self.gru.input.weight(params);
        let d_history = fit(&mut state.d_history, rows.agent_rows() * h);
        let history = View::dense(&state.gru.history, h);
        self.out.backward(params, history, d_representation, Some(ViewMut::dense(d_history, h)), grads);
        self.gru.backward(params, &rows.agent_times, &mut state.gru, d_history, grads);
        let d_gates = View::dense(&state.gru.gates, 3 * h);

        // Each group's agents share one reward: their gradients meet before the products.
        let d_reward_gates = fit(&mut state.reward_gates, rows.groups.len() * 3 * h);
        d_reward_gates.fill(0.0);
        math::vectorized(|| {
            for (group, sum) in rows.groups.iter().zip(d_reward_gates.chunks_exact_mut(3 * h)) {
                for row in group.queries.clone() {
                    math::add_scaled(sum, 1.0, d_gates.row(row));
                }
            }
        });
        let d_reward_gates = View::dense(d_reward_gates, 3 * h);
        let rewards = View::dense(&state.rewards, r);
        let reward_weight = self.gru.input.weight_mut(grads).columns(reward_columns.clone());
        matmul::dyt_x(d_reward_gates, rewards, reward_weight);
        let mut d_rewards = ViewMut::dense(fit(&mut state.d_rewards, rows.groups.len() * r), r);
        matmul::dy_w(d_reward_gates, weight.columns(reward_columns), d_rewards.reborrow(), Accum::Replace);
        activation::relu_backward(rewards, d_rewards.reborrow());
        let previous_rewards = View::dense(&rows.previous_rewards, 1);
        self.reward_embed.backward_params(previous_rewards, d_rewards.as_view(), grads);

        let encoded = View::dense(&state.encoder.encoded, width);
        let encoded_weight = self.gru.input.weight_mut(grads).columns(encoded_columns.clone());
        matmul::dyt_x(d_gates, encoded, encoded_weight);
        let d_encoded = ViewMut::dense(fit(&mut state.d_encoded, rows.agent_rows() * width), width);
        matmul::dy_w(d_gates, weight.columns(encoded_columns), d_encoded, Accum::Replace);
        let d_encoded = View::dense(&state.d_encoded, width);
        self.encoder.backward(params, rows, &mut state.encoder, d_encoded, grads);
    }
}

impl TaskEncoderState {
    /// The GRU's state after each row, `[R, h]`.
    pub fn history(&self) -> &[f32] {
        &self.gru.history
    }
}
