//! What follows the attention in a transformer's block whose norms follow their sums ("post-norm").

use crate::Accum;
use crate::{
    Buffer, LayerNorm, LayoutBuilder, Linear, Scratch, View, ViewMut, activation, linear, matmul, vectorized,
};
use std::ops::Range;

/// With u the row that asked and a what its attention gave:
/// y = `attention_norm`(u + `attention_out`(a)), o = `feedforward_norm`(y + `feedforward_out`(ReLU(`feedforward_hidden`(y)))).
#[derive(Clone, Debug)]
pub struct PostNorm {
    /// a → h.
    attention_out: Linear,
    attention_norm: LayerNorm,
    /// h → f.
    feedforward_hidden: Linear,
    /// f → h.
    feedforward_out: Linear,
    feedforward_norm: LayerNorm,
}

/// What forward leaves for backward. With N rows:
#[derive(Debug)]
pub struct PostNormState {
    /// u + `attention_out`(a), `[N, h]`.
    attention_sum: Buffer,
    /// Moments of that, `[N, 2]`.
    attention_moments: Buffer,
    /// y, `[N, h]`.
    y: Buffer,
    /// ReLU's output, `[N, f]`.
    hidden: Buffer,
    /// y + `feedforward_out`(hidden), `[N, h]`.
    feedforward_sum: Buffer,
    /// Moments of that, `[N, 2]`.
    feedforward_moments: Buffer,
}

/// Gradients by parts of [`PostNormState`], which the parameters' gradients are made of in the end.
#[derive(Debug)]
pub struct PostNormGradients {
    attention_sum: Buffer,
    hidden: Buffer,
    feedforward_sum: Buffer,
}

impl PostNorm {
    /// Declares `{name}.attention_out`, `.attention_norm`, `.feedforward_hidden`, `.feedforward_out` and
    /// `.feedforward_norm`: `attention_dim` → `dim` → `feedforward_dim` → `dim`.
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        attention_dim: usize,
        dim: usize,
        feedforward_dim: usize,
    ) -> Self {
        Self {
            attention_out: Linear::new(layout, &format!("{name}.attention_out"), attention_dim, dim),
            attention_norm: LayerNorm::new(layout, &format!("{name}.attention_norm"), dim),
            feedforward_hidden: Linear::new(
                layout,
                &format!("{name}.feedforward_hidden"),
                dim,
                feedforward_dim,
            ),
            feedforward_out: Linear::new(layout, &format!("{name}.feedforward_out"), feedforward_dim, dim),
            feedforward_norm: LayerNorm::new(layout, &format!("{name}.feedforward_norm"), dim),
        }
    }

    /// h: columns of u and of the output.
    pub fn dim(&self) -> usize {
        self.attention_out.outputs
    }

    /// A state for so many rows, none of them written yet.
    pub fn state(&self, rows: usize, stock: &mut Scratch) -> PostNormState {
        let (h, f) = (self.dim(), self.feedforward_hidden.outputs);
        PostNormState {
            attention_sum: stock.take(rows * h),
            attention_moments: stock.take(rows * 2),
            y: stock.take(rows * h),
            hidden: stock.take(rows * f),
            feedforward_sum: stock.take(rows * h),
            feedforward_moments: stock.take(rows * 2),
        }
    }

    /// Writes `out` (rows, h) and rows `rows` of the state, from `u` (rows, h) and `attended` (rows, a).
    pub fn forward(
        &self,
        params: &[f32],
        rows: Range<usize>,
        u: View<'_>,
        attended: View<'_>,
        state: &mut PostNormState,
        out: ViewMut<'_>,
    ) {
        let (h, f) = (self.dim(), self.feedforward_hidden.outputs);
        let mut sum = of_rows(&mut state.attention_sum, &rows, h);
        matmul::x_wt(attended, self.attention_out.weight(params), sum.reborrow(), Accum::Replace);
        add_row_and(sum.reborrow(), self.attention_out.bias(params), u);
        let mut y = of_rows(&mut state.y, &rows, h);
        let moments = &mut state.attention_moments[2 * rows.start..2 * rows.end];
        self.attention_norm.forward(params, sum.as_view(), y.reborrow(), moments);

        let mut hidden = of_rows(&mut state.hidden, &rows, f);
        self.feedforward_hidden.forward_relu(params, y.as_view(), hidden.reborrow());
        let mut sum = of_rows(&mut state.feedforward_sum, &rows, h);
        let weight = self.feedforward_out.weight(params);
        matmul::x_wt(hidden.as_view(), weight, sum.reborrow(), Accum::Replace);
        add_row_and(sum.reborrow(), self.feedforward_out.bias(params), y.as_view());
        let moments = &mut state.feedforward_moments[2 * rows.start..2 * rows.end];
        self.feedforward_norm.forward(params, sum.as_view(), out, moments);
    }

    /// Room for the gradients of as many rows as forward has written.
    pub fn gradients(&self, state: &PostNormState, stock: &mut Scratch) -> PostNormGradients {
        PostNormGradients {
            attention_sum: stock.take(state.y.len()),
            hidden: stock.take(state.hidden.len()),
            feedforward_sum: stock.take(state.y.len()),
        }
    }

    /// Takes `d_out` (rows, h): the gradient by what forward made of rows `rows`. Writes `d_u` (rows, h), `d_attended`
    /// (rows, a) and the same rows of `d`, and adds to the gradients of the norms' parameters.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        rows: Range<usize>,
        state: &PostNormState,
        d: &mut PostNormGradients,
        d_out: View<'_>,
        mut d_u: ViewMut<'_>,
        d_attended: ViewMut<'_>,
        grads: &mut [f32],
    ) {
        let (h, f) = (self.dim(), self.feedforward_hidden.outputs);
        let sum = View::dense(&state.feedforward_sum, h).rows(rows.clone());
        let moments = &state.feedforward_moments[2 * rows.start..2 * rows.end];
        let mut d_sum = of_rows(&mut d.feedforward_sum, &rows, h);
        self.feedforward_norm.backward(params, sum, moments, d_out, Some(d_sum.reborrow()), grads);
        let d_sum = d_sum.as_view();
        let mut d_hidden = of_rows(&mut d.hidden, &rows, f);
        matmul::dy_w(d_sum, self.feedforward_out.weight(params), d_hidden.reborrow(), Accum::Replace);
        let hidden = View::dense(&state.hidden, f).rows(rows.clone());
        activation::relu_backward(hidden, d_hidden.reborrow());
        // `d_u` holds the gradient by y until the norm has been passed.
        let weight = self.feedforward_hidden.weight(params);
        matmul::dy_w(d_hidden.as_view(), weight, d_u.reborrow(), Accum::Replace);
        linear::add(d_u.reborrow(), d_sum);

        let sum = View::dense(&state.attention_sum, h).rows(rows.clone());
        let moments = &state.attention_moments[2 * rows.start..2 * rows.end];
        let mut d_sum = of_rows(&mut d.attention_sum, &rows, h);
        self.attention_norm.backward(params, sum, moments, d_u.as_view(), Some(d_sum.reborrow()), grads);
        let d_sum = d_sum.as_view();
        matmul::dy_w(d_sum, self.attention_out.weight(params), d_attended, Accum::Replace);
        for row in 0..d_sum.rows {
            d_u.row(row).copy_from_slice(d_sum.row(row));
        }
    }

    /// Adds to the gradients of the linear layers, all rows together, after [`PostNorm::backward`] of all of them.
    /// `attended` (N, a) is what forward read.
    pub fn backward_params(
        &self,
        attended: View<'_>,
        state: &PostNormState,
        d: &PostNormGradients,
        grads: &mut [f32],
    ) {
        let (h, f) = (self.dim(), self.feedforward_hidden.outputs);
        let d_sum = View::dense(&d.feedforward_sum, h);
        self.feedforward_out.backward_params(View::dense(&state.hidden, f), d_sum, grads);
        let (y, d_hidden) = (View::dense(&state.y, h), View::dense(&d.hidden, f));
        self.feedforward_hidden.backward_params(y, d_hidden, grads);
        self.attention_out.backward_params(attended, View::dense(&d.attention_sum, h), grads);
    }
}

impl PostNormState {
    /// Gives all buffers back.
    pub fn give(self, stock: &mut Scratch) {
        let Self { attention_sum, attention_moments, y, hidden, feedforward_sum, feedforward_moments } = self;
        for buffer in [attention_sum, attention_moments, y, hidden, feedforward_sum, feedforward_moments] {
            stock.give(buffer);
        }
    }
}

impl PostNormGradients {
    /// Gives all buffers back.
    pub fn give(self, stock: &mut Scratch) {
        for buffer in [self.attention_sum, self.hidden, self.feedforward_sum] {
            stock.give(buffer);
        }
    }
}

/// Some rows of a buffer.
fn of_rows<'a>(buffer: &'a mut Buffer, rows: &Range<usize>, width: usize) -> ViewMut<'a> {
    ViewMut::dense(&mut buffer[rows.start * width..rows.end * width], width)
}

vectorized! {
    /// y += the same row everywhere, and x.
    fn add_row_and<'a>(y: ViewMut<'a>, row: &'a [f32], x: View<'a>) {
        for at in 0..y.rows {
            for ((y, bias), x) in y.row(at).iter_mut().zip(row).zip(x.row(at)) {
                *y += bias + x;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

    const ROWS: usize = 5;
    const H: usize = 6;
    const A: usize = 4;
    const F: usize = 7;

    fn block() -> (PostNorm, usize) {
        let mut layout = LayoutBuilder::default();
        let block = PostNorm::new(&mut layout, "block", A, H, F);
        (block, layout.len())
    }

    /// In two parts, as a recurrence works on them.
    const PARTS: [Range<usize>; 2] = [0..2, 2..ROWS];

    fn run(block: &PostNorm, params: &[f32], u: &[f32], attended: &[f32]) -> (Vec<f32>, PostNormState) {
        let (mut out, mut state) = (vec![0.0; ROWS * H], block.state(ROWS, &mut Scratch::default()));
        for rows in PARTS {
            let (u, attended) = (View::dense(u, H), View::dense(attended, A));
            let (u, attended) = (u.rows(rows.clone()), attended.rows(rows.clone()));
            let out = ViewMut::dense(&mut out, H).rows(rows.clone());
            block.forward(params, rows, u, attended, &mut state, out);
        }
        (out, state)
    }

    /// The equations in f64, one row at a time.
    fn reference(params: &[f32], u: &[f32], attended: &[f32]) -> Vec<f64> {
        let mut rest = params.iter().map(|&x| f64::from(x));
        let mut next = |len: usize| rest.by_ref().take(len).collect::<Vec<f64>>();
        let linear = |w: &[f64], b: &[f64], x: &[f64]| -> Vec<f64> {
            let dot = |row: &[f64]| row.iter().zip(x).map(|(w, x)| w * x).sum::<f64>();
            w.chunks(x.len()).map(dot).zip(b).map(|(y, b)| y + b).collect()
        };
        let norm = |w: &[f64], b: &[f64], x: &[f64]| -> Vec<f64> {
            let mean = x.iter().sum::<f64>() / x.len() as f64;
            let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / x.len() as f64;
            let scaled = x.iter().map(|x| (x - mean) / (variance + 1e-5).sqrt());
            scaled.zip(w.iter().zip(b)).map(|(x, (w, b))| x * w + b).collect()
        };
        let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a + b).collect::<Vec<f64>>();
        let (w_out, b_out, w_norm, b_norm) = (next(H * A), next(H), next(H), next(H));
        let (w_hidden, b_hidden) = (next(F * H), next(F));
        let (w_back, b_back, w_last, b_last) = (next(H * F), next(H), next(H), next(H));
        let wide = |x: &[f32]| x.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>();
        let rows = u.chunks(H).zip(attended.chunks(A)).flat_map(|(u, attended)| {
            let y = norm(&w_norm, &b_norm, &sum(&wide(u), &linear(&w_out, &b_out, &wide(attended))));
            let hidden: Vec<f64> = linear(&w_hidden, &b_hidden, &y).iter().map(|x| x.max(0.0)).collect();
            norm(&w_last, &b_last, &sum(&y, &linear(&w_back, &b_back, &hidden)))
        });
        rows.collect()
    }

    #[test]
    fn follows_the_equations() {
        let (block, len) = block();
        let (params, u, attended) = (noise(1, len), noise(2, ROWS * H), noise(3, ROWS * A));
        let (out, _) = run(&block, &params, &u, &attended);
        for (a, b) in out.iter().zip(reference(&params, &u, &attended)) {
            assert!((f64::from(*a) - b).abs() < 1e-5, "{a} {b}");
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let (block, len) = block();
        let (params, u, attended) = (noise(1, len), noise(2, ROWS * H), noise(3, ROWS * A));
        let to = noise(4, ROWS * H);
        let loss = |params: &[f32], u: &[f32], attended: &[f32]| {
            let (out, _) = run(&block, params, u, attended);
            out.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
        };
        let (_, state) = run(&block, &params, &u, &attended);
        let (mut du, mut da) = (vec![9.0; u.len()], vec![9.0; attended.len()]);
        let mut grads = vec![0.0; len];
        let mut d = block.gradients(&state, &mut Scratch::default());
        for rows in PARTS {
            let d_out = View::dense(&to, H).rows(rows.clone());
            let d_u = ViewMut::dense(&mut du, H).rows(rows.clone());
            let d_attended = ViewMut::dense(&mut da, A).rows(rows.clone());
            block.backward(&params, rows, &state, &mut d, d_out, d_u, d_attended, &mut grads);
        }
        block.backward_params(View::dense(&attended, A), &state, &d, &mut grads);
        check("params", &params, &grads, |params| loss(params, &u, &attended));
        check("u", &u, &du, |u| loss(&params, u, &attended));
        check("attended", &attended, &da, |attended| loss(&params, &u, attended));
    }
}
