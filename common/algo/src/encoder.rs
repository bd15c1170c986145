//! The encoder that utility, task encoder and mixer share in form, not in parameters (paper, appendix E):
//! every entity is embedded, then each agent attends over entities.

use crate::Rows;
use rit_nn::{
    Attention, Buffer, LayoutBuilder, Linear, Scratch, View, ViewMut, activation,
    attention::{AttentionState, Group, Visible},
    math, vectorized,
};

/// x = ReLU(`embed`(entities)), d → h, and [x_k ‖ `attention`(x_k over the entities it sees)], h + a.
#[derive(Clone, Debug)]
pub struct Encoder {
    embed: Linear,
    attention: Attention,
}

/// What forward leaves for backward. With R agent rows and E entity rows:
#[derive(Debug, Default)]
pub struct EncoderState {
    /// x, `[E, h]`.
    x: Buffer,
    attention: AttentionState,
    /// [x_k ‖ attention], `[R, h + a]`.
    pub encoded: Buffer,
}

impl Encoder {
    /// Declares `{name}.embed` and `{name}.attention`.
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        entity_dim: usize,
        hidden_dim: usize,
        attention_dim: usize,
        heads: usize,
    ) -> Self {
        let embed = Linear::new(layout, &format!("{name}.embed"), entity_dim, hidden_dim);
        let attention =
            Attention::new(layout, &format!("{name}.attention"), hidden_dim, attention_dim, heads);
        Self { embed, attention }
    }

    /// h: columns of x_k in the encoded row.
    pub fn hidden_dim(&self) -> usize {
        self.embed.outputs
    }

    /// h + a: columns of the encoded row.
    pub fn width(&self) -> usize {
        self.embed.outputs + self.attention.dim
    }

    /// An encoded row's parts: x_k (R, h) and the attention's output (R, a).
    pub fn split<'a>(&self, encoded: View<'a>) -> (View<'a>, View<'a>) {
        let h = self.hidden_dim();
        (encoded.columns(0..h), encoded.columns(h..self.width()))
    }

    /// Fills `state.encoded`.
    pub fn forward(&self, params: &[f32], rows: &Rows, visible: Visible<'_>, state: &mut EncoderState) {
        let (h, width) = (self.hidden_dim(), self.width());
        let x = state.x.fit(rows.entity_rows() * h);
        self.embed.forward_relu(params, rows.entities(), ViewMut::dense(x, h));
        let encoded = state.encoded.fit(rows.agent_rows() * width);
        for group in &rows.groups {
            for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                encoded[agent * width..][..h].copy_from_slice(&state.x[entity * h..][..h]);
            }
        }
        let queries = View::dense(encoded, width).columns(0..h);
        self.attention.project(params, queries, View::dense(&state.x, h), &mut state.attention);
        let out = ViewMut::dense(encoded, width).columns(h..width);
        self.attention.attend(&rows.groups, visible, &mut state.attention, out);
    }

    /// Takes the gradients by the attention's output, `d_attended` (R, a), and by the agents' own x where
    /// that is used, `d_agents` (R, h); adds to the parameters' gradients.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        rows: &Rows,
        state: &mut EncoderState,
        d_attended: View<'_>,
        d_agents: Option<View<'_>>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (h, width) = (self.hidden_dim(), self.width());
        let mut d_queries = scratch.take(rows.agent_rows() * h);
        let mut d_x = scratch.take(rows.entity_rows() * h);
        self.attention.backward(
            params,
            View::dense(&state.encoded, width).columns(0..h),
            View::dense(&state.x, h),
            &rows.groups,
            &state.attention,
            d_attended,
            ViewMut::dense(&mut d_queries, h),
            ViewMut::dense(&mut d_x, h),
            grads,
            scratch,
        );
        // An agent's x is a key, a query and, maybe, of use by itself.
        add_to_agents(&rows.groups, View::dense(&d_queries, h), &mut d_x);
        if let Some(d_agents) = d_agents {
            add_to_agents(&rows.groups, d_agents, &mut d_x);
        }
        activation::relu_backward(View::dense(&state.x, h), ViewMut::dense(&mut d_x, h));
        self.embed.backward_params(rows.entities(), View::dense(&d_x, h), grads);
        scratch.give(d_queries);
        scratch.give(d_x);
    }
}

vectorized! {
    /// Adds agents' rows to those of the entities they are.
    fn add_to_agents<'a>(groups: &'a [Group], of_agents: View<'a>, d_x: &'a mut [f32]) {
        let h = of_agents.cols;
        for group in groups {
            for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                math::add_scaled(&mut d_x[entity * h..][..h], 1.0, of_agents.row(agent));
            }
        }
    }
}
