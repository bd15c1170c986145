//! Which tasks belong together: training tasks to learn from, testing tasks for zero-shot evaluation.

use crate::{
    Environment, EnvironmentOptions, Spec, UnknownName,
    combat::{Combat, CombatSet, Team, TeamError, translation::Translation},
    foreign::{ForeignSet, ForeignTask},
    matrix_game::MatrixGame,
    own,
    particle::{CooperativeNavigation, DIRECTIONS, PredatorPrey, PredatorPreyReward},
};
use rit_episode::{Action, Dims, wire::TaskSize};
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// (predators, prey) of the predator and prey tasks, plain and pro.
const TRAINING_HUNTS: [(usize, usize); 3] = [(2, 1), (3, 1), (3, 2)];
const TESTING_HUNTS: [(usize, usize); 2] = [(4, 2), (5, 2)];

/// The task sets of the paper's section VI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum TaskSet {
    /// Four two-step matrix games (table I).
    MatrixGame,
    /// The cooperative navigation series.
    CooperativeNavigation,
    /// The predator and prey series.
    PredatorPrey,
    /// The predator and prey series pro.
    PredatorPreyPro,
    /// StarCraft micro-combat.
    Combat(CombatSet),
    /// Tasks whose worlds others made: a Python function, or a program that registers them.
    Foreign(&'static ForeignSet),
}

/// What the set of tasks is called whose worlds a Python function makes.
pub const PYTHON: &str = "python";

/// Tasks are trained on or kept for zero-shot evaluation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Tasks to learn from.
    #[default]
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
    /// Cooperative navigation (n, n).
    CooperativeNavigation {
        /// Number of agents, and of landmarks.
        n: usize,
    },
    /// Predator and prey (m, n).
    PredatorPrey {
        /// Number of predators, m: the agents.
        predators: usize,
        /// Number of prey, n.
        prey: usize,
        /// Which series it belongs to.
        reward: PredatorPreyReward,
    },
    /// A battle of two teams.
    Combat {
        /// The set, which says what units look like.
        set: CombatSet,
        /// The agents' team.
        allies: Team,
        /// The opponent's.
        enemies: Team,
    },
    /// A task whose world others made.
    Foreign(&'static ForeignTask),
}

/// Between the teams of a battle's name, where they differ.
const VERSUS: &str = "-vs-";
/// Most agents of a task that no list names, and most landmarks or prey.
const SIZE_MAX: usize = 64;

/// A name that is no task of a set.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TaskError {
    /// Its sizes are none that the set can have.
    #[error("{name}: {what} must be 1 to {SIZE_MAX}")]
    Size {
        /// The name.
        name: String,
        /// Which size.
        what: &'static str,
    },
    /// Its team cannot fight.
    #[error(transparent)]
    Team(#[from] TeamError),
    /// Its maker knows it, and its world is none that the set can have.
    #[error("task {name:?} of {set}: {reason}")]
    World {
        /// The name.
        name: String,
        /// The set.
        set: String,
        /// What is wrong with its world.
        reason: String,
    },
    /// It names nothing.
    #[error(transparent)]
    Unknown(#[from] UnknownName),
}

impl TaskSet {
    /// Every task set that comes with the program.
    pub const ALL: [Self; 8] = [
        Self::MatrixGame,
        Self::CooperativeNavigation,
        Self::PredatorPrey,
        Self::PredatorPreyPro,
        Self::Combat(CombatSet::Marines),
        Self::Combat(CombatSet::StalkersZealots),
        Self::Combat(CombatSet::MarinesMaraudersMedivacs),
        Self::Combat(CombatSet::ColossiStalkersZealots),
    ];

    /// Every task set that this program knows by name, those that it has registered last.
    pub fn known() -> Vec<Self> {
        [Self::ALL.to_vec(), own::registered()].concat()
    }

    /// Whether its worlds are in Python.
    pub fn is_python(self) -> bool {
        matches!(self, Self::Foreign(set) if set.maker.is_none())
    }

    /// The tasks of one split, in a fixed order: a task's index is its place among the training tasks.
    pub fn tasks(self, split: Split) -> Vec<Task> {
        match (self, split) {
            (Self::MatrixGame, Split::Training) => {
                (0..MatrixGame::GAMES).map(|game| Task::MatrixGame { game }).collect()
            }
            (Self::MatrixGame, Split::Testing) => vec![],
            (Self::CooperativeNavigation, Split::Training) => navigation([2, 3, 4]),
            (Self::CooperativeNavigation, Split::Testing) => navigation([5, 6]),
            (Self::PredatorPrey, Split::Training) => hunts(PredatorPreyReward::Plain, TRAINING_HUNTS),
            (Self::PredatorPrey, Split::Testing) => hunts(PredatorPreyReward::Plain, TESTING_HUNTS),
            (Self::PredatorPreyPro, Split::Training) => hunts(PredatorPreyReward::Pro, TRAINING_HUNTS),
            (Self::PredatorPreyPro, Split::Testing) => hunts(PredatorPreyReward::Pro, TESTING_HUNTS),
            (Self::Combat(set), Split::Training) => battles(set, &set.teams()[..set.n_training()]),
            (Self::Combat(set), Split::Testing) => battles(set, &set.teams()[set.n_training()..]),
            (Self::Foreign(set), split) => set.tasks(split).iter().map(Task::Foreign).collect(),
        }
    }

    /// The task of this name: one of the set's lists, or any other of its kind, such as `navigation-8-8`,
    /// `predator-prey-6-3`, `5s3z` or `3m-vs-4m`.
    ///
    /// # Errors
    /// When no task of the set is called so.
    pub fn task(self, name: &str) -> Result<Task, TaskError> {
        let listed = [self.tasks(Split::Training), self.tasks(Split::Testing)].concat();
        let unknown = match UnknownName::look_up("task", name, &listed) {
            Ok(task) => return Ok(task),
            Err(unknown) => unknown,
        };
        let sizes = |prefix: &str| {
            let (first, second) = name.strip_prefix(prefix)?.strip_prefix('-')?.split_once('-')?;
            plain_number(first).zip(plain_number(second))
        };
        let in_range = |size: usize, what| match size {
            1..=SIZE_MAX => Ok(size),
            _ => Err(TaskError::Size { name: name.to_owned(), what }),
        };
        let hunt = |prefix, reward| {
            let Some((predators, prey)) = sizes(prefix) else { return Err(unknown.clone().into()) };
            let (predators, prey) = (in_range(predators, "predators")?, in_range(prey, "prey")?);
            Ok(Task::PredatorPrey { predators, prey, reward })
        };
        match self {
            Self::MatrixGame => Err(unknown.into()),
            Self::Foreign(set) => match set.unlisted(name) {
                Ok(Some(task)) => Ok(Task::Foreign(task)),
                Ok(None) => Err(unknown.into()),
                Err(reason) => Err(TaskError::World { name: name.to_owned(), set: set.name.clone(), reason }),
            },
            Self::CooperativeNavigation => match sizes("navigation") {
                Some((n, landmarks)) if n == landmarks => {
                    Ok(Task::CooperativeNavigation { n: in_range(n, "agents")? })
                }
                _ => Err(unknown.into()),
            },
            Self::PredatorPrey => hunt("predator-prey", PredatorPreyReward::Plain),
            Self::PredatorPreyPro => hunt("predator-prey-pro", PredatorPreyReward::Pro),
            Self::Combat(set) => {
                let (allies, enemies) = name.split_once(VERSUS).unwrap_or((name, name));
                Ok(Task::Combat {
                    set,
                    allies: Team::parse(allies, set)?,
                    enemies: Team::parse(enemies, set)?,
                })
            }
        }
    }

    /// Whether its tasks know winning.
    pub fn has_wins(self) -> bool {
        match self {
            Self::MatrixGame | Self::Combat(_) => true,
            Self::CooperativeNavigation | Self::PredatorPrey | Self::PredatorPreyPro => false,
            Self::Foreign(set) => {
                !set.training.is_empty() && set.training.iter().all(|task| task.spec.has_wins)
            }
        }
    }

    /// Whether its tasks have prey.
    pub fn has_prey(self) -> bool {
        match self {
            Self::PredatorPrey | Self::PredatorPreyPro => true,
            Self::MatrixGame | Self::CooperativeNavigation | Self::Combat(_) | Self::Foreign(_) => false,
        }
    }

    /// Whether its worlds follow one release of the particle environment or another.
    pub fn has_physics(self) -> bool {
        matches!(self, Self::CooperativeNavigation)
    }

    /// Whether a radius limits what agents see in its tasks.
    pub fn has_view_radius(self) -> bool {
        match self {
            Self::CooperativeNavigation | Self::PredatorPrey | Self::PredatorPreyPro => true,
            Self::MatrixGame | Self::Combat(_) | Self::Foreign(_) => false,
        }
    }

    /// The padded sizes over all its tasks, testing tasks included (paper, appendix A).
    pub fn dims(self) -> Dims {
        Self::dims_of([Split::Training, Split::Testing].into_iter().flat_map(|split| self.tasks(split)))
    }

    /// The padded sizes over these tasks.
    pub fn dims_of(tasks: impl IntoIterator<Item = Task>) -> Dims {
        let mut dims = Dims { entity_dim: 0, n_actions: 0, agents_max: 0, entities_max: 0, steps_max: 0 };
        let mut others_max = 0;
        for task in tasks {
            let spec = task.spec();
            dims.entity_dim = spec.entity_dim();
            dims.n_actions = spec.n_actions;
            dims.agents_max = dims.agents_max.max(spec.n_agents);
            others_max = others_max.max(spec.n_entities - spec.n_agents);
            dims.steps_max = dims.steps_max.max(spec.steps_max);
        }
        Dims { entities_max: dims.agents_max + others_max, ..dims }
    }
}

impl Task {
    /// Makes the task's world.
    ///
    /// # Panics
    /// With a view radius that is negative or not a number.
    pub fn environment(self, options: EnvironmentOptions) -> Box<dyn Environment> {
        match self {
            Self::MatrixGame { game } => Box::new(MatrixGame::new(game)),
            Self::CooperativeNavigation { n } => Box::new(CooperativeNavigation::new(n, options)),
            Self::PredatorPrey { predators, prey, reward } => {
                Box::new(PredatorPrey::new(predators, prey, reward, options))
            }
            Self::Combat { set, allies, enemies } => {
                Box::new(Combat::new(set, [allies, enemies], options.combat))
            }
            Self::Foreign(task) => task.world(),
        }
    }

    /// What the task is, as data: nothing is built for it.
    pub fn spec(self) -> Spec {
        match self {
            Self::MatrixGame { .. } => MatrixGame::SPEC,
            Self::CooperativeNavigation { n } => CooperativeNavigation::spec(n),
            Self::PredatorPrey { predators, prey, .. } => PredatorPrey::spec(predators, prey),
            Self::Combat { set, allies, enemies } => Combat::spec(set, [allies, enemies]),
            Self::Foreign(task) => task.spec,
        }
    }

    /// Where an action pushes or walks its agent, as a direction of the plane; `None` where entities have no places.
    pub fn direction(self, action: Action) -> Option<[f32; 2]> {
        match self {
            Self::MatrixGame { .. } | Self::Foreign(_) => None,
            Self::CooperativeNavigation { .. } | Self::PredatorPrey { .. } => {
                DIRECTIONS.get(usize::from(action)).copied()
            }
            Self::Combat { .. } => Some(Translation::direction(action)),
        }
    }

    /// The task's real sizes.
    pub fn size(self) -> TaskSize {
        let Spec { n_agents, n_entities, .. } = self.spec();
        TaskSize { n_agents, n_entities }
    }
}

impl fmt::Display for TaskSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::MatrixGame => "matrix-game",
            Self::CooperativeNavigation => "cooperative-navigation",
            Self::PredatorPrey => "predator-prey",
            Self::PredatorPreyPro => "predator-prey-pro",
            Self::Combat(set) => return set.fmt(f),
            Self::Foreign(set) => &set.name,
        })
    }
}

impl TryFrom<String> for TaskSet {
    type Error = UnknownName;

    fn try_from(name: String) -> Result<Self, UnknownName> {
        name.parse()
    }
}

impl From<TaskSet> for String {
    fn from(task_set: TaskSet) -> Self {
        task_set.to_string()
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MatrixGame { game } => write!(f, "game-{}", game + 1),
            Self::CooperativeNavigation { n } => write!(f, "navigation-{n}-{n}"),
            Self::PredatorPrey { predators, prey, reward } => {
                let series = match reward {
                    PredatorPreyReward::Plain => "predator-prey",
                    PredatorPreyReward::Pro => "predator-prey-pro",
                };
                write!(f, "{series}-{predators}-{prey}")
            }
            Self::Foreign(task) => f.write_str(&task.name),
            Self::Combat { allies, enemies, .. } if allies == enemies => allies.fmt(f),
            Self::Combat { allies, enemies, .. } => write!(f, "{allies}{VERSUS}{enemies}"),
        }
    }
}

impl FromStr for TaskSet {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        if name == PYTHON {
            return Ok(Self::Foreign(ForeignSet::unknown_python()));
        }
        UnknownName::look_up("task set", name, &Self::known())
    }
}

/// A number as names have it: `3`, and neither `03` nor `+3`, so that one task is not called by two names.
fn plain_number(text: &str) -> Option<usize> {
    text.parse().ok().filter(|number: &usize| number.to_string() == text)
}

fn navigation<const N: usize>(sizes: [usize; N]) -> Vec<Task> {
    sizes.map(|n| Task::CooperativeNavigation { n }).to_vec()
}

fn battles(set: CombatSet, teams: &[Team]) -> Vec<Task> {
    teams.iter().map(|&team| Task::Combat { set, allies: team, enemies: team }).collect()
}

fn hunts<const N: usize>(reward: PredatorPreyReward, sizes: [(usize, usize); N]) -> Vec<Task> {
    let task = |(predators, prey)| Task::PredatorPrey { predators, prey, reward };
    sizes.map(task).to_vec()
}

#[cfg(test)]
mod tests;
