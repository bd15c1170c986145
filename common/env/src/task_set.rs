//! Which tasks belong together: training tasks to learn from, testing tasks for zero-shot evaluation.

use crate::{Environment, matrix_game::MatrixGame};
use rit_episode::{Dims, wire::TaskSize};
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// The task sets of the paper's section VI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TaskSet {
    /// Four two-step matrix games (table I).
    MatrixGame,
}

/// Tasks are trained on or kept for zero-shot evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Split {
    /// Tasks to learn from.
    Training,
    /// Tasks never seen in training.
    Testing,
}

/// One task of a task set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Task {
    /// One of the four matrix games, 0 to 3.
    MatrixGame {
        /// Which.
        game: usize,
    },
}

/// A name that means nothing, with those that do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown {what} {name:?}; known: {}", known.join(", "))]
pub struct UnknownName {
    /// What was asked for.
    pub what: &'static str,
    /// The name given.
    pub name: String,
    /// Names that would do.
    pub known: Vec<String>,
}

impl TaskSet {
    /// Every task set.
    pub const ALL: [Self; 1] = [Self::MatrixGame];

    /// The tasks of one split, in a fixed order: a task's index is its place among the training tasks.
    pub fn tasks(self, split: Split) -> Vec<Task> {
        match (self, split) {
            (Self::MatrixGame, Split::Training) => (0..MatrixGame::GAMES)
                .map(|game| Task::MatrixGame { game })
                .collect(),
            (Self::MatrixGame, Split::Testing) => vec![],
        }
    }

    /// Whether its tasks know winning.
    pub fn has_wins(self) -> bool {
        match self {
            Self::MatrixGame => true,
        }
    }

    /// The padded sizes over all its tasks, testing tasks included (paper, appendix A).
    pub fn dims(self) -> Dims {
        let tasks = [Split::Training, Split::Testing]
            .into_iter()
            .flat_map(|split| self.tasks(split));
        let mut dims = Dims {
            entity_dim: 0,
            n_actions: 0,
            agents_max: 0,
            entities_max: 0,
            steps_max: 0,
        };
        let mut others_max = 0;
        for environment in tasks.map(Task::environment) {
            dims.entity_dim = environment.feature_dim() + environment.n_actions();
            dims.n_actions = environment.n_actions();
            dims.agents_max = dims.agents_max.max(environment.n_agents());
            others_max = others_max.max(environment.n_entities() - environment.n_agents());
            dims.steps_max = dims.steps_max.max(environment.steps_max());
        }
        Dims {
            entities_max: dims.agents_max + others_max,
            ..dims
        }
    }
}

impl Task {
    /// Makes the task's world.
    pub fn environment(self) -> Box<dyn Environment> {
        match self {
            Self::MatrixGame { game } => Box::new(MatrixGame::new(game)),
        }
    }

    /// The task's real sizes.
    pub fn size(self) -> TaskSize {
        let environment = self.environment();
        TaskSize {
            n_agents: environment.n_agents(),
            n_entities: environment.n_entities(),
        }
    }
}

impl fmt::Display for TaskSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::MatrixGame => "matrix-game",
        })
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MatrixGame { game } => write!(f, "game-{}", game + 1),
        }
    }
}

impl FromStr for TaskSet {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        Self::ALL
            .into_iter()
            .find(|set| set.to_string() == name)
            .ok_or_else(|| UnknownName {
                what: "task set",
                name: name.to_owned(),
                known: Self::ALL.map(|set| set.to_string()).to_vec(),
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;

    #[test]
    fn every_task_of_every_set_conforms() {
        for set in TaskSet::ALL {
            for split in [Split::Training, Split::Testing] {
                for task in set.tasks(split) {
                    conformance::check(|| task.environment());
                    let (dims, size) = (set.dims(), task.size());
                    assert!(size.n_agents <= dims.agents_max, "{task}");
                    assert!(
                        size.n_entities - size.n_agents <= dims.entities_max - dims.agents_max,
                        "{task}"
                    );
                }
            }
            assert_eq!(set.dims().validate(), Ok(()));
        }
    }

    #[test]
    fn names_lead_back() {
        for set in TaskSet::ALL {
            assert_eq!(set.to_string().parse(), Ok(set));
        }
        let unknown = "matrixgame".parse::<TaskSet>().unwrap_err();
        assert!(
            unknown
                .to_string()
                .starts_with("unknown task set \"matrixgame\"; known: matrix-game")
        );
    }
}
