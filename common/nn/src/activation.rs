//! Activations over whole buffers, each with its backward.

use crate::{
    View, ViewMut, for_lanes,
    math::{self, each, load, store},
    vectorized,
};

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

/// LeakyReLU's slope below 0, PyTorch's.
const LEAK: f32 = 0.01;

vectorized! {
    /// y = LeakyReLU(y): y where it is positive, else 0.01 y; in place.
    pub fn leaky_relu<'a>(y: ViewMut<'a>) {
        for row in 0..y.rows {
            for value in y.row(row) {
                *value = if *value > 0.0 { *value } else { LEAK * *value };
            }
        }
    }
}

vectorized! {
    /// dy = dy where y > 0, else 0.01 dy, in place; `y` is what [`leaky_relu`] left.
    pub fn leaky_relu_backward<'a>(y: View<'a>, dy: ViewMut<'a>) {
        debug_assert_eq!((y.rows, y.cols), (dy.rows, dy.cols));
        for row in 0..y.rows {
            for (dy, y) in dy.row(row).iter_mut().zip(y.row(row)) {
                *dy = if *y > 0.0 { *dy } else { LEAK * *dy };
            }
        }
    }
}

/// softplus(x) = ln(1 + e^x), and its slope 1 / (1 + e^−x): exact however large x is. For single numbers, such as a
/// loss.
pub fn softplus(x: f64) -> (f64, f64) {
    let small = libm::exp(-x.abs());
    (x.max(0.0) + libm::log1p(small), if x > 0.0 { 1.0 / (1.0 + small) } else { small / (1.0 + small) })
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

vectorized! {
    /// y = GELU(x) = x Φ(x), Φ the normal distribution's: exact, by the error function. `x` and `y` (rows, columns).
    pub fn gelu<'a>(x: View<'a>, y: ViewMut<'a>) {
        debug_assert_eq!((x.rows, x.cols), (y.rows, y.cols));
        for row in 0..y.rows {
            let (x, y) = (x.row(row), y.row(row));
            for_lanes!(0..x.len(), |at, len| {
                let x = load(x, at, len);
                store(each(|lane| x[lane] * normal_cdf(x[lane])), y, at, len);
            });
        }
    }
}

vectorized! {
    /// dy = dy (Φ(x) + x φ(x)), in place; `x` is what [`gelu`] read.
    pub fn gelu_backward<'a>(x: View<'a>, dy: ViewMut<'a>) {
        debug_assert_eq!((x.rows, x.cols), (dy.rows, dy.cols));
        for row in 0..dy.rows {
            let (x, dy) = (x.row(row), dy.row(row));
            for_lanes!(0..x.len(), |at, len| {
                let (x, d) = (load(x, at, len), load(dy, at, len));
                store(each(|lane| d[lane] * gelu_slope(x[lane])), dy, at, len);
            });
        }
    }
}

/// Φ(x).
#[inline(always)]
fn normal_cdf(x: f32) -> f32 {
    0.5 * (1.0 + math::erf(x * std::f32::consts::FRAC_1_SQRT_2))
}

/// Φ(x) + x φ(x), φ(x) = e^(−x²/2) / √(2π).
#[inline(always)]
fn gelu_slope(x: f32) -> f32 {
    const INVERSE_ROOT_TAU: f32 = 0.398_942_3;
    normal_cdf(x) + x * (INVERSE_ROOT_TAU * math::exp(-0.5 * x * x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

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
    fn leaky_relu_and_its_slope() {
        let mut y = [-1.0, 0.0, 2.0, -300.0];
        leaky_relu(ViewMut::dense(&mut y, 2));
        assert_eq!(y, [-0.01, 0.0, 2.0, -3.0]);
        let mut dy = [1.0, 1.0, 5.0, 2.0];
        leaky_relu_backward(View::dense(&y, 2), ViewMut::dense(&mut dy, 2));
        assert_eq!(dy, [0.01, 0.01, 5.0, 0.02]);
    }

    #[test]
    fn softplus_and_its_slope() {
        for (x, value, slope) in [
            (0.0, std::f64::consts::LN_2, 0.5),
            (1.0, 1.313_261_687_518_222_8, 0.731_058_578_630_004_9),
            (-1.0, 0.313_261_687_518_222_8, 0.268_941_421_369_995_1),
            (2000.0, 2000.0, 1.0),
            (-2000.0, 0.0, 0.0),
        ] {
            let (v, s) = softplus(x);
            assert!((v - value).abs() < 1e-15 && (s - slope).abs() < 1e-15, "{x}: {v} {s}");
        }
    }

    #[test]
    fn elu_and_its_slope() {
        assert_eq!((elu(2.0), elu_slope(elu(2.0))), (2.0, 1.0));
        assert!((elu(-1.0) + 0.632_120_6).abs() < 1e-6);
        assert!((elu_slope(elu(-1.0)) - 0.367_879_4).abs() < 1e-6);
    }

    #[test]
    fn gelu_is_the_exact_one() {
        let x: Vec<f32> = (-600..=600).map(|step| step as f32 * 0.01).collect();
        let mut y = vec![0.0; x.len()];
        gelu(View::dense(&x, x.len()), ViewMut::dense(&mut y, x.len()));
        for (x, y) in x.iter().map(|&x| f64::from(x)).zip(y) {
            let exact = 0.5 * x * libm::erfc(-x / std::f64::consts::SQRT_2);
            assert!((f64::from(y) - exact).abs() < 1e-6, "{x}: {y} {exact}");
        }
    }

    #[test]
    fn gelu_gradients_are_the_numeric_ones() {
        let (x, to) = (noise(1, 2 * 21), noise(2, 2 * 21));
        let loss = |x: &[f32]| {
            let mut y = vec![0.0; x.len()];
            gelu(View::dense(x, 21), ViewMut::dense(&mut y, 21));
            y.iter().zip(&to).map(|(y, to)| f64::from(y * to)).sum()
        };
        let mut dx = to.clone();
        gelu_backward(View::dense(&x, 21), ViewMut::dense(&mut dx, 21));
        check("x", &x, &dx, loss);
    }
}
