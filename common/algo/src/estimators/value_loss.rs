//! The clipped value loss with Huber's function, of one value.

/// H(x) = x²/2 for |x| ≤ δ, δ (|x| − δ/2) beyond, and its derivative.
pub fn huber(x: f64, delta: f64) -> (f64, f64) {
    if x.abs() <= delta { (0.5 * x * x, x) } else { (delta * (x.abs() - 0.5 * delta), delta * x.signum()) }
}

/// max(H(y − v), H(y − v_old − clip(v − v_old, −c, c))) and its derivative by v: a value does not gain by going further
/// than c from what it was.
pub fn clipped(value: f32, old_value: f32, target: f32, clip: f64, delta: f64) -> (f64, f64) {
    let [value, old_value, target] = [value, old_value, target].map(f64::from);
    let (plain, slope) = huber(target - value, delta);
    let limited = huber(target - old_value - (value - old_value).clamp(-clip, clip), delta).0;
    // Within the clip both are the same; beyond it the limited one does not depend on v.
    if plain >= limited || (value - old_value).abs() <= clip { (plain, -slope) } else { (limited, 0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn huber_by_hand() {
        for (x, loss, slope) in
            [(0.0, 0.0, 0.0), (1.0, 0.5, 1.0), (-2.0, 2.0, -2.0), (3.0, 4.0, 2.0), (-3.0, 4.0, -2.0)]
        {
            assert_eq!(huber(x, 2.0), (loss, slope), "{x}");
        }
    }

    #[test]
    fn clipped_losses_by_hand() {
        let cases = [
            // v, v_old, y, loss, slope; c = 0.5, δ = 2
            (1.25, 1.0, 2.0, 0.28125, -0.75),
            // Gone 1 towards the target, 0.5 of it counts.
            (2.0, 1.0, 3.0, 1.125, 0.0),
            // Gone away from it: all counts.
            (0.0, 1.0, 1.5, 1.125, -1.5),
            // Beyond δ: 2 (4 − 1).
            (0.0, 0.0, 4.0, 6.0, -2.0),
            (0.0, 0.0, -4.0, 6.0, 2.0),
        ];
        for (value, old_value, target, loss, slope) in cases {
            assert_eq!(clipped(value, old_value, target, 0.5, 2.0), (loss, slope), "{value} {old_value}");
        }
    }
}
