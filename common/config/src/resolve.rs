//! From what a person typed to a [`Config`].

use crate::{
    Backend, Config, ConfigError, Environment, KeepBest, SpawnRotate, StarCraft, Until, foreign, keys,
    method_keys,
};
use rit_algo::{Method, Regime};
use rit_env::{
    TaskSet,
    combat::{StatsVersion, world::ScriptedMedivac},
};
use std::collections::BTreeMap;
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
    let mut set = Table::new();
    for setting in settings {
        merge(&mut set, setting.clone());
    }
    method_keys::translate_ablations(&mut set, method_keys::named(&typed)?)?;
    merge(&mut typed, set);
    keys::check(&typed, &defaults)?;
    foreign::choose(&mut typed)?;
    let (method, task_set) = (method_keys::named(&typed)?, task_set(&typed)?);
    method_keys::check(&typed, method)?;
    let mut all = defaults;
    for preset in method_keys::presets(method, task_set)? {
        merge(&mut all, preset);
    }
    merge(&mut all, typed);
    let mut config: Config = all.try_into().map_err(|error| wrong_value(&error))?;
    if matches!(task_set, TaskSet::Foreign(_)) {
        config.environment.task_set = foreign::task_set(&config.environment)?;
        config.dims().validate()?;
    }
    for (key, value, min, max) in config.limits() {
        value.check(key, min, max)?;
    }
    if method.facts().regime == Regime::OnPolicy && config.algorithm.policy_lag > 0 {
        return Err(ConfigError::OnPolicyLag { method, policy_lag: config.algorithm.policy_lag });
    }
    let task_set = config.environment.task_set;
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
    check_backend(&config)?;
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

/// `[starcraft]` as nobody has changed it.
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
    let no_assignment = || ConfigError::NoAssignment(keys::quoted(assignment));
    let (key, text) = assignment.split_once('=').ok_or_else(no_assignment)?;
    let (key, text) = (key.trim(), text.trim());
    if key.is_empty() {
        return Err(no_assignment());
    }
    let value = keys::read(key, text, &defaults()?)?;
    let (sections, name) = key.rsplit_once('.').unwrap_or(("", key));
    let table = Table::from_iter([(name.to_owned(), value)]);
    let sections = sections.rsplit('.').filter(|section| !section.is_empty());
    Ok(sections.fold(table, |table, section| Table::from_iter([(section.to_owned(), table.into())])))
}

/// The keys that somebody may have meant who wrote this name, such as an option that does not exist: all that are called
/// so in their sections, or else the one most like it.
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
const FREE: [&str; 16] = [
    "environment.environments_per_worker",
    "environment.interpreter",
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
        ConfigError::Syntax {
            source_name: source_name.to_owned(),
            line: before.matches('\n').count() + 1,
            column: last_line.chars().count() + 1,
            reason: one_line(&error),
        }
    })
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
        let settings: Vec<Table> = settings.iter().map(|text| set(text)).collect::<Result<_, _>>()?;
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

    /// Why these settings are refused, by `set` or by `resolve`.
    fn refused(settings: &[&str]) -> String {
        with(settings).unwrap_err().to_string()
    }

    /// Why an experiment's text is refused.
    fn refused_file(text: &str) -> String {
        resolve(text, "my.toml", &[]).unwrap_err().to_string()
    }

    #[test]
    fn errors_name_the_key_and_the_remedy() {
        for (setting, message) in [
            ("algorithm.gamma=7", "algorithm.gamma = 7 is out of range 0..=1"),
            ("algorithm.gamma=nan", "algorithm.gamma = NaN is out of range 0..=1"),
            ("algorithm.gamma=high", "algorithm.gamma must be a number, not \"high\""),
            ("algorithm.lr=1e30", "algorithm.lr = 1e30 is out of range 1e-12..=1"),
            ("algorithm.lr=1e-13", "algorithm.lr = 1e-13 is out of range 1e-12..=1"),
            ("algorithm.rmsprop_alpha=1", "algorithm.rmsprop_alpha = 1 is out of range 0..=0.999999"),
            ("algorithm.batch_size=-1", "algorithm.batch_size must be a whole number of at least 0, not -1"),
            (
                "algorithm.batch_size=32.0",
                "algorithm.batch_size must be a whole number of at least 0, not 32.0; write 32",
            ),
            (
                "algorithm.batch_size=many",
                "algorithm.batch_size must be a whole number of at least 0, not \"many\"",
            ),
            ("algorithm.batch_size=6000", "algorithm.batch_size = 6000 is out of range 1..=5000"),
            (
                "algorithm.task_representations=no",
                "algorithm.task_representations must be true or false, not \"no\"",
            ),
            (
                "seed=18446744073709551615",
                "seed = 18446744073709551615 is out of range 0..=9223372036854775807",
            ),
            ("training.t_max=1e30", "training.t_max = 1e30 is out of range 0..=9223372036854775807"),
            ("training.t_max=2e12", "training.t_max = 2000000000000 is out of range 1..=1000000000000"),
            (
                "environment.approach_shaping=5",
                "environment.approach_shaping means nothing to matrix-game; leave it out",
            ),
            (
                "environment.view_radius=1",
                "environment.view_radius means nothing to matrix-game; leave it out",
            ),
            ("network.n_heads=3", "network.attention_dim = 64 is not a multiple of network.n_heads = 3"),
            ("algorithm.mixing=vdn", "algorithm.mixing must be \"network\" or \"sum\""),
            (
                "environment.spawn_rotate=x",
                "environment.spawn_rotate = \"x\" is none of its choices: published, always, never",
            ),
            (
                "algorithm.optimizer=sgd",
                "algorithm.optimizer = \"sgd\" is none of its choices: rmsprop, adam",
            ),
            ("web.listen=8080", "web.listen = \"8080\"; write \"127.0.0.1:PORT\" or \"off\""),
            (
                "algorithm.gamma",
                "--set \"algorithm.gamma\": write --set section.key=value, such as --set algorithm.lr=0.0005",
            ),
            (
                "algorithm={gamma=0.5}",
                "algorithm must be a section, not a value: set one of its keys, such as algorithm.batch_size",
            ),
        ] {
            assert_eq!(refused(&[setting]), message, "{setting}");
        }
        assert_eq!(
            refused(&["algorithm.name=refil", "algorithm.encoder=x"]),
            "algorithm.encoder = \"x\" is none of its choices: within, beside"
        );
        assert!(refused(&["training.until=win_rate=2"]).contains("write win_rate=NUMBER"));
        assert!(refused(&["web.listen=0.0.0.0:8080"]).contains("ssh -L 8080:127.0.0.1:8080 THIS-MACHINE"));
        assert!(
            refused(&["environment.task_set=chess"])
                .contains("unknown task set \"chess\"; known: matrix-game")
        );
        assert!(refused_file("").contains("names no environment.task_set"));
    }

    #[test]
    fn a_key_that_is_not_there_gets_the_one_that_was_meant_or_those_there_are() {
        for (setting, advice) in [
            ("algorithm.gama=0.9", "unknown key \"algorithm.gama\"; did you mean algorithm.gamma?"),
            ("gamma=0.9", "unknown key \"gamma\"; did you mean algorithm.gamma?"),
            ("learner.gamma=0.9", "unknown key \"learner.gamma\"; did you mean algorithm.gamma?"),
            (
                "learner.device=cuda",
                "unknown key \"learner.device\"; [learner] has listen, metrics_every_env_steps, shards, \
                 stall_timeout_ms, threads, tls, token_file",
            ),
            ("zzz.qqq=1", "unknown key \"zzz.qqq\"; a key is one of actors, algorithm,"),
            ("seed\n8=1", "unknown key \"seed\\n8\"; "),
            ("=1", "--set \"=1\": write --set section.key=value"),
        ] {
            let message = refused(&[setting]);
            assert!(message.starts_with(advice), "{message}");
        }
        let endless = "gamma".repeat(1_000_000);
        let message = refused(&[&format!("{endless}=1")]);
        assert!(message.len() < 400 && message.contains("gammagamma\"…"), "{message}");
        assert_eq!(keys_like("lr"), ["algorithm.lr"]);
        assert_eq!(keys_like("batch-size"), ["algorithm.batch_size"]);
        assert_eq!(keys_like("bach-size"), ["algorithm.batch_size"]);
        assert_eq!(keys_like("listen"), ["learner.listen", "web.listen"]);
        assert!(keys_like("zzz").is_empty());
    }

    #[test]
    fn one_setting_sets_one_key() {
        assert_eq!(
            refused(&["training.t_max=6\nseed=9"]),
            "training.t_max must be a whole number of at least 0, not \"6\\nseed=9\""
        );
        let message = refused(&["training.until=mean_return=1\nseed=9"]);
        assert!(message.contains("\"mean_return=1\\nseed=9\""), "{message}");
        let quoted = set("learner.token_file=\"a b\"").unwrap();
        assert_eq!(quoted, set("learner.token_file=a b").unwrap());
        assert_eq!(quoted["learner"]["token_file"].as_str(), Some("a b"));
    }

    #[test]
    fn a_list_is_written_as_in_toml_or_with_commas() {
        for text in ["[\"game-1\", \"game-4\"]", "game-1,game-4", "game-1, game-4"] {
            let config = with(&[&format!("environment.training_tasks={text}")]).unwrap();
            assert_eq!(config.environment.training_tasks, ["game-1", "game-4"], "{text}");
        }
        assert!(refused(&["environment.training_tasks=[1"]).contains("must be a list, not \"[1\""));
        assert!(refused(&["environment.training_tasks=game-9"]).starts_with("environment.training_tasks: "));
    }

    #[test]
    fn counts_may_be_written_short() {
        for text in ["1e6", "1000k", "1M", "1_000_000", "1000000"] {
            let config = with(&[&format!("training.t_max={text}")]).unwrap();
            assert_eq!(config.training.t_max, 1_000_000, "{text}");
        }
        let largest = with(&["seed=9223372036854775807"]).unwrap();
        assert_eq!(largest.seed.0, 9_223_372_036_854_775_807);
        assert_eq!(resolve(&largest.to_toml().unwrap(), "config.toml", &[]), Ok(largest));
        assert_eq!(with(&["algorithm.grad_norm_clip=1k"]).unwrap().algorithm.grad_norm_clip, 1000.0);
    }

    #[test]
    fn a_bound_is_within_its_bounds_and_leads_back() {
        for setting in [
            "algorithm.lr=1e-12",
            "algorithm.lr=1",
            "algorithm.optimizer_eps=1e-12",
            "algorithm.rmsprop_alpha=0.999999",
        ] {
            let config = with(&[setting]).unwrap();
            assert_eq!(resolve(&config.to_toml().unwrap(), "config.toml", &[]), Ok(config), "{setting}");
        }
        let text = with(&["algorithm.lr=0.001", "algorithm.gamma=0.9"]).unwrap().to_toml().unwrap();
        assert!(text.contains("lr = 0.001\n") && text.contains("gamma = 0.9\n"), "{text}");
    }

    #[test]
    fn an_end_that_no_task_reaches_is_refused() {
        assert!(with(&["training.until=win_rate=0.5"]).is_ok());
        for name in ["cooperative-navigation", "predator-prey", "predator-prey-pro"] {
            let text = format!("environment.task_set = {name:?}\ntraining.until = \"win_rate=0.5\"");
            assert_eq!(
                refused_file(&text),
                format!(
                    "training.until = \"win_rate=0.5\": the tasks of {name} know no winning, so that is never \
                     reached; write mean_return=NUMBER"
                )
            );
        }
    }

    #[test]
    fn a_best_policy_is_kept_by_what_its_tasks_know() {
        let kept = |text: &str| with(&[text]).unwrap().checkpoints.keep_best;
        assert_eq!(kept("checkpoints.keep_best=win_rate"), KeepBest::WinRate);
        assert_eq!((kept("checkpoints.keep_best="), kept("seed=1")), (KeepBest::Never, KeepBest::Never));
        assert!(
            refused(&["checkpoints.keep_best=loss"])
                .starts_with("checkpoints.keep_best = \"loss\"; write mean_return")
        );
        assert!(
            refused(&["evaluation.absolute_metric=true"])
                .contains("set checkpoints.keep_best to mean_return")
        );
        assert!(with(&["evaluation.absolute_metric=true", "checkpoints.keep_best=mean_return"]).is_ok());
        let text = "environment.task_set = \"predator-prey\"\ncheckpoints.keep_best = \"win_rate\"";
        assert!(refused_file(text).contains("the tasks of predator-prey know no winning; write mean_return"));
    }

    #[test]
    fn what_is_no_toml_is_said_with_its_place() {
        for (text, place) in [
            ("a = = b", "my.toml, line 1, column 5: "),
            ("seed = 1\n\n# ä\n\"ä\" = x\n", "my.toml, line 4, column 7: "),
            ("seed = 1\nseed = 2\n", "my.toml, line 2, column 1: "),
            ("seed = 18446744073709551615\n", "my.toml, line 1, column 8: "),
        ] {
            let message = refused_file(text);
            assert!(message.starts_with(place), "{message}");
        }
        for text in ["a = = b", "seed = 1\nseed = 2", "[a\n]", "a = '''\nb"] {
            assert!(!refused_file(text).contains('\n'), "one line: {}", refused_file(text));
        }
    }

    #[test]
    fn a_file_has_whole_numbers_written_as_such() {
        let refused = |value: &str| refused_file(&format!("{MATRIX}\ntraining.t_max = {value}"));
        let must = "training.t_max must be a whole number of at least 0, not ";
        assert_eq!(refused("1e6"), format!("{must}1000000.0; write 1000000"));
        assert_eq!(refused("0.5"), format!("{must}0.5"));
        assert_eq!(refused("\"5\""), format!("{must}\"5\""));
        assert_eq!(refused("[5]"), format!("{must}a list"));
        assert_eq!(refused_file(&format!("algorithm = 5\n{MATRIX}")), "algorithm must be a section, not 5");
    }
}
