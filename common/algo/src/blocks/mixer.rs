//! The mixing network (paper, appendix G): Q_total from the agents' utilities, monotone in each of them, with
//! weights that four hyper-networks make of the state and the task representations.
//!
//! With c_k = [`out`(attention over all present entities) ‖ z_k]:
//! W₁ row k = |`w1`(ReLU(`w1_hidden`(c_k)))|, w₂ = |mean_k `w2`(ReLU(`w2_hidden`(c_k)))|, b₁ = mean_k `b1`(c_k),
//! b₂ = mean_k `b2`(ReLU(`b2_hidden`(c_k))), and Q_total = ELU(qᵀ W₁ + b₁) w₂ + b₂ (equation 15).
//! Means are over real agents; a mean and a linear layer commute, so `w2` and `b2` work on the means.

use super::{Encoder, encoder::Entities};
use crate::Rows;
use rit_nn::{
    LayoutBuilder, Linear, Tape, Var, View, ViewMut,
    activation::{elu, elu_slope},
    attention::{Group, Visible},
    vectorized,
};

/// The mixing network.
#[derive(Clone, Debug)]
pub struct Mixer {
    /// Over all present entities.
    pub encoder: Encoder,
    /// `w1_hidden`, `w2_hidden`, `b2_hidden` and `b1` side by side over c, after `out` (a → h): [attention ‖ z] to all
    /// of them, derived.
    hyper: Linear,
    /// The first of these by itself.
    w1_hidden: Linear,
    w1: Linear,
    w2: Linear,
    b2: Linear,
}

/// The weights that mix. With R agent rows, G groups, x the mixing and y the hyper-network's embedding size:
#[derive(Clone, Copy, Debug)]
pub struct MixerWeights {
    /// Entities as the mixer's encoder sees them.
    pub entities: Entities,
    /// The agents' queries over them, (R, heads · h).
    pub queries: Var,
    /// `w1`'s output, signed, (R, x).
    pub w1: Var,
    /// b₁, (G, x).
    pub b1: Var,
    /// `w2`'s output, signed, (G, x).
    pub w2: Var,
    /// b₂, (G, 1).
    pub b2: Var,
}

impl Mixer {
    /// Declares all parameters named `mixer.…` but those of `encoder`, which is declared. `context` is h_z, or 0.
    pub fn new(
        layout: &mut LayoutBuilder,
        encoder: Encoder,
        context: usize,
        mixing_dim: usize,
        hypernet_dim: usize,
    ) -> Self {
        let (h, a, x, y) = (encoder.hidden_dim(), encoder.attention_dim(), mixing_dim, hypernet_dim);
        let out = Linear::new(layout, "mixer.out", a, h);
        let layers =
            [("mixer.w1_hidden", y), ("mixer.w2_hidden", y), ("mixer.b2_hidden", x), ("mixer.b1", x)];
        let hyper = Linear::side_by_side(layout, h + context, &layers);
        // No ReLU stands between the two.
        let hyper = layout.derived().chain(&out, &hyper);
        let w1_hidden = hyper.output_rows(0..y);
        let w1 = Linear::new(layout, "mixer.w1", y, x);
        let w2 = Linear::new(layout, "mixer.w2", y, x);
        let b2 = Linear::new(layout, "mixer.b2", x, 1);
        Self { encoder, hyper, w1_hidden, w1, w2, b2 }
    }

    /// All that does not depend on utilities: the weights that mix them, from `representation` (R, h_z) if there is
    /// one.
    pub fn weights<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &'a Rows,
        representation: Option<Var>,
    ) -> MixerWeights {
        let (x, y) = (self.w1.outputs, self.w1.inputs);
        let entities = self.encoder.entities(tape, rows);
        let queries = self.encoder.queries(tape, rows, entities);
        let attended = tape.reserve(queries.rows, self.encoder.attention_dim());
        self.encoder.attend(tape, rows, (queries, entities), &[Visible::All], attended);
        let parts: Vec<Var> = [attended].into_iter().chain(representation).collect();
        let hyper = tape.linear_of(&self.hyper, &parts, 0..2 * y + x);
        let w1 = tape.linear(&self.w1, hyper.columns(0..y));
        // A mean and a linear layer commute.
        let means = tape.mean_over_members(hyper.columns(y..2 * y + 2 * x), &rows.groups);
        let w2 = tape.linear(&self.w2, means.columns(0..y));
        let b2 = tape.linear(&self.b2, means.columns(y..y + x));
        for var in [entities.x, entities.values, queries, attended, hyper] {
            tape.free(var);
        }
        MixerWeights { entities, queries, w1, b1: means.columns(y + x..y + 2 * x), w2, b2 }
    }

    /// The weights where agents are shown entities through M masks: W₁ of these, (R M, x), with row `r M + i` what agent
    /// row r makes of mask i, and all else as it is. For utilities of imagined passes.
    pub fn weights_under<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &'a Rows,
        weights: &MixerWeights,
        masks: &[Visible<'a>],
    ) -> MixerWeights {
        let MixerWeights { entities, queries, .. } = *weights;
        let attended = tape.reserve(queries.rows * masks.len(), self.encoder.attention_dim());
        self.encoder.attend(tape, rows, (queries, entities), masks, attended);
        let hidden = tape.linear_relu(&self.w1_hidden, attended);
        MixerWeights { w1: tape.linear(&self.w1, hidden), ..*weights }
    }

    /// Q_total (G, 1) from each agent's chosen utility `q` (R, 1).
    pub fn mix<'a>(&self, tape: &mut Tape<'a>, groups: &'a [Group], weights: &MixerWeights, q: Var) -> Var {
        let MixerWeights { w1, b1, w2, b2, .. } = *weights;
        let mut hidden = tape.take(groups.len() * b1.cols);
        let mut q_total = tape.take(groups.len());
        let views = [tape.view(w1), tape.view(b1), tape.view(w2), tape.view(b2)];
        mix(groups, tape.slice(q), views, &mut hidden, &mut q_total);
        let q_total = tape.push(q_total, 1);
        if !tape.is_recording() {
            tape.give(hidden);
            return q_total;
        }
        tape.record(move |back| {
            let Some(d_total) = back.gradients.take(q_total) else { return back.stock.give(hidden) };
            let work = &mut back.gradients.work;
            let [mut d_q, mut d_w1, mut d_b1, mut d_w2, mut d_b2] =
                [q, w1, b1, w2, b2].map(|var| work.take(var.len()));
            let values = [back.values.view(w1), back.values.view(w2)];
            let d = [(&mut d_w1, w1), (&mut d_b1, b1), (&mut d_w2, w2)]
                .map(|(buffer, var)| ViewMut::dense(buffer, var.cols));
            d_b2.copy_from_slice(d_total.view().data);
            mix_backward(groups, back.values.slice(q), &hidden, values, &d_b2, &mut d_q, d);
            for (var, buffer) in [(q, d_q), (w1, d_w1), (b1, d_b1), (w2, d_w2), (b2, d_b2)] {
                back.gradients.contribute(var, buffer);
            }
            back.gradients.done(d_total);
            back.stock.give(hidden);
        });
        q_total
    }
}

vectorized! {
    /// Equation 15 for every group, from W₁, b₁, w₂ and b₂, W₁ and w₂ still signed.
    fn mix<'a>(
        groups: &'a [Group],
        q: &'a [f32],
        weights: [View<'a>; 4],
        hidden: &'a mut [f32],
        q_total: &'a mut [f32],
    ) {
        let [w1, b1, w2, b2] = weights;
        let x = b1.cols;
        for (at, group) in groups.iter().enumerate() {
            let hidden = &mut hidden[at * x..][..x];
            hidden.copy_from_slice(b1.row(at));
            for row in group.queries.clone() {
                for (hidden, w1) in hidden.iter_mut().zip(w1.row(row)) {
                    *hidden += q[row] * w1.abs();
                }
            }
            let mut total = b2.row(at)[0];
            for (hidden, w2) in hidden.iter_mut().zip(w2.row(at)) {
                *hidden = elu(*hidden);
                total += *hidden * w2.abs();
            }
            q_total[at] = total;
        }
    }
}

vectorized! {
    /// Writes the gradients by q and, into `d`, by W₁, b₁ and w₂. W₁ and w₂, still signed, are `weights`.
    fn mix_backward<'a>(
        groups: &'a [Group],
        q: &'a [f32],
        hidden: &'a [f32],
        weights: [View<'a>; 2],
        d_total: &'a [f32],
        d_q: &'a mut [f32],
        d: [ViewMut<'a>; 3],
    ) {
        let ([w1, w2], [mut d_w1, mut d_b1, mut d_w2]) = (weights, d);
        let x = d_b1.cols;
        for (at, group) in groups.iter().enumerate() {
            let (d_b1, d_w2) = (d_b1.row(at), d_w2.row(at));
            let of_group = w2.row(at).iter().zip(&hidden[at * x..][..x]);
            for ((d_b1, d_w2), (w2, &hidden)) in d_b1.iter_mut().zip(d_w2).zip(of_group) {
                *d_b1 = d_total[at] * w2.abs() * elu_slope(hidden);
                *d_w2 = d_total[at] * hidden * slope_of_abs(*w2);
            }
            for row in group.queries.clone() {
                let w1 = w1.row(row);
                d_q[row] = w1.iter().zip(&*d_b1).map(|(w1, d)| w1.abs() * d).sum();
                for ((d_w1, w1), d) in d_w1.row(row).iter_mut().zip(w1).zip(&*d_b1) {
                    *d_w1 = d * q[row] * slope_of_abs(*w1);
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

#[cfg(test)]
mod tests;
