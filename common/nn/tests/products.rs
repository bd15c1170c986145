//! Products of matrices that are mostly zero, in blocks, against sums in f64: masks and ReLUs make such matrices, and
//! faer 0.24 has an open report of wrong parallel products of them (faer#273). Ours run on one thread.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests too")]

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rit_nn::{Accum, View, ViewMut, matmul};

/// A matrix inside a wider one.
struct Matrix {
    data: Vec<f32>,
    rows: usize,
    cols: usize,
    first: usize,
    stride: usize,
}

impl Matrix {
    /// Random numbers, of which this share of blocks is zero.
    fn new(rows: usize, cols: usize, zeros: f64, rng: &mut ChaCha8Rng) -> Self {
        let (first, behind) = (rng.random_range(0..20), rng.random_range(0..20));
        let stride = first + cols + behind;
        let data = (0..rows * stride).map(|_| rng.random_range(-1.0..1.0)).collect();
        let mut matrix = Self { data, rows, cols, first, stride };
        let (high, wide) = (rng.random_range(1..20), rng.random_range(1..20));
        for row in (0..rows).step_by(high) {
            for col in (0..cols).step_by(wide) {
                if rng.random_bool(zeros) {
                    for row in row..(row + high).min(rows) {
                        let at = row * stride + first;
                        matrix.data[at + col..at + (col + wide).min(cols)].fill(0.0);
                    }
                }
            }
        }
        matrix
    }

    fn view(&self) -> View<'_> {
        View { data: &self.data, rows: self.rows, cols: self.stride, stride: self.stride }
            .columns(self.first..self.first + self.cols)
    }

    fn view_mut(&mut self) -> ViewMut<'_> {
        ViewMut { data: &mut self.data, rows: self.rows, cols: self.stride, stride: self.stride }
            .columns(self.first..self.first + self.cols)
    }

    fn at(&self, row: usize, col: usize) -> f64 {
        f64::from(self.data[row * self.stride + self.first + col])
    }

    fn is_inside(&self, index: usize) -> bool {
        (self.first..self.first + self.cols).contains(&(index % self.stride))
    }
}

/// One of the three products, by our function and number by number.
#[derive(Clone, Copy, Debug)]
enum Product {
    XWt,
    DyW,
    DytX,
}

impl Product {
    /// Shapes (rows, cols) of both factors for an outcome (m, n) that sums over k.
    fn shapes(self, m: usize, k: usize, n: usize) -> [(usize, usize); 2] {
        match self {
            Self::XWt => [(m, k), (n, k)],
            Self::DyW => [(m, k), (k, n)],
            Self::DytX => [(k, m), (k, n)],
        }
    }

    fn run(self, a: View<'_>, b: View<'_>, out: ViewMut<'_>, accum: Accum) {
        match self {
            Self::XWt => matmul::x_wt(a, b, out, accum),
            Self::DyW => matmul::dy_w(a, b, out, accum),
            Self::DytX => matmul::dyt_x(a, b, out, accum),
        }
    }

    fn naive(self, a: &Matrix, b: &Matrix, row: usize, col: usize, k: usize) -> f64 {
        let term = |i| match self {
            Self::XWt => a.at(row, i) * b.at(col, i),
            Self::DyW => a.at(row, i) * b.at(i, col),
            Self::DytX => a.at(i, row) * b.at(i, col),
        };
        (0..k).map(term).sum()
    }
}

#[test]
fn products_of_matrices_with_blocks_of_zeros() {
    let rng = &mut ChaCha8Rng::seed_from_u64(273);
    for size in 1..=64 {
        for (axis, zeros) in
            [0.5, 0.8, 0.95].into_iter().flat_map(|zeros| (0..3).map(move |axis| (axis, zeros)))
        {
            // Every size on every axis, beside random ones.
            let mut sizes = [0; 3].map(|_| rng.random_range(1..=64));
            sizes[axis] = size;
            let [m, k, n] = sizes;
            for product in [Product::XWt, Product::DyW, Product::DytX] {
                for accum in [Accum::Replace, Accum::Add] {
                    compare(product, accum, (m, k, n), zeros, rng);
                }
            }
        }
    }
}

fn compare(
    product: Product,
    accum: Accum,
    (m, k, n): (usize, usize, usize),
    zeros: f64,
    rng: &mut ChaCha8Rng,
) {
    let [(a_rows, a_cols), (b_rows, b_cols)] = product.shapes(m, k, n);
    let (a, b) = (Matrix::new(a_rows, a_cols, zeros, rng), Matrix::new(b_rows, b_cols, zeros, rng));
    let mut out = Matrix::new(m, n, zeros, rng);
    let before = Matrix { data: out.data.clone(), ..out };
    if accum == Accum::Replace {
        // What stands there must not count, even if it is no number.
        for row in 0..m {
            out.view_mut().row(row).fill(f32::NAN);
        }
    }
    product.run(a.view(), b.view(), out.view_mut(), accum);
    for row in 0..m {
        for col in 0..n {
            let base = if accum == Accum::Add { before.at(row, col) } else { 0.0 };
            let expected = base + product.naive(&a, &b, row, col, k);
            let found = out.at(row, col);
            assert!(
                (found - expected).abs() <= 1e-5,
                "{product:?} {accum:?} {m}×{k}×{n}, zeros {zeros}: {found} and not {expected} at ({row}, {col})"
            );
        }
    }
    for (index, (after, before)) in out.data.iter().zip(&before.data).enumerate() {
        assert!(out.is_inside(index) || after == before, "{product:?}: the neighbours of {m}×{n} changed");
    }
}
