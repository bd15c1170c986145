//! Shapley values of games of few players, by the definition: over all permutations (paper, section III-C).
//!
//! A coalition is a set of players, one bit each; a game is the value of every coalition, by that number.

/// Most players: 2ⁿ coalitions and n! permutations.
pub const PLAYERS_MAX: usize = 6;

/// Every permutation of 0 … n − 1, in lexicographic order.
pub fn permutations(n: usize) -> Vec<Vec<usize>> {
    if n == 0 {
        return vec![Vec::new()];
    }
    let shorter = permutations(n - 1);
    let begin_with = |first: usize| {
        shorter.iter().map(move |rest| {
            let rest = rest.iter().map(|&player| player + usize::from(player >= first));
            std::iter::once(first).chain(rest).collect()
        })
    };
    (0..n).flat_map(begin_with).collect()
}

/// Each player's marginal contribution v(S ∪ i) − v(S) where players come in this order, by player.
pub fn marginals(game: &[f64], order: &[usize]) -> Vec<f64> {
    let (mut coalition, mut marginals) = (0, vec![0.0; order.len()]);
    for &player in order {
        let with = coalition | 1 << player;
        marginals[player] = game[with] - game[coalition];
        coalition = with;
    }
    marginals
}

/// The Shapley values of a game of n players: mean marginal contributions over all permutations.
pub fn exact(game: &[f64], n: usize) -> Vec<f64> {
    let orders = permutations(n);
    let mut values = vec![0.0; n];
    for order in &orders {
        for (value, marginal) in values.iter_mut().zip(marginals(game, order)) {
            *value += marginal / orders.len() as f64;
        }
    }
    values
}

/// How much two players differ at most in what they add to a coalition of others: 0 for symmetric ones.
pub fn asymmetry(game: &[f64], a: usize, b: usize) -> f64 {
    let others = (0..game.len()).filter(|coalition| coalition & (1 << a | 1 << b) == 0);
    others.map(|coalition| (game[coalition | 1 << a] - game[coalition | 1 << b]).abs()).fold(0.0, f64::max)
}
