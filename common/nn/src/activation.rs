//! Activations over whole buffers, each with its backward.

use crate::{View, ViewMut, math, vectorized};

vectorized! {
    /// y = max(y, 0), in place.
    pub fn relu<'a>(y: ViewMut<'a>) {
        for row in 0..y.rows {
            for value in y.row(row) {
                *value = value.max(0.0);
            }
        }
    }
}

vectorized! {
    /// dy = dy where y > 0, else 0, in place; `y` is what [`relu`] left.
    pub fn relu_backward<'a>(y: View<'a>, dy: ViewMut<'a>) {
        debug_assert_eq!((y.rows, y.cols), (dy.rows, dy.cols));
        for row in 0..y.rows {
            for (dy, y) in dy.row(row).iter_mut().zip(y.row(row)) {
                *dy = if *y > 0.0 { *dy } else { 0.0 };
            }
        }
    }
}

/// ELU(x) = x where x > 0, else e^x − 1.
#[inline(always)]
pub fn elu(x: f32) -> f32 {
    if x > 0.0 { x } else { math::exp(x) - 1.0 }
}

/// dELU/dx from y = ELU(x): 1 where x > 0, else y + 1.
#[inline(always)]
pub fn elu_slope(y: f32) -> f32 {
    if y > 0.0 { 1.0 } else { y + 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relu_and_its_slope() {
        let mut y = [-1.0, 0.0, 2.0, -3.0, 4.0, 5.0];
        relu(ViewMut::dense(&mut y, 3));
        assert_eq!(y, [0.0, 0.0, 2.0, 0.0, 4.0, 5.0]);
        let mut dy = [1.0; 6];
        relu_backward(View::dense(&y, 3), ViewMut::dense(&mut dy, 3));
        assert_eq!(dy, [0.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
    }

    #[test]
    fn elu_and_its_slope() {
        assert_eq!((elu(2.0), elu_slope(elu(2.0))), (2.0, 1.0));
        assert!((elu(-1.0) + 0.632_120_6).abs() < 1e-6);
        assert!((elu_slope(elu(-1.0)) - 0.367_879_4).abs() < 1e-6);
    }
}
