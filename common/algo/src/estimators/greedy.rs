//! The greedy action. Double Q-learning (van Hasselt et al. 2016) lets the online network choose it and the target network
//! say what it is worth.

/// The available action of the largest utility, the lowest index among equals; 0 where none is available. `utilities` and
/// `available` (A).
#[inline]
pub fn greedy_action(utilities: &[f32], available: &[u8]) -> u8 {
    let mut best: Option<(usize, f32)> = None;
    for (action, (&utility, &available)) in utilities.iter().zip(available).enumerate() {
        if available != 0 && best.is_none_or(|(_, most)| utility > most) {
            best = Some((action, utility));
        }
    }
    best.map_or(0, |(action, _)| action as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimators::td;

    #[test]
    fn the_greedy_action_is_the_lowest_of_the_best_available() {
        let least = f32::NEG_INFINITY;
        for (utilities, available, expected) in [
            ([1.0, 3.0, 2.0], [1, 1, 1], 1),
            // Ties go to the lowest.
            ([3.0, 3.0, 3.0], [1, 1, 1], 0),
            ([1.0, 3.0, 3.0], [1, 1, 1], 1),
            ([0.0, -0.0, 0.0], [0, 1, 1], 1),
            // What is not available is never chosen, however good.
            ([9.0, 1.0, 2.0], [0, 1, 1], 2),
            ([9.0, 1.0, 1.0], [0, 1, 1], 1),
            ([9.0, 8.0, -7.0], [0, 0, 1], 2),
            // However bad what is available is.
            ([0.0, least, least], [0, 1, 1], 1),
            ([0.0, f32::MIN, least], [0, 0, 1], 2),
            // Where nothing is.
            ([1.0, 3.0, 2.0], [0, 0, 0], 0),
        ] {
            assert_eq!(greedy_action(&utilities, &available), expected, "{utilities:?}, {available:?}");
        }
    }

    /// Of two networks that disagree, the online one chooses and the target one values: 1 of (1, 5, 7). With the largest of
    /// the target's own it would be 7.
    #[test]
    fn double_q_by_hand() {
        let (online, target, available) = ([4.0, 3.0, 9.0], [1.0, 5.0, 7.0], [1, 1, 0]);
        let chosen = usize::from(greedy_action(&online, &available));
        assert_eq!((chosen, target[chosen]), (0, 1.0));
        assert_eq!(td::target(2.0, 0.5, false, target[chosen]), 2.5);
    }
}
