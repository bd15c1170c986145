//! Layer normalisation over a row's features: y = (x − mean) / √(variance + ε) ⊙ weight + bias.

use crate::{
    Initial, LayoutBuilder, View, ViewMut, for_lanes,
    math::{LANES, Lanes, each, load, store},
    vectorized,
};
use std::ops::Range;

/// ε, inside the root; the variance is the biased one. Both are PyTorch's.
const EPS: f32 = 1e-5;

/// A normalisation with a weight, 1 at first, and a bias, 0 at first, for each feature.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    weight: Range<usize>,
    bias: Range<usize>,
}

impl LayerNorm {
    /// Declares `{name}.weight` (dim) and `{name}.bias` (dim).
    pub fn new(layout: &mut LayoutBuilder, name: &str, dim: usize) -> Self {
        let weight = layout.add_as(format!("{name}.weight"), &[dim], Initial::Ones);
        let bias = layout.add_as(format!("{name}.bias"), &[dim], Initial::Zeros);
        Self { weight, bias }
    }

    /// Features of a row.
    pub fn dim(&self) -> usize {
        self.weight.len()
    }

    /// `x` (rows, dim), `y` (rows, dim). Each row's mean and 1/√(variance + ε) go to `moments` (rows, 2), for
    /// backward.
    pub fn forward(&self, params: &[f32], x: View<'_>, y: ViewMut<'_>, moments: &mut [f32]) {
        normalize(x, &params[self.weight.clone()], &params[self.bias.clone()], y, moments);
    }

    /// [`Self::backward_params`], then [`Self::backward_input`] where `dx` is asked for.
    pub fn backward(
        &self,
        params: &[f32],
        x: View<'_>,
        moments: &[f32],
        dy: View<'_>,
        dx: Option<ViewMut<'_>>,
        grads: &mut [f32],
    ) {
        self.backward_params(x, moments, dy, grads);
        if let Some(dx) = dx {
            self.backward_input(params, x, moments, dy, dx);
        }
    }

    /// Adds to the parameters' gradients. Takes what forward read, the moments it wrote, and `dy` (rows, dim).
    pub fn backward_params(&self, x: View<'_>, moments: &[f32], dy: View<'_>, grads: &mut [f32]) {
        // The weight and the bias lie side by side.
        let (d_weight, d_bias) = grads[self.weight.start..self.bias.end].split_at_mut(self.dim());
        gradients(x, moments, dy, d_weight, d_bias);
    }

    /// Writes `dx` (rows, dim), from the same.
    pub fn backward_input(
        &self,
        params: &[f32],
        x: View<'_>,
        moments: &[f32],
        dy: View<'_>,
        dx: ViewMut<'_>,
    ) {
        normalize_backward(x, &params[self.weight.clone()], moments, dy, dx);
    }
}

vectorized! {
    fn normalize<'a>(
        x: View<'a>,
        weight: &'a [f32],
        bias: &'a [f32],
        y: ViewMut<'a>,
        moments: &'a mut [f32],
    ) {
        let dim = x.cols;
        for (row, moments) in moments.chunks_exact_mut(2).enumerate() {
            let x = x.row(row);
            let mean = total(dim, |at, len| load(x, at, len)) / dim as f32;
            let squares = total(dim, |at, len| {
                let x = load(x, at, len);
                each(|lane| if lane < len { (x[lane] - mean) * (x[lane] - mean) } else { 0.0 })
            });
            let inverse = 1.0 / (squares / dim as f32 + EPS).sqrt();
            let y = y.row(row);
            for_lanes!(0..dim, |at, len| {
                let (x, w, b) = (load(x, at, len), load(weight, at, len), load(bias, at, len));
                let out = each(|lane| ((x[lane] - mean) * inverse).mul_add(w[lane], b[lane]));
                store(out, y, at, len);
            });
            moments.copy_from_slice(&[mean, inverse]);
        }
    }
}

vectorized! {
    /// With x̂ the normalised row and g = dy ⊙ weight: dx = (g − mean g − x̂ mean(g x̂)) / √(variance + ε).
    fn normalize_backward<'a>(
        x: View<'a>,
        weight: &'a [f32],
        moments: &'a [f32],
        dy: View<'a>,
        dx: ViewMut<'a>,
    ) {
        let dim = x.cols;
        for (row, moments) in moments.chunks_exact(2).enumerate() {
            let (mean, inverse) = (moments[0], moments[1]);
            let (x, dy, dx) = (x.row(row), dy.row(row), dx.row(row));
            let g = |at, len| {
                let (dy, w) = (load(dy, at, len), load(weight, at, len));
                each(|lane| dy[lane] * w[lane])
            };
            let g_mean = total(dim, g) / dim as f32;
            let along = total(dim, |at, len| {
                let (g, x) = (g(at, len), load(x, at, len));
                each(|lane| g[lane] * ((x[lane] - mean) * inverse))
            }) / dim as f32;
            for_lanes!(0..dim, |at, len| {
                let (g, x) = (g(at, len), load(x, at, len));
                let out = each(|lane| {
                    ((x[lane] - mean) * inverse).mul_add(-along, g[lane] - g_mean) * inverse
                });
                store(out, dx, at, len);
            });
        }
    }
}

vectorized! {
    /// d_weight += Σ dy ⊙ x̂; d_bias += Σ dy.
    fn gradients<'a>(
        x: View<'a>,
        moments: &'a [f32],
        dy: View<'a>,
        d_weight: &'a mut [f32],
        d_bias: &'a mut [f32],
    ) {
        for (row, moments) in moments.chunks_exact(2).enumerate() {
            let (mean, inverse) = (moments[0], moments[1]);
            let (x, dy) = (x.row(row), dy.row(row));
            for ((dw, db), (x, dy)) in d_weight.iter_mut().zip(&mut *d_bias).zip(x.iter().zip(dy)) {
                *dw = dy.mul_add((x - mean) * inverse, *dw);
                *db += dy;
            }
        }
    }
}

/// Σ of a function of each column, summed in sixteen lanes. Lanes beyond the last column must be 0.
#[inline(always)]
fn total(dim: usize, f: impl Fn(usize, usize) -> Lanes) -> f32 {
    let mut sums = [0.0; LANES];
    for_lanes!(0..dim, |at, len| {
        let x = f(at, len);
        sums = each(|lane| sums[lane] + x[lane]);
    });
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

    const DIM: usize = 21;
    const ROWS: usize = 4;

    fn norm() -> (LayerNorm, usize) {
        let mut layout = LayoutBuilder::default();
        // Something before it: offsets are not all zero.
        layout.add("before", &[3], 1.0);
        let norm = LayerNorm::new(&mut layout, "norm", DIM);
        (norm, layout.len())
    }

    fn run(norm: &LayerNorm, params: &[f32], x: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut y, mut moments) = (vec![0.0; x.len()], vec![0.0; 2 * x.len() / DIM]);
        norm.forward(params, View::dense(x, DIM), ViewMut::dense(&mut y, DIM), &mut moments);
        (y, moments)
    }

    /// The definition, in f64, one number at a time.
    fn reference(x: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f64> {
        let x: Vec<f64> = x.iter().map(|&x| f64::from(x)).collect();
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / x.len() as f64;
        let scaled = x.iter().map(|x| (x - mean) / (variance + 1e-5).sqrt());
        scaled.zip(weight.iter().zip(bias)).map(|(x, (&w, &b))| x * f64::from(w) + f64::from(b)).collect()
    }

    #[test]
    fn follows_the_definition_row_by_row() {
        let (norm, len) = norm();
        let (params, mut x) = (noise(1, len), noise(2, ROWS * DIM));
        // A row of equal numbers has no variance: the bias is what is left.
        x[DIM..2 * DIM].fill(3.0);
        let (y, _) = run(&norm, &params, &x);
        for (row, (x, y)) in x.chunks(DIM).zip(y.chunks(DIM)).enumerate() {
            let expected = reference(x, &params[norm.weight.clone()], &params[norm.bias.clone()]);
            for (y, expected) in y.iter().zip(expected) {
                assert!((f64::from(*y) - expected).abs() < 1e-6, "row {row}: {y} {expected}");
            }
        }
    }

    #[test]
    fn begins_as_plain_normalisation() {
        let mut layout = LayoutBuilder::default();
        LayerNorm::new(&mut layout, "norm", 2);
        let kinds: Vec<_> = layout.finish().params().iter().map(|param| param.initial).collect();
        assert_eq!(kinds, [Initial::Ones, Initial::Zeros]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let (norm, len) = norm();
        let (params, x, to) = (noise(1, len), noise(2, ROWS * DIM), noise(3, ROWS * DIM));
        let loss = |params: &[f32], x: &[f32]| {
            let (y, _) = run(&norm, params, x);
            y.iter().zip(&to).map(|(y, to)| f64::from(y * to)).sum()
        };
        let (_, moments) = run(&norm, &params, &x);
        let (mut grads, mut dx) = (vec![0.0; len], vec![0.0; x.len()]);
        let to_x = Some(ViewMut::dense(&mut dx, DIM));
        norm.backward(&params, View::dense(&x, DIM), &moments, View::dense(&to, DIM), to_x, &mut grads);
        check("params", &params, &grads, |params| loss(params, &x));
        check("x", &x, &dx, |x| loss(&params, x));
    }
}
