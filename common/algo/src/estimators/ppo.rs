//! Proximal policy optimisation (Schulman et al. 2017): the clipped surrogate objective of one choice.

/// One choice's part of the policy loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surrogate {
    /// −min(ρ Â, clip(ρ, 1 − c, 1 + c) Â).
    pub loss: f64,
    /// Its derivative by log π.
    pub slope: f64,
    /// ρ = π / π_old.
    pub ratio: f64,
    /// Whether ρ lies outside 1 ± c.
    pub clipped: bool,
    /// (ρ − 1) − log ρ: an estimate of the divergence KL(π_old ‖ π) that is never negative.
    pub kl: f64,
}

/// The surrogate of a choice with probability e^`log_prob`, e^`old_log_prob` when it was made.
pub fn surrogate(log_prob: f32, old_log_prob: f32, advantage: f32, clip: f64) -> Surrogate {
    let (log_ratio, advantage) = (f64::from(log_prob) - f64::from(old_log_prob), f64::from(advantage));
    // Rust's own e^x differs from machine to machine.
    let ratio = libm::exp(log_ratio);
    let (plain, limited) = (ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
    Surrogate {
        loss: -plain.min(limited),
        slope: if plain <= limited { -plain } else { 0.0 },
        ratio,
        clipped: (ratio - 1.0).abs() > clip,
        kl: ratio - 1.0 - log_ratio,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surrogates_by_hand() {
        // Probability ratios 1, 2 and 1/2 with c = 0.2: on the side where more would be gained, the gain ends.
        let cases = [
            // log₂ ρ, Â, loss, slope, clipped
            (0.0, 3.0, -3.0, -3.0, false),
            (0.0, -3.0, 3.0, 3.0, false),
            (1.0, 3.0, -3.6, 0.0, true),
            (1.0, -3.0, 6.0, 6.0, true),
            (-1.0, 3.0, -1.5, -1.5, true),
            (-1.0, -3.0, 2.4, 0.0, true),
        ];
        for (log2, advantage, loss, slope, clipped) in cases {
            let log_ratio = log2 * std::f32::consts::LN_2;
            let found = surrogate(log_ratio - 1.0, -1.0, advantage, 0.2);
            let close = |a: f64, b: f64| (a - b).abs() < 1e-6;
            assert!(close(found.loss, loss) && close(found.slope, slope), "{log2} {advantage}: {found:?}");
            assert_eq!(found.clipped, clipped);
            let ratio = 2_f64.powf(f64::from(log2));
            assert!(close(found.ratio, ratio) && close(found.kl, ratio - 1.0 - ratio.ln()));
        }
    }

    #[test]
    fn the_slope_is_the_numeric_one() {
        for (log_prob, advantage) in [(-0.9, 0.7), (-0.5, -0.7), (-1.4, 0.7), (-1.05, -2.0)] {
            let loss = |log_prob| surrogate(log_prob, -1.0, advantage, 0.2).loss;
            let numeric = (loss(log_prob + 1e-3) - loss(log_prob - 1e-3)) / 2e-3;
            let slope = surrogate(log_prob, -1.0, advantage, 0.2).slope;
            assert!((slope - numeric).abs() < 1e-3, "{log_prob} {advantage}: {slope} {numeric}");
        }
    }
}
