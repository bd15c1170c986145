//! The multi matrix game (paper, table I): four two-step games that look alike. The first step's reward tells
//! which game it is; the second pays +100 for the game's one optimal joint action and −12 otherwise.

use crate::{Environment, EnvironmentError, Spec, Step};
use rit_episode::{Action, End, Observation, Rng};

/// Reward of the first step, by game, whatever is played.
const FIRST_REWARD: [f32; MatrixGame::GAMES] = [-12.0, -6.0, 0.0, 6.0];
/// The joint action (A¹, A²) that wins the second step, by game; a¹ is 0.
const OPTIMAL: [[Action; 2]; MatrixGame::GAMES] = [[0, 2], [2, 2], [0, 1], [0, 0]];
/// Reward of the second step for any other joint action.
const MISS: f32 = -12.0;
/// Reward of the second step for the optimal joint action.
const WIN: f32 = 100.0;

/// One of the four games. Two agents, three actions, two steps.
#[derive(Debug)]
pub struct MatrixGame {
    game: usize,
    step: usize,
}

impl MatrixGame {
    /// Number of games.
    pub const GAMES: usize = 4;

    /// Features are the player's one-hot (2) and the step index (1).
    pub const SPEC: Spec = Spec {
        n_agents: 2,
        n_entities: 2,
        feature_dim: 3,
        n_actions: 3,
        steps_max: 2,
        has_wins: true,
        has_scenes: false,
        is_reproducible: true,
    };

    /// The game of this index, 0 to 3.
    ///
    /// # Panics
    /// When there is no such game.
    pub fn new(game: usize) -> Self {
        assert!(game < Self::GAMES, "there are {} games", Self::GAMES);
        Self { game, step: 0 }
    }
}

impl Environment for MatrixGame {
    fn spec(&self) -> Spec {
        Self::SPEC
    }

    fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
        self.step = 0;
        Ok(())
    }

    fn observe(&self, observation: &mut Observation) {
        for player in 0..2 {
            let features = observation.entity_mut(player);
            features[player] = 1.0;
            features[2] = self.step as f32;
        }
        observation.see_and_allow_all();
    }

    fn step(&mut self, actions: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        self.step += 1;
        if self.step == 1 {
            return Ok(Step { reward: FIRST_REWARD[self.game], shaping: 0.0, end: None, won: false });
        }
        let won = actions == OPTIMAL[self.game];
        Ok(Step { reward: if won { WIN } else { MISS }, shaping: 0.0, end: Some(End::Terminated), won })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_episode::{RunSeed, Stream};

    /// Table I as printed: rows A¹, columns A², first reward / second reward.
    const TABLE: [[[(f32, f32); 3]; 3]; 4] = {
        const fn row(first: f32, second: [f32; 3]) -> [(f32, f32); 3] {
            [(first, second[0]), (first, second[1]), (first, second[2])]
        }
        const NONE: [f32; 3] = [-12.0, -12.0, -12.0];
        [
            [row(-12.0, [-12.0, -12.0, 100.0]), row(-12.0, NONE), row(-12.0, NONE)],
            [row(-6.0, NONE), row(-6.0, NONE), row(-6.0, [-12.0, -12.0, 100.0])],
            [row(0.0, [-12.0, 100.0, -12.0]), row(0.0, NONE), row(0.0, NONE)],
            [row(6.0, [100.0, -12.0, -12.0]), row(6.0, NONE), row(6.0, NONE)],
        ]
    };

    #[test]
    fn pays_exactly_what_table_i_says() {
        let rng = &mut RunSeed(0).stream(Stream::Environment, 0);
        for (game, table) in TABLE.iter().enumerate() {
            let mut environment = MatrixGame::new(game);
            for first in 0..9_u8 {
                for second in 0..9_u8 {
                    environment.reset(rng).unwrap();
                    let [one, two] = [[first / 3, first % 3], [second / 3, second % 3]];
                    let step = environment.step(&one, rng).unwrap();
                    let expected = table[usize::from(one[0])][usize::from(one[1])].0;
                    assert_eq!(step, Step { reward: expected, shaping: 0.0, end: None, won: false });
                    let step = environment.step(&two, rng).unwrap();
                    let expected = table[usize::from(two[0])][usize::from(two[1])].1;
                    let won = expected == 100.0;
                    assert_eq!(
                        step,
                        Step { reward: expected, shaping: 0.0, end: Some(End::Terminated), won }
                    );
                }
            }
        }
    }

    #[test]
    fn all_games_look_alike() {
        let rng = &mut RunSeed(0).stream(Stream::Environment, 0);
        let seen = |game: usize, rng: &mut Rng| {
            let mut environment = MatrixGame::new(game);
            let mut observations = [Observation::new(2, 2, 3, 3), Observation::new(2, 2, 3, 3)];
            environment.reset(rng).unwrap();
            environment.observe(&mut observations[0]);
            environment.step(&[1, 2], rng).unwrap();
            environment.observe(&mut observations[1]);
            observations
        };
        let first = seen(0, rng);
        assert_eq!(first[0].entities(), [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert_eq!(first[1].entities(), [1.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
        for game in 1..MatrixGame::GAMES {
            assert_eq!(seen(game, rng), first);
        }
    }
}
