//! Tasks that a program of one's own brings: registered by name before anything else, then task sets like any other.

use crate::{
    Environment, EnvironmentError, FailureKind, ForeignSet, ForeignTask, PYTHON, Scene, Spec, Step, TaskSet,
};
use rit_episode::{Action, Observation, Rng};
use std::{
    any::Any,
    collections::HashSet,
    hash::{Hash, Hasher},
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Mutex, PoisonError},
};

/// Makes the world of the task of a name; `None` where there is no such task.
pub type Make = fn(&str) -> Option<Box<dyn Environment>>;

/// Makes the worlds of a registered set. Makers of one set are equal: functions cannot be compared, and names are unique.
#[derive(Clone, Copy, Debug)]
pub struct Maker {
    set: &'static str,
    make: Make,
}

impl PartialEq for Maker {
    fn eq(&self, other: &Self) -> bool {
        self.set == other.set
    }
}

impl Eq for Maker {}

impl Hash for Maker {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.set.hash(state);
    }
}

/// A set of tasks of one's own. All its tasks have the same features and actions; their teams may differ.
#[derive(Clone, Copy, Debug)]
pub struct OwnTaskSet {
    /// What it is called: in `environment.task_set`, and as an experiment.
    pub name: &'static str,
    /// Tasks to learn from, where an experiment names no others.
    pub training: &'static [&'static str],
    /// Tasks kept for zero-shot evaluation, where an experiment names no others.
    pub testing: &'static [&'static str],
    /// What the features of an entity are called, in order.
    pub feature_names: &'static [&'static str],
    /// What actions are called, in order.
    pub action_names: &'static [&'static str],
    /// Makes the worlds, of listed tasks and of any other whose name it understands.
    pub make: Make,
}

/// Why a set cannot be registered.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OwnTaskSetError {
    /// Its name.
    #[error(
        "{0:?} cannot be the name of a task set: small letters, digits and hyphens, and no other set is called so"
    )]
    Name(&'static str),
    /// Nothing to learn from.
    #[error("the task set {0} has no task to learn from")]
    NoTrainingTasks(&'static str),
    /// A name that is there twice.
    #[error("the task set {set} has two {what} of the name {name:?}")]
    Twice {
        /// The set.
        set: &'static str,
        /// Tasks, features or actions.
        what: &'static str,
        /// The name.
        name: &'static str,
    },
    /// A listed task that its maker does not make.
    #[error("task {task:?} of {set}: {reason}")]
    Task {
        /// The set.
        set: &'static str,
        /// The task.
        task: String,
        /// What is wrong with it.
        reason: String,
    },
}

/// Sets that this program has beside [`TaskSet::ALL`].
static REGISTERED: Mutex<Vec<&'static ForeignSet>> = Mutex::new(Vec::new());

/// Adds a set to those that this process knows by name. Processes that work on one run, the actors on other hosts among
/// them, are to be of the same program.
///
/// # Errors
/// When something about it is wrong.
pub fn register(set: &OwnTaskSet) -> Result<(), OwnTaskSetError> {
    let OwnTaskSet { name, training, testing, feature_names, action_names, make } = *set;
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if name.is_empty() || !name.chars().all(plain) || name == PYTHON || name.parse::<TaskSet>().is_ok() {
        return Err(OwnTaskSetError::Name(name));
    }
    if training.is_empty() {
        return Err(OwnTaskSetError::NoTrainingTasks(name));
    }
    for (what, names) in [
        ("tasks", [training, testing].concat()),
        ("features", feature_names.to_vec()),
        ("actions", action_names.to_vec()),
    ] {
        let mut seen = HashSet::new();
        if let Some(twice) = names.into_iter().find(|one| !seen.insert(*one)) {
            return Err(OwnTaskSetError::Twice { set: name, what, name: twice });
        }
    }
    let (maker, sizes) = (Maker { set: name, make }, [feature_names.len(), action_names.len()]);
    let tasks = |names: &[&str]| {
        let task = |task: &&str| {
            match described(maker, task, sizes) {
                Ok(Some(known)) => Ok(known),
                Ok(None) => Err("its maker does not know it".to_owned()),
                Err(reason) => Err(reason),
            }
            .map_err(|reason| OwnTaskSetError::Task {
                set: name,
                task: (*task).to_owned(),
                reason,
            })
        };
        names.iter().map(task).collect::<Result<Vec<_>, _>>()
    };
    let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    let set = ForeignSet {
        name: name.to_owned(),
        training: tasks(training)?,
        testing: tasks(testing)?,
        feature_names: names(feature_names),
        action_names: names(action_names),
        maker: Some(maker),
    };
    REGISTERED.lock().unwrap_or_else(PoisonError::into_inner).push(set.kept());
    Ok(())
}

/// The sets that this program has registered, in that order.
pub fn registered() -> Vec<TaskSet> {
    let registered = REGISTERED.lock().unwrap_or_else(PoisonError::into_inner);
    registered.iter().map(|set| TaskSet::Foreign(set)).collect()
}

/// The task of this name, if its maker knows it; or what is wrong with its world.
pub(crate) fn described(maker: Maker, task: &str, sizes: [usize; 2]) -> Result<Option<ForeignTask>, String> {
    let made =
        catch_unwind(|| (maker.make)(task).map(|world| world.spec())).map_err(|panic| words(&*panic))?;
    let Some(spec) = made else { return Ok(None) };
    let Spec { feature_dim, n_actions, .. } = spec;
    if [feature_dim, n_actions] != sizes {
        return Err(format!(
            "its world has {feature_dim} features and {n_actions} actions, and the set names {} and {}",
            sizes[0], sizes[1]
        ));
    }
    spec.check().map_err(|error| error.to_string())?;
    Ok(Some(ForeignTask { name: task.to_owned(), spec, maker: Some(maker) }))
}

/// A world of a program's own, held to what environments promise: what it breaks costs an episode, and not the process.
pub(crate) struct Held {
    world: Box<dyn Environment>,
    spec: Spec,
    is_over_at_limit: bool,
    seen: Observation,
    steps: usize,
}

impl Held {
    /// The world of this task, which is still what it was when the run learned of it: buffers, networks and other hosts
    /// count on that.
    pub(crate) fn make(maker: Maker, task: &ForeignTask) -> Result<Self, EnvironmentError> {
        let ForeignTask { name, spec: promised, .. } = task;
        let made = held(|| {
            let made = (maker.make)(name);
            Ok(made.map(|world| (world.spec(), world.is_over_at_limit(), world)))
        })?;
        let (spec, is_over_at_limit, world) = made.ok_or_else(|| {
            bad(format!("the maker no longer makes the task {name:?}, which it has made before"))
        })?;
        if let Some((fact, now, before)) = spec.first_difference(promised) {
            return Err(bad(format!(
                "the world of {name:?} has {fact} = {now} now, and had {before} when its set was registered; a task's \
                 world is always the same"
            )));
        }
        Ok(Self { spec, is_over_at_limit, world, seen: Observation::default(), steps: 0 })
    }

    /// Checks the state before it is shown.
    fn look(&mut self) -> Result<(), EnvironmentError> {
        let Spec { n_agents, n_entities, feature_dim, n_actions, .. } = self.spec;
        let Self { world, seen, .. } = self;
        seen.reset(n_agents, n_entities, feature_dim, n_actions);
        held(|| {
            world.observe(seen);
            Ok(())
        })?;
        seen.check().map_err(|fault| bad(fault.to_string()))
    }
}

impl Environment for Held {
    fn spec(&self) -> Spec {
        self.spec
    }

    fn begin_reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        held(|| self.world.begin_reset(rng))
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        held(|| self.world.reset(rng))?;
        self.steps = 0;
        self.look()
    }

    fn observe(&self, observation: &mut Observation) {
        observation.clone_from(&self.seen);
    }

    fn begin_step(&mut self, actions: &[Action]) -> Result<(), EnvironmentError> {
        held(|| self.world.begin_step(actions))
    }

    fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError> {
        let step = held(|| self.world.step(actions, rng))?;
        self.steps += 1;
        if !step.reward.is_finite() || !step.shaping.is_finite() {
            return Err(bad(format!(
                "a step paid {} and {}, which are no numbers",
                step.reward, step.shaping
            )));
        }
        if step.end.is_none() && self.steps >= self.spec.steps_max {
            return Err(bad(format!("the episode does not end within steps_max = {}", self.spec.steps_max)));
        }
        self.look()?;
        Ok(step)
    }

    fn is_over_at_limit(&self) -> bool {
        self.is_over_at_limit
    }

    fn scene(&self) -> Option<Scene> {
        // A drawing has no place for an error: a world that panics is not drawn.
        catch_unwind(AssertUnwindSafe(|| self.world.scene())).ok().flatten()
    }
}

fn bad(detail: String) -> EnvironmentError {
    EnvironmentError::new(FailureKind::BadAnswer, detail)
}

/// What a world's own code comes to; a panic is an error of its own. After one the world is not used again.
fn held<T>(act: impl FnOnce() -> Result<T, EnvironmentError>) -> Result<T, EnvironmentError> {
    catch_unwind(AssertUnwindSafe(act))
        .unwrap_or_else(|panic| Err(EnvironmentError::new(FailureKind::Raised, words(&*panic))))
}

fn words(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!("it panicked: {}", text.unwrap_or("without words"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{EnvironmentOptions, Split, Task, matrix_game::MatrixGame};
    use rit_episode::{End, RunSeed, Stream};

    /// A world that breaks the promise that its task is named after.
    struct Breaks(&'static str);

    impl Environment for Breaks {
        fn spec(&self) -> Spec {
            assert!(self.0 != "spec", "the rules are lost");
            if self.0 == "sizes" { Spec { n_entities: 5, ..MatrixGame::SPEC } } else { MatrixGame::SPEC }
        }

        fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
            assert!(self.0 != "panic", "the board is on fire");
            Ok(())
        }

        fn observe(&self, observation: &mut Observation) {
            observation.see_and_allow_all();
            match self.0 {
                "feature" => observation.entity_mut(1)[2] = f32::NAN,
                "mask" => observation.available_mut(0).fill(0),
                _ => {}
            }
        }

        fn step(&mut self, _: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
            let reward = if self.0 == "reward" { f32::NAN } else { 1.0 };
            let end = (self.0 != "endless").then_some(End::Terminated);
            Ok(Step { reward, shaping: 0.0, end, won: false })
        }

        fn is_over_at_limit(&self) -> bool {
            assert!(self.0 != "limit", "the clock is lost");
            self.0 == "timed"
        }

        fn scene(&self) -> Option<Scene> {
            assert!(self.0 != "scene", "the canvas is torn");
            Some(Scene { bodies: vec![], links: vec![] })
        }
    }

    fn make(task: &str) -> Option<Box<dyn Environment>> {
        const KINDS: [&str; 11] = [
            "none", "panic", "feature", "mask", "reward", "endless", "spec", "sizes", "limit", "timed",
            "scene",
        ];
        KINDS.into_iter().find(|kind| *kind == task).map(|kind| Box::new(Breaks(kind)) as _)
    }

    const SET: OwnTaskSet = OwnTaskSet {
        name: "breaking",
        training: &["none"],
        testing: &[],
        feature_names: &["a", "b", "c"],
        action_names: &["x", "y", "z"],
        make,
    };

    #[test]
    fn a_registered_set_is_known_by_name_with_tasks_beyond_its_lists() {
        assert_eq!(register(&SET), Ok(()));
        let set: TaskSet = "breaking".parse().unwrap();
        assert!(registered().contains(&set) && !set.is_python());
        assert_eq!(set.to_string(), "breaking");
        assert_eq!(set.tasks(Split::Training), [set.task("none").unwrap()]);
        assert_eq!(set.task("endless").unwrap().to_string(), "endless");
        assert_eq!(set.task("endless"), set.task("endless"));
        assert!(set.task("other").unwrap_err().to_string().starts_with("unknown task \"other\""));
        assert_eq!(set.feature_names(), ["a", "b", "c"]);
        // A task whose world is wrong is no unknown one: what is wrong is said.
        assert_eq!(
            set.task("spec").unwrap_err().to_string(),
            "task \"spec\" of breaking: it panicked: the rules are lost"
        );
        assert_eq!(register(&SET), Err(OwnTaskSetError::Name("breaking")), "and only once");
    }

    #[test]
    fn what_is_wrong_with_a_set_is_said() {
        let refused =
            |set: OwnTaskSet| register(&OwnTaskSet { name: "wrong", ..set }).unwrap_err().to_string();
        for name in ["", "Wrong", "two words", "python", "matrix-game"] {
            assert_eq!(register(&OwnTaskSet { name, ..SET }), Err(OwnTaskSetError::Name(name)));
        }
        assert_eq!(
            refused(OwnTaskSet { training: &[], ..SET }),
            "the task set wrong has no task to learn from"
        );
        assert_eq!(
            refused(OwnTaskSet { testing: &["none"], ..SET }),
            "the task set wrong has two tasks of the name \"none\""
        );
        assert_eq!(
            refused(OwnTaskSet { testing: &["other"], ..SET }),
            "task \"other\" of wrong: its maker does not know it"
        );
        assert_eq!(
            refused(OwnTaskSet { action_names: &["x"], ..SET }),
            "task \"none\" of wrong: its world has 3 features and 3 actions, and the set names 3 and 1"
        );
        assert_eq!(
            refused(OwnTaskSet { feature_names: &[], make: |_| Some(Box::new(Blind)), ..SET }),
            "task \"none\" of wrong: 2 agents, 2 entities (agents included), 0 features, 3 actions and 2 steps make no \
             task; it needs at least one agent, as many entities as agents, a feature, an action and a step"
        );
    }

    /// A world without a feature.
    struct Blind;

    impl Environment for Blind {
        fn spec(&self) -> Spec {
            Spec { feature_dim: 0, ..MatrixGame::SPEC }
        }

        fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
            Ok(())
        }

        fn observe(&self, _: &mut Observation) {}

        fn step(&mut self, _: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
            Ok(Step { reward: 0.0, shaping: 0.0, end: None, won: false })
        }
    }

    fn world(task: &str) -> Box<dyn Environment> {
        let maker = Some(Maker { set: "breaking", make });
        let task = ForeignTask { name: task.to_owned(), spec: MatrixGame::SPEC, maker };
        Task::Foreign(Box::leak(Box::new(task))).environment(EnvironmentOptions::default())
    }

    #[test]
    fn a_scene_that_panics_is_not_drawn_and_the_limit_is_passed_on() {
        assert_eq!(world("scene").scene(), None);
        assert!(world("none").scene().is_some());
        assert!(world("timed").is_over_at_limit() && !world("none").is_over_at_limit());
    }

    #[test]
    fn a_broken_promise_costs_an_episode_and_is_named() {
        let rng = &mut RunSeed(1).stream(Stream::Environment, 0);
        let mut course = |task: &str| {
            let mut world = world(task);
            world.reset(rng).and_then(|()| world.step(&[0, 0], rng)).and_then(|_| world.step(&[0, 0], rng))
        };
        assert!(course("none").is_ok());
        for (task, kind, words) in [
            ("panic", FailureKind::Raised, "it panicked: the board is on fire"),
            ("feature", FailureKind::BadAnswer, "feature 2 of entity 1 is NaN"),
            ("mask", FailureKind::BadAnswer, "agent 0 has no available action"),
            ("reward", FailureKind::BadAnswer, "a step paid NaN and 0"),
            ("endless", FailureKind::BadAnswer, "the episode does not end within steps_max = 2"),
            ("spec", FailureKind::Raised, "it panicked: the rules are lost"),
            ("limit", FailureKind::Raised, "it panicked: the clock is lost"),
            (
                "sizes",
                FailureKind::BadAnswer,
                "the world of \"sizes\" has n_entities = 5 now, and had 2 when its set was registered;",
            ),
        ] {
            let error = course(task).unwrap_err();
            assert!(error.kind == kind && error.detail.starts_with(words), "{task}: {error}");
        }
    }
}
