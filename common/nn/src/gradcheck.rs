//! Numeric gradients, for tests of this crate and of those above it.

/// Deterministic noise in (−1, 1), away from zero so that ReLUs do not sit on their kink.
pub fn noise(seed: u64, len: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        // xorshift64*
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32 / (1_u64 << 24) as f32
    };
    (0..len)
        .map(|_| {
            let value = 2.0 * next() - 1.0;
            value + 0.02 * value.signum()
        })
        .collect()
}

/// Compares a gradient with central differences of the loss, element by element. A ReLU's kink inside the
/// larger step is most likely outside the smaller one, so an element may agree with either.
///
/// # Panics
/// Where they differ by more than 1 % of the largest element plus what f32 rounding explains.
pub fn check(name: &str, at: &[f32], gradient: &[f32], loss: impl Fn(&[f32]) -> f64) {
    const STEPS: [f32; 2] = [2e-3, 2e-4];
    assert_eq!(at.len(), gradient.len());
    assert!(gradient.iter().any(|&g| g != 0.0), "{name}: a gradient of zeros shows nothing");
    let largest = gradient.iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
    let scale = loss(at).abs().max(1.0) as f32;
    let mut moved = at.to_vec();
    for element in 0..at.len() {
        let mut difference = |step: f32| {
            moved[element] = at[element] + step;
            let above = loss(&moved);
            moved[element] = at[element] - step;
            let below = loss(&moved);
            moved[element] = at[element];
            ((above - below) / f64::from(2.0 * step)) as f32
        };
        let agrees = |numeric: f32, step: f32| {
            // Rounding of the loss, about 1e-7 of it, divided by the step.
            (numeric - gradient[element]).abs() <= 1e-2 * largest + 2e-7 * scale / step
        };
        let mut numeric = 0.0;
        let found = STEPS.into_iter().any(|step| {
            numeric = difference(step);
            agrees(numeric, step)
        });
        assert!(found, "{name}[{element}]: {} written, {numeric} measured", gradient[element]);
    }
}
