//! From what a person typed to a [`Config`].

use crate::{Config, Environment, SpawnRotate, method_keys};
use rit_algo::{Method, Regime};
use rit_env::{
    TaskError, TaskSet, UnknownName,
    combat::{StatsVersion, world::ScriptedMedivac},
};
use std::collections::BTreeMap;
use toml::{Table, Value};

/// What is wrong with what was typed. Every message names the key and what would do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML.
    #[error("{source_name} is not TOML: {reason}")]
    Syntax {
        /// The file or option.
        source_name: String,
        /// What the parser said, in one line.
        reason: String,
    },
    /// No such key.
    #[error("unknown key {key:?}{}", suggestion.as_ref().map_or(String::new(), |known| format!("; did you mean {known:?}?")))]
    UnknownKey {
        /// The key.
        key: String,
        /// The key that looks most like it.
        suggestion: Option<String>,
    },
    /// A value of another kind.
    #[error("{key} must be {expected}, not {found}")]
    Kind {
        /// The key.
        key: String,
        /// The kind it must have.
        expected: &'static str,
        /// The kind it has.
        found: &'static str,
    },
    /// A number out of its range.
    #[error("{key} = {value} is out of range {min}..={max}")]
    Range {
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// Its smallest.
        min: f64,
        /// Its largest.
        max: f64,
    },
    /// A number that changes nothing in this task set.
    #[error("{key} means nothing to {task_set}; leave it out")]
    Meaningless {
        /// The key.
        key: &'static str,
        /// The task set.
        task_set: TaskSet,
    },
    /// A name that is no task of the set.
    #[error("{key}: {error}")]
    Task {
        /// The key.
        key: &'static str,
        /// What is wrong with the name.
        error: TaskError,
    },
    /// A task that is listed twice.
    #[error("{key} lists {name} twice")]
    TaskTwice {
        /// The key.
        key: &'static str,
        /// The task.
        name: String,
    },
    /// A key that this method has no use for.
    #[error("{key} means nothing to {method}; these have it: {owners}")]
    NotOfMethod {
        /// The key.
        key: String,
        /// The method.
        method: Method,
        /// Who has it.
        owners: String,
    },
    /// A name that no method has.
    #[error(
        "unknown algorithm {name:?}; {}known: {}",
        suggestion.map_or(String::new(), |known| format!("did you mean {known:?}? ")),
        Method::ALL.map(Method::name).join(", ")
    )]
    UnknownMethod {
        /// The name.
        name: String,
        /// The name that looks most like it.
        suggestion: Option<&'static str>,
    },
    /// Another method for a run that has begun.
    #[error("the run was begun with the algorithm {method} and cannot go on with {name}; start a new one")]
    OtherMethod {
        /// The run's.
        method: Method,
        /// What was typed.
        name: Method,
    },
    /// Weights that are older than an on-policy method can learn with.
    #[error(
        "algorithm.policy_lag = {policy_lag}: {method} learns from each batch with the weights that rolled it; only 0 will do"
    )]
    OnPolicyLag {
        /// The method.
        method: Method,
        /// What was typed.
        policy_lag: usize,
    },
    /// A word that means nothing there.
    #[error("{0}")]
    Name(#[from] UnknownName),
    /// An experiment that does not say what to train on.
    #[error("the experiment names no environment.task_set; known: {known}")]
    NoTaskSet {
        /// Those there are.
        known: String,
    },
    /// A key that a run under way cannot change.
    #[error("{key} cannot change in a run that has begun; start a new one")]
    Fixed {
        /// The key.
        key: String,
    },
    /// Nobody would roll episodes.
    #[error(
        "actors.count = 0 leaves the run nobody who rolls episodes; `rit ctl pause` lets it rest, and with actors.remote \
         actors on other hosts may do all of it"
    )]
    NoActors,
    /// A key that a running learner cannot change.
    #[error("{key} cannot change while the learner runs; these can: {}", LIVE.join(", "))]
    NotLive {
        /// The key.
        key: String,
    },
    /// Values that cannot go together.
    #[error("{0}")]
    Model(#[from] rit_algo::ConfigError),
    /// What is left for the deserialiser to find: a word that is none of its choices.
    #[error("{0}")]
    Value(String),
}

/// Resolves an experiment and what the command line sets, in ascending order of precedence.
///
/// # Errors
/// The first thing found wrong.
pub fn resolve(experiment: &str, source_name: &str, settings: &[Table]) -> Result<Config, ConfigError> {
    let defaults = parse(include_str!("presets/all.toml"), "presets/all.toml")?;
    let mut typed = parse(experiment, source_name)?;
    method_keys::translate_ablations(&mut typed, Method::Rit)?;
    let mut set = Table::new();
    for setting in settings {
        merge(&mut set, setting.clone());
    }
    method_keys::translate_ablations(&mut set, method_keys::named(&typed)?)?;
    merge(&mut typed, set);
    check_keys(&typed, &defaults, "")?;
    let (method, task_set) = (method_keys::named(&typed)?, task_set(&typed)?);
    method_keys::check(&typed, method)?;
    let mut all = defaults;
    for preset in method_keys::presets(method, task_set)? {
        merge(&mut all, preset);
    }
    merge(&mut all, typed);
    let config: Config =
        all.try_into().map_err(|error: toml::de::Error| ConfigError::Value(one_line(&error)))?;
    for (key, value, min, max) in config.limits() {
        // Written so that a NaN is out of every range.
        if !(min..=max).contains(&value) {
            return Err(ConfigError::Range { key, value, min, max });
        }
    }
    if method.facts().regime == Regime::OnPolicy && config.algorithm.policy_lag > 0 {
        return Err(ConfigError::OnPolicyLag { method, policy_lag: config.algorithm.policy_lag });
    }
    let task_set = config.environment.task_set;
    let Environment { training_tasks, testing_tasks, spawn_rotate, stats, enemy_medivac, .. } =
        &config.environment;
    for (key, names) in
        [("environment.training_tasks", training_tasks), ("environment.testing_tasks", testing_tasks)]
    {
        for (at, name) in names.iter().enumerate() {
            task_set.task(name).map_err(|error| ConfigError::Task { key, error })?;
            if names[..at].contains(name) {
                return Err(ConfigError::TaskTwice { key, name: name.clone() });
            }
        }
    }
    let is_combat = matches!(task_set, TaskSet::Combat(_));
    let meaningless = [
        ("environment.spawn_rotate", *spawn_rotate != SpawnRotate::Published && !is_combat),
        ("environment.stats", *stats != StatsVersion::default() && !is_combat),
        ("environment.enemy_medivac", *enemy_medivac != ScriptedMedivac::default() && !is_combat),
        ("environment.approach_shaping", config.environment.approach_shaping != 0.0 && !task_set.has_prey()),
        (
            "environment.view_radius",
            config.environment.view_radius.is_finite() && !task_set.has_view_radius(),
        ),
    ];
    if let Some(&(key, _)) = meaningless.iter().find(|(_, meaningless)| *meaningless) {
        return Err(ConfigError::Meaningless { key, task_set });
    }
    config.model().validate()?;
    Ok(config)
}

/// One `section.key=value` of the command line. A value that is no TOML is taken as a word.
///
/// # Errors
/// When there is no `=` or no key.
pub fn set(assignment: &str) -> Result<Table, ConfigError> {
    // Whatever a shell lets through, the message is one line.
    let source_name = || format!("--set {}", assignment.replace(char::is_control, " "));
    let Some((key, value)) = assignment.split_once('=') else {
        let reason = "write --set section.key=value".to_owned();
        return Err(ConfigError::Syntax { source_name: source_name(), reason });
    };
    let (key, value) = (key.trim(), value.trim());
    parse(&format!("{key} = {value}"), &source_name())
        .or_else(|_| parse(&format!("{key} = {value:?}"), &source_name()))
}

/// Keys, or sections, that a run may change when it goes on: no weight follows from them.
const FREE: [&str; 10] = [
    "training",
    "evaluation",
    "checkpoints",
    "actors",
    "learner.listen",
    "learner.token_file",
    "learner.tls",
    "learner.threads",
    "learner.metrics_every_env_steps",
    "web",
];

/// Keys that a running learner can change. Of these `algorithm.epsilon_finish` changes the
/// result, and `evaluation` does where `training.until` ends the run at an evaluation.
const LIVE: [&str; 7] = [
    "algorithm.epsilon_finish",
    "evaluation.every_env_steps",
    "evaluation.episodes",
    "checkpoints.every_env_steps",
    "actors.count",
    "actors.heartbeat_timeout_ms",
    "learner.metrics_every_env_steps",
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
        let (key, value, max) = ("actors.count", count as f64, max as f64);
        return Err(ConfigError::Range { key, value, min: 0.0, max });
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

/// Every `section.key` of the method with its value.
fn flat(config: &Config) -> Result<BTreeMap<String, Value>, ConfigError> {
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

/// See [`Config::result_settings`].
pub(crate) fn result_settings(config: &Config) -> Result<BTreeMap<String, String>, ConfigError> {
    let keys = flat(config)?.into_iter().filter(|(key, _)| !is_under(key, &FREE));
    let shown = |value: Value| match value {
        Value::String(text) => text,
        // 0.99, where an f32 is 0.9900000095367432 on its way through TOML's f64.
        Value::Float(number) if f64::from(number as f32) == number => (number as f32).to_string(),
        value => value.to_string(),
    };
    Ok(keys.map(|(key, value)| (key, shown(value))).collect())
}

/// Whether a running learner can change this key.
pub fn is_live(key: &str) -> bool {
    is_under(key, &LIVE)
}

pub(crate) fn parse(text: &str, source_name: &str) -> Result<Table, ConfigError> {
    text.parse::<Table>().map_err(|error| ConfigError::Syntax {
        source_name: source_name.to_owned(),
        reason: one_line(&error),
    })
}

fn one_line(error: &toml::de::Error) -> String {
    error.message().lines().collect::<Vec<_>>().join("; ")
}

/// Puts `above` over `below`, table by table.
fn merge(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge(below, above),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

/// Every typed key must be one of the defaults', and of its kind.
fn check_keys(typed: &Table, defaults: &Table, prefix: &str) -> Result<(), ConfigError> {
    for (name, value) in typed {
        let key = format!("{prefix}{name}");
        let Some(default) = defaults.get(name) else {
            return Err(ConfigError::UnknownKey { suggestion: closest(&key), key });
        };
        match (value, default) {
            (Value::Table(value), Value::Table(default)) => check_keys(value, default, &format!("{key}."))?,
            // A whole number will do for a real one.
            (Value::Integer(_), Value::Float(_)) => {}
            (Value::Integer(number), Value::Integer(_)) if *number < 0 => {
                return Err(ConfigError::Kind {
                    key,
                    expected: "a whole number of at least 0",
                    found: "a negative one",
                });
            }
            _ if value.same_type(default) => {}
            _ => return Err(ConfigError::Kind { key, expected: kind(default), found: kind(value) }),
        }
    }
    Ok(())
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a word in quotes",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a section",
    }
}

/// Longest key that is compared with the known ones: comparing takes time in proportion to the length.
const COMPARED_LEN_MAX: usize = 100;

/// The known key that looks most like this one, if any does.
fn closest(key: &str) -> Option<String> {
    if key.len() > COMPARED_LEN_MAX {
        return None;
    }
    let mut known = Vec::new();
    if let Ok(defaults) = parse(include_str!("presets/all.toml"), "presets/all.toml") {
        for (section, value) in &defaults {
            known.push(section.clone());
            if let Value::Table(keys) = value {
                known.extend(keys.keys().map(|name| format!("{section}.{name}")));
            }
        }
    }
    // The last part alone is compared too: a key in the wrong section is a common slip.
    let last = |key: &str| key.rsplit('.').next().map(str::to_owned).unwrap_or_default();
    let likeness =
        |known: &str| strsim::jaro_winkler(key, known).max(strsim::jaro_winkler(&last(key), &last(known)));
    let best = known.into_iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(&best) > 0.8).then_some(best)
}

fn task_set(typed: &Table) -> Result<TaskSet, ConfigError> {
    let known = || TaskSet::ALL.map(|set| set.to_string()).join(", ");
    let name = typed.get("environment").and_then(|section| section.get("task_set")).and_then(Value::as_str);
    name.ok_or_else(|| ConfigError::NoTaskSet { known: known() })?.parse().map_err(ConfigError::Name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{OptimizerName, Until};

    const MATRIX: &str = "environment.task_set = \"matrix-game\"";

    fn with(settings: &[&str]) -> Result<Config, ConfigError> {
        let settings: Vec<Table> = settings.iter().map(|text| set(text).unwrap()).collect();
        resolve(MATRIX, "test", &settings)
    }

    #[test]
    fn table_ii_is_what_the_presets_say() {
        let matrix = with(&[]).unwrap();
        let algorithm = &matrix.algorithm;
        assert_eq!((algorithm.batch_size, algorithm.buffer_size, algorithm.n_rollout_threads), (32, 5000, 1));
        assert_eq!((algorithm.lr, algorithm.optimizer), (5e-4, OptimizerName::RmsProp));
        assert_eq!((algorithm.rmsprop_alpha, algorithm.optimizer_eps), (0.99, 1e-5));
        assert_eq!((matrix.training.t_max, matrix.network.task_representation_dim), (50_000, 32));
        for name in ["cooperative-navigation", "predator-prey", "predator-prey-pro"] {
            let mpe = resolve(&format!("environment.task_set = {name:?}"), "test", &[]).unwrap();
            let algorithm = &mpe.algorithm;
            assert_eq!(
                (algorithm.batch_size, algorithm.buffer_size, algorithm.n_rollout_threads),
                (64, 5000, 8)
            );
            assert_eq!(
                (algorithm.lr, algorithm.optimizer, algorithm.optimizer_eps),
                (1e-3, OptimizerName::Adam, 1e-8)
            );
            assert_eq!((mpe.training.t_max, mpe.network.task_representation_dim), (5_050_000, 20));
            assert_eq!((algorithm.epsilon_anneal_steps, algorithm.target_update_interval), (50_000, 200));
        }
    }

    #[test]
    fn the_command_line_is_above_the_experiment() {
        let config = with(&["algorithm.gamma=0.5", "algorithm.mixing=sum", "seed=9"]).unwrap();
        assert_eq!((config.algorithm.gamma, config.algorithm.name), (0.5, Method::RitVdn));
        assert_eq!(config.seed.0, 9);
        assert_eq!(with(&["training.until=win_rate=1.0"]).unwrap().training.until, Until::WinRate(1.0));
        assert_eq!(with(&["algorithm.gamma=1", "algorithm.gamma=0"]).unwrap().algorithm.gamma, 0.0);
    }

    #[test]
    fn what_weights_follow_from_is_told_from_what_they_do_not() {
        let settings = |text: &str| with(&[text]).unwrap().result_settings().unwrap();
        let keys = settings("algorithm.gamma=0.99");
        let value = |key: &str| keys.get(key).map(String::as_str);
        assert_eq!(
            (value("algorithm.gamma"), value("environment.task_set")),
            (Some("0.99"), Some("matrix-game"))
        );
        for key in [
            "seed",
            "algorithm.policy_lag",
            "algorithm.epsilon_finish",
            "network.hidden_dim",
            "learner.shards",
        ] {
            assert!(keys.contains_key(key), "{key}");
        }
        for free in [
            "training.t_max=7",
            "actors.count=3",
            "learner.threads=2",
            "checkpoints.keep=9",
            "web.listen=off",
        ] {
            assert_eq!(settings(free), keys, "{free}");
        }
        assert_ne!(settings("algorithm.gamma=0.5"), keys);
        assert!(is_live("algorithm.epsilon_finish") && !is_live("algorithm.gamma"));
    }

    #[test]
    fn what_is_written_leads_back() {
        let config = with(&["environment.view_radius=inf", "algorithm.lr=0.25"]).unwrap();
        let text = config.to_toml().unwrap();
        assert_eq!(resolve(&text, "config.toml", &[]), Ok(config));
    }

    #[test]
    fn errors_name_the_key_and_the_remedy() {
        let message = |settings: &[&str]| with(settings).unwrap_err().to_string();
        assert_eq!(message(&["algorithm.gamma=7"]), "algorithm.gamma = 7 is out of range 0..=1");
        assert_eq!(message(&["algorithm.gamma=nan"]), "algorithm.gamma = NaN is out of range 0..=1");
        assert_eq!(
            message(&["algorithm.gama=0.9"]),
            "unknown key \"algorithm.gama\"; did you mean \"algorithm.gamma\"?"
        );
        assert_eq!(message(&["gamma=0.9"]), "unknown key \"gamma\"; did you mean \"algorithm.gamma\"?");
        assert_eq!(message(&["zzz.qqq=1"]), "unknown key \"zzz\"");
        let endless = "gamma".repeat(1_000_000);
        assert_eq!(message(&[&format!("{endless}=1")]), format!("unknown key \"{endless}\""));
        assert_eq!(
            message(&["algorithm.gamma=high"]),
            "algorithm.gamma must be a number, not a word in quotes"
        );
        assert_eq!(
            message(&["algorithm.batch_size=-1"]),
            "algorithm.batch_size must be a whole number of at least 0, not a negative one"
        );
        assert_eq!(
            message(&["algorithm.batch_size=6000"]),
            "algorithm.batch_size = 6000 is out of range 1..=5000"
        );
        assert_eq!(
            message(&["environment.approach_shaping=5"]),
            "environment.approach_shaping means nothing to matrix-game; leave it out"
        );
        assert_eq!(
            message(&["environment.view_radius=1"]),
            "environment.view_radius means nothing to matrix-game; leave it out"
        );
        assert_eq!(message(&["network.n_heads=3"]), "attention_dim 64 is not a multiple of n_heads 3");
        assert!(message(&["training.until=win_rate=2"]).contains("write win_rate=NUMBER"));
        assert!(message(&["web.listen=0.0.0.0:8080"]).contains("ssh -L 8080:127.0.0.1:8080 THIS-MACHINE"));
        assert!(message(&["web.listen=8080"]).contains("must be a word in quotes"));
        assert!(message(&["web.listen=on"]).ends_with("write \"127.0.0.1:PORT\" or \"off\""));
        assert_eq!(message(&["algorithm.mixing=vdn"]), "algorithm.mixing must be \"network\" or \"sum\"");
        assert!(
            message(&["environment.task_set=chess"])
                .contains("unknown task set \"chess\"; known: matrix-game")
        );
        assert!(resolve("", "test", &[]).unwrap_err().to_string().contains("names no environment.task_set"));
        assert!(
            resolve("a = = b", "my.toml", &[]).unwrap_err().to_string().starts_with("my.toml is not TOML: ")
        );
        assert!(set("algorithm.gamma").unwrap_err().to_string().contains("section.key=value"));
        let two_lines = set("seed\n8").unwrap_err().to_string();
        assert_eq!(two_lines, "--set seed 8 is not TOML: write --set section.key=value");
    }
}
