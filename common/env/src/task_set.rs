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
            first.parse::<usize>().ok().zip(second.parse::<usize>().ok())
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
            Self::Foreign(set) => set.unlisted(name).map(Task::Foreign).ok_or(unknown.into()),
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
mod tests {
    use super::*;
    use crate::{Physics, conformance};

    fn all_tasks(set: TaskSet) -> Vec<Task> {
        [set.tasks(Split::Training), set.tasks(Split::Testing)].concat()
    }

    #[test]
    fn every_task_of_every_set_conforms() {
        for set in TaskSet::ALL {
            // Battles are long and there are many: every tenth, from the smallest to the largest.
            let step = if matches!(set, TaskSet::Combat(_)) { 10 } else { 1 };
            for task in all_tasks(set).into_iter().step_by(step) {
                conformance::check(|| task.environment(EnvironmentOptions::default()));
            }
            let otherwise = EnvironmentOptions {
                view_radius: Some(0.5),
                approach_shaping: 0.5,
                physics: Physics::Mpe2,
                ..Default::default()
            };
            conformance::check(|| set.tasks(Split::Training)[0].environment(otherwise));
        }
    }

    #[test]
    fn dims_hold_every_task() {
        for set in TaskSet::ALL {
            let dims = set.dims();
            assert_eq!(dims.validate(), Ok(()));
            for task in all_tasks(set) {
                let size = task.size();
                assert!(size.n_agents <= dims.agents_max, "{task}");
                assert!(size.n_entities - size.n_agents <= dims.entities_max - dims.agents_max, "{task}");
            }
        }
        // Six agents and six landmarks; five predators, two obstacles and two prey.
        for (set, agents_max, entities_max) in [
            (TaskSet::CooperativeNavigation, 6, 12),
            (TaskSet::PredatorPrey, 5, 9),
            (TaskSet::PredatorPreyPro, 5, 9),
        ] {
            let expected = Dims { entity_dim: 12, n_actions: 5, agents_max, entities_max, steps_max: 25 };
            assert_eq!(set.dims(), expected, "{set}");
        }
    }

    #[test]
    fn tasks_are_those_of_the_paper() {
        let hunts = [["2-1", "3-1", "3-2"].as_slice(), ["4-2", "5-2"].as_slice()];
        for (set, prefix, sizes) in [
            (TaskSet::MatrixGame, "game", [["1", "2", "3", "4"].as_slice(), &[]]),
            (TaskSet::CooperativeNavigation, "navigation", [&["2-2", "3-3", "4-4"], &["5-5", "6-6"]]),
            (TaskSet::PredatorPrey, "predator-prey", hunts),
            (TaskSet::PredatorPreyPro, "predator-prey-pro", hunts),
        ] {
            for (split, sizes) in [Split::Training, Split::Testing].into_iter().zip(sizes) {
                let names: Vec<String> = set.tasks(split).iter().map(Task::to_string).collect();
                let expected: Vec<String> = sizes.iter().map(|size| format!("{prefix}-{size}")).collect();
                assert_eq!(names, expected);
            }
        }
    }

    #[test]
    fn names_lead_back() {
        for set in TaskSet::ALL {
            assert_eq!(set.to_string().parse(), Ok(set));
            for task in all_tasks(set) {
                assert_eq!(set.task(&task.to_string()), Ok(task));
            }
        }
        let unknown = "matrixgame".parse::<TaskSet>().unwrap_err();
        assert!(unknown.to_string().starts_with("unknown task set \"matrixgame\"; known: matrix-game"));
        assert_eq!(TaskSet::Combat(CombatSet::Marines).to_string(), "3-8m");
        assert_eq!(
            TaskSet::CooperativeNavigation.task("predator-prey-3-1").unwrap_err().to_string(),
            "unknown task \"predator-prey-3-1\"; known: navigation-2-2, navigation-3-3, navigation-4-4, \
             navigation-5-5, navigation-6-6"
        );
    }

    #[test]
    fn tasks_beyond_the_lists_have_names_too() {
        for (set, name) in [
            (TaskSet::CooperativeNavigation, "navigation-8-8"),
            (TaskSet::PredatorPrey, "predator-prey-6-3"),
            (TaskSet::PredatorPreyPro, "predator-prey-pro-2-2"),
            (TaskSet::Combat(CombatSet::StalkersZealots), "1s7z"),
            (TaskSet::Combat(CombatSet::Marines), "3m-vs-4m"),
        ] {
            assert_eq!(set.task(name).map(|task| task.to_string()).as_deref(), Ok(name));
        }
        let refused = |set: TaskSet, name: &str| set.task(name).unwrap_err().to_string();
        assert_eq!(
            refused(TaskSet::CooperativeNavigation, "navigation-0-0"),
            "navigation-0-0: agents must be 1 to 64"
        );
        assert_eq!(refused(TaskSet::Combat(CombatSet::Marines), "9m"), "9m has 9 units; a side has 1 to 8");
        for name in ["navigation-2-3", "navigation-2", "navigation--2-2", "game-5", ""] {
            assert!(refused(TaskSet::CooperativeNavigation, name).starts_with("unknown task"), "{name}");
        }
    }

    /// A spec says what its world does.
    #[test]
    fn specs_are_the_worlds_own() {
        for set in TaskSet::ALL {
            for task in all_tasks(set) {
                let environment = task.environment(EnvironmentOptions::default());
                assert_eq!(environment.spec(), task.spec(), "{task}");
                assert_eq!(task.spec().has_wins, set.has_wins());
                assert_eq!(environment.scene().is_some(), task.spec().has_scenes, "{task}");
            }
        }
    }
}
