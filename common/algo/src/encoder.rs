//! The encoder that utility, task encoder and mixer share in form, not in parameters (paper, appendix E):
//! every entity is embedded, then each agent attends over entities.

use crate::Rows;
use rit_nn::{
    Attention, LayoutBuilder, Linear, View, ViewMut, activation,
    attention::{AttentionState, Visible},
    fit, math,
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
    x: Vec<f32>,
    /// The agents' rows of x, `[R, h]`.
    queries: Vec<f32>,
    attention: AttentionState,
    /// [x_k ‖ attention], `[R, h + a]`.
    pub encoded: Vec<f32>,
    d_x: Vec<f32>,
    d_queries: Vec<f32>,
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

    /// Fills `state.encoded`.
    pub fn forward(&self, params: &[f32], rows: &Rows, visible: Visible<'_>, state: &mut EncoderState) {
        let (h, width) = (self.hidden_dim(), self.width());
        let x = fit(&mut state.x, rows.entity_rows() * h);
        self.embed.forward_relu(params, rows.entities(), ViewMut::dense(x, h));
        let queries = fit(&mut state.queries, rows.agent_rows() * h);
        let encoded = fit(&mut state.encoded, rows.agent_rows() * width);
        for group in &rows.groups {
            for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                let x = &state.x[entity * h..][..h];
                queries[agent * h..][..h].copy_from_slice(x);
                encoded[agent * width..][..h].copy_from_slice(x);
            }
        }
        let (queries, keys) = (View::dense(queries, h), View::dense(&state.x, h));
        let out = ViewMut::dense(encoded, width).columns(h..width);
        self.attention.forward(params, queries, keys, &rows.groups, visible, &mut state.attention, out);
    }

    /// Takes `d_encoded` (R, h + a) and adds to the parameters' gradients.
    pub fn backward(
        &self,
        params: &[f32],
        rows: &Rows,
        state: &mut EncoderState,
        d_encoded: View<'_>,
        grads: &mut [f32],
    ) {
        let (h, width) = (self.hidden_dim(), self.width());
        let queries = View::dense(&state.queries, h);
        let d_queries = ViewMut::dense(fit(&mut state.d_queries, rows.agent_rows() * h), h);
        let d_x = ViewMut::dense(fit(&mut state.d_x, rows.entity_rows() * h), h);
        let keys = View::dense(&state.x, h);
        let d_out = d_encoded.columns(h..width);
        let attention = &mut state.attention;
        self.attention.backward(params, queries, keys, &rows.groups, attention, d_out, d_queries, d_x, grads);
        // An agent's x is a key, a query and a part of its encoded row.
        math::vectorized(|| {
            for group in &rows.groups {
                for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                    let d_x = &mut state.d_x[entity * h..][..h];
                    math::add_scaled(d_x, 1.0, &state.d_queries[agent * h..][..h]);
                    math::add_scaled(d_x, 1.0, &d_encoded.row(agent)[..h]);
                }
            }
        });
        activation::relu_backward(View::dense(&state.x, h), ViewMut::dense(&mut state.d_x, h));
        self.embed.backward_params(rows.entities(), View::dense(&state.d_x, h), grads);
    }
}
