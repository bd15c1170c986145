//! Diagonal normal distributions, one dimension at a time: log-density, entropy, divergence, each with its gradients.

use crate::math;

/// ln 2π.
const LN_TAU: f32 = 1.837_877_1;

/// ln N(x; mean, variance).
#[inline(always)]
pub fn log_density(x: f32, mean: f32, variance: f32) -> f32 {
    let away = x - mean;
    -0.5 * (LN_TAU + math::ln(variance) + away * away / variance)
}

/// Gradients of [`log_density`] by x, mean and variance.
#[inline(always)]
pub fn log_density_gradients(x: f32, mean: f32, variance: f32) -> [f32; 3] {
    let away = (x - mean) / variance;
    [-away, away, 0.5 * (away * away - 1.0 / variance)]
}

/// H(N(·, variance)) = ½ ln(2πe · variance).
#[inline(always)]
pub fn entropy(variance: f32) -> f32 {
    0.5 * (1.0 + LN_TAU + math::ln(variance))
}

/// dH/dvariance.
#[inline(always)]
pub fn entropy_gradient(variance: f32) -> f32 {
    0.5 / variance
}

/// KL(N(mean, variance) ‖ N(to.0, to.1)) = ½ [ln(variance′ / variance) + (variance + (mean − mean′)²) / variance′ − 1].
#[inline(always)]
pub fn divergence(mean: f32, variance: f32, to: (f32, f32)) -> f32 {
    let away = mean - to.0;
    0.5 * (math::ln(to.1 / variance) + (variance + away * away) / to.1 - 1.0)
}

/// Gradients of [`divergence`] by mean, variance, mean′ and variance′.
#[inline(always)]
pub fn divergence_gradients(mean: f32, variance: f32, to: (f32, f32)) -> [f32; 4] {
    let away = mean - to.0;
    let d_mean = away / to.1;
    let d_variance_to = 0.5 * (1.0 - (variance + away * away) / to.1) / to.1;
    [d_mean, 0.5 * (1.0 / to.1 - 1.0 / variance), -d_mean, d_variance_to]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::check;

    #[test]
    fn values_by_hand() {
        let close = |a: f32, b: f64| assert!((f64::from(a) - b).abs() < 1e-6, "{a} {b}");
        // The standard normal density at 0 is 0.3989, at 1 0.2420; its entropy 1.4189.
        close(log_density(0.0, 0.0, 1.0), -0.918_938_533);
        close(log_density(1.0, 0.0, 1.0), -1.418_938_533);
        // Half as wide again: ln 2 less, four times the squares.
        close(log_density(2.0, 1.5, 0.25), -0.918_938_533 + 2.0_f64.ln() - 0.5);
        close(entropy(1.0), 1.418_938_533);
        close(entropy(0.25), 1.418_938_533 - 2.0_f64.ln());
        close(divergence(0.3, 0.7, (0.3, 0.7)), 0.0);
        // ½ [ln 4 + (1 + 1) / 4 − 1].
        close(divergence(1.0, 1.0, (0.0, 4.0)), 0.5 * (4.0_f64.ln() - 0.5));
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let at = [0.4, -0.3, 0.7];
        let of = log_density_gradients(at[0], at[1], at[2]);
        check("log density", &at, &of, |x| f64::from(log_density(x[0], x[1], x[2])));
        check("entropy", &[0.7], &[entropy_gradient(0.7)], |x| f64::from(entropy(x[0])));
        let at = [0.4, 0.6, -0.3, 0.9];
        let of = divergence_gradients(at[0], at[1], (at[2], at[3]));
        check("divergence", &at, &of, |x| f64::from(divergence(x[0], x[1], (x[2], x[3]))));
    }
}
