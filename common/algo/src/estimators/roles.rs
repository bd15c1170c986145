//! ROMA's loss on the roles: their entropy should be low, and their distribution predictable from the agent's history.
//!
//! L = softplus(w_H H + w_KL KL), H and KL means over all filled rows of Σ over dimensions.

use rit_nn::{activation, gaussian};

/// How much the two parts count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoleWeights {
    /// w_H.
    pub entropy: f32,
    /// w_KL.
    pub divergence: f32,
}

/// A diagonal normal distribution, one number of each for every dimension.
#[derive(Clone, Copy, Debug)]
pub struct Normal<'a> {
    /// Its mean.
    pub mean: &'a [f32],
    /// Its variance.
    pub variance: &'a [f32],
}

/// One row's Σ over dimensions of the role's entropy, and of its divergence from the posterior.
#[inline(always)]
pub fn row(role: Normal<'_>, posterior: Normal<'_>) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for dim in 0..role.mean.len() {
        let variance = role.variance[dim];
        let to = (posterior.mean[dim], posterior.variance[dim]);
        sums[0] += f64::from(gaussian::entropy(variance));
        sums[1] += f64::from(gaussian::divergence(role.mean[dim], variance, to));
    }
    sums
}

/// One row's gradients by the role's mean and variance and by the posterior's, each times `scale`: what the loss's
/// slope and the mean over rows make of it.
#[inline(always)]
pub fn row_gradients(
    role: Normal<'_>,
    posterior: Normal<'_>,
    weights: RoleWeights,
    scale: f32,
    d: [&mut [f32]; 4],
) {
    let [d_mean, d_variance, d_mean_to, d_variance_to] = d;
    let (of_entropy, of_divergence) = (scale * weights.entropy, scale * weights.divergence);
    for dim in 0..role.mean.len() {
        let variance = role.variance[dim];
        let to = (posterior.mean[dim], posterior.variance[dim]);
        let by = gaussian::divergence_gradients(role.mean[dim], variance, to);
        d_mean[dim] = of_divergence * by[0];
        d_variance[dim] = of_divergence * by[1] + of_entropy * gaussian::entropy_gradient(variance);
        d_mean_to[dim] = of_divergence * by[2];
        d_variance_to[dim] = of_divergence * by[3];
    }
}

/// The loss of these means over rows, and its slope by w_H H + w_KL KL.
pub fn loss(entropy: f64, divergence: f64, weights: RoleWeights) -> (f64, f64) {
    activation::softplus(f64::from(weights.entropy) * entropy + f64::from(weights.divergence) * divergence)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_nn::gradcheck::check;

    /// Two dimensions. Entropies 1.418939 and 1.418939 − ln 2; divergences ½ (ln 4 + 2/4 − 1) and 0.
    #[test]
    fn a_row_by_hand() {
        let role = Normal { mean: &[1.0, -0.5], variance: &[1.0, 0.25] };
        let posterior = Normal { mean: &[0.0, -0.5], variance: &[4.0, 0.25] };
        let [entropy, divergence] = row(role, posterior);
        assert!((entropy - 2.144_729_9).abs() < 1e-6, "{entropy}");
        assert!((divergence - 0.443_147_2).abs() < 1e-6, "{divergence}");
        let weights = RoleWeights { entropy: 0.5, divergence: 2.0 };
        let (loss, slope) = loss(entropy, divergence, weights);
        // softplus(1.958659).
        assert!((loss - 2.090_606_0).abs() < 1e-6 && (slope - 0.876_387_8).abs() < 1e-6, "{loss} {slope}");
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let weights = RoleWeights { entropy: 0.5, divergence: 2.0 };
        // Mean, variance, the posterior's mean and variance; three dimensions.
        let at = [0.3, -0.8, 0.5, 0.4, 1.1, 0.7, -0.2, 0.1, 0.6, 0.9, 0.5, 1.3];
        let normals = |x: &[f32]| -> [f64; 2] {
            let role = Normal { mean: &x[0..3], variance: &x[3..6] };
            row(role, Normal { mean: &x[6..9], variance: &x[9..12] })
        };
        let value = |x: &[f32]| {
            let [entropy, divergence] = normals(x);
            loss(entropy, divergence, weights).0
        };
        let [entropy, divergence] = normals(&at);
        let (_, slope) = loss(entropy, divergence, weights);
        let mut d = [0.0; 12];
        let (first, second) = d.split_at_mut(6);
        let ((a, b), (c, e)) = (first.split_at_mut(3), second.split_at_mut(3));
        let role = Normal { mean: &at[0..3], variance: &at[3..6] };
        let posterior = Normal { mean: &at[6..9], variance: &at[9..12] };
        row_gradients(role, posterior, weights, slope as f32, [a, b, c, e]);
        check("distributions", &at, &d, value);
    }
}
