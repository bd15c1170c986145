//! What a person typed, and what the programs use.
//!
//! Typed: an experiment's TOML and `--set section.key=value`, which are [`toml::Table`]s. Used: a [`Config`],
//! complete and within its limits. [`resolve`] leads from one to the other: every key's default, below the
//! task set's preset, below the method's, below the experiment, below the command line. A run directory holds the
//! resolved one.

mod completed;
mod config;
mod error;
mod foreign;
mod keys;
mod method_keys;
mod number;
mod owned_run_dir;
mod program;
mod regular_file;
mod resolve;
mod run_dir;
mod run_lock;
mod run_place;
mod saved;

pub use completed::{completed, preset_settings};
pub use config::{
    Actors, Algorithm, Backend, Checkpoints, Config, Environment, Evaluation, KeepBest, Learner, Network,
    OptimizerName, SpawnRotate, StarCraft, Tls, Training, Until, Web, WebListen, World,
};
pub use error::ConfigError;
pub use foreign::{PythonAsked, python_answered, python_asked};
pub use method_keys::family;
pub use number::{CountError, WHOLE_MAX, count};
pub use owned_run_dir::OwnedRunDir;
pub use program::{in_program_words, program_name, set_program_name};
pub use regular_file::{TEXT_BYTES_MAX, open_regular, read_regular, read_tail, read_text, write_whole};
pub use resolve::{all_keys, is_free, is_live, keys_like, resolve, set, set_all, set_live};
pub use run_dir::{RunDir, RunDirError};
pub use run_lock::RunLock;
