//! A linear layer whose weight another layer makes for each row (a hyper-network's layer).

use crate::{Accum, Linear, View, ViewMut, matmul, vectorized};

/// y = xᵀ W + `head bias`, where row by row W = `weight`(c) as (inputs, outputs): entry (i, o) is output
/// `i · outputs + o` of that layer. `bias`(c) adds the rest.
///
/// W itself is never made. With M the layer's weight read as (inputs, outputs · r) and b its bias read as (inputs,
/// outputs), y_o = Σ_i (x M)_{o,i} c_i + (x b)_o: the same numbers, and a row of r · outputs instead of W's inputs ·
/// outputs.
#[derive(Clone, Debug)]
pub struct Generated {
    /// r → inputs · outputs.
    weight: Linear,
    /// r → outputs.
    bias: Linear,
}

impl Generated {
    /// Of these two layers over c.
    pub fn new(weight: Linear, bias: Linear) -> Self {
        debug_assert!(weight.inputs == bias.inputs && weight.outputs.is_multiple_of(bias.outputs));
        Self { weight, bias }
    }

    /// Columns of x.
    pub fn inputs(&self) -> usize {
        self.weight.outputs / self.bias.outputs
    }

    /// Columns of y.
    pub fn outputs(&self) -> usize {
        self.bias.outputs
    }

    /// r: columns of c.
    pub fn codes(&self) -> usize {
        self.weight.inputs
    }

    /// The generating weight, (inputs, outputs · r).
    fn by_code<'a>(&self, params: &'a [f32]) -> View<'a> {
        View::dense(self.weight.weight(params).data, self.outputs() * self.codes())
    }

    /// The generating bias, (inputs, outputs).
    fn constant<'a>(&self, params: &'a [f32]) -> View<'a> {
        View::dense(self.weight.bias(params), self.outputs())
    }

    /// Writes `y` (rows, outputs) from `x` (rows, inputs) and `c` (rows, r). `mixed` (rows, outputs · r) is left for
    /// backward.
    pub fn forward(&self, params: &[f32], x: View<'_>, c: View<'_>, mixed: ViewMut<'_>, mut y: ViewMut<'_>) {
        let mut mixed = mixed;
        self.bias.forward(params, c, y.reborrow());
        matmul::x_w(x, self.constant(params), y.reborrow(), Accum::Add);
        matmul::x_w(x, self.by_code(params), mixed.reborrow(), Accum::Replace);
        contract(mixed.as_view(), c, y);
    }

    /// Takes `dy` (rows, outputs). Writes `dx` (rows, inputs) and `dc` (rows, r), leaves a gradient in `mixed`, and adds
    /// to those of the parameters.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        x: View<'_>,
        c: View<'_>,
        mut mixed: ViewMut<'_>,
        dy: View<'_>,
        mut dx: ViewMut<'_>,
        mut dc: ViewMut<'_>,
        grads: &mut [f32],
    ) {
        self.bias.backward(params, c, dy, Some(dc.reborrow()), grads);
        contract_backward(mixed.reborrow(), c, dy, dc);
        let d_mixed = mixed.as_view();
        matmul::x_wt(d_mixed, self.by_code(params), dx.reborrow(), Accum::Replace);
        matmul::x_wt(dy, self.constant(params), dx, Accum::Add);
        let (width, outputs) = (self.outputs() * self.codes(), self.outputs());
        let to = ViewMut::dense(self.weight.weight_mut(grads).data, width);
        matmul::dyt_x(x, d_mixed, to, Accum::Add);
        let to = ViewMut::dense(self.weight.bias_mut(grads), outputs);
        matmul::dyt_x(x, dy, to, Accum::Add);
    }
}

vectorized! {
    /// y_o += Σ mixed_{o,i} c_i, row by row.
    fn contract<'a>(mixed: View<'a>, c: View<'a>, y: ViewMut<'a>) {
        for row in 0..y.rows {
            let c = c.row(row);
            for (y, mixed) in y.row(row).iter_mut().zip(mixed.row(row).chunks_exact(c.len())) {
                *y += crate::math::dot(mixed, c);
            }
        }
    }
}

vectorized! {
    /// dc_i += Σ dy_o mixed_{o,i}, then mixed_{o,i} = dy_o c_i, row by row.
    fn contract_backward<'a>(mixed: ViewMut<'a>, c: View<'a>, dy: View<'a>, dc: ViewMut<'a>) {
        for row in 0..dy.rows {
            let (c, dc) = (c.row(row), dc.row(row));
            for (dy, mixed) in dy.row(row).iter().zip(mixed.row(row).chunks_exact_mut(c.len())) {
                for ((mixed, c), dc) in mixed.iter_mut().zip(c).zip(&mut *dc) {
                    *dc = dy.mul_add(*mixed, *dc);
                    *mixed = dy * c;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        LayoutBuilder,
        gradcheck::{check, noise},
    };

    const ROWS: usize = 3;
    const INPUTS: usize = 5;
    const OUTPUTS: usize = 4;
    const CODES: usize = 2;

    fn layer() -> (Generated, usize) {
        let mut layout = LayoutBuilder::default();
        let weight = Linear::new(&mut layout, "weight", CODES, INPUTS * OUTPUTS);
        let bias = Linear::new(&mut layout, "bias", CODES, OUTPUTS);
        (Generated::new(weight, bias), layout.len())
    }

    fn run(layer: &Generated, params: &[f32], x: &[f32], c: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut mixed, mut y) = (vec![9.0; ROWS * OUTPUTS * CODES], vec![9.0; ROWS * OUTPUTS]);
        let (x, c) = (View::dense(x, INPUTS), View::dense(c, CODES));
        let to = ViewMut::dense(&mut mixed, OUTPUTS * CODES);
        layer.forward(params, x, c, to, ViewMut::dense(&mut y, OUTPUTS));
        (y, mixed)
    }

    /// Every row's weight made as the definition says.
    #[test]
    fn is_a_linear_layer_of_its_own_for_each_row() {
        let (layer, len) = layer();
        let (params, x, c) = (noise(1, len), noise(2, ROWS * INPUTS), noise(3, ROWS * CODES));
        let (y, _) = run(&layer, &params, &x, &c);
        for row in 0..ROWS {
            let c = View::dense(&c[row * CODES..][..CODES], CODES);
            let (mut weight, mut bias) = (vec![0.0; INPUTS * OUTPUTS], vec![0.0; OUTPUTS]);
            layer.weight.forward(&params, c, ViewMut::dense(&mut weight, INPUTS * OUTPUTS));
            layer.bias.forward(&params, c, ViewMut::dense(&mut bias, OUTPUTS));
            for out in 0..OUTPUTS {
                let sum: f32 = (0..INPUTS).map(|i| x[row * INPUTS + i] * weight[i * OUTPUTS + out]).sum();
                assert!((y[row * OUTPUTS + out] - sum - bias[out]).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let (layer, len) = layer();
        let (params, x, c) = (noise(1, len), noise(2, ROWS * INPUTS), noise(3, ROWS * CODES));
        let to = noise(4, ROWS * OUTPUTS);
        let loss = |params: &[f32], x: &[f32], c: &[f32]| {
            run(&layer, params, x, c).0.iter().zip(&to).map(|(y, to)| f64::from(y * to)).sum()
        };
        let (_, mut mixed) = run(&layer, &params, &x, &c);
        let (mut dx, mut dc, mut grads) = (vec![9.0; x.len()], vec![9.0; c.len()], vec![0.0; len]);
        layer.backward(
            &params,
            View::dense(&x, INPUTS),
            View::dense(&c, CODES),
            ViewMut::dense(&mut mixed, OUTPUTS * CODES),
            View::dense(&to, OUTPUTS),
            ViewMut::dense(&mut dx, INPUTS),
            ViewMut::dense(&mut dc, CODES),
            &mut grads,
        );
        check("params", &params, &grads, |params| loss(params, &x, &c));
        check("x", &x, &dx, |x| loss(&params, x, &c));
        check("c", &c, &dc, |c| loss(&params, &x, c));
    }
}
