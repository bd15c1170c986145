//! Matrix products, the one place that speaks to faer. Layouts are stated here and nowhere else: everything
//! is row-major, weights are (out, in) as PyTorch stores them.
//!
//! A product's row depends on that row's input alone, not on how many rows are multiplied beside it: the
//! same state must get the same utilities whichever other environments an actor steps at the same time. faer
//! gives this from `least_rows` rows on; fewer get rows of zeros beside them.

use crate::{View, ViewMut};
use faer::{Par, linalg::matmul::matmul, mat};
use std::sync::atomic::{AtomicU64, Ordering};

/// What a product does with what stands at its destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Accum {
    /// Overwrites it; its old contents do not matter.
    Replace,
    /// Adds to it.
    Add,
}

impl From<Accum> for faer::Accum {
    fn from(accum: Accum) -> Self {
        match accum {
            Accum::Replace => Self::Replace,
            Accum::Add => Self::Add,
        }
    }
}

/// Multiplications and additions of all products so far, in this process.
static FLOPS: AtomicU64 = AtomicU64::new(0);

/// How many multiplications and additions all products of this process have taken: what benchmarks divide by
/// time.
pub fn flops() -> u64 {
    FLOPS.load(Ordering::Relaxed)
}

fn count(m: usize, k: usize, n: usize) {
    FLOPS.fetch_add(2 * (m * k * n) as u64, Ordering::Relaxed);
}

/// `y = x wᵀ`, or `y += x wᵀ`: a layer's forward. `x` (rows, in), `w` (out, in), `y` (rows, out).
pub fn x_wt(x: View<'_>, w: View<'_>, y: ViewMut<'_>, accum: Accum) {
    debug_assert_eq!((x.cols, x.rows, y.cols), (w.cols, y.rows, w.rows));
    let rows = least_rows(x.cols, w.rows);
    if (1..rows).contains(&x.rows) {
        return few_rows(x, y, accum, rows, |x, y| x_wt(x, w, y, accum));
    }
    count(x.rows, x.cols, w.rows);
    matmul(write(y), accum.into(), read(x), read(w).transpose(), 1.0_f32, Par::Seq);
}

/// `y = x w`, or `y += x w`: the forward of a layer whose weight stands the other way, `w` (in, out). `x` (rows, in),
/// `y` (rows, out).
pub fn x_w(x: View<'_>, w: View<'_>, y: ViewMut<'_>, accum: Accum) {
    let rows = least_rows(x.cols, w.cols);
    if (1..rows).contains(&x.rows) {
        return few_rows(x, y, accum, rows, |x, y| x_w(x, w, y, accum));
    }
    dy_w(x, w, y, accum);
}

/// `dx = dy w`, or `dx += dy w`: a layer's backward to its input. `dy` (rows, out), `dx` (rows, in).
pub fn dy_w(dy: View<'_>, w: View<'_>, dx: ViewMut<'_>, accum: Accum) {
    debug_assert_eq!((dy.cols, dy.rows, dx.cols), (w.rows, dx.rows, w.cols));
    count(dy.rows, dy.cols, w.cols);
    matmul(write(dx), accum.into(), read(dy), read(w), 1.0_f32, Par::Seq);
}

/// `dw = dyᵀ x`, or `dw += dyᵀ x`: a layer's backward to its weight. `dy` (rows, out), `x` (rows, in), `dw`
/// (out, in).
pub fn dyt_x(dy: View<'_>, x: View<'_>, dw: ViewMut<'_>, accum: Accum) {
    debug_assert_eq!((dy.rows, dy.cols, x.cols), (x.rows, dw.rows, dw.cols));
    count(dy.cols, dy.rows, x.cols);
    matmul(write(dw), accum.into(), read(dy).transpose(), read(x), 1.0_f32, Par::Seq);
}

/// The fewest rows whose product is summed as that of many rows is. One row goes through faer's matrix–vector path,
/// and products of no more than 4096 multiplications through one that sums inputs beyond 64 apart.
fn least_rows(inputs: usize, outputs: usize) -> usize {
    const SMALL: usize = 4096;
    const CHUNK: usize = 64;
    if inputs > CHUNK { (SMALL / (inputs * outputs.max(1)) + 1).max(2) } else { 2 }
}

/// A product with as many rows of zeros after those of `x` as make `rows`.
fn few_rows(
    x: View<'_>,
    mut y: ViewMut<'_>,
    accum: Accum,
    rows: usize,
    product: impl FnOnce(View<'_>, ViewMut<'_>),
) {
    let (mut padded, mut out) = (vec![0.0; rows * x.cols], vec![0.0; rows * y.cols]);
    for row in 0..x.rows {
        padded[row * x.cols..][..x.cols].copy_from_slice(x.row(row));
        if accum == Accum::Add {
            out[row * y.cols..][..y.cols].copy_from_slice(y.row(row));
        }
    }
    product(View::dense(&padded, x.cols), ViewMut::dense(&mut out, y.cols));
    for row in 0..x.rows {
        let of_row = row * y.cols..(row + 1) * y.cols;
        y.row(row).copy_from_slice(&out[of_row]);
    }
}

fn read(view: View<'_>) -> mat::MatRef<'_, f32> {
    mat::MatRef::from_row_major_slice_with_stride(
        extent(view.data, view.rows, view.cols, view.stride),
        view.rows,
        view.cols,
        view.stride,
    )
}

fn write(view: ViewMut<'_>) -> mat::MatMut<'_, f32> {
    let ViewMut { data, rows, cols, stride } = view;
    let len = extent(data, rows, cols, stride).len();
    // faer 0.24's `from_row_major_slice_with_stride_mut` swaps the strides and writes out of bounds; a
    // column-major matrix transposed is the same view.
    mat::MatMut::from_column_major_slice_with_stride_mut(&mut data[..len], cols, rows, stride).transpose_mut()
}

/// The elements from a matrix's first to its last.
fn extent(data: &[f32], rows: usize, cols: usize, stride: usize) -> &[f32] {
    if rows == 0 || cols == 0 { &[] } else { &data[..(rows - 1) * stride + cols] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::noise;

    #[test]
    fn products_are_what_the_loops_say() {
        let (rows, inputs, outputs) = (5, 3, 4);
        let (x, w, dy) = (noise(1, rows * inputs), noise(2, outputs * inputs), noise(3, rows * outputs));
        let (mut y, mut dx, mut dw) =
            (vec![9.0; rows * outputs], vec![1.0; rows * inputs], vec![1.0; outputs * inputs]);
        let view = |data, cols| View::dense(data, cols);
        x_wt(view(&x, inputs), view(&w, inputs), ViewMut::dense(&mut y, outputs), Accum::Replace);
        dy_w(view(&dy, outputs), view(&w, inputs), ViewMut::dense(&mut dx, inputs), Accum::Add);
        dyt_x(view(&dy, outputs), view(&x, inputs), ViewMut::dense(&mut dw, inputs), Accum::Add);
        let close = |a: f32, b: f32| assert!((a - b).abs() < 1e-5, "{a} {b}");
        for row in 0..rows {
            for out in 0..outputs {
                close(
                    y[row * outputs + out],
                    (0..inputs).map(|i| x[row * inputs + i] * w[out * inputs + i]).sum(),
                );
            }
            for i in 0..inputs {
                let sum: f32 = (0..outputs).map(|out| dy[row * outputs + out] * w[out * inputs + i]).sum();
                close(dx[row * inputs + i], 1.0 + sum);
            }
        }
        for out in 0..outputs {
            for i in 0..inputs {
                let sum: f32 = (0..rows).map(|row| dy[row * outputs + out] * x[row * inputs + i]).sum();
                close(dw[out * inputs + i], 1.0 + sum);
            }
        }
    }

    #[test]
    fn strided_views_leave_their_neighbours_alone() {
        let (x, w) = (noise(1, 6 * 5), noise(2, 2 * 3));
        let mut y = vec![7.0; 6 * 4];
        let x_columns = View::dense(&x, 5).columns(1..4);
        x_wt(x_columns, View::dense(&w, 3), ViewMut::dense(&mut y, 4).columns(1..3), Accum::Replace);
        for row in 0..6 {
            assert_eq!((y[row * 4], y[row * 4 + 3]), (7.0, 7.0));
            let expected: f32 = (0..3).map(|i| x[row * 5 + 1 + i] * w[i]).sum();
            assert!((y[row * 4 + 1] - expected).abs() < 1e-5);
        }
    }

    /// The property that acting for several environments at once rests on.
    #[test]
    fn a_row_does_not_depend_on_the_rows_beside_it() {
        for (inputs, outputs) in [
            (12, 64),
            (64, 64),
            (64, 128),
            (128, 192),
            (64, 192),
            (148, 64),
            (64, 4),
            (64, 5),
            (64, 6),
            (64, 20),
            (9, 8),
            (192, 192),
            (144, 64),
            // Few outputs of many inputs: small products.
            (77, 8),
            (128, 5),
            (200, 2),
            (300, 1),
            (65, 31),
            (65, 32),
        ] {
            // By themselves, and as columns of wider matrices, both of them.
            for (accum, margin) in
                [(Accum::Replace, 0), (Accum::Add, 0), (Accum::Replace, 20), (Accum::Add, 20)]
            {
                let width = inputs + margin;
                let (x, w) = (noise(1, 300 * width), noise(2, outputs * width));
                let start = noise(3, 300 * outputs);
                let across = noise(4, inputs * (outputs + margin));
                // One after the other: with the weight as (out, in) and as (in, out).
                let run = |first: usize, rows: usize| {
                    let mut y = start[first * outputs..(first + rows) * outputs].to_vec();
                    let mut y_across = y.clone();
                    let x = View::dense(&x[first * width..(first + rows) * width], width).columns(0..inputs);
                    let w = View::dense(&w, width).columns(margin..width);
                    x_wt(x, w, ViewMut::dense(&mut y, outputs), accum);
                    let w = View::dense(&across, outputs + margin).columns(margin..outputs + margin);
                    x_w(x, w, ViewMut::dense(&mut y_across, outputs), accum);
                    [y, y_across]
                };
                let all = run(0, 300);
                for (first, rows) in
                    (1..64).map(|rows| (rows % 7, rows)).chain([(3, 97), (0, 128), (50, 250)])
                {
                    for (part, all) in run(first, rows).iter().zip(&all) {
                        assert!(
                            part[..] == all[first * outputs..(first + rows) * outputs],
                            "{inputs} {outputs} {rows} {margin}"
                        );
                    }
                }
            }
        }
    }
}
