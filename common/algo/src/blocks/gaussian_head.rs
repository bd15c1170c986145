//! From features to a diagonal normal distribution.

use rit_nn::{LayerNorm, LayoutBuilder, Linear, Tape, Var};

/// y = `out`(LeakyReLU(`norm`(`hidden`(x)))), i → r → 2l: the mean is y[..l], the variance max(e^y[l..], floor).
#[derive(Clone, Debug)]
pub struct GaussianHead {
    hidden: Linear,
    norm: LayerNorm,
    out: Linear,
    variance_floor: f32,
}

/// A distribution's numbers, (R, l) each.
#[derive(Clone, Copy, Debug)]
pub struct NormalVars {
    /// Its mean.
    pub mean: Var,
    /// Its variance.
    pub variance: Var,
}

impl GaussianHead {
    /// Declares `{name}.hidden`, `.norm` and `.out`.
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        inputs: usize,
        hidden_dim: usize,
        dim: usize,
        variance_floor: f32,
    ) -> Self {
        Self {
            hidden: Linear::new(layout, &format!("{name}.hidden"), inputs, hidden_dim),
            norm: LayerNorm::new(layout, &format!("{name}.norm"), hidden_dim),
            out: Linear::new(layout, &format!("{name}.out"), hidden_dim, 2 * dim),
            variance_floor,
        }
    }

    /// Of x in parts, (R, …) each, their columns together i.
    pub fn forward(&self, tape: &mut Tape<'_>, parts: &[Var]) -> NormalVars {
        let hidden = tape.linear_of(&self.hidden, parts, 0..0);
        let normed = tape.layer_norm(&self.norm, hidden);
        let active = tape.leaky_relu(normed);
        let y = tape.linear(&self.out, active);
        let dim = self.out.outputs / 2;
        let variance = tape.variance(y.columns(dim..2 * dim), self.variance_floor);
        for var in [hidden, normed, active] {
            tape.free(var);
        }
        NormalVars { mean: y.columns(0..dim), variance }
    }
}

#[cfg(test)]
mod tests;
