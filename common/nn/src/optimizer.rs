//! RMSprop and Adam as PyTorch defines them, and clipping by the global norm.

use crate::{math::normal, vectorized};

/// Which optimiser, with its own constants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OptimizerKind {
    /// v = α v + (1 − α) g²; p −= lr g / (√v + ε).
    RmsProp {
        /// α: how much of the last mean square stays.
        alpha: f32,
        /// ε, outside the root.
        eps: f32,
    },
    /// Adam with bias correction.
    Adam {
        /// β₁: how much of the last mean stays.
        beta1: f32,
        /// β₂: how much of the last mean square stays.
        beta2: f32,
        /// ε, outside the root.
        eps: f32,
    },
}

/// An optimiser with its moments, each one flat buffer like the parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Optimizer {
    /// Which.
    pub kind: OptimizerKind,
    /// Learning rate.
    pub lr: f32,
    /// Steps taken.
    pub steps: u64,
    /// Mean of gradients; empty for RMSprop.
    pub mean: Vec<f32>,
    /// Mean of squared gradients.
    pub mean_square: Vec<f32>,
}

impl Optimizer {
    /// An optimiser at its beginning for this many parameters.
    pub fn new(kind: OptimizerKind, lr: f32, len: usize) -> Self {
        let mean = match kind {
            OptimizerKind::RmsProp { .. } => Vec::new(),
            OptimizerKind::Adam { .. } => vec![0.0; len],
        };
        Self { kind, lr, steps: 0, mean, mean_square: vec![0.0; len] }
    }

    /// Takes one step along `scale · grads`.
    pub fn step(&mut self, params: &mut [f32], grads: &[f32], scale: f32) {
        self.steps += 1;
        match self.kind {
            OptimizerKind::RmsProp { alpha, eps } => {
                rmsprop(params, grads, &mut self.mean_square, [scale, self.lr, alpha, eps]);
            }
            OptimizerKind::Adam { beta1, beta2, eps } => {
                let rate = (f64::from(self.lr) / bias_correction(beta1, self.steps)) as f32;
                let root = bias_correction(beta2, self.steps).sqrt() as f32;
                let moments = (&mut self.mean[..], &mut self.mean_square[..]);
                adam(params, grads, moments, [scale, beta1, beta2, rate, root, eps]);
            }
        }
    }
}

/// 1 − βᵗ: how much of a moment's weight is real after so many steps. In f64, as PyTorch takes it, and not by the system's
/// library, whose last bit differs from one machine to the next.
fn bias_correction(beta: f32, steps: u64) -> f64 {
    1.0 - libm::pow(f64::from(beta), steps as f64)
}

vectorized! {
    fn rmsprop<'a>(
        params: &'a mut [f32],
        grads: &'a [f32],
        mean_square: &'a mut [f32],
        constants: [f32; 4],
    ) {
        let [scale, lr, alpha, eps] = constants;
        for ((p, g), v) in params.iter_mut().zip(grads).zip(mean_square) {
            let g = g * scale;
            *v = normal(alpha * *v + (1.0 - alpha) * g * g);
            *p -= lr * g / (v.sqrt() + eps);
        }
    }
}

vectorized! {
    fn adam<'a>(
        params: &'a mut [f32],
        grads: &'a [f32],
        moments: (&'a mut [f32], &'a mut [f32]),
        constants: [f32; 6],
    ) {
        let [scale, beta1, beta2, rate, root, eps] = constants;
        let moments = moments.0.iter_mut().zip(moments.1);
        for ((p, g), (m, v)) in params.iter_mut().zip(grads).zip(moments) {
            let g = g * scale;
            *m = normal(beta1 * *m + (1.0 - beta1) * g);
            *v = normal(beta2 * *v + (1.0 - beta2) * g * g);
            *p -= rate * *m / (v.sqrt() / root + eps);
        }
    }
}

vectorized! {
    /// Σ g², in f64: in lanes of a fixed number, so that the sum is the same on every instruction set.
    pub fn sum_of_squares<'a>(grads: &'a [f32]) -> f64 {
        let (chunks, rest) = grads.as_chunks::<8>();
        let mut sums = [0.0_f64; 8];
        for chunk in chunks {
            for (sum, &g) in sums.iter_mut().zip(chunk) {
                *sum += f64::from(g) * f64::from(g);
            }
        }
        let rest: f64 = rest.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
        sums.iter().sum::<f64>() + rest
    }
}

/// What to scale gradients with so that their norm is at most `limit`: PyTorch's min(1, limit / (‖g‖ + 1e-6)).
pub fn clip_scale(norm: f64, limit: f64) -> f32 {
    (limit / (norm + 1e-6)).min(1.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f32, b: f64) {
        assert!((f64::from(a) - b).abs() < 1e-6 * b.abs().max(1.0), "{a} {b}");
    }

    /// Two steps by hand, g = 0.5 then −1, p from 1.
    #[test]
    fn rmsprop_by_hand() {
        let kind = OptimizerKind::RmsProp { alpha: 0.9, eps: 0.01 };
        let (mut optimizer, mut p) = (Optimizer::new(kind, 0.1, 1), [1.0]);
        optimizer.step(&mut p, &[0.5], 1.0);
        // v = 0.025; p = 1 − 0.1 · 0.5 / (0.158114 + 0.01)
        close(p[0], 1.0 - 0.05 / (0.025_f64.sqrt() + 0.01));
        let before = f64::from(p[0]);
        optimizer.step(&mut p, &[-2.0], 0.5);
        // v = 0.0225 + 0.1 = 0.1225, root 0.35
        close(p[0], before + 0.1 / 0.36);
    }

    #[test]
    fn adam_by_hand() {
        let kind = OptimizerKind::Adam { beta1: 0.9, beta2: 0.99, eps: 1e-8 };
        let (mut optimizer, mut p) = (Optimizer::new(kind, 0.1, 1), [1.0]);
        optimizer.step(&mut p, &[0.5], 1.0);
        // Both corrections undo the first step's shares: p = 1 − 0.1 · 0.5 / 0.5.
        close(p[0], 0.9);
        optimizer.step(&mut p, &[-1.0], 1.0);
        let (m, v): (f64, f64) = (0.9 * 0.05 - 0.1, 0.99 * 0.0025 + 0.01);
        close(p[0], 0.9 - 0.1 * (m / 0.19) / (v / 0.0199).sqrt());
    }

    /// The same bits on every machine: these are steps at which a system's `pow` rounds otherwise.
    #[test]
    fn bias_corrections_are_not_the_systems() {
        for (beta, steps, bits) in [
            (0.9, 3, 0x3fd1_5810_a083_1254_u64),
            (0.95, 4, 0x3fc7_be42_b2b9_f540),
            (0.99, 9, 0x3fb6_23ba_7d90_b160),
            (0.999, 31, 0x3f9f_45a2_b96d_9800),
        ] {
            let correction = bias_correction(beta, steps);
            assert_eq!(correction.to_bits(), bits, "{beta}, {steps}: {correction}");
            assert!((correction - (1.0 - f64::from(beta).powf(steps as f64))).abs() < 1e-15);
        }
    }

    #[test]
    fn moments_without_gradients_end_at_zero() {
        let adam = OptimizerKind::Adam { beta1: 0.9, beta2: 0.99, eps: 1e-8 };
        for kind in [adam, OptimizerKind::RmsProp { alpha: 0.9, eps: 0.01 }] {
            let (mut optimizer, mut p) = (Optimizer::new(kind, 0.1, 1), [1.0]);
            optimizer.step(&mut p, &[0.5], 1.0);
            for _ in 0..20_000 {
                optimizer.step(&mut p, &[0.0], 1.0);
                let moments = [&optimizer.mean[..], &optimizer.mean_square].concat();
                assert!(!moments.iter().any(|moment| moment.is_subnormal()), "{moments:?}");
            }
            assert!(optimizer.mean.iter().chain(&optimizer.mean_square).all(|&moment| moment == 0.0));
        }
    }

    #[test]
    fn clipping_leaves_small_gradients_alone() {
        let grads: Vec<f32> = (0..19)
            .map(|i| {
                if i == 7 {
                    3.0
                } else if i == 18 {
                    4.0
                } else {
                    0.0
                }
            })
            .collect();
        assert_eq!(sum_of_squares(&grads), 25.0);
        assert_eq!(clip_scale(5.0, 10.0), 1.0);
        close(clip_scale(20.0, 10.0), 10.0 / 20.000_001);
    }
}
