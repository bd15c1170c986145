//! The mixing network (paper, appendix G): Q_total from the agents' utilities, monotone in each of them, with
//! weights that four hyper-networks make of the state and the task representations.
//!
//! With c_k = [`out`(attention over all present entities) ‖ z_k]:
//! W₁ row k = |`w1`(ReLU(`w1_hidden`(c_k)))|, w₂ = |mean_k `w2`(ReLU(`w2_hidden`(c_k)))|, b₁ = mean_k `b1`(c_k),
//! b₂ = mean_k `b2`(ReLU(`b2_hidden`(c_k))), and Q_total = ELU(qᵀ W₁ + b₁) w₂ + b₂ (equation 15).
//! Means are over real agents; a mean and a linear layer commute, so `w2` and `b2` work on the means.

use crate::{
    Rows,
    encoder::{Encoder, EncoderState},
    rit::RitConfig,
};
use faer::Accum;
use rit_nn::{
    LayoutBuilder, Linear, View, ViewMut, activation, activation::elu, activation::elu_slope,
    attention::Visible, fit, math, matmul,
};
use std::ops::Range;

/// The mixing network.
#[derive(Clone, Debug)]
pub struct Mixer {
    encoder: Encoder,
    /// a → h.
    out: Linear,
    /// `w1_hidden`, `w2_hidden`, `b2_hidden` and `b1` side by side over c.
    hyper: Linear,
    w1: Linear,
    w2: Linear,
    b2: Linear,
}

/// What forward leaves for backward. With R agent rows and G groups, x the mixing and y the hyper-network's
/// embedding size:
#[derive(Debug, Default)]
pub struct MixerState {
    encoder: EncoderState,
    /// c, `[R, h + h_z]`.
    context: Vec<f32>,
    /// ReLU'd w1_hidden, w2_hidden, b2_hidden, and b1, `[R, 2y + 2x]`; backward leaves its gradient here.
    hyper: Vec<f32>,
    /// `w1`'s output, signed, `[R, x]`; backward leaves its gradient here.
    w1: Vec<f32>,
    /// Means over agents of w2_hidden, b2_hidden and b1, `[G, y + 2x]`.
    means: Vec<f32>,
    /// `w2`'s output, signed, `[G, x]`; backward leaves its gradient here.
    w2: Vec<f32>,
    /// b₂, `[G]`.
    b2: Vec<f32>,
    /// ELU's output, `[G, x]`.
    hidden: Vec<f32>,
    /// Q_total, `[G]`.
    pub q_total: Vec<f32>,
    d_means: Vec<f32>,
    d_hyper: Vec<f32>,
    d_context: Vec<f32>,
    d_encoded: Vec<f32>,
}

impl Mixer {
    /// Declares all parameters named `mixer.…`.
    pub fn new(
        layout: &mut LayoutBuilder,
        config: &RitConfig,
        mixing_dim: usize,
        hypernet_dim: usize,
    ) -> Self {
        let (h, a, x, y) = (config.hidden_dim, config.attention_dim, mixing_dim, hypernet_dim);
        let encoder = Encoder::new(layout, "mixer", config.entity_dim, h, a, config.n_heads);
        let out = Linear::new(layout, "mixer.out", a, h);
        let layers =
            [("mixer.w1_hidden", y), ("mixer.w2_hidden", y), ("mixer.b2_hidden", x), ("mixer.b1", x)];
        let hyper = Linear::side_by_side(layout, h + config.representation_dim(), &layers);
        let w1 = Linear::new(layout, "mixer.w1", y, x);
        let w2 = Linear::new(layout, "mixer.w2", y, x);
        let b2 = Linear::new(layout, "mixer.b2", x, 1);
        Self { encoder, out, hyper, w1, w2, b2 }
    }

    fn mixing_dim(&self) -> usize {
        self.w1.outputs
    }

    /// Columns of `means`: (w2_hidden, b2_hidden, b1).
    fn mean_columns(&self) -> (Range<usize>, Range<usize>, Range<usize>) {
        let (x, y) = (self.mixing_dim(), self.w1.inputs);
        (0..y, y..y + x, y + x..y + 2 * x)
    }

    /// Fills `state.q_total` (G) from each agent's chosen utility `q` (R) and `representation` (R, h_z).
    pub fn forward(
        &self,
        params: &[f32],
        rows: &Rows,
        q: &[f32],
        representation: View<'_>,
        state: &mut MixerState,
    ) {
        let (h, x, y) = (self.out.outputs, self.mixing_dim(), self.w1.inputs);
        let (agents, groups) = (rows.agent_rows(), rows.groups.len());
        self.encoder.forward(params, rows, Visible::All, &mut state.encoder);
        let attended = View::dense(&state.encoder.encoded, self.encoder.width())
            .columns(self.encoder.hidden_dim()..self.encoder.width());
        let width = self.hyper.inputs;
        let mut context = ViewMut::dense(fit(&mut state.context, agents * width), width);
        for row in 0..representation.rows {
            context.row(row)[h..].copy_from_slice(representation.row(row));
        }
        self.out.forward(params, attended, context.columns(0..h));

        let outputs = self.hyper.outputs;
        let mut hyper = ViewMut::dense(fit(&mut state.hyper, agents * outputs), outputs);
        self.hyper.forward(params, View::dense(&state.context, width), hyper.reborrow());
        activation::relu(hyper.reborrow().columns(0..2 * y + x));
        let w1 = ViewMut::dense(fit(&mut state.w1, agents * x), x);
        self.w1.forward(params, hyper.as_view().columns(0..y), w1);

        let mean_width = y + 2 * x;
        let means = fit(&mut state.means, groups * mean_width);
        means.fill(0.0);
        math::vectorized(|| {
            for (group, means) in rows.groups.iter().zip(means.chunks_exact_mut(mean_width)) {
                let share = 1.0 / group.queries.len() as f32;
                for row in group.queries.clone() {
                    math::add_scaled(means, share, &state.hyper[row * outputs + y..][..mean_width]);
                }
            }
        });
        let (w2_hidden, b2_hidden, b1) = self.mean_columns();
        let means = View::dense(means, mean_width);
        self.w2.forward(params, means.columns(w2_hidden), ViewMut::dense(fit(&mut state.w2, groups * x), x));
        self.b2.forward(params, means.columns(b2_hidden), ViewMut::dense(fit(&mut state.b2, groups), 1));

        let hidden = fit(&mut state.hidden, groups * x);
        let q_total = fit(&mut state.q_total, groups);
        math::vectorized(|| {
            for (at, group) in rows.groups.iter().enumerate() {
                let hidden = &mut hidden[at * x..][..x];
                hidden.copy_from_slice(&means.row(at)[b1.clone()]);
                for row in group.queries.clone() {
                    for (hidden, w1) in hidden.iter_mut().zip(&state.w1[row * x..][..x]) {
                        *hidden += q[row] * w1.abs();
                    }
                }
                let mut total = state.b2[at];
                for (hidden, w2) in hidden.iter_mut().zip(&state.w2[at * x..][..x]) {
                    *hidden = elu(*hidden);
                    total += *hidden * w2.abs();
                }
                q_total[at] = total;
            }
        });
    }

    /// Takes `d_total` (G). Writes `d_q` (R), adds to `d_representation` (R, h_z) and to the parameters'
    /// gradients. `q` is what forward was given.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        rows: &Rows,
        q: &[f32],
        state: &mut MixerState,
        d_total: &[f32],
        d_q: &mut [f32],
        mut d_representation: ViewMut<'_>,
        grads: &mut [f32],
    ) {
        let (h, x, y) = (self.out.outputs, self.mixing_dim(), self.w1.inputs);
        let (agents, groups) = (rows.agent_rows(), rows.groups.len());
        let (width, outputs, mean_width) = (self.hyper.inputs, self.hyper.outputs, y + 2 * x);
        let (w2_hidden, b2_hidden, b1) = self.mean_columns();
        let d_means = fit(&mut state.d_means, groups * mean_width);
        math::vectorized(|| {
            for (at, group) in rows.groups.iter().enumerate() {
                let d_b1 = &mut d_means[at * mean_width..][b1.clone()];
                let (hidden, w2) = (&state.hidden[at * x..][..x], &mut state.w2[at * x..][..x]);
                for i in 0..x {
                    d_b1[i] = d_total[at] * w2[i].abs() * elu_slope(hidden[i]);
                    w2[i] = d_total[at] * hidden[i] * slope_of_abs(w2[i]);
                }
                for row in group.queries.clone() {
                    let w1 = &mut state.w1[row * x..][..x];
                    let mut sum = 0.0;
                    for i in 0..x {
                        sum += d_b1[i] * w1[i].abs();
                        w1[i] = d_b1[i] * q[row] * slope_of_abs(w1[i]);
                    }
                    d_q[row] = sum;
                }
            }
        });
        let means = View::dense(&state.means, mean_width);
        let d_w2 = View::dense(&state.w2, x);
        let mut d_means = ViewMut::dense(d_means, mean_width);
        let to = d_means.reborrow().columns(w2_hidden.clone());
        self.w2.backward(params, means.columns(w2_hidden), d_w2, Some(to), grads);
        let to = d_means.reborrow().columns(b2_hidden.clone());
        self.b2.backward(params, means.columns(b2_hidden), View::dense(d_total, 1), Some(to), grads);

        let hyper = View::dense(&state.hyper, outputs);
        let mut d_hyper = ViewMut::dense(fit(&mut state.d_hyper, agents * outputs), outputs);
        let to = d_hyper.reborrow().columns(0..y);
        self.w1.backward(params, hyper.columns(0..y), View::dense(&state.w1, x), Some(to), grads);
        for (at, group) in rows.groups.iter().enumerate() {
            let share = 1.0 / group.queries.len() as f32;
            for row in group.queries.clone() {
                for (to, d_mean) in d_hyper.row(row)[y..].iter_mut().zip(d_means.row(at)) {
                    *to = share * *d_mean;
                }
            }
        }
        let relued = 0..2 * y + x;
        activation::relu_backward(hyper.columns(relued.clone()), d_hyper.reborrow().columns(relued));
        let d_context = ViewMut::dense(fit(&mut state.d_context, agents * width), width);
        let context = View::dense(&state.context, width);
        self.hyper.backward(params, context, d_hyper.as_view(), Some(d_context), grads);

        let d_context = View::dense(&state.d_context, width);
        for row in 0..d_representation.rows {
            math::add_scaled(d_representation.row(row), 1.0, &d_context.row(row)[h..]);
        }
        let (from, width) = (self.encoder.hidden_dim(), self.encoder.width());
        let attended = View::dense(&state.encoder.encoded, width).columns(from..width);
        // x_k itself is a query here and nothing more: its columns get no gradient of their own.
        let d_encoded = fit(&mut state.d_encoded, agents * width);
        d_encoded.fill(0.0);
        let d_out = d_context.columns(0..h);
        self.out.backward_params(attended, d_out, grads);
        let to = ViewMut::dense(d_encoded, width).columns(from..width);
        matmul::dy_w(d_out, self.out.weight(params), to, Accum::Replace);
        let d_encoded = View::dense(&state.d_encoded, width);
        self.encoder.backward(params, rows, &mut state.encoder, d_encoded, grads);
    }
}

/// d|w|/dw, zero at zero.
#[inline(always)]
fn slope_of_abs(w: f32) -> f32 {
    if w > 0.0 {
        1.0
    } else if w < 0.0 {
        -1.0
    } else {
        0.0
    }
}
