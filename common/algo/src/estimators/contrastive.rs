//! The contrastive loss L_C (paper, equation 3) of one pair of task representations, as a pure function.

use rit_nn::{activation, math};

/// Binary cross-entropy of a logit, y = 1 where both representations come from the `same` task: softplus(l) − l y; and its
/// gradient by the logit, σ(l) − y, divided by the number of `pairs`.
pub fn cross_entropy(logit: f32, same: bool, pairs: usize) -> (f64, f32) {
    let (l, y) = (f64::from(logit), f64::from(u8::from(same)));
    // softplus(l) = max(l, 0) + softplus(−|l|). In this order, on which the last bit depends.
    let loss = l.max(0.0) - l * y + activation::softplus(-l.abs()).0;
    (loss, (math::sigmoid(logit) - y as f32) / pairs as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cross_entropies_by_hand() {
        // σ(ln 3) = 3/4: −ln(3/4) where the task is the same, −ln(1/4) where it is not.
        let logit = 3.0_f32.ln();
        for (logit, same, loss, slope) in [
            (0.0, true, 2.0_f64.ln(), -0.5),
            (0.0, false, 2.0_f64.ln(), 0.5),
            (logit, true, (4.0_f64 / 3.0).ln(), -0.25),
            (logit, false, 4.0_f64.ln(), 0.75),
            (-logit, false, (4.0_f64 / 3.0).ln(), 0.25),
        ] {
            for pairs in [1, 8] {
                let (ours, our_slope) = cross_entropy(logit, same, pairs);
                assert!((ours - loss).abs() < 1e-7, "{logit}, {same}: {ours}");
                assert!((our_slope * pairs as f32 - slope).abs() < 1e-6, "{logit}, {same}: {our_slope}");
            }
        }
    }

    /// No logit is too large for it.
    #[test]
    fn a_certain_discriminator_loses_its_logit_or_nothing() {
        assert_eq!(cross_entropy(1000.0, false, 1), (1000.0, 1.0));
        assert_eq!(cross_entropy(1000.0, true, 1), (0.0, 0.0));
        assert_eq!(cross_entropy(-1000.0, true, 1), (1000.0, -1.0));
    }

    /// The same bits on every machine: at one in ten of these a system's `exp` or `log1p` rounds otherwise.
    #[test]
    fn the_loss_is_not_the_systems() {
        for step in -200..=200_i16 {
            let logit = f32::from(step) * 0.01;
            for same in [true, false] {
                let (l, y) = (f64::from(logit), f64::from(u8::from(same)));
                let expected = l.max(0.0) - l * y + libm::log1p(libm::exp(-l.abs()));
                let (loss, _) = cross_entropy(logit, same, 1);
                assert_eq!(loss.to_bits(), expected.to_bits(), "{logit}, {same}: {loss} {expected}");
            }
        }
    }
}
