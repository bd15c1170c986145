//! What a weights file says of itself: the model, so that it can be built, and what goes in and comes out.

use rit_algo::{ConfigError, Method, ModelConfig, method::Encoder};
use rit_config::Config;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, str::FromStr as _};

/// What this build writes and reads. Raise it when a key or a tensor changes its meaning.
pub const FORMAT_VERSION: u32 = 1;

/// What a run's observations and actions are called.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TaskNames {
    /// The task set.
    pub task_set: String,
    /// Features of an entity, by column, without its last action's one-hot.
    pub features: Vec<String>,
    /// Actions, by number.
    pub actions: Vec<String>,
}

impl TaskNames {
    /// Those of a run.
    pub fn of(config: &Config) -> Self {
        let set = config.environment.task_set;
        Self { task_set: set.to_string(), features: set.feature_names(), actions: set.action_names() }
    }
}

/// The description in a weights file's metadata.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// See [`FORMAT_VERSION`].
    pub format_version: u32,
    /// The algorithm's name.
    pub method: String,
    /// How entities become what an agent's history is made of.
    pub encoder: String,
    /// The task set that it was trained on.
    pub task_set: String,
    /// Every size that the method has a use for, heads among them.
    pub sizes: BTreeMap<String, usize>,
    /// Features of an entity, by column, without the last action's one-hot that follows them.
    pub feature_names: Vec<String>,
    /// Actions, by number.
    pub action_names: Vec<String>,
    /// SHA-256 of the weights as little-endian f32, tensor after tensor in the order of [`rit_nn::Layout`], in
    /// hexadecimal.
    pub digest: String,
}

/// A description that makes no model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// Another build's.
    #[error("it has format version {found}, this build reads {FORMAT_VERSION}; use the build that wrote it")]
    Format {
        /// Its version.
        found: u32,
    },
    /// No algorithm of ours.
    #[error(transparent)]
    Method(#[from] rit_algo::method::UnknownMethod),
    /// No encoder of its method.
    #[error("{method} has no encoder {found:?}")]
    Encoder {
        /// The method.
        method: Method,
        /// What is said.
        found: String,
    },
    /// Sizes that no model has.
    #[error(transparent)]
    Sizes(#[from] ConfigError),
    /// A size that is missing or beyond all reason.
    #[error("its size {name} is {found}; it must be 1 to {max}")]
    Size {
        /// Its name.
        name: &'static str,
        /// What is said; 0 where nothing is.
        found: usize,
        /// The most there may be.
        max: usize,
    },
    /// More or fewer names than there are columns or actions.
    #[error("it names {found} {what} where its sizes say {expected}")]
    Names {
        /// Features or actions.
        what: &'static str,
        /// Names.
        found: usize,
        /// As many as there should be.
        expected: usize,
    },
}

/// No size is larger: whatever a file says, a model of it fits into memory.
const SIZE_MAX: usize = 65_535;
/// Nor are there more heads, or blocks.
const COUNT_MAX: usize = 64;

impl Description {
    /// Of weights with this digest.
    pub fn new(model: &ModelConfig, names: &TaskNames, digest: String) -> Self {
        let sizes = model.sizes().into_iter().map(|(name, size)| (name.to_owned(), size));
        Self {
            format_version: FORMAT_VERSION,
            method: model.method.name().to_owned(),
            encoder: model.encoder.name().to_owned(),
            task_set: names.task_set.clone(),
            sizes: sizes.collect(),
            feature_names: names.features.clone(),
            action_names: names.actions.clone(),
            digest,
        }
    }

    /// Itself as the file has it.
    ///
    /// # Errors
    /// Never: it is made of words and numbers.
    pub fn to_json(&self) -> serde_json::Result<String> {
        serde_json::to_string(self)
    }

    /// The names in it.
    pub fn names(&self) -> TaskNames {
        TaskNames {
            task_set: self.task_set.clone(),
            features: self.feature_names.clone(),
            actions: self.action_names.clone(),
        }
    }

    /// The model that it describes.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn model(&self) -> Result<ModelConfig, DescriptionError> {
        if self.format_version != FORMAT_VERSION {
            return Err(DescriptionError::Format { found: self.format_version });
        }
        let method = Method::from_str(&self.method)?;
        let own = method.facts().encoder;
        let known = Encoder::ALL.into_iter().find(|encoder| encoder.name() == self.encoder);
        let fits =
            |encoder: &Encoder| *encoder == own || (*encoder == Encoder::Beside && own == Encoder::Within);
        let encoder = known.filter(fits).ok_or_else(|| DescriptionError::Encoder {
            method,
            found: self.encoder.chars().take(64).collect(),
        })?;
        let model =
            ModelConfig::of_sizes(method, encoder, |name| self.sizes.get(name).copied().unwrap_or_default());
        for (name, found) in model.sizes() {
            let max = if matches!(name, "n_heads" | "n_blocks") { COUNT_MAX } else { SIZE_MAX };
            if !(1..=max).contains(&found) {
                return Err(DescriptionError::Size { name, found, max });
            }
        }
        model.validate()?;
        let names = [
            ("actions", self.action_names.len(), model.n_actions),
            ("features", self.feature_names.len(), model.entity_dim.saturating_sub(model.n_actions)),
        ];
        for (what, found, expected) in names {
            if found != expected {
                return Err(DescriptionError::Names { what, found, expected });
            }
        }
        Ok(model)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(settings: &[&str]) -> Config {
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        rit_config::resolve("environment.task_set = \"cooperative-navigation\"", "test", &settings).unwrap()
    }

    #[test]
    fn every_method_describes_the_model_it_is_built_from() {
        for method in Method::ALL {
            let config = config(&[&format!("algorithm.name={method}")]);
            let description = Description::new(&config.model(), &TaskNames::of(&config), String::new());
            let described = description.model().unwrap();
            let layout = |config: ModelConfig| rit_algo::Model::new(config).unwrap().layout().clone();
            assert_eq!(layout(described), layout(config.model()), "{method}");
            let text = serde_json::to_string(&description).unwrap();
            assert_eq!(serde_json::from_str::<Description>(&text).unwrap(), description);
        }
        let beside = config(&["algorithm.name=refil", "algorithm.encoder=beside"]);
        let description = Description::new(&beside.model(), &TaskNames::of(&beside), String::new());
        assert_eq!(description.model().unwrap().encoder, Encoder::Beside);
    }

    /// Files of builds that wrote down sizes which MAPPO has no use for.
    #[test]
    fn a_size_that_its_method_has_no_use_for_changes_nothing() {
        let config = config(&["algorithm.name=mappo"]);
        let description = Description::new(&config.model(), &TaskNames::of(&config), String::new());
        assert!(!description.sizes.contains_key("n_heads") && !description.sizes.contains_key("n_blocks"));
        let mut older = description.clone();
        older.sizes.extend([("n_heads".to_owned(), 4), ("n_blocks".to_owned(), 1)]);
        let layout = |described: &Description| {
            rit_algo::Model::new(described.model().unwrap()).unwrap().layout().clone()
        };
        assert_eq!(layout(&older), layout(&description));
    }

    #[test]
    fn what_makes_no_model_is_named() {
        let config = config(&[]);
        let good = Description::new(&config.model(), &TaskNames::of(&config), String::new());
        let refused = |change: &dyn Fn(&mut Description)| {
            let mut description = good.clone();
            change(&mut description);
            description.model().unwrap_err().to_string()
        };
        assert_eq!(
            refused(&|d| d.format_version = 9),
            "it has format version 9, this build reads 1; use the build that wrote it"
        );
        assert!(refused(&|d| d.method = "dqn".into()).starts_with("unknown algorithm \"dqn\"; known: rit, "));
        assert_eq!(refused(&|d| d.encoder = "flat".into()), "rit has no encoder \"flat\"");
        let size = |name: &'static str, size| refused(&|d| d.sizes.extend([(name.to_owned(), size)]));
        assert_eq!(size("hidden_dim", 0), "its size hidden_dim is 0; it must be 1 to 65535");
        assert_eq!(
            size("hidden_dim", usize::MAX),
            format!("its size hidden_dim is {}; it must be 1 to 65535", usize::MAX)
        );
        assert_eq!(size("n_heads", 3), "network.attention_dim = 64 is not a multiple of network.n_heads = 3");
        assert_eq!(size("entity_dim", 13), "it names 7 features where its sizes say 8");
        assert_eq!(refused(&|d| drop(d.action_names.pop())), "it names 4 actions where its sizes say 5");
        assert!(
            refused(&|d| d.sizes.retain(|name, _| name != "n_heads")).starts_with("its size n_heads is 0")
        );
    }
}
