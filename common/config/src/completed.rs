//! Settings that an older build wrote down, as this one says them; and settings of a run that changes none.

use crate::{
    ConfigError,
    method_keys::{TIME_LIMIT_BOOTSTRAPS, time_limit},
    resolve,
    saved::KNOWN_SINCE,
};
use std::collections::BTreeMap;
use toml::{Table, Value};

/// Adds the keys that did not exist when an older build wrote these settings, with the values that it behaved as if it had,
/// so that they can be compared with settings of this build. Settings that this build refuses are returned unchanged.
pub fn completed(mut settings: BTreeMap<String, String>) -> BTreeMap<String, String> {
    if let Some(bootstraps) = settings.remove(&format!("algorithm.{TIME_LIMIT_BOOTSTRAPS}")) {
        settings.insert("algorithm.time_limit".to_owned(), time_limit(bootstraps == "true").to_owned());
    }
    if KNOWN_SINCE.iter().any(|(key, _)| !settings.contains_key(*key))
        && let Ok(today) = today(&settings)
    {
        for (key, then) in KNOWN_SINCE.into_iter().filter(|(key, _)| today.contains_key(*key)) {
            settings.entry(key.to_owned()).or_insert_with(|| then.to_owned());
        }
    }
    settings
}

/// Every setting of a run on this task set with this method for which nothing else is set.
///
/// # Errors
/// When there is no such task set or method.
pub fn preset_settings(task_set: &str, method: &str) -> Result<BTreeMap<String, String>, ConfigError> {
    today(&BTreeMap::from([
        ("environment.task_set".to_owned(), task_set.to_owned()),
        ("algorithm.name".to_owned(), method.to_owned()),
    ]))
}

/// What this build makes of them, every key.
fn today(settings: &BTreeMap<String, String>) -> Result<BTreeMap<String, String>, ConfigError> {
    let mut typed = Table::new();
    for (key, text) in settings {
        // Texts were written without quotation marks, and all else as TOML.
        let parsed =
            format!("value = {text}").parse::<Table>().ok().and_then(|mut line| line.remove("value"));
        let value = parsed.unwrap_or_else(|| Value::String(text.clone()));
        let (table, name) = match key.split_once('.') {
            Some((section, name)) => {
                let section = typed.entry(section).or_insert_with(|| Value::Table(Table::new()));
                let Value::Table(section) = section else { continue };
                (section, name)
            }
            None => (&mut typed, key.as_str()),
        };
        table.insert(name.to_owned(), value);
    }
    resolve("", "settings of an older build", &[typed])?.settings()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::set;

    fn of(settings: &[(&str, &str)]) -> BTreeMap<String, String> {
        settings.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
    }

    #[test]
    fn a_key_of_today_has_its_default_and_what_was_written_stays() {
        let older = of(&[
            ("environment.task_set", "3-8m"),
            ("algorithm.name", "vdn-attn"),
            ("algorithm.gamma", "0.8"),
            ("seed", "7"),
        ]);
        let today = completed(older.clone());
        assert_eq!(today["algorithm.reward_scale"], "1.0");
        assert_eq!(today["environment.backend"], "embedded");
        assert_eq!(today["algorithm.time_limit"], "environment", "the preset of combat says otherwise today");
        assert!(!today.contains_key("environment.spawn_rotate"), "what was done then is not known");
        assert!(older.iter().all(|(key, value)| today[key] == *value));
        let on_policy = completed(of(&[("environment.task_set", "3-8m"), ("algorithm.name", "mappo")]));
        assert!(!on_policy.contains_key("algorithm.reward_scale"), "mappo has none");
        let renamed = completed(of(&[
            ("environment.task_set", "cooperative-navigation"),
            ("algorithm.name", "mat"),
            ("algorithm.time_limit_bootstraps", "true"),
        ]));
        assert_eq!(renamed["algorithm.time_limit"], "truncated");
        assert!(!renamed.contains_key("algorithm.time_limit_bootstraps"));
    }

    #[test]
    fn what_this_build_wrote_is_whole() {
        for name in ["rit", "mappo", "roma"] {
            let method = set(&format!("algorithm.name={name}")).unwrap();
            let config =
                resolve("environment.task_set = \"cooperative-navigation\"", "test", &[method]).unwrap();
            let settings = config.settings().unwrap();
            assert_eq!(completed(settings.clone()), settings);
            let mut older = settings.clone();
            older.remove("algorithm.reward_scale");
            assert_eq!(completed(older), settings);
        }
    }

    #[test]
    fn settings_that_this_build_refuses_stay_as_they_are() {
        for settings in [
            of(&[("algorithm.name", "dqn"), ("algorithm.gamma", "0.9")]),
            of(&[("algorithm.wisdom", "1")]),
            of(&[("algorithm.gamma", "7")]),
        ] {
            assert_eq!(completed(settings.clone()), settings);
        }
    }
}
