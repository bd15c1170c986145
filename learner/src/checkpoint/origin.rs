//! Whose checkpoint it is: of which run, and trained with which settings.

use rit_config::{Config, ConfigError, RunDir};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What this build writes and reads: the files of a checkpoint, their names and what they mean. Raise it when any of
/// that changes.
pub const FORMAT_VERSION: u32 = 1;

/// What a checkpoint says of where it comes from.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// See [`FORMAT_VERSION`]; 0 in checkpoints from before there was one.
    pub format_version: u32,
    /// The run, in hexadecimal; of a copied run the first one.
    pub run_id: String,
    /// Every key of the configuration that weights follow from, with its value.
    pub settings: BTreeMap<String, String>,
}

/// Why training cannot go on from a checkpoint, though it may be whole.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OtherOrigin {
    /// Another build's.
    #[error(
        "it has format version {found}, this build reads {FORMAT_VERSION}; go on with the build that wrote it"
    )]
    Format {
        /// Its version.
        found: u32,
    },
    /// From another run directory.
    #[error("it is of another run ({found}); move it away")]
    Run {
        /// That run.
        found: String,
    },
    /// Trained otherwise.
    #[error(
        "it was trained with {key} = {trained}, config.toml says {now}; set it back, or begin a new run with the other value"
    )]
    Setting {
        /// The key.
        key: String,
        /// Its value in the checkpoint.
        trained: String,
        /// Its value in `config.toml`.
        now: String,
    },
}

impl Origin {
    /// Of the checkpoints that a learner of this run writes.
    ///
    /// # Errors
    /// When the configuration cannot be written down.
    pub fn of(run_dir: &RunDir, config: &Config) -> Result<Self, ConfigError> {
        let run_id = run_dir.lineage().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { format_version: FORMAT_VERSION, run_id, settings: config.result_settings()? })
    }

    /// Whether a learner with this origin may go on from a checkpoint with the `other`. Returns the settings that may
    /// change while a run goes on and have changed, in words.
    ///
    /// # Errors
    /// The first difference that may not be.
    pub fn may_go_on_from(&self, other: &Self) -> Result<Vec<String>, OtherOrigin> {
        if other.format_version != self.format_version {
            return Err(OtherOrigin::Format { found: other.format_version });
        }
        if other.run_id != self.run_id {
            return Err(OtherOrigin::Run { found: other.run_id.clone() });
        }
        let none = || "nothing".to_owned();
        let mut changed = Vec::new();
        let keys =
            self.settings.keys().chain(other.settings.keys().filter(|key| !self.settings.contains_key(*key)));
        // The build that wrote the checkpoint may have known fewer keys.
        let completed = rit_config::completed(other.settings.clone());
        for key in keys {
            let (now, trained) = (self.settings.get(key), completed.get(key));
            if now == trained {
                continue;
            }
            let (now, trained) = (now.cloned().unwrap_or_else(none), trained.cloned().unwrap_or_else(none));
            if !rit_config::is_live(key) {
                return Err(OtherOrigin::Setting { key: key.clone(), trained, now });
            }
            changed.push(format!(
                "{key} is {now} from here on, it was {trained} when the checkpoint was written"
            ));
        }
        Ok(changed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_named() {
        let settings = [
            ("algorithm.gamma", "0.99"),
            ("algorithm.epsilon_finish", "0.05"),
            ("environment.task_set", "matrix-game"),
            ("environment.backend", "embedded"),
            ("seed", "5"),
        ];
        let settings = settings.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
        let mine = Origin { format_version: FORMAT_VERSION, run_id: "ab".into(), settings };
        assert_eq!(mine.may_go_on_from(&mine), Ok(vec![]));
        let with = |key: &str, value: Option<&str>| {
            let mut other = mine.clone();
            match value {
                Some(value) => other.settings.insert(key.into(), value.into()),
                None => other.settings.remove(key),
            };
            mine.may_go_on_from(&other).map_err(|error| error.to_string())
        };
        let refused = |key, value| with(key, value).unwrap_err();
        assert!(
            refused("algorithm.gamma", Some("0.5"))
                .starts_with("it was trained with algorithm.gamma = 0.5, config.toml says 0.99; set it back")
        );
        assert!(refused("seed", None).starts_with("it was trained with seed = nothing, config.toml says 5"));
        // A key that the checkpoint's build did not know had its default then.
        let mut mine_with_scale = mine.clone();
        mine_with_scale.settings.insert("algorithm.reward_scale".into(), "1.0".into());
        assert_eq!(mine_with_scale.may_go_on_from(&mine), Ok(vec![]));
        mine_with_scale.settings.insert("algorithm.reward_scale".into(), "0.1".into());
        let error = mine_with_scale.may_go_on_from(&mine).unwrap_err().to_string();
        assert!(error.contains("algorithm.reward_scale = 1.0, config.toml says 0.1"), "{error}");
        assert!(
            refused("algorithm.luck", Some("1")).contains("algorithm.luck = 1, config.toml says nothing")
        );
        let changed = with("algorithm.epsilon_finish", Some("0.1")).unwrap();
        assert_eq!(
            changed,
            ["algorithm.epsilon_finish is 0.05 from here on, it was 0.1 when the checkpoint was written"]
        );
        let old = mine.may_go_on_from(&Origin::default()).unwrap_err().to_string();
        assert_eq!(old, "it has format version 0, this build reads 1; go on with the build that wrote it");
        let other = Origin { run_id: "cd".into(), ..mine.clone() };
        assert_eq!(
            mine.may_go_on_from(&other).unwrap_err().to_string(),
            "it is of another run (cd); move it away"
        );
    }
}
