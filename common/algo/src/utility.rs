//! The utility function network Q^k(τ^k, a^{<k}, ·) (paper, figure 1 a): encoder, GRU, decoder.

use crate::{
    Rows,
    decoder::{Decoder, DecoderState, Tables},
    encoder::{Encoder, EncoderState},
    rit::RitConfig,
};
use rit_nn::{Accum, Gru, LayoutBuilder, Scratch, View, ViewMut, attention::Visible, gru::GruState, matmul};

/// The utility function network.
#[derive(Clone, Debug)]
pub struct Utility {
    encoder: Encoder,
    gru: Gru,
    /// Turns histories into utilities, one agent after another.
    pub decoder: Decoder,
}

/// What forward leaves for backward.
#[derive(Debug, Default)]
pub struct UtilityState {
    pub(crate) encoder: EncoderState,
    pub(crate) gru: GruState,
    /// The decoder's part, with the utilities.
    pub decoder: DecoderState,
}

impl Utility {
    /// Declares all parameters named `utility.…`.
    pub fn new(layout: &mut LayoutBuilder, config: &RitConfig) -> Self {
        let (h, a) = (config.hidden_dim, config.attention_dim);
        let encoder = Encoder::new(layout, "utility", config.entity_dim, h, a, config.n_heads);
        let gru = Gru::new(layout, "utility.gru", h + a, h);
        let z = config.representation_dim();
        let decoder = Decoder::new(layout, "utility", config.n_actions, h, a, config.n_heads, z);
        Self { encoder, gru, decoder }
    }

    /// Histories τ of all rows, and all of the decoder that needs no predecessors. `before` (rows of the
    /// first time, h) is the history before the first time, or zeros; `representation` is z (R, h_z).
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn forward(
        &self,
        params: &[f32],
        tables: &Tables,
        rows: &Rows,
        before: Option<View<'_>>,
        representation: View<'_>,
        state: &mut UtilityState,
        scratch: &mut Scratch,
    ) {
        let h = self.gru.hidden_dim;
        self.encoder.forward(params, rows, Visible::Where(&rows.others), &mut state.encoder);
        let encoded = View::dense(&state.encoder.encoded, self.encoder.width());
        let gates = state.gru.gates.fit(rows.agent_rows() * 3 * h);
        matmul::x_wt(encoded, self.gru.input.weight(params), ViewMut::dense(gates, 3 * h), Accum::Replace);
        self.gru.forward(params, &rows.agent_times, before, &mut state.gru, scratch);
        let history = View::dense(&state.gru.history, h);
        self.decoder.prepare(params, tables, history, representation, &mut state.decoder);
    }

    /// Takes `d_utilities` (R, A); adds to `d_representation` (R, h_z) and to the parameters' gradients.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        tables: &Tables,
        rows: &Rows,
        representation: View<'_>,
        state: &mut UtilityState,
        d_utilities: View<'_>,
        d_representation: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (h, width) = (self.gru.hidden_dim, self.encoder.width());
        let history = View::dense(&state.gru.history, h);
        let mut d_history = scratch.take(rows.agent_rows() * h);
        self.decoder.backward(
            params,
            tables,
            history,
            representation,
            &state.decoder,
            d_utilities,
            ViewMut::dense(&mut d_history, h),
            d_representation,
            grads,
            scratch,
        );
        let GruState { gates, new_from_hidden, history } = &mut state.gru;
        let left = (&mut gates[..], &new_from_hidden[..]);
        self.gru.backward(params, &rows.agent_times, left, history, &mut d_history, grads, scratch);
        scratch.give(d_history);
        let d_gates = View::dense(&state.gru.gates, 3 * h);
        let encoded = View::dense(&state.encoder.encoded, width);
        matmul::dyt_x(d_gates, encoded, self.gru.input.weight_mut(grads), Accum::Add);
        let mut d_encoded = scratch.take(rows.agent_rows() * width);
        let to = ViewMut::dense(&mut d_encoded, width);
        matmul::dy_w(d_gates, self.gru.input.weight(params), to, Accum::Replace);
        let d_encoded_view = View::dense(&d_encoded, width);
        let (d_agents, d_attended) = self.encoder.split(d_encoded_view);
        self.encoder.backward(params, rows, &mut state.encoder, d_attended, Some(d_agents), grads, scratch);
        scratch.give(d_encoded);
    }
}

impl UtilityState {
    /// Histories τ, `[R, h]`.
    pub fn history(&self) -> &[f32] {
        &self.gru.history
    }
}
