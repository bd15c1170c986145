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
use rit_nn::{
    Buffer, LayoutBuilder, Linear, Scratch, View, ViewMut, activation,
    activation::{elu, elu_slope},
    attention::{Group, Visible},
    linear, math, vectorized,
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
    pub(crate) encoder: EncoderState,
    /// c, `[R, h + h_z]`.
    context: Buffer,
    /// ReLU'd w1_hidden, w2_hidden, b2_hidden, and b1, `[R, 2y + 2x]`.
    hyper: Buffer,
    /// `w1`'s output, signed, `[R, x]`; backward leaves its gradient here.
    w1: Buffer,
    /// Means over agents of w2_hidden, b2_hidden and b1, `[G, y + 2x]`.
    means: Buffer,
    /// `w2`'s output, signed, `[G, x]`; backward leaves its gradient here.
    w2: Buffer,
    /// b₂, `[G]`.
    b2: Buffer,
    /// ELU's output, `[G, x]`.
    hidden: Buffer,
    /// Q_total, `[G]`.
    pub q_total: Buffer,
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

    /// All that does not depend on utilities: the weights that mix them, from `representation` (R, h_z).
    pub fn prepare(&self, params: &[f32], rows: &Rows, representation: View<'_>, state: &mut MixerState) {
        let (h, x, y) = (self.out.outputs, self.mixing_dim(), self.w1.inputs);
        let (agents, groups) = (rows.agent_rows(), rows.groups.len());
        self.encoder.forward(params, rows, Visible::All, &mut state.encoder);
        let (_, attended) = self.encoder.split(View::dense(&state.encoder.encoded, self.encoder.width()));
        let width = self.hyper.inputs;
        let mut context = ViewMut::dense(state.context.fit(agents * width), width);
        for row in 0..representation.rows {
            context.row(row)[h..].copy_from_slice(representation.row(row));
        }
        self.out.forward(params, attended, context.columns(0..h));

        let outputs = self.hyper.outputs;
        let mut hyper = ViewMut::dense(state.hyper.fit(agents * outputs), outputs);
        self.hyper.forward(params, View::dense(&state.context, width), hyper.reborrow());
        activation::relu(hyper.reborrow().columns(0..2 * y + x));
        let w1 = ViewMut::dense(state.w1.fit(agents * x), x);
        self.w1.forward(params, hyper.as_view().columns(0..y), w1);

        let mean_width = y + 2 * x;
        let means = state.means.fit(groups * mean_width);
        average(&rows.groups, View::dense(&state.hyper, outputs).columns(y..outputs), means);
        let (w2_hidden, b2_hidden, _) = self.mean_columns();
        let means = View::dense(means, mean_width);
        self.w2.forward(params, means.columns(w2_hidden), ViewMut::dense(state.w2.fit(groups * x), x));
        self.b2.forward(params, means.columns(b2_hidden), ViewMut::dense(state.b2.fit(groups), 1));
    }

    /// Fills `state.q_total` (G) from each agent's chosen utility `q` (R), after [`Mixer::prepare`].
    pub fn forward(&self, rows: &Rows, q: &[f32], state: &mut MixerState) {
        let (groups, x, y) = (rows.groups.len(), self.mixing_dim(), self.w1.inputs);
        let (_, _, b1) = self.mean_columns();
        let MixerState { w1, w2, b2, means, hidden, q_total, .. } = state;
        let (hidden, q_total) = (hidden.fit(groups * x), q_total.fit(groups));
        let b1 = View::dense(means, y + 2 * x).columns(b1);
        mix(&rows.groups, q, [w1, w2, b2], b1, hidden, q_total);
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
        d_representation: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (h, x, y) = (self.out.outputs, self.mixing_dim(), self.w1.inputs);
        let (agents, groups) = (rows.agent_rows(), rows.groups.len());
        let (width, outputs, mean_width) = (self.hyper.inputs, self.hyper.outputs, y + 2 * x);
        let (w2_hidden, b2_hidden, b1) = self.mean_columns();
        let mut d_means = scratch.take(groups * mean_width);
        let d_b1 = ViewMut::dense(&mut d_means, mean_width).columns(b1);
        mix_backward(&rows.groups, q, &state.hidden, [&mut state.w1, &mut state.w2], d_total, d_q, d_b1);
        let means = View::dense(&state.means, mean_width);
        let d_w2 = View::dense(&state.w2, x);
        let to = ViewMut::dense(&mut d_means, mean_width).columns(w2_hidden.clone());
        self.w2.backward(params, means.columns(w2_hidden), d_w2, Some(to), grads);
        let to = ViewMut::dense(&mut d_means, mean_width).columns(b2_hidden.clone());
        self.b2.backward(params, means.columns(b2_hidden), View::dense(d_total, 1), Some(to), grads);

        let hyper = View::dense(&state.hyper, outputs);
        let mut d_hyper = scratch.take(agents * outputs);
        let to = ViewMut::dense(&mut d_hyper, outputs).columns(0..y);
        self.w1.backward(params, hyper.columns(0..y), View::dense(&state.w1, x), Some(to), grads);
        let to = ViewMut::dense(&mut d_hyper, outputs).columns(y..outputs);
        average_backward(&rows.groups, View::dense(&d_means, mean_width), to);
        scratch.give(d_means);
        let relued = 0..2 * y + x;
        let d_relued = ViewMut::dense(&mut d_hyper, outputs).columns(relued.clone());
        activation::relu_backward(hyper.columns(relued), d_relued);
        let mut d_context = scratch.take(agents * width);
        let to = Some(ViewMut::dense(&mut d_context, width));
        let context = View::dense(&state.context, width);
        self.hyper.backward(params, context, View::dense(&d_hyper, outputs), to, grads);
        scratch.give(d_hyper);

        let d_context_view = View::dense(&d_context, width);
        if d_representation.cols > 0 {
            linear::add(d_representation, d_context_view.columns(h..width));
        }
        let (_, attended) = self.encoder.split(View::dense(&state.encoder.encoded, self.encoder.width()));
        let d_out = d_context_view.columns(0..h);
        let mut d_attended = scratch.take(agents * self.out.inputs);
        let to = Some(ViewMut::dense(&mut d_attended, self.out.inputs));
        self.out.backward(params, attended, d_out, to, grads);
        scratch.give(d_context);
        // x_k itself is a query here and nothing more.
        let from = View::dense(&d_attended, self.out.inputs);
        self.encoder.backward(params, rows, &mut state.encoder, from, None, grads, scratch);
        scratch.give(d_attended);
    }
}

vectorized! {
    /// Each group's mean over its agents.
    fn average<'a>(groups: &'a [Group], rows: View<'a>, means: &'a mut [f32]) {
        means.fill(0.0);
        for (group, mean) in groups.iter().zip(means.chunks_exact_mut(rows.cols)) {
            let share = 1.0 / group.queries.len() as f32;
            for row in group.queries.clone() {
                math::add_scaled(mean, share, rows.row(row));
            }
        }
    }
}

vectorized! {
    /// Each agent's share of its group's gradient.
    fn average_backward<'a>(groups: &'a [Group], d_means: View<'a>, d_rows: ViewMut<'a>) {
        for (at, group) in groups.iter().enumerate() {
            let share = 1.0 / group.queries.len() as f32;
            for row in group.queries.clone() {
                for (d_row, d_mean) in d_rows.row(row).iter_mut().zip(d_means.row(at)) {
                    *d_row = share * d_mean;
                }
            }
        }
    }
}

vectorized! {
    /// Equation 15 for every group, from W₁, w₂ (both still signed) and b₂ in `weights`, and b₁.
    fn mix<'a>(
        groups: &'a [Group],
        q: &'a [f32],
        weights: [&'a [f32]; 3],
        b1: View<'a>,
        hidden: &'a mut [f32],
        q_total: &'a mut [f32],
    ) {
        let ([w1, w2, b2], x) = (weights, b1.cols);
        for (at, group) in groups.iter().enumerate() {
            let hidden = &mut hidden[at * x..][..x];
            hidden.copy_from_slice(b1.row(at));
            for row in group.queries.clone() {
                for (hidden, w1) in hidden.iter_mut().zip(&w1[row * x..][..x]) {
                    *hidden += q[row] * w1.abs();
                }
            }
            let mut total = b2[at];
            for (hidden, w2) in hidden.iter_mut().zip(&w2[at * x..][..x]) {
                *hidden = elu(*hidden);
                total += *hidden * w2.abs();
            }
            q_total[at] = total;
        }
    }
}

vectorized! {
    /// Leaves the gradients by W₁ and w₂ in `weights`, writes those by q and by b₁.
    fn mix_backward<'a>(
        groups: &'a [Group],
        q: &'a [f32],
        hidden: &'a [f32],
        weights: [&'a mut [f32]; 2],
        d_total: &'a [f32],
        d_q: &'a mut [f32],
        d_b1: ViewMut<'a>,
    ) {
        let ([w1, w2], x) = (weights, d_b1.cols);
        for (at, group) in groups.iter().enumerate() {
            let d_b1 = d_b1.row(at);
            let of_group = w2[at * x..][..x].iter_mut().zip(&hidden[at * x..][..x]);
            for (d_b1, (w2, &hidden)) in d_b1.iter_mut().zip(of_group) {
                *d_b1 = d_total[at] * w2.abs() * elu_slope(hidden);
                *w2 = d_total[at] * hidden * slope_of_abs(*w2);
            }
            for row in group.queries.clone() {
                let w1 = &mut w1[row * x..][..x];
                d_q[row] = w1.iter().zip(&*d_b1).map(|(w1, d)| w1.abs() * d).sum();
                for (w1, d) in w1.iter_mut().zip(&*d_b1) {
                    *w1 = d * q[row] * slope_of_abs(*w1);
                }
            }
        }
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
