//! The weights that a run begins with: random ones of its seed, or another run's.

use rit_algo::Model;
use rit_config::{Config, RunDir};
use rit_episode::Stream;
use rit_policy::{CarryOverError, TaskNames, Weights, WeightsFileError, carry_over};
use std::path::PathBuf;

/// Why a run cannot begin with the weights that its configuration names.
#[derive(Debug, thiserror::Error)]
pub enum InitialError {
    /// They cannot be read.
    #[error("network.initial_weights: {0}")]
    File(#[from] WeightsFileError),
    /// They are others.
    #[error(
        "{path} holds the weights {found}, network.initial_weights says {expected}; put the file back that `rit train \
         --from` wrote, or begin a new run"
    )]
    Other {
        /// The file.
        path: PathBuf,
        /// Digest of what it holds.
        found: String,
        /// Digest of what it should.
        expected: String,
    },
    /// They are of another model.
    #[error("network.initial_weights: {0}")]
    CarryOver(#[from] CarryOverError),
}

/// All parameters before the first update: random ones, with another run's weights over them where the run began so.
///
/// # Errors
/// When those weights are not there, or not those.
pub fn initial_params(run_dir: &RunDir, config: &Config, model: &Model) -> Result<Vec<f32>, InitialError> {
    let mut params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
    let expected = &config.network.initial_weights;
    if !expected.is_empty() {
        let path = run_dir.initial_weights();
        let from = Weights::load(&path)?;
        let found = from.description.digest.clone();
        if found != *expected {
            return Err(InitialError::Other { path, found, expected: expected.clone() });
        }
        carry_over(&from, model, &TaskNames::of(config), &mut params)?;
    }
    Ok(params)
}
