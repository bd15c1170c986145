//! The contrastive loss L_C (paper, equation 3): a discriminator tells whether two task representations come
//! from the same task.

use rand::{Rng, seq::SliceRandom as _};
use rit_nn::{LayoutBuilder, Linear, View, ViewMut, activation, fit, math};

/// g: logit = `out`(ReLU(`hidden`([z₁ ‖ z₂]))), 2 h_z → h → 1.
#[derive(Clone, Debug)]
pub struct Discriminator {
    hidden: Linear,
    out: Linear,
}

/// Scratch of one part of the pairs. With P pairs:
#[derive(Debug, Default)]
pub struct DiscriminatorState {
    hidden: Vec<f32>,
    d_hidden: Vec<f32>,
    /// The logits; then their gradient, `[P]`.
    logits: Vec<f32>,
    /// The pairs' gradient, `[P, 2 h_z]`.
    pub d_pairs: Vec<f32>,
}

impl Discriminator {
    /// Declares all parameters named `discriminator.…`.
    pub fn new(layout: &mut LayoutBuilder, representation_dim: usize, hidden_dim: usize) -> Self {
        let hidden = Linear::new(layout, "discriminator.hidden", 2 * representation_dim, hidden_dim);
        let out = Linear::new(layout, "discriminator.out", hidden_dim, 1);
        Self { hidden, out }
    }

    /// Binary cross-entropy of these pairs against their labels, summed; adds to the parameters' gradients
    /// and fills `state.d_pairs`, both for the loss divided by `total` pairs. `pairs` (P, 2 h_z), `same` (P).
    pub fn loss(
        &self,
        params: &[f32],
        pairs: View<'_>,
        same: &[bool],
        total: usize,
        state: &mut DiscriminatorState,
        grads: &mut [f32],
    ) -> f64 {
        let (count, h) = (pairs.rows, self.hidden.outputs);
        let hidden = ViewMut::dense(fit(&mut state.hidden, count * h), h);
        self.hidden.forward_relu(params, pairs, hidden);
        let hidden = View::dense(&state.hidden, h);
        let logits = fit(&mut state.logits, count);
        self.out.forward(params, hidden, ViewMut::dense(logits, 1));

        let mut loss = 0.0;
        for (logit, &same) in logits.iter_mut().zip(same) {
            let (l, y) = (f64::from(*logit), f64::from(u8::from(same)));
            loss += l.max(0.0) - l * y + (-l.abs()).exp().ln_1p();
            *logit = (math::sigmoid(*logit) - y as f32) / total as f32;
        }

        let mut d_hidden = ViewMut::dense(fit(&mut state.d_hidden, count * h), h);
        self.out.backward(params, hidden, View::dense(logits, 1), Some(d_hidden.reborrow()), grads);
        activation::relu_backward(hidden, d_hidden.reborrow());
        let d_pairs = ViewMut::dense(fit(&mut state.d_pairs, count * pairs.cols), pairs.cols);
        self.hidden.backward(params, pairs, d_hidden.as_view(), Some(d_pairs), grads);
        loss
    }
}

/// Row i is paired with row `pairing[i]`: a uniform permutation.
pub fn draw_pairing(rows: usize, rng: &mut impl Rng) -> Vec<usize> {
    let mut pairing: Vec<usize> = (0..rows).collect();
    pairing.shuffle(rng);
    pairing
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_nn::gradcheck::{check, noise};

    #[test]
    fn loss_and_gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let discriminator = Discriminator::new(&mut layout, 3, 5);
        let len = layout.len();
        let (params, pairs) = (noise(1, len), noise(2, 4 * 6));
        let same = [true, false, false, true];
        let run = |params: &[f32], pairs: &[f32]| {
            let (mut state, mut grads) = (DiscriminatorState::default(), vec![0.0; len]);
            let loss = discriminator.loss(params, View::dense(pairs, 6), &same, 4, &mut state, &mut grads);
            (loss / 4.0, state.d_pairs, grads)
        };
        let (_, d_pairs, grads) = run(&params, &pairs);
        check("params", &params, &grads, |params| run(params, &pairs).0);
        check("pairs", &pairs, &d_pairs, |pairs| run(&params, pairs).0);
    }

    #[test]
    fn an_undecided_discriminator_loses_ln_2() {
        let mut layout = LayoutBuilder::default();
        let discriminator = Discriminator::new(&mut layout, 2, 3);
        let (mut state, mut grads) = (DiscriminatorState::default(), vec![0.0; layout.len()]);
        let params = vec![0.0; layout.len()];
        let pairs = noise(1, 2 * 4);
        let pairs = View::dense(&pairs, 4);
        let loss = discriminator.loss(&params, pairs, &[true, false], 2, &mut state, &mut grads);
        assert!((loss - 2.0 * std::f64::consts::LN_2).abs() < 1e-12);
    }
}
