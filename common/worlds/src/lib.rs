//! Where the worlds of a run come from. Actors, evaluation and pictures get them here, by the run's configuration.
//!
//! `rit-env` knows no network, so what plays elsewhere has a crate of its own and its place in [`factory`] and
//! [`check`]: another back end is one arm in each.

use rit_config::{Backend, Config};
use rit_env::{Embedded, EnvironmentFactory, TaskSet, combat::CombatSet};
use rit_foreign::{Launch, PythonWorlds};
use rit_starcraft::{Settings, StarCraft, StarCraftError, Wanted};
use std::{sync::Arc, time::Duration};

pub use rit_starcraft as starcraft;

/// Why a configuration's worlds cannot be had on this machine.
pub type Unavailable = StarCraftError;

/// The factory of a configuration's worlds. Nothing is started before the first world is needed.
pub fn factory(config: &Config) -> Arc<dyn EnvironmentFactory> {
    if config.environment.task_set.is_python() {
        return Arc::new(PythonWorlds::new(Launch::of(&config.environment)));
    }
    match games(config) {
        Some(games) => Arc::new(games),
        None => Arc::new(Embedded(config.environment_options())),
    }
}

/// Whether this machine has what a configuration's worlds need; looks, and starts nothing. Returns a warning, if there is
/// one.
///
/// # Errors
/// With what is missing, and where to get it.
pub fn check(config: &Config) -> Result<Option<String>, Unavailable> {
    match real_set(config) {
        Some(_) => Ok(StarCraft::check(&wanted(config))?.notice()),
        None => Ok(None),
    }
}

/// The real games of a configuration, where it plays any.
pub fn games(config: &Config) -> Option<StarCraft> {
    let settings = Settings {
        wanted: wanted(config),
        custom_types: config.starcraft.custom_types,
        timeout: Duration::from_millis(config.starcraft.timeout_ms),
        spawn_rotate: config.environment.spawn_rotate.rotates(),
        games_max: config.actors.episodes_at_once,
        seed: config.seed,
    };
    real_set(config).map(|set| StarCraft::installed(set, settings))
}

fn wanted(config: &Config) -> Wanted {
    let rit_config::StarCraft { map, base_build, data_version, .. } = config.starcraft.clone();
    Wanted { map, base_build, data_version }
}

/// The set that is played in real games, if any is.
fn real_set(config: &Config) -> Option<CombatSet> {
    match (config.environment.backend, config.environment.task_set) {
        (Backend::Starcraft, TaskSet::Combat(set)) => Some(set),
        _ => None,
    }
}
