//! Where the worlds of a run come from. Actors, evaluation and pictures get them here, by the run's configuration.
//!
//! `rit-env` knows no network, so what plays elsewhere has a crate of its own and its place in [`factory`]: another
//! back end is one arm there.

use rit_config::Config;
use rit_env::{Embedded, EnvironmentFactory, TaskSet};
use rit_foreign::{Launch, PythonWorlds};
use std::sync::Arc;

/// The factory of a configuration's worlds. Nothing is started before the first world is needed.
pub fn factory(config: &Config) -> Arc<dyn EnvironmentFactory> {
    if matches!(config.environment.task_set, TaskSet::Foreign(_)) {
        return Arc::new(PythonWorlds::new(Launch::of(&config.environment)));
    }
    Arc::new(Embedded(config.environment_options()))
}
