//! The task representation function f^ω: z^k from each agent's observations, actions and the rewards of the
//! steps before (paper, section IV-B and figure 1 b).

use crate::{
    Rows,
    encoder::{Encoder, EncoderState},
    rit::{RitConfig, TaskRepresentations},
};
use rit_nn::{
    Accum, Buffer, Gru, LayoutBuilder, Linear, Scratch, View, ViewMut, activation,
    attention::{Group, Visible},
    gru::GruState,
    math, matmul, vectorized,
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
    pub(crate) encoder: EncoderState,
    /// ReLU'd reward embeddings, `[groups, r]`: the reward is the team's, so it is embedded once per group.
    rewards: Buffer,
    pub(crate) gru: GruState,
    /// z, `[R, h_z]`.
    pub representation: Buffer,
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
        scratch: &mut Scratch,
    ) {
        let (h, r) = (self.gru.hidden_dim, self.reward_embed.outputs);
        let (encoded_columns, reward_columns) = self.columns();
        let weight = self.gru.input.weight(params);
        self.encoder.forward(params, rows, Visible::Where(&rows.others), &mut state.encoder);

        let groups = rows.groups.len();
        let rewards = ViewMut::dense(state.rewards.fit(groups * r), r);
        self.reward_embed.forward_relu(params, View::dense(&rows.previous_rewards, 1), rewards);
        let mut reward_gates = scratch.take(groups * 3 * h);
        let rewards = View::dense(&state.rewards, r);
        let to = ViewMut::dense(&mut reward_gates, 3 * h);
        matmul::x_wt(rewards, weight.columns(reward_columns), to, Accum::Replace);

        let gates = state.gru.gates.fit(rows.agent_rows() * 3 * h);
        let encoded = View::dense(&state.encoder.encoded, self.encoder.width());
        let to = ViewMut::dense(gates, 3 * h);
        matmul::x_wt(encoded, weight.columns(encoded_columns), to, Accum::Replace);
        add_to_members(&rows.groups, View::dense(&reward_gates, 3 * h), gates);
        scratch.give(reward_gates);
        self.gru.forward(params, &rows.agent_times, before, &mut state.gru, scratch);

        let z = self.out.outputs;
        let representation = ViewMut::dense(state.representation.fit(rows.agent_rows() * z), z);
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
        scratch: &mut Scratch,
    ) {
        let (h, r, width) = (self.gru.hidden_dim, self.reward_embed.outputs, self.encoder.width());
        let (encoded_columns, reward_columns) = self.columns();
        let weight = self.gru.input.weight(params);
        let mut d_history = scratch.take(rows.agent_rows() * h);
        let history = View::dense(&state.gru.history, h);
        let to = Some(ViewMut::dense(&mut d_history, h));
        self.out.backward(params, history, d_representation, to, grads);
        let GruState { gates, new_from_hidden, history } = &mut state.gru;
        let left = (&mut gates[..], &new_from_hidden[..]);
        self.gru.backward(params, &rows.agent_times, left, history, &mut d_history, grads, scratch);
        scratch.give(d_history);
        let d_gates = View::dense(&state.gru.gates, 3 * h);

        // Each group's agents share one reward: their gradients meet before the products.
        let mut d_reward_gates = scratch.take_zeros(rows.groups.len() * 3 * h);
        sum_over_members(&rows.groups, d_gates, &mut d_reward_gates);
        let from = View::dense(&d_reward_gates, 3 * h);
        let rewards = View::dense(&state.rewards, r);
        let reward_weight = self.gru.input.weight_mut(grads).columns(reward_columns.clone());
        matmul::dyt_x(from, rewards, reward_weight, Accum::Add);
        let mut d_rewards = scratch.take(rows.groups.len() * r);
        let to = ViewMut::dense(&mut d_rewards, r);
        matmul::dy_w(from, weight.columns(reward_columns), to, Accum::Replace);
        activation::relu_backward(rewards, ViewMut::dense(&mut d_rewards, r));
        let previous_rewards = View::dense(&rows.previous_rewards, 1);
        self.reward_embed.backward_params(previous_rewards, View::dense(&d_rewards, r), grads);
        scratch.give(d_reward_gates);
        scratch.give(d_rewards);

        let encoded = View::dense(&state.encoder.encoded, width);
        let encoded_weight = self.gru.input.weight_mut(grads).columns(encoded_columns.clone());
        matmul::dyt_x(d_gates, encoded, encoded_weight, Accum::Add);
        let mut d_encoded = scratch.take(rows.agent_rows() * width);
        let to = ViewMut::dense(&mut d_encoded, width);
        matmul::dy_w(d_gates, weight.columns(encoded_columns), to, Accum::Replace);
        let d_encoded_view = View::dense(&d_encoded, width);
        let (d_agents, d_attended) = self.encoder.split(d_encoded_view);
        self.encoder.backward(params, rows, &mut state.encoder, d_attended, Some(d_agents), grads, scratch);
        scratch.give(d_encoded);
    }
}

vectorized! {
    /// rows += their group's row.
    fn add_to_members<'a>(groups: &'a [Group], of_group: View<'a>, rows: &'a mut [f32]) {
        let width = of_group.cols;
        for (at, group) in groups.iter().enumerate() {
            for row in group.queries.clone() {
                math::add_scaled(&mut rows[row * width..][..width], 1.0, of_group.row(at));
            }
        }
    }
}

vectorized! {
    /// sums += each group's rows: the backward of [`add_to_members`].
    fn sum_over_members<'a>(groups: &'a [Group], rows: View<'a>, sums: &'a mut [f32]) {
        for (group, sum) in groups.iter().zip(sums.chunks_exact_mut(rows.cols)) {
            for row in group.queries.clone() {
                math::add_scaled(sum, 1.0, rows.row(row));
            }
        }
    }
}

impl TaskEncoderState {
    /// The GRU's state after each row, `[R, h]`.
    pub fn history(&self) -> &[f32] {
        &self.gru.history
    }
}
