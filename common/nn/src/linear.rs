//! A linear layer, y = x Wᵀ + b.

use crate::{Accum, LayoutBuilder, View, ViewMut, math, matmul, vectorized};
use std::ops::Range;

/// A linear layer, or several over the same input that lie side by side and are computed as one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Linear {
    weight: Range<usize>,
    bias: Range<usize>,
    /// Features of a row of x.
    pub inputs: usize,
    /// Features of a row of y.
    pub outputs: usize,
}

impl Linear {
    /// Declares `{name}.weight` (outputs, inputs) and `{name}.bias` (outputs).
    pub fn new(layout: &mut LayoutBuilder, name: &str, inputs: usize, outputs: usize) -> Self {
        Self::side_by_side(layout, inputs, &[(name, outputs)])
    }

    /// Declares `{name}.weight` alone: y = x Wᵀ, for [products](crate::tape::Tape::product_of).
    pub fn without_bias(layout: &mut LayoutBuilder, name: &str, inputs: usize, outputs: usize) -> Self {
        let bound = 1.0 / (inputs as f32).sqrt();
        let weight = layout.add(format!("{name}.weight"), &[outputs, inputs], bound);
        Self { bias: weight.end..weight.end, weight, inputs, outputs }
    }

    /// Declares several layers over one input. Their weights lie together, then their biases, so that one
    /// product computes them all; their outputs stand side by side in the order given.
    pub fn side_by_side(layout: &mut LayoutBuilder, inputs: usize, layers: &[(&str, usize)]) -> Self {
        let bound = 1.0 / (inputs as f32).sqrt();
        let weights = layout.len();
        for (name, outputs) in layers {
            layout.add(format!("{name}.weight"), &[*outputs, inputs], bound);
        }
        let biases = layout.len();
        for (name, outputs) in layers {
            layout.add(format!("{name}.bias"), &[*outputs], bound);
        }
        let outputs = layers.iter().map(|(_, outputs)| outputs).sum();
        Self { weight: weights..biases, bias: biases..layout.len(), inputs, outputs }
    }

    /// A layer whose parameters are declared already: `weight` (outputs, inputs), `bias` (outputs).
    pub fn at(weight: Range<usize>, bias: Range<usize>, inputs: usize) -> Self {
        let outputs = bias.len();
        debug_assert_eq!(weight.len(), inputs * outputs);
        Self { weight, bias, inputs, outputs }
    }

    /// The layer of some of its outputs alone.
    pub fn output_rows(&self, outputs: Range<usize>) -> Self {
        let weight =
            self.weight.start + outputs.start * self.inputs..self.weight.start + outputs.end * self.inputs;
        let bias = self.bias.start + outputs.start..self.bias.start + outputs.end;
        Self { weight, bias, inputs: self.inputs, outputs: outputs.len() }
    }

    /// The same layer in a buffer that begins this much later.
    pub(crate) fn moved_back(&self, by: usize) -> Self {
        let back = |range: &Range<usize>| range.start - by..range.end - by;
        Self { weight: back(&self.weight), bias: back(&self.bias), ..*self }
    }

    /// The weight, (outputs, inputs).
    pub fn weight<'a>(&self, params: &'a [f32]) -> View<'a> {
        View::dense(&params[self.weight.clone()], self.inputs)
    }

    /// The weight or its gradient to be written, (outputs, inputs).
    pub fn weight_mut<'a>(&self, params: &'a mut [f32]) -> ViewMut<'a> {
        ViewMut::dense(&mut params[self.weight.clone()], self.inputs)
    }

    /// The bias, (outputs).
    pub fn bias<'a>(&self, params: &'a [f32]) -> &'a [f32] {
        &params[self.bias.clone()]
    }

    /// The bias or its gradient to be written, (outputs).
    pub fn bias_mut<'a>(&self, params: &'a mut [f32]) -> &'a mut [f32] {
        &mut params[self.bias.clone()]
    }

    /// y = x Wᵀ + b. `x` (rows, inputs), `y` (rows, outputs).
    pub fn forward(&self, params: &[f32], x: View<'_>, mut y: ViewMut<'_>) {
        matmul::x_wt(x, self.weight(params), y.reborrow(), Accum::Replace);
        add_row(y, self.bias(params));
    }

    /// y = ReLU(x Wᵀ + b). `x` (rows, inputs), `y` (rows, outputs).
    pub fn forward_relu(&self, params: &[f32], x: View<'_>, mut y: ViewMut<'_>) {
        matmul::x_wt(x, self.weight(params), y.reborrow(), Accum::Replace);
        add_row_relu(y, self.bias(params));
    }

    /// Adds to the gradients of W and b; writes dx (rows, inputs) where asked for. `dy` (rows, outputs).
    pub fn backward(
        &self,
        params: &[f32],
        x: View<'_>,
        dy: View<'_>,
        dx: Option<ViewMut<'_>>,
        grads: &mut [f32],
    ) {
        self.backward_params(x, dy, grads);
        if let Some(dx) = dx {
            matmul::dy_w(dy, self.weight(params), dx, Accum::Replace);
        }
    }

    /// Adds to the gradients of W and b alone.
    pub fn backward_params(&self, x: View<'_>, dy: View<'_>, grads: &mut [f32]) {
        matmul::dyt_x(dy, x, self.weight_mut(grads), Accum::Add);
        add_column_sums(dy, self.bias_mut(grads));
    }
}

vectorized! {
    /// y += the same row everywhere.
    pub fn add_row<'a>(y: ViewMut<'a>, row: &'a [f32]) {
        for at in 0..y.rows {
            for (y, x) in y.row(at).iter_mut().zip(row) {
                *y += x;
            }
        }
    }
}

vectorized! {
    /// y = x.
    pub fn copy<'a>(y: ViewMut<'a>, x: View<'a>) {
        for row in 0..y.rows {
            y.row(row).copy_from_slice(x.row(row));
        }
    }
}

vectorized! {
    /// y = 0.
    pub fn zero<'a>(y: ViewMut<'a>) {
        for row in 0..y.rows {
            y.row(row).fill(0.0);
        }
    }
}

vectorized! {
    /// y += x.
    pub fn add<'a>(y: ViewMut<'a>, x: View<'a>) {
        for row in 0..y.rows {
            math::add_scaled(y.row(row), 1.0, x.row(row));
        }
    }
}

vectorized! {
    /// y = ReLU(y + the same row everywhere).
    pub fn add_row_relu<'a>(y: ViewMut<'a>, row: &'a [f32]) {
        for at in 0..y.rows {
            for (y, x) in y.row(at).iter_mut().zip(row) {
                *y = (*y + x).max(0.0);
            }
        }
    }
}

vectorized! {
    /// sums += Σ rows of dy: the gradient of a bias.
    pub fn add_column_sums<'a>(dy: View<'a>, sums: &'a mut [f32]) {
        for row in 0..dy.rows {
            math::add_scaled(sums, 1.0, dy.row(row));
        }
    }
}

vectorized! {
    /// sums += Σ weight · row of x: xᵀ weights.
    pub fn add_weighted_rows<'a>(sums: &'a mut [f32], weights: &'a [f32], x: View<'a>) {
        for (row, &weight) in weights.iter().enumerate() {
            math::add_scaled(sums, weight, x.row(row));
        }
    }
}

vectorized! {
    /// Each row of y += its weight · x: y += weights xᵀ.
    pub fn add_outer_product<'a>(y: ViewMut<'a>, weights: &'a [f32], x: &'a [f32]) {
        for (row, &weight) in weights.iter().enumerate() {
            math::add_scaled(y.row(row), weight, x);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        activation,
        gradcheck::{check, noise},
    };

    #[test]
    fn side_by_side_layers_are_the_layers() {
        let mut layout = LayoutBuilder::default();
        let both = Linear::side_by_side(&mut layout, 3, &[("a", 2), ("b", 4)]);
        let layout = layout.finish();
        let names: Vec<_> = layout.params().iter().map(|param| param.name.as_str()).collect();
        assert_eq!(names, ["a.weight", "b.weight", "a.bias", "b.bias"]);
        let params = noise(1, layout.len());
        let x = noise(2, 5 * 3);
        let mut y = vec![0.0; 5 * 6];
        both.forward(&params, View::dense(&x, 3), ViewMut::dense(&mut y, 6));
        for (param, columns) in [(0, 0..2), (1, 2..6)] {
            let weight = View::dense(&params[layout.params()[param].range.clone()], 3);
            let bias = &params[layout.params()[param + 2].range.clone()];
            for row in 0..5 {
                for (out, column) in columns.clone().enumerate() {
                    let expected =
                        bias[out] + (0..3).map(|i| x[row * 3 + i] * weight.row(out)[i]).sum::<f32>();
                    assert!((y[row * 6 + column] - expected).abs() < 1e-5);
                }
            }
        }
    }

    #[test]
    fn products_with_vectors_by_hand() {
        let x = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let mut sums = [10.0, 20.0, 30.0];
        add_weighted_rows(&mut sums, &[2.0, -1.0], View::dense(&x, 3));
        assert_eq!(sums, [8.0, 19.0, 30.0]);
        let mut y = [1.0; 4];
        add_outer_product(ViewMut::dense(&mut y, 2), &[2.0, -1.0], &[3.0, 5.0]);
        assert_eq!(y, [7.0, 11.0, -2.0, -4.0]);
    }

    #[test]
    fn a_part_of_a_layer_makes_a_part_of_its_outputs() {
        let mut layout = LayoutBuilder::default();
        let layer = Linear::side_by_side(&mut layout, 3, &[("a", 2), ("b", 4)]);
        let params = noise(1, layout.len());
        let x = noise(2, 5 * 3);
        let (mut all, mut some) = (vec![0.0; 5 * 6], vec![0.0; 5 * 3]);
        layer.forward(&params, View::dense(&x, 3), ViewMut::dense(&mut all, 6));
        layer.output_rows(1..4).forward(&params, View::dense(&x, 3), ViewMut::dense(&mut some, 3));
        for row in 0..5 {
            assert_eq!(some[row * 3..][..3], all[row * 6 + 1..][..3]);
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let linear = Linear::new(&mut layout, "l", 3, 4);
        let (params, x, to) = (noise(1, layout.len()), noise(2, 5 * 3), noise(3, 5 * 4));
        let loss = |params: &[f32], x: &[f32]| {
            let mut y = vec![0.0; 5 * 4];
            linear.forward_relu(params, View::dense(x, 3), ViewMut::dense(&mut y, 4));
            y.iter().zip(&to).map(|(y, to)| f64::from(y * to)).sum()
        };
        let mut y = vec![0.0; 5 * 4];
        linear.forward_relu(&params, View::dense(&x, 3), ViewMut::dense(&mut y, 4));
        let mut dy = to.clone();
        activation::relu_backward(View::dense(&y, 4), ViewMut::dense(&mut dy, 4));
        let (mut grads, mut dx) = (vec![0.0; params.len()], vec![0.0; x.len()]);
        let dx_view = Some(ViewMut::dense(&mut dx, 3));
        linear.backward(&params, View::dense(&x, 3), View::dense(&dy, 4), dx_view, &mut grads);
        check("params", &params, &grads, |params| loss(params, &x));
        check("x", &x, &dx, |x| loss(&params, x));
    }
}
