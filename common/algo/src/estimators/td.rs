//! The temporal-difference loss L_TD (paper, equation 6), as a pure function.

/// One filled step's target: r + γ (1 − terminated) Q̄_total(t + 1), in the unit of Q_total.
pub fn target(reward: f32, gamma: f32, terminated: bool, next_target_q_total: f32) -> f32 {
    if terminated { reward } else { reward + gamma * next_target_q_total }
}

/// (target − Q_total)² and its gradient by Q_total, divided by the number of filled steps.
pub fn squared_error(target: f32, q_total: f32, filled: usize) -> (f64, f32) {
    let error = f64::from(target) - f64::from(q_total);
    (error * error, (-2.0 * error / filled as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_by_hand() {
        assert_eq!(target(1.0, 0.5, false, 4.0), 3.0);
        assert_eq!(target(1.0, 0.5, true, 4.0), 1.0);
    }

    #[test]
    fn errors_by_hand() {
        assert_eq!(squared_error(3.0, 1.0, 4), (4.0, -1.0));
        assert_eq!(squared_error(1.0, 3.0, 2), (4.0, 2.0));
    }
}
