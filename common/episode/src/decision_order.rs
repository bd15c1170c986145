//! The decision order I: which real agent decides first, second, … in an episode (paper, section IV-A).

use crate::Rng;
use rand::seq::SliceRandom as _;

/// A fresh uniform permutation of the real agents: `order[k]` is the agent that decides k-th.
pub fn draw(n_agents: usize, rng: &mut Rng) -> Vec<u8> {
    let mut order = identity(n_agents);
    order.shuffle(rng);
    order
}

/// The order without permutation: agent k decides k-th (the paper's RIT-No-Random-Permutation).
///
/// # Panics
/// With more agents than [`crate::Dims::ENTITIES_LIMIT`].
pub fn identity(n_agents: usize) -> Vec<u8> {
    assert!(n_agents <= crate::Dims::ENTITIES_LIMIT, "an agent's index is one byte");
    (0..n_agents).map(|agent| agent as u8).collect()
}

/// Whether this is a permutation of `0..order.len()`.
pub fn is_permutation(order: &[u8]) -> bool {
    let mut seen = [false; 256];
    order.iter().all(|&agent| {
        usize::from(agent) < order.len() && !std::mem::replace(&mut seen[usize::from(agent)], true)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RunSeed, Stream};
    use std::collections::HashMap;

    #[test]
    fn all_orders_come_equally_often() {
        let mut counts: HashMap<Vec<u8>, u32> = HashMap::new();
        for episode in 0..6000 {
            let order = draw(3, &mut RunSeed(1).stream(Stream::DecisionOrder, episode));
            assert!(is_permutation(&order));
            *counts.entry(order).or_default() += 1;
        }
        assert_eq!(counts.len(), 6);
        // 1000 expected of each, standard deviation 29: five of them either way.
        assert!(counts.values().all(|&count| (855..1145).contains(&count)), "{counts:?}");
    }

    #[test]
    fn tells_permutations_from_other_lists() {
        assert!(is_permutation(&[2, 0, 1]));
        assert!(is_permutation(&[]));
        assert!(!is_permutation(&[0, 0]));
        assert!(!is_permutation(&[1, 2]));
    }
}
