//! Linear layers on the tape.

use super::{Backward, Gradient, Tape, Var};
use crate::{Accum, Linear, View, ViewMut, activation, linear, matmul};
use std::ops::Range;

impl Tape<'_> {
    /// y = x Wᵀ + b. `x` (rows, inputs), y (rows, outputs).
    pub fn linear(&mut self, layer: &Linear, x: Var) -> Var {
        self.linear_of(layer, &[x], 0..0)
    }

    /// y = ReLU(x Wᵀ + b). `x` (rows, inputs), y (rows, outputs).
    pub fn linear_relu(&mut self, layer: &Linear, x: Var) -> Var {
        self.linear_of(layer, &[x], 0..layer.outputs)
    }

    /// y = [x₁ ‖ x₂ ‖ …] Wᵀ + b with ReLU over the columns `relu`, a product for each part instead of a
    /// concatenation. Parts (rows, …), their columns together `inputs`; y (rows, outputs).
    pub fn linear_of(&mut self, layer: &Linear, parts: &[Var], relu: Range<usize>) -> Var {
        let y = self.take(parts[0].rows * layer.outputs);
        let y = self.push(y, layer.outputs);
        self.linear_into(layer, parts, relu, y);
        y
    }

    /// As [`Tape::linear_of`], into columns of a matrix that was [reserved](Tape::reserve).
    pub fn linear_into(&mut self, layer: &Linear, parts: &[Var], relu: Range<usize>, y: Var) {
        let params = self.params;
        self.write_into(y, |values, mut y, _| {
            products(layer, 0, params, parts, |part| values.view(part), y.reborrow());
            let bias = layer.bias(params);
            linear::add_row_relu(y.reborrow().columns(relu.clone()), &bias[relu.clone()]);
            for columns in [0..relu.start, relu.end..layer.outputs] {
                if !columns.is_empty() {
                    linear::add_row(y.reborrow().columns(columns.clone()), &bias[columns]);
                }
            }
        });
        let (layer, parts) = (layer.clone(), parts.to_vec());
        self.record(move |back| {
            let Some(mut dy) = back.gradients.take(y) else { return };
            if !relu.is_empty() {
                let of_y = back.values.view(y).columns(relu.clone());
                activation::relu_backward(of_y, dy.view_mut().columns(relu));
            }
            linear::add_column_sums(dy.view(), layer.bias_mut(back.grads));
            products_backward(&layer, 0, &parts, &dy, back);
            back.gradients.done(dy);
        });
    }

    /// y = [x₁ ‖ x₂ ‖ …] Wᵀ over those columns of W that begin with `first`, without the bias: one part's share where
    /// the other parts have other rows.
    pub fn product_of(&mut self, layer: &Linear, first: usize, parts: &[Var]) -> Var {
        let mut y = self.take(parts[0].rows * layer.outputs);
        let view = ViewMut::dense(&mut y, layer.outputs);
        products(layer, first, self.params, parts, |part| self.view(part), view);
        let y = self.push(y, layer.outputs);
        let (layer, parts) = (layer.clone(), parts.to_vec());
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            products_backward(&layer, first, &parts, &dy, back);
            back.gradients.done(dy);
        });
        y
    }
}

/// y = Σ parts, each by its columns of W, which begin with `first`.
fn products<'v>(
    layer: &Linear,
    first: usize,
    params: &[f32],
    parts: &[Var],
    view: impl Fn(Var) -> View<'v>,
    mut y: ViewMut<'_>,
) {
    let (mut first, mut accum) = (first, Accum::Replace);
    for &part in parts {
        let weight = layer.weight(params).columns(first..first + part.cols);
        matmul::x_wt(view(part), weight, y.reborrow(), accum);
        first += part.cols;
        accum = Accum::Add;
    }
}

/// Adds to W's gradient and contributes to those by the parts.
fn products_backward(layer: &Linear, first: usize, parts: &[Var], dy: &Gradient, back: &mut Backward<'_>) {
    let mut first = first;
    for &part in parts {
        let columns = first..first + part.cols;
        let of_weight = layer.weight_mut(back.grads).columns(columns.clone());
        matmul::dyt_x(dy.view(), back.values.view(part), of_weight, Accum::Add);
        if let Some(mut dx) = back.gradients.begin(part) {
            let accum = dx.accum;
            matmul::dy_w(dy.view(), layer.weight(back.params).columns(columns), dx.view_mut(), accum);
            back.gradients.end(dx);
        }
        first += part.cols;
    }
}

#[cfg(test)]
mod tests {
    use crate::{LayoutBuilder, Linear, gradcheck::check_operation};

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let first = Linear::new(&mut layout, "first", 5, 4);
        let second = Linear::new(&mut layout, "second", 3, 2);
        // Parts of several rows' widths, ReLU over some columns, columns of a value used twice and one not at all.
        check_operation(layout.len(), &[(6, 2), (6, 3)], |tape, x| {
            let y = tape.linear_of(&first, &[x[0], x[1]], 1..3);
            let out = tape.reserve(6, 4);
            tape.linear_into(&second, &[y.columns(0..3)], 0..0, out.columns(0..2));
            tape.linear_into(&second, &[y.columns(0..2), x[0].columns(1..2)], 0..2, out.columns(2..4));
            out
        });
    }

    #[test]
    fn one_parts_share_of_a_product() {
        let mut layout = LayoutBuilder::default();
        let layer = Linear::new(&mut layout, "layer", 5, 4);
        let bias_free = layout.len() - 4;
        check_operation(bias_free, &[(3, 2)], |tape, x| tape.product_of(&layer, 2, &[x[0]]));
    }
}
