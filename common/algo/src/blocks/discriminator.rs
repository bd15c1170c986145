//! The contrastive loss L_C (paper, equation 3): a discriminator tells whether two task representations come
//! from the same task.

use crate::estimators::contrastive::cross_entropy;
use rand::{Rng, seq::SliceRandom as _};
use rit_nn::{LayoutBuilder, Linear, Scratch, View, ViewMut, activation};

/// g: logit = `out`(ReLU(`hidden`([z₁ ‖ z₂]))), 2 h_z → h → 1.
#[derive(Clone, Debug)]
pub struct Discriminator {
    hidden: Linear,
    out: Linear,
}

impl Discriminator {
    /// Declares all parameters named `discriminator.…`.
    pub fn new(layout: &mut LayoutBuilder, representation_dim: usize, hidden_dim: usize) -> Self {
        let hidden = Linear::new(layout, "discriminator.hidden", 2 * representation_dim, hidden_dim);
        let out = Linear::new(layout, "discriminator.out", hidden_dim, 1);
        Self { hidden, out }
    }

    /// h_z.
    pub fn representation_dim(&self) -> usize {
        self.hidden.inputs / 2
    }

    /// Binary cross-entropy of these pairs against their labels, summed. Writes the gradient by the pairs and
    /// adds to the parameters' gradients, both for the loss divided by `total` pairs. `pairs` and `d_pairs`
    /// (P, 2 h_z), `same` (P).
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn loss(
        &self,
        params: &[f32],
        pairs: View<'_>,
        same: &[bool],
        total: usize,
        d_pairs: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) -> f64 {
        let (count, h) = (pairs.rows, self.hidden.outputs);
        let mut hidden = scratch.take(count * h);
        self.hidden.forward_relu(params, pairs, ViewMut::dense(&mut hidden, h));
        let hidden_view = View::dense(&hidden, h);
        let mut logits = scratch.take(count);
        self.out.forward(params, hidden_view, ViewMut::dense(&mut logits, 1));

        // From here on the logits are their gradient.
        let mut loss = 0.0;
        for (logit, &same) in logits.iter_mut().zip(same) {
            let (of_pair, slope) = cross_entropy(*logit, same, total);
            loss += of_pair;
            *logit = slope;
        }

        let mut d_hidden = scratch.take(count * h);
        let to = ViewMut::dense(&mut d_hidden, h);
        self.out.backward(params, hidden_view, View::dense(&logits, 1), Some(to), grads);
        activation::relu_backward(hidden_view, ViewMut::dense(&mut d_hidden, h));
        self.hidden.backward(params, pairs, View::dense(&d_hidden, h), Some(d_pairs), grads);
        for buffer in [hidden, logits, d_hidden] {
            scratch.give(buffer);
        }
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
            let (mut d_pairs, mut grads) = (vec![0.0; pairs.len()], vec![0.0; len]);
            let (from, to) = (View::dense(pairs, 6), ViewMut::dense(&mut d_pairs, 6));
            let loss = discriminator.loss(params, from, &same, 4, to, &mut grads, &mut Scratch::default());
            (loss / 4.0, d_pairs, grads)
        };
        let (_, d_pairs, grads) = run(&params, &pairs);
        check("params", &params, &grads, |params| run(params, &pairs).0);
        check("pairs", &pairs, &d_pairs, |pairs| run(&params, pairs).0);
    }

    #[test]
    fn an_undecided_discriminator_loses_ln_2() {
        let mut layout = LayoutBuilder::default();
        let discriminator = Discriminator::new(&mut layout, 2, 3);
        let (params, mut grads) = (vec![0.0; layout.len()], vec![0.0; layout.len()]);
        let (pairs, mut d_pairs) = (noise(1, 2 * 4), vec![0.0; 2 * 4]);
        let (from, to) = (View::dense(&pairs, 4), ViewMut::dense(&mut d_pairs, 4));
        let same = [true, false];
        let loss = discriminator.loss(&params, from, &same, 2, to, &mut grads, &mut Scratch::default());
        assert!((loss - 2.0 * std::f64::consts::LN_2).abs() < 1e-12);
    }
}
