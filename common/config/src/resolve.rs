//! From what a person typed to a [`Config`].

use crate::{
    Backend, Config, ConfigError, Environment, KeepBest, SpawnRotate, StarCraft, Until, foreign, keys,
    method_keys, number::WHOLE_MAX,
};
use rit_algo::{Method, Regime};
use rit_env::{
    Physics, TaskSet,
    combat::{StatsVersion, world::ScriptedMedivac},
};
use std::collections::{BTreeMap, HashMap};
use toml::{Table, Value};

/// Every key with its default.
const DEFAULTS: &str = include_str!("presets/all.toml");

/// Resolves an experiment and what the command line sets, in ascending order of precedence.
///
/// # Errors
/// The first thing found wrong.
pub fn resolve(experiment: &str, source_name: &str, settings: &[Table]) -> Result<Config, ConfigError> {
    let defaults = defaults()?;
    let mut typed = parse(experiment, source_name)?;
    method_keys::translate_ablations(&mut typed, Method::Rit)?;
    method_keys::translate_time_limit(&mut typed)?;
    let mut set = Table::new();
    for setting in settings {
        merge(&mut set, setting.clone());
    }
    method_keys::translate_ablations(&mut set, method_keys::named(&typed)?)?;
    method_keys::translate_time_limit(&mut set)?;
    merge(&mut typed, set);
    // Whatever is wrong with the name is said once the keys are right.
    let listed = method_keys::named(&typed).map(|method| method_keys::of_method(&defaults, method));
    keys::check(&typed, &defaults, listed.as_ref().unwrap_or(&defaults))?;
    foreign::choose(&mut typed)?;
    let (method, task_set) = (method_keys::named(&typed)?, task_set(&typed)?);
    method_keys::check(&typed, method)?;
    let mut all = defaults;
    for preset in method_keys::presets(method, task_set)? {
        merge(&mut all, preset);
    }
    merge(&mut all, typed);
    let mut config: Config = all.try_into().map_err(|error| wrong_value(&error))?;
    if task_set.is_python() {
        config.environment.task_set = foreign::task_set(&config.environment)?;
    }
    for (key, value, min, max) in config.limits() {
        value.check(key, min, max)?;
    }
    check_keys_together(&config)?;
    check_tasks(&config)?;
    // Unknown tasks have no sizes.
    config.dims().validate()?;
    check_backend(&config)?;
    check_meaning(&config)?;
    config.model().validate()?;
    Ok(config)
}

/// Values that are sound each by itself, and cannot go together.
fn check_keys_together(config: &Config) -> Result<(), ConfigError> {
    let (method, task_set) = (config.algorithm.name, config.environment.task_set);
    if method.facts().regime == Regime::OnPolicy && config.algorithm.policy_lag > 0 {
        return Err(ConfigError::OnPolicyLag { method, policy_lag: config.algorithm.policy_lag });
    }
    if matches!(config.training.until, Until::WinRate(_)) && !task_set.has_wins() {
        return Err(ConfigError::NoWins { until: config.training.until.into(), task_set });
    }
    if config.checkpoints.keep_best == KeepBest::WinRate && !task_set.has_wins() {
        return Err(ConfigError::Value(format!(
            "checkpoints.keep_best = \"win_rate\": the tasks of {task_set} know no winning; write mean_return"
        )));
    }
    if config.evaluation.absolute_metric && config.checkpoints.keep_best == KeepBest::Never {
        return Err(ConfigError::Value(
            "evaluation.absolute_metric evaluates the best policy, and none is kept; set checkpoints.keep_best to \
             mean_return or win_rate"
                .to_owned(),
        ));
    }
    Ok(())
}

/// Whether every name is that of a task, and no list has a task twice, under one name or two: `3m-vs-3m` is `3m`.
fn check_tasks(config: &Config) -> Result<(), ConfigError> {
    let Environment { task_set, training_tasks, testing_tasks, .. } = &config.environment;
    for (key, names) in
        [("environment.training_tasks", training_tasks), ("environment.testing_tasks", testing_tasks)]
    {
        let mut listed = HashMap::new();
        for name in names {
            let task = task_set.task(name).map_err(|error| ConfigError::Task { key, error })?;
            if let Some(first) = listed.insert(task, name) {
                let (first, second) = (first.clone(), name.clone());
                return Err(ConfigError::TaskTwice { key, first, second });
            }
        }
    }
    Ok(())
}

/// Whether every key of `[environment]` that is set means something to the task set.
fn check_meaning(config: &Config) -> Result<(), ConfigError> {
    let Environment {
        task_set,
        spawn_rotate,
        stats,
        enemy_medivac,
        approach_shaping,
        physics,
        view_radius,
        ..
    } = config.environment;
    let is_combat = matches!(task_set, TaskSet::Combat(_));
    let meaningless = [
        ("environment.spawn_rotate", spawn_rotate != SpawnRotate::Published && !is_combat),
        ("environment.stats", stats != StatsVersion::default() && !is_combat),
        ("environment.enemy_medivac", enemy_medivac != ScriptedMedivac::default() && !is_combat),
        ("environment.approach_shaping", approach_shaping != 0.0 && !task_set.has_prey()),
        ("environment.physics", physics != Physics::default() && !task_set.has_physics()),
        ("environment.view_radius", view_radius.is_finite() && !task_set.has_view_radius()),
    ];
    match meaningless.into_iter().find(|(_, meaningless)| *meaningless) {
        Some((key, _)) => Err(ConfigError::Meaningless { key, task_set }),
        None => Ok(()),
    }
}

/// `[starcraft]` with its defaults.
fn starcraft_default() -> Result<StarCraft, ConfigError> {
    let section = defaults()?.remove("starcraft").unwrap_or(Value::Table(Table::new()));
    section.try_into().map_err(|error| wrong_value(&error))
}

/// What plays in real games, and what only the simulator knows, or only they.
fn check_backend(config: &Config) -> Result<(), ConfigError> {
    let Environment { task_set, backend, stats, enemy_medivac, .. } = config.environment;
    let (starcraft, default) = (&config.starcraft, starcraft_default()?);
    let (name, meaningless) = match backend {
        Backend::Starcraft if !matches!(task_set, TaskSet::Combat(_)) => {
            return Err(ConfigError::NoBattles { task_set });
        }
        Backend::Starcraft => (
            "starcraft",
            vec![
                ("environment.stats", stats != StatsVersion::default()),
                ("environment.enemy_medivac", enemy_medivac != ScriptedMedivac::default()),
            ],
        ),
        Backend::Embedded => (
            "embedded",
            vec![
                ("starcraft.map", starcraft.map != default.map),
                ("starcraft.base_build", starcraft.base_build != default.base_build),
                ("starcraft.data_version", starcraft.data_version != default.data_version),
                ("starcraft.custom_types", starcraft.custom_types != default.custom_types),
                ("starcraft.timeout_ms", starcraft.timeout_ms != default.timeout_ms),
            ],
        ),
    };
    match meaningless.into_iter().find(|(_, is_set)| *is_set) {
        Some((key, _)) => Err(ConfigError::NotOfBackend { key, backend: name }),
        None => Ok(()),
    }
}

/// One `section.key=value` of the command line: one key, whatever the value holds.
///
/// # Errors
/// When there is no `=`, no such key, or the value is of another kind.
pub fn set(assignment: &str) -> Result<Table, ConfigError> {
    let defaults = defaults()?;
    set_listing(assignment, &defaults, &defaults)
}

/// All of a command line's. Where one of them names the method, no message lists a key that it has not.
///
/// # Errors
/// As [`set`].
pub fn set_all(assignments: &[String]) -> Result<Vec<Table>, ConfigError> {
    let defaults = defaults()?;
    let method = method_keys::assigned(assignments);
    let listed = method.map_or_else(|| defaults.clone(), |method| method_keys::of_method(&defaults, method));
    assignments.iter().map(|assignment| set_listing(assignment, &defaults, &listed)).collect()
}

fn set_listing(assignment: &str, defaults: &Table, listed: &Table) -> Result<Table, ConfigError> {
    let no_assignment = || ConfigError::NoAssignment(keys::quoted(assignment));
    let (key, text) = assignment.split_once('=').ok_or_else(no_assignment)?;
    let (key, text) = (key.trim(), text.trim());
    if key.is_empty() {
        return Err(no_assignment());
    }
    let value = keys::read(key, text, defaults, listed)?;
    let (sections, name) = key.rsplit_once('.').unwrap_or(("", key));
    let table = Table::from_iter([(name.to_owned(), value)]);
    let sections = sections.rsplit('.').filter(|section| !section.is_empty());
    Ok(sections.fold(table, |table, section| Table::from_iter([(section.to_owned(), table.into())])))
}

/// Suggestions for a name that is no key, such as an unknown command-line option: every `section.key` whose last part is
/// this name, or else the key most similar to it.
pub fn keys_like(name: &str) -> Vec<String> {
    let Ok(defaults) = defaults() else { return Vec::new() };
    let called = keys::called(&name.replace('-', "_"), &defaults);
    if called.is_empty() { keys::closest(name, &defaults).into_iter().collect() } else { called }
}

/// Every key that there is, with its section.
pub fn all_keys() -> Vec<String> {
    defaults().map_or_else(|_| Vec::new(), |defaults| keys::all(&defaults, ""))
}

/// Keys, or sections, that a run may change when it goes on: no weight follows from them.
const FREE: [&str; 17] = [
    "environment.environments_per_worker",
    "environment.interpreter",
    "environment.lost_rounds_max",
    "environment.timeout_ms",
    "environment.worker_memory_mb",
    "training",
    "evaluation",
    "checkpoints",
    "actors",
    "learner.listen",
    "learner.token_file",
    "learner.tls",
    "learner.threads",
    "learner.metrics_every_env_steps",
    "learner.stall_timeout_ms",
    "web",
    "starcraft",
];

/// Keys that a running learner can change. Of these `algorithm.epsilon_finish` changes the
/// result, and `evaluation` does where `training.until` ends the run at an evaluation.
pub(crate) const LIVE: [&str; 12] = [
    "algorithm.epsilon_finish",
    "evaluation.every_env_steps",
    "evaluation.episodes",
    "evaluation.testing_every_env_steps",
    "evaluation.testing_episodes",
    "checkpoints.every_env_steps",
    "checkpoints.last_retry_ms",
    "checkpoints.rescue_dir",
    "actors.count",
    "actors.heartbeat_timeout_ms",
    "learner.metrics_every_env_steps",
    "learner.stall_timeout_ms",
];

/// The configuration of a running learner with these settings.
///
/// # Errors
/// The first thing found wrong, or a key that cannot change now.
pub fn set_live(config: &Config, settings: &[Table]) -> Result<Config, ConfigError> {
    let new = resolve(&config.to_toml()?, "the run's configuration", settings)?;
    if let Some(key) = first_difference(config, &new, &LIVE)? {
        return Err(ConfigError::NotLive { key });
    }
    let (count, max) = (new.actors.count, new.actors.count_max);
    if count == 0 && new.actors.remote == 0 {
        return Err(ConfigError::NoActors);
    }
    if count > max.max(config.actors.count) {
        let (key, min) = ("actors.count".to_owned(), "0".to_owned());
        return Err(ConfigError::Range { key, value: count.to_string(), min, max: max.to_string() });
    }
    Ok(new)
}

/// Whether a run of the one configuration may go on as one of the other.
///
/// # Errors
/// The first key that differs and may not.
pub(crate) fn may_go_on(old: &Config, new: &Config) -> Result<(), ConfigError> {
    first_difference(old, new, &FREE)?.map_or(Ok(()), |key| Err(ConfigError::Fixed { key }))
}

/// The first key outside these keys and sections that differs.
fn first_difference(old: &Config, new: &Config, free: &[&str]) -> Result<Option<String>, ConfigError> {
    let (old, new) = (flat(old)?, flat(new)?);
    let mut differing = old.iter().filter(|(key, value)| new.get(*key) != Some(value));
    Ok(differing.find(|(key, _)| !is_under(key, free)).map(|(key, _)| key.clone()))
}

/// Whether a key is one of these, or in one of these sections.
fn is_under(key: &str, keys: &[&str]) -> bool {
    keys.iter().any(|one| key == *one || key.starts_with(&format!("{one}.")))
}

/// Whether no weight follows from a key.
pub fn is_free(key: &str) -> bool {
    is_under(key, &FREE)
}

/// Every `section.key` of the method with its value.
pub(crate) fn flat(config: &Config) -> Result<BTreeMap<String, Value>, ConfigError> {
    let table = config.to_table()?;
    let mut keys = BTreeMap::new();
    for (section, value) in table {
        match value {
            Value::Table(table) => {
                keys.extend(table.into_iter().map(|(key, value)| (format!("{section}.{key}"), value)));
            }
            value => {
                keys.insert(section, value);
            }
        }
    }
    Ok(keys)
}

/// See [`Config::settings`].
pub(crate) fn settings(config: &Config) -> Result<BTreeMap<String, String>, ConfigError> {
    let shown = |value: Value| match value {
        Value::String(text) => text,
        value => value.to_string(),
    };
    Ok(flat(config)?.into_iter().map(|(key, value)| (key, shown(value))).collect())
}

/// Whether a running learner can change this key.
pub fn is_live(key: &str) -> bool {
    is_under(key, &LIVE)
}

pub(crate) fn defaults() -> Result<Table, ConfigError> {
    parse(DEFAULTS, "presets/all.toml")
}

pub(crate) fn parse(text: &str, source_name: &str) -> Result<Table, ConfigError> {
    text.parse::<Table>().map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        let last_line = before.rsplit('\n').next().unwrap_or_default();
        let number = error.span().and_then(|span| text.get(span)).filter(|found| is_whole_number(found));
        let reason = number.map(|number| format!("{number} is out of range {}..={WHOLE_MAX}", i64::MIN));
        ConfigError::Syntax {
            source_name: source_name.to_owned(),
            line: before.matches('\n').count() + 1,
            column: last_line.chars().count() + 1,
            reason: reason.unwrap_or_else(|| one_line(&error)),
        }
    })
}

/// Whether this is a whole number, though it may have too many digits for one.
fn is_whole_number(text: &str) -> bool {
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit() || byte == b'_')
}

fn one_line(error: &toml::de::Error) -> String {
    error.message().lines().collect::<Vec<_>>().join("; ")
}

/// What the deserialiser found, with the key, which it names apart from its message.
pub(crate) fn wrong_value(error: &toml::de::Error) -> ConfigError {
    let (text, message) = (error.to_string(), one_line(error));
    let named = text.lines().rev().find_map(|line| line.strip_prefix("in `")?.strip_suffix('`'));
    let key = named.unwrap_or_default().to_owned();
    let choice = message.strip_prefix("unknown variant `").and_then(|rest| rest.split_once("`, expected "));
    if let Some((found, choices)) = choice {
        let choices = choices.trim_start_matches("one of ").replace(" or ", ", ").replace('`', "");
        return ConfigError::Choice { key, found: keys::quoted(found), choices };
    }
    // Types that read a text of their own name the key themselves.
    ConfigError::Value(if key.is_empty() || message.contains(&key) {
        message
    } else {
        format!("{key}: {message}")
    })
}

/// Puts `above` over `below`, table by table.
pub(crate) fn merge(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge(below, above),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

fn task_set(typed: &Table) -> Result<TaskSet, ConfigError> {
    let known = || TaskSet::known().iter().map(TaskSet::to_string).collect::<Vec<_>>().join(", ");
    let name = typed.get("environment").and_then(|section| section.get("task_set")).and_then(Value::as_str);
    name.ok_or_else(|| ConfigError::NoTaskSet { known: known() })?.parse().map_err(ConfigError::Name)
}

#[cfg(test)]
mod tests;
