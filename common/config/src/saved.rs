//! `config.toml` of a run: of a format that this build knows, and complete. What a build that wrote it did not know yet
//! is named: today's default for it would be a guess.

use crate::{
    Config, ConfigError, method_keys, resolve,
    resolve::{flat, is_free, merge},
    run_dir::CONFIG,
    set,
};
use std::collections::BTreeSet;
use toml::{Table, Value};

/// What this build writes. Raise it when what a key means changes.
pub(crate) const FORMAT_VERSION: i64 = 1;

/// Keys that have been added since, and what builds did that did not know them: no guess, whatever a preset says today.
pub(crate) const KNOWN_SINCE: [(&str, &str); 4] = [
    ("environment.backend", "embedded"),
    ("environment.physics", "original"),
    ("algorithm.reward_scale", "1.0"),
    ("algorithm.time_limit", "environment"),
];

/// Its key, the first of the file.
const KEY: &str = "format_version";

/// A run's configuration, and warnings of how it was found.
#[derive(Debug)]
pub(crate) struct Saved {
    pub(crate) config: Config,
    pub(crate) notices: Vec<String>,
}

/// The file's text.
pub(crate) fn to_text(config: &Config) -> Result<String, ConfigError> {
    Ok(format!("{KEY} = {FORMAT_VERSION}\n{}", config.to_toml()?))
}

/// What the file says, under these settings.
pub(crate) fn resolve_saved(text: &str, settings: &[Table]) -> Result<Saved, ConfigError> {
    let Ok(mut table) = text.parse::<Table>() else {
        // It says where the mistake is.
        return Ok(Saved { config: resolve(text, CONFIG, settings)?, notices: Vec::new() });
    };
    let mut notices = Vec::new();
    match table.remove(KEY) {
        Some(Value::Integer(FORMAT_VERSION)) => {}
        Some(found) => return Err(ConfigError::Format { found: found.to_string() }),
        None => notices.push(format!("{CONFIG} carries no {KEY}: an older build wrote it")),
    }
    method_keys::translate_time_limit(&mut table)?;
    let typed = keys(&table);
    let to_text =
        |table: &Table| toml::to_string(table).map_err(|error| ConfigError::Value(error.to_string()));
    let today = flat(&resolve(&to_text(&table)?, CONFIG, &[])?)?;
    let (known, missing): (Vec<String>, Vec<String>) = today
        .into_keys()
        .filter(|key| !typed.contains(key))
        .partition(|key| KNOWN_SINCE.iter().any(|(known, _)| known == key));
    if let Some(key) = missing.iter().find(|key| !is_free(key)) {
        return Err(ConfigError::Incomplete { key: key.clone() });
    }
    if !missing.is_empty() {
        notices.push(format!("{CONFIG} lacks {}: today's defaults are taken", missing.join(", ")));
    }
    for (key, then) in KNOWN_SINCE.iter().filter(|(key, _)| known.iter().any(|known| known == key)) {
        merge(&mut table, set(&format!("{key}={then}"))?);
        notices.push(format!("{CONFIG} lacks {key}: {then}, as builds did that had no such key"));
    }
    let config = resolve(&to_text(&table)?, CONFIG, settings)?;
    Ok(Saved { config, notices })
}

/// Every `section.key`.
fn keys(table: &Table) -> BTreeSet<String> {
    let mut keys = BTreeSet::new();
    for (section, value) in table {
        match value {
            Value::Table(table) => keys.extend(table.keys().map(|key| format!("{section}.{key}"))),
            _ => drop(keys.insert(section.clone())),
        }
    }
    keys
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_env::rollout::TimeLimit;

    fn config() -> Config {
        resolve("environment.task_set = \"matrix-game\"\nseed = 5", "test", &[]).unwrap()
    }

    #[test]
    fn what_is_written_leads_back_without_a_word() {
        let text = to_text(&config()).unwrap();
        assert!(text.starts_with("format_version = 1\n"), "{text}");
        let saved = resolve_saved(&text, &[]).unwrap();
        assert_eq!((saved.config, saved.notices), (config(), vec![]));
        let saved = resolve_saved(&text, &[set("training.t_max=7").unwrap()]).unwrap();
        assert_eq!((saved.config.training.t_max, saved.notices), (7, vec![]));
    }

    #[test]
    fn what_an_older_build_did_not_write_is_named() {
        let text = to_text(&config()).unwrap();
        let without = |key: &str| -> String {
            let lines = text.lines().filter(|line| !line.starts_with(&format!("{key} = ")));
            lines.map(|line| format!("{line}\n")).collect()
        };
        let error = |text: &str| resolve_saved(text, &[]).unwrap_err().to_string();
        assert_eq!(
            error(&without("policy_lag")),
            "config.toml lacks algorithm.policy_lag, from which weights follow: an older build wrote it; add the value \
             that the run was trained with"
        );
        assert!(error(&without("seed")).contains("config.toml lacks seed"));
        let notices = |text: &str| resolve_saved(text, &[]).unwrap().notices;
        assert_eq!(
            notices(&without("keep")),
            ["config.toml lacks checkpoints.keep: today's defaults are taken"]
        );
        assert_eq!(
            notices(&without("backend")),
            ["config.toml lacks environment.backend: embedded, as builds did that had no such key"],
        );
        assert_eq!(
            notices(&without("format_version")),
            ["config.toml carries no format_version: an older build wrote it"]
        );
        // What a preset says today is not what was done.
        let combat = resolve("environment.task_set = \"3-8m\"", "test", &[]).unwrap();
        assert_eq!(combat.algorithm.time_limit, TimeLimit::Terminated);
        let lines = to_text(&combat).unwrap();
        let older: String =
            lines.split_inclusive('\n').filter(|line| !line.starts_with("time_limit")).collect();
        let of = |settings: &[Table]| resolve_saved(&older, settings).unwrap().config.algorithm.time_limit;
        assert_eq!(of(&[]), TimeLimit::Environment);
        assert_eq!(of(&[set("algorithm.time_limit=truncated").unwrap()]), TimeLimit::Truncated);
        let next = FORMAT_VERSION + 1;
        let [this, newer] = [FORMAT_VERSION, next].map(|version| format!("format_version = {version}"));
        let newer = text.replacen(&this, &newer, 1);
        assert_eq!(
            error(&newer),
            format!(
                "config.toml has format_version {next}, this build reads {FORMAT_VERSION}; go on with the build that \
                 wrote it"
            )
        );
        assert!(error("seed = = 3").contains("line 1"));
    }
}
