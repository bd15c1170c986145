//! Environments in Python: which keys they have, and the task set that follows from them.

use crate::{Config, ConfigError, Environment, World, keys, resolve};
use rit_env::{ForeignSet, ForeignTask, PYTHON, Spec, TaskSet};
use toml::{Table, Value};

/// Keys of `[environment]` that mean nothing without `python`.
const KEYS: [&str; 8] = [
    "python",
    "interpreter",
    "environments_per_worker",
    "timeout_ms",
    "worker_memory_mb",
    "worlds",
    "feature_names",
    "action_names",
];

/// What has to be asked of Python before a run can begin.
#[derive(Clone, Debug, PartialEq)]
pub struct PythonAsked {
    /// How it is started.
    pub environment: Environment,
    /// The tasks, each once: those to learn from first.
    pub tasks: Vec<String>,
}

/// What an experiment under these settings has to ask Python for; nothing where it has no environment in Python, or says
/// all already.
///
/// # Errors
/// When it names no task to learn from, or its keys are wrong.
pub fn python_asked(
    experiment: &str,
    source_name: &str,
    settings: &[Table],
) -> Result<Option<PythonAsked>, ConfigError> {
    let mut typed = resolve::parse(experiment, source_name)?;
    settings.iter().for_each(|setting| resolve::merge(&mut typed, setting.clone()));
    let Some(Value::Table(typed)) = typed.remove("environment") else { return Ok(None) };
    let mut defaults = resolve::defaults()?;
    let typed = Table::from_iter([("environment".to_owned(), Value::Table(typed))]);
    keys::check(&typed, &defaults, &defaults)?;
    let mut typed = typed;
    choose(&mut typed)?;
    resolve::merge(&mut defaults, typed);
    let Some(section) = defaults.remove("environment") else { return Ok(None) };
    if section.get("task_set").and_then(Value::as_str) != Some(PYTHON) {
        return Ok(None);
    }
    let environment: Environment = section.try_into().map_err(|error| resolve::wrong_value(&error))?;
    if !environment.worlds.is_empty() {
        return Ok(None);
    }
    if environment.training_tasks.is_empty() {
        return Err(ConfigError::NoTrainingTasks);
    }
    let mut tasks: Vec<String> = Vec::new();
    for task in environment.training_tasks.iter().chain(&environment.testing_tasks) {
        if !tasks.contains(task) {
            tasks.push(task.clone());
        }
    }
    Ok(Some(PythonAsked { environment, tasks }))
}

/// Settings that say what Python has said.
///
/// # Errors
/// When TOML cannot say it.
pub fn python_answered(
    worlds: &[World],
    feature_names: &[String],
    action_names: &[String],
) -> Result<Table, ConfigError> {
    let value = |error: toml::ser::Error| ConfigError::Value(error.to_string());
    let worlds = worlds.iter().map(Value::try_from).collect::<Result<Vec<_>, _>>().map_err(value)?;
    let names = |names: &[String]| Value::Array(names.iter().cloned().map(Value::String).collect());
    let section = Table::from_iter([
        ("worlds".to_owned(), Value::Array(worlds)),
        ("feature_names".to_owned(), names(feature_names)),
        ("action_names".to_owned(), names(action_names)),
    ]);
    Ok(Table::from_iter([("environment".to_owned(), Value::Table(section))]))
}

/// `python` says which task set it is.
pub(crate) fn choose(typed: &mut Table) -> Result<(), ConfigError> {
    let Some(Value::Table(section)) = typed.get_mut("environment") else { return Ok(()) };
    let named = |key: &str| section.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    match (named(PYTHON).is_empty(), named("task_set").as_str()) {
        (true, PYTHON) => Err(ConfigError::NoPython),
        (true, task_set) => {
            let key = KEYS.iter().find(|key| section.contains_key(**key) && **key != PYTHON);
            // Without any task set at all, that is what is said.
            match key.filter(|_| !task_set.is_empty()) {
                Some(key) => Err(ConfigError::NotOfPython { key: format!("environment.{key}") }),
                None => Ok(()),
            }
        }
        (false, "" | PYTHON) => {
            section.insert("task_set".to_owned(), PYTHON.into());
            Ok(())
        }
        (false, task_set) => Err(ConfigError::TwoTaskSets { task_set: keys::quoted(task_set) }),
    }
}

/// The task set of a configuration with environments in Python.
pub(crate) fn task_set(environment: &Environment) -> Result<TaskSet, ConfigError> {
    let Environment { training_tasks, testing_tasks, worlds, feature_names, action_names, .. } = environment;
    if worlds.is_empty() {
        return Err(ConfigError::NoWorlds);
    }
    let tasks = |names: &[String]| {
        let task = |name: &String| {
            let world = worlds.iter().find(|world| world.task == *name);
            let world = world.ok_or_else(|| ConfigError::NoWorld { task: keys::quoted(name) })?;
            let spec = Spec {
                n_agents: world.n_agents,
                n_entities: world.n_entities,
                feature_dim: feature_names.len(),
                n_actions: action_names.len(),
                steps_max: world.steps_max,
                has_wins: world.has_wins,
                has_scenes: false,
                is_reproducible: world.is_reproducible,
            };
            spec.check().map_err(|error| ConfigError::WorldSizes { task: keys::quoted(name), error })?;
            Ok(ForeignTask { name: name.clone(), spec, maker: None })
        };
        names.iter().map(task).collect::<Result<Vec<_>, ConfigError>>()
    };
    let set = ForeignSet {
        name: PYTHON.to_owned(),
        training: tasks(training_tasks)?,
        testing: tasks(testing_tasks)?,
        feature_names: feature_names.clone(),
        action_names: action_names.clone(),
        maker: None,
    };
    if set.training.is_empty() {
        return Err(ConfigError::NoTrainingTasks);
    }
    Ok(TaskSet::Foreign(set.kept()))
}

/// Takes the keys away that mean nothing to a run of tasks that come with the program.
pub(crate) fn retain(table: &mut Table, config: &Config) {
    if let (true, Some(Value::Table(section))) =
        (config.environment.python.is_empty(), table.get_mut("environment"))
    {
        section.retain(|key, _| !KEYS.contains(&key));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{resolve, set};
    use rit_env::Split;

    const MINE: &str =
        "[environment]\npython = \"worlds:make\"\ntraining_tasks = [\"two\"]\ntesting_tasks = [\"three\"]";

    fn answered() -> Table {
        let world = |task: &str, n_agents| World {
            task: task.to_owned(),
            n_agents,
            n_entities: 2 * n_agents,
            steps_max: 25,
            has_wins: false,
            is_reproducible: true,
        };
        let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
        python_answered(&[world("two", 2), world("three", 3)], &names(&["x", "y"]), &names(&["stay", "go"]))
            .unwrap()
    }

    #[test]
    fn what_python_says_makes_a_whole_configuration() {
        let asked = python_asked(MINE, "my.toml", &[]).unwrap().unwrap();
        assert_eq!(asked.tasks, ["two", "three"]);
        assert_eq!(
            (asked.environment.python.as_str(), asked.environment.timeout_ms),
            ("worlds:make", 30_000)
        );
        let config = resolve(MINE, "my.toml", &[answered()]).unwrap();
        let names: Vec<_> = config.tasks(Split::Testing).iter().map(ToString::to_string).collect();
        assert_eq!(names, ["three"]);
        let dims = config.dims();
        assert_eq!((dims.agents_max, dims.entities_max, dims.entity_dim, dims.n_actions), (3, 6, 4, 2));
        let text = config.to_toml().unwrap();
        assert_eq!(resolve(&text, "config.toml", &[]), Ok(config));
        assert_eq!(python_asked(&text, "config.toml", &[]), Ok(None), "it says all already");
    }

    /// No run begins with a task in which nothing can be decided, however its file came about.
    #[test]
    fn sizes_that_make_no_task_are_refused() {
        let world = |change: &dyn Fn(&mut World)| {
            let mut world = World {
                task: "two".to_owned(),
                n_agents: 2,
                n_entities: 4,
                steps_max: 25,
                has_wins: false,
                is_reproducible: true,
            };
            change(&mut world);
            world
        };
        let resolved = |world: World, features: &[&str], actions: &[&str]| {
            let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
            let answered = python_answered(&[world], &names(features), &names(actions)).unwrap();
            let only = set("environment.testing_tasks=[]").unwrap();
            resolve(MINE, "my.toml", &[answered, only]).map_err(|error| error.to_string())
        };
        assert!(resolved(world(&|_| {}), &["x"], &["stay"]).is_ok());
        let refused =
            |world, features: &[&str], actions: &[&str]| resolved(world, features, actions).unwrap_err();
        for message in [
            refused(world(&|world| world.n_agents = 0), &["x"], &["stay"]),
            refused(world(&|world| world.n_entities = 1), &["x"], &["stay"]),
            refused(world(&|world| world.steps_max = 0), &["x"], &["stay"]),
            refused(world(&|_| {}), &[], &["stay"]),
            refused(world(&|_| {}), &["x"], &[]),
        ] {
            assert!(message.starts_with("environment.worlds: task \"two\": "), "{message}");
            assert!(message.contains("make no task; it needs at least one agent"), "{message}");
        }
        // What is too large is so over all tasks, and no fault of one key.
        assert_eq!(
            refused(world(&|world| world.n_entities = 300), &["x"], &["stay"]),
            "the sizes that hold every training and testing task: entities_max = 300 is out of range 2..=255; name \
             other tasks"
        );
    }

    #[test]
    fn what_is_missing_is_named() {
        let refused = |text: &str| python_asked(text, "my.toml", &[]).unwrap_err().to_string();
        assert!(
            refused("environment.python = \"a:b\"").starts_with("environment.training_tasks names no task")
        );
        assert_eq!(
            refused("environment = {python = \"a:b\", task_set = \"matrix-game\"}"),
            "environment.python and environment.task_set = \"matrix-game\" both say what is played; leave one out"
        );
        assert!(refused("environment.task_set = \"python\"").starts_with("environment.python is missing"));
        assert_eq!(python_asked("environment.task_set = \"matrix-game\"", "my.toml", &[]), Ok(None));
        let resolved =
            |text: &str, settings: &[Table]| resolve(text, "my.toml", settings).unwrap_err().to_string();
        assert!(resolved(MINE, &[]).starts_with("environment.worlds says nothing of the tasks"));
        let more = set("environment.testing_tasks=[\"four\"]").unwrap();
        assert!(resolved(MINE, &[answered(), more]).starts_with("environment.worlds does not know \"four\""));
        assert_eq!(
            resolved("environment = {task_set = \"matrix-game\", timeout_ms = 7}", &[]),
            "environment.timeout_ms means nothing without environment.python; leave it out"
        );
    }

    #[test]
    fn a_run_of_our_own_tasks_says_nothing_of_python() {
        let text = resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap().to_toml().unwrap();
        assert!(KEYS.iter().all(|key| !text.contains(&format!("\n{key} = "))), "{text}");
    }
}
