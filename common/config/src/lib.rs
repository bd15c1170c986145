//! What a person typed, and what the programs use.
//!
//! Typed: an experiment's TOML and `--set section.key=value`, which are [`toml::Table`]s. Used: a [`Config`],
//! complete and within its limits. [`resolve`] leads from one to the other: every key's default, below the
//! task set's preset, below the experiment, below the command line. A run directory holds the resolved one.

mod config;
mod resolve;
mod run_dir;

pub use config::{
    Actors, Algorithm, Checkpoints, Config, Environment, Evaluation, Learner, MixingKind, Network,
    OptimizerName, Tls, Training, Until, Web, WebListen,
};
pub use resolve::{ConfigError, resolve, set, set_live};
pub use run_dir::{RunDir, RunDirError};
