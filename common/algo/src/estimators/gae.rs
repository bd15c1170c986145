//! Generalised advantage estimation (Schulman et al. 2016): how much better an action was than the value said.

/// A_t = δ_t + γ λ A_{t+1} with δ_t = r_t + γ V_{t+1} − V_t, A = 0 after the last step, of one episode. `rewards` and
/// `values` (T), in the rewards' unit; `bootstrap` is the value of the state after the last step: 0 where the episode
/// terminated.
pub fn advantages(rewards: &[f32], values: &[f64], bootstrap: f64, gamma: f64, lambda: f64) -> Vec<f64> {
    debug_assert_eq!(rewards.len(), values.len());
    let mut advantages = vec![0.0; rewards.len()];
    let (mut next_value, mut next_advantage) = (bootstrap, 0.0);
    for step in (0..rewards.len()).rev() {
        let delta = f64::from(rewards[step]) + gamma * next_value - values[step];
        next_advantage = delta + gamma * lambda * next_advantage;
        advantages[step] = next_advantage;
        next_value = values[step];
    }
    advantages
}

/// The λ-return G_t = A_t + V_t: what the value of a step is trained towards, in the rewards' unit. It is the mean of all
/// returns that stop after k steps and go on with V, each weighted by (1 − λ) λ^(k − 1).
pub fn lambda_return(advantage: f64, value: f64) -> f64 {
    advantage + value
}

/// Mean and population standard deviation of numbers; 0 and 0 of none.
pub fn mean_and_deviation(numbers: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = numbers.clone().count().max(1) as f64;
    let mean = numbers.clone().sum::<f64>() / count;
    let variance = numbers.map(|x| (x - mean) * (x - mean)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

/// An advantage in units of the batch's standard deviation, as PPO takes it.
pub fn normalized(advantage: f64, (mean, deviation): (f64, f64)) -> f64 {
    (advantage - mean) / (deviation + 1e-5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_by_hand() {
        // γ = 1/2, λ = 1/2, so γ λ = 1/4. Rewards 1, 2, 4; values 2, 4, 8.
        // Terminated: δ = 1 + 2 − 2, 2 + 4 − 4, 4 − 8 = 1, 2, −4; A = 1 + 1/4, 2 − 1, −4.
        assert_eq!(advantages(&[1.0, 2.0, 4.0], &[2.0, 4.0, 8.0], 0.0, 0.5, 0.5), [1.25, 1.0, -4.0]);
        // Truncated with V = 24 after it: the last δ is 4 + 12 − 8 = 8; A = 1 + 4/4, 2 + 8/4, 8.
        assert_eq!(advantages(&[1.0, 2.0, 4.0], &[2.0, 4.0, 8.0], 24.0, 0.5, 0.5), [2.0, 4.0, 8.0]);
        // λ = 0 is one step's error, λ = 1 the discounted return less the value.
        assert_eq!(advantages(&[1.0, 2.0], &[3.0, 4.0], 0.0, 0.5, 0.0), [0.0, -2.0]);
        assert_eq!(advantages(&[1.0, 2.0], &[3.0, 4.0], 0.0, 0.5, 1.0), [-1.0, -2.0]);
    }

    #[test]
    fn lambda_returns_by_hand() {
        // As above: γ = λ = 1/2, truncated with V = 24 after the last step. From the definition, backward:
        // G_t = r_t + γ ((1 − λ) V_{t+1} + λ G_{t+1}) = 4 + 12, 2 + (8 + 16)/4, 1 + (4 + 8)/4.
        let values = [2.0, 4.0, 8.0];
        let advantages = advantages(&[1.0, 2.0, 4.0], &values, 24.0, 0.5, 0.5);
        let returns: Vec<f64> = advantages.iter().zip(values).map(|(&a, v)| lambda_return(a, v)).collect();
        assert_eq!(returns, [4.0, 8.0, 16.0]);
    }

    #[test]
    fn normalisation_by_hand() {
        let of = |numbers: &[f64]| mean_and_deviation(numbers.iter().copied());
        assert_eq!(of(&[1.0, 3.0, 5.0, 7.0]), (4.0, 5.0_f64.sqrt()));
        assert_eq!(of(&[]), (0.0, 0.0));
        assert!((normalized(6.0, (4.0, 2.0)) - 2.0 / 2.00001).abs() < 1e-15);
        assert_eq!(normalized(4.0, (4.0, 0.0)), 0.0);
    }
}
