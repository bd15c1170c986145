//! The distribution over available actions that a row of logits means: π = softmax over what is available, 0
//! elsewhere.

use crate::{View, ViewMut, math, vectorized};

vectorized! {
    /// π and log π, and Σ −π log π of each row, from `logits` (rows, A) and `available` `[rows, A]`. What is not
    /// available gets π = 0 and log π = 0 and takes no part; a row without any action gets zeros.
    pub fn distribution<'a>(
        logits: View<'a>,
        available: &'a [u8],
        probabilities: ViewMut<'a>,
        log_probabilities: ViewMut<'a>,
        entropies: &'a mut [f32],
    ) {
        let n_actions = logits.cols;
        for (row, entropy) in entropies.iter_mut().enumerate() {
            let logits = logits.row(row);
            let available = &available[row * n_actions..][..n_actions];
            let (p, log_p) = (probabilities.row(row), log_probabilities.row(row));
            let mut largest = f32::NEG_INFINITY;
            for (&logit, &flag) in logits.iter().zip(available) {
                largest = if flag != 0 { largest.max(logit) } else { largest };
            }
            let mut total = 0.0;
            for ((p, &logit), &flag) in p.iter_mut().zip(logits).zip(available) {
                *p = if flag != 0 { math::exp_share(logit - largest) } else { 0.0 };
                total += *p;
            }
            *entropy = 0.0;
            // Once a row, and exact: log π of a sure action must not be rounded away from 0 by an approximation.
            let log_total = libm::logf(total);
            for (((p, log_p), &logit), &flag) in p.iter_mut().zip(log_p).zip(logits).zip(available) {
                (*p, *log_p) = if flag != 0 { (*p / total, logit - largest - log_total) } else { (0.0, 0.0) };
                *entropy -= *p * *log_p;
            }
        }
    }
}

vectorized! {
    /// The loss's gradient by the logits (rows, A), written: that by each row's log π of the action taken,
    /// `d_log_prob`, and that by its entropy H, `d_entropy`, together.
    /// d log π(a) / d logit = 1(a) − π; d H / d logit = −π (log π + H).
    pub fn distribution_backward<'a>(
        probabilities: View<'a>,
        log_probabilities: View<'a>,
        entropies: &'a [f32],
        actions: &'a [u8],
        d_log_prob: &'a [f32],
        d_entropy: &'a [f32],
        d_logits: ViewMut<'a>,
    ) {
        for (row, &entropy) in entropies.iter().enumerate() {
            let (p, log_p) = (probabilities.row(row), log_probabilities.row(row));
            let d_logits = d_logits.row(row);
            for ((d_logit, &p), &log_p) in d_logits.iter_mut().zip(p).zip(log_p) {
                *d_logit = -p * (d_log_prob[row] + d_entropy[row] * (log_p + entropy));
            }
            d_logits[usize::from(actions[row])] += d_log_prob[row];
        }
    }
}

/// The action that a number `u` in [0, 1) samples: the first available one, by number, whose cumulative probability
/// exceeds u; the last available one if rounding leaves none; 0 where none is available.
pub fn sample(logits: &[f32], available: &[u8], u: f32) -> u8 {
    let allowed = || logits.iter().zip(available).enumerate().filter(|(_, (_, flag))| **flag != 0);
    let largest = allowed().fold(f32::NEG_INFINITY, |largest, (_, (&logit, _))| largest.max(logit));
    let share = |logit: f32| math::exp_share(logit - largest);
    let total: f32 = allowed().map(|(_, (&logit, _))| share(logit)).sum();
    let (mut cumulative, mut last) = (0.0, 0);
    for (action, (&logit, _)) in allowed() {
        cumulative += share(logit) / total;
        last = action;
        if cumulative > u {
            break;
        }
    }
    last as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

    const A: usize = 4;
    const AVAILABLE: [u8; 16] = [1, 1, 1, 1, 0, 1, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0];

    fn run(logits: &[f32]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let rows = logits.len() / A;
        let (mut p, mut log_p, mut h) = (vec![0.0; logits.len()], vec![0.0; logits.len()], vec![0.0; rows]);
        let (p_view, log_p_view) = (ViewMut::dense(&mut p, A), ViewMut::dense(&mut log_p, A));
        distribution(View::dense(logits, A), &AVAILABLE[..rows * A], p_view, log_p_view, &mut h);
        (p, log_p, h)
    }

    #[test]
    fn distributions_by_hand() {
        let ln = f32::ln;
        // π = 1/8, 1/4, 1/2, 1/8; of the second row's two, 1/4 and 3/4; the third is sure; the fourth may do nothing.
        let rows = [[1.0, 2.0, 4.0, 1.0], [9.0, 1.0, 3.0, 9.0], [7.0, 8.0, 9.0, 9.0], [1.0, 1.0, 1.0, 1.0]];
        let (p, log_p, h) = run(&rows.concat().into_iter().map(ln).collect::<Vec<_>>());
        let expected =
            [[0.125, 0.25, 0.5, 0.125], [0.0, 0.25, 0.75, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]];
        for (at, &expected) in expected.as_flattened().iter().enumerate() {
            assert!((p[at] - expected).abs() < 1e-6, "{at}: {} {expected}", p[at]);
            let log = if expected > 0.0 { ln(expected) } else { 0.0 };
            assert!((log_p[at] - log).abs() < 1e-6, "{at}: {} {log}", log_p[at]);
        }
        // 1.75 ln 2 and ¼ ln 4 + ¾ ln 4/3.
        for (h, expected) in h.iter().zip([1.213_007_6, 0.562_335_1, 0.0, 0.0]) {
            assert!((h - expected).abs() < 1e-6, "{h} {expected}");
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let logits = noise(1, 3 * A);
        let (d_log_prob, d_entropy, actions) = (noise(2, 3), noise(3, 3), [1, 2, 0]);
        let loss = |logits: &[f32]| {
            let (_, log_p, h) = run(logits);
            let of_row = |row: usize| {
                d_log_prob[row] * log_p[row * A + usize::from(actions[row])] + d_entropy[row] * h[row]
            };
            (0..3).map(|row| f64::from(of_row(row))).sum()
        };
        let (p, log_p, h) = run(&logits);
        let mut d_logits = vec![0.0; logits.len()];
        distribution_backward(
            View::dense(&p, A),
            View::dense(&log_p, A),
            &h,
            &actions,
            &d_log_prob,
            &d_entropy,
            ViewMut::dense(&mut d_logits, A),
        );
        check("logits", &logits, &d_logits, loss);
        assert_eq!(d_logits[A], 0.0, "what is not available has no gradient");
    }

    #[test]
    fn samples_by_hand() {
        // π = 1/4, –, 1/2, 1/4.
        let logits = [1.0_f32, 100.0, 2.0, 1.0].map(f32::ln);
        let available = [1, 0, 1, 1];
        for (u, action) in [(0.0, 0), (0.2499, 0), (0.2501, 2), (0.7499, 2), (0.7501, 3), (0.999_999_94, 3)] {
            assert_eq!(sample(&logits, &available, u), action, "{u}");
        }
        // Rounding: what no cumulative probability exceeds is the last available one.
        assert_eq!(sample(&logits, &available, 1.5), 3);
        assert_eq!(sample(&logits, &[0, 0, 0, 1], 0.0), 3);
        assert_eq!(sample(&logits, &[0; 4], 0.5), 0);
    }

    #[test]
    fn samples_come_as_often_as_the_distribution_says() {
        let logits = [0.3, -1.0, 2.0, 0.0];
        let (p, _, _) = run(&logits);
        let mut counts = [0_u32; A];
        for step in 0..100_000 {
            counts[usize::from(sample(&logits, &[1; A], step as f32 / 100_000.0))] += 1;
        }
        for (count, p) in counts.iter().zip(p) {
            assert!((*count as f32 - 100_000.0 * p).abs() <= 2.0, "{count} {p}");
        }
    }
}
