//! Shapley values of games that are solved by hand.

use proptest::prelude::*;
use rit_statistics::shapley::{asymmetry, exact, marginals, permutations};

fn near(found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?} is not {expected:?}");
}

#[test]
fn gloves_an_airport_and_a_vote() {
    // Players 0 and 1 hold a left glove each, 2 a right one; a pair is worth 1.
    let gloves: Vec<f64> = (0..8).map(|set| f64::from(u8::from(set & 4 != 0 && set & 3 != 0))).collect();
    near(&exact(&gloves, 3), &[1.0 / 6.0, 1.0 / 6.0, 4.0 / 6.0]);
    assert_eq!((asymmetry(&gloves, 0, 1), asymmetry(&gloves, 0, 2)), (0.0, 1.0));
    // A runway of 1, 2 or 3: each pays its share of the parts that it needs.
    let runway =
        |set: usize| (0..3).filter(move |player| set >> player & 1 == 1).map(|player| player as f64 + 1.0);
    let airport: Vec<f64> = (0..8).map(|set| runway(set).fold(0.0, f64::max)).collect();
    near(&exact(&airport, 3), &[1.0 / 3.0, 1.0 / 3.0 + 0.5, 1.0 / 3.0 + 0.5 + 1.0]);
    near(&marginals(&airport, &[1, 0, 2]), &[0.0, 2.0, 1.0]);
    // 4 votes of 6 decide; players have 3, 1, 1 and 1: three of four orders have the first decide.
    let votes = |set: usize| (0..4).map(|player| (set >> player & 1) * [3, 1, 1, 1][player]).sum::<usize>();
    let vote: Vec<f64> = (0..16).map(|set| f64::from(u8::from(votes(set) >= 4))).collect();
    near(&exact(&vote, 4), &[0.75, 1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0]);
}

#[test]
fn permutations_are_all_there() {
    assert_eq!(permutations(3), [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]);
    assert_eq!(permutations(6).len(), 720);
    assert_eq!(permutations(0).len(), 1);
}

proptest! {
    /// Efficiency: values sum to what the grand coalition has above the empty one. Linearity in the game.
    #[test]
    fn values_are_efficient_and_linear(game in prop::collection::vec(-10.0..10.0_f64, 32)) {
        let values = exact(&game, 5);
        prop_assert!((values.iter().sum::<f64>() - (game[31] - game[0])).abs() < 1e-9);
        let doubled: Vec<f64> = game.iter().map(|value| 2.0 * value + 7.0).collect();
        for (value, doubled) in values.iter().zip(exact(&doubled, 5)) {
            prop_assert!((2.0 * value - doubled).abs() < 1e-9);
        }
    }
}
