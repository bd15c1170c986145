//! `rit train --from`: another run's weights as a new run's beginning.

use crate::failure::Failure;
use rit_algo::Model;
use rit_config::{Config, RunDir};
use rit_episode::Stream;
use rit_policy::{CarriedOver, TaskNames, Weights, carry_over, weights_file};
use std::{fs::OpenOptions, io::Write as _, os::unix::fs::OpenOptionsExt as _, path::Path};

/// Weights that a new run begins with.
pub struct Beginning {
    weights: Weights,
    words: String,
}

impl Beginning {
    /// Reads the weights and notes them in the new run's configuration.
    ///
    /// # Errors
    /// When they cannot be read, or are of other sizes.
    pub fn from(given: &Path, config: &mut Config) -> Result<Self, Failure> {
        let weights = Weights::load(given)?;
        let (model, names) = (Model::new(config.model()).map_err(Failure::input)?, TaskNames::of(config));
        // What the learner will do, so that what cannot be done is said before anything is made.
        let mut params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
        let carried = carry_over(&weights, &model, &names, &mut params)?;
        config.network.initial_weights.clone_from(&weights.description.digest);
        let words = in_words(given, &weights, &carried);
        Ok(Self { weights, words })
    }

    /// What is reused, and what begins as ever.
    pub fn words(&self) -> &str {
        &self.words
    }

    /// Writes the weights into the run's directory, so that the run needs no other file.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&self, run_dir: &RunDir) -> Result<(), Failure> {
        let Weights { description, model, params } = &self.weights;
        let bytes = weights_file::encode(model, &description.names(), params).map_err(Failure::runtime)?;
        let path = run_dir.initial_weights();
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
        file.and_then(|mut file| file.write_all(&bytes))
            .map_err(|error| Failure::runtime_message(format!("{}: {error}", path.display())))
    }
}

fn in_words(given: &Path, weights: &Weights, carried: &CarriedOver) -> String {
    let CarriedOver { reused, fresh, left, renamed } = carried;
    let description = &weights.description;
    let mut words = format!(
        "begins with the weights of {} ({} on {}): {} of them reused; ",
        given.display(),
        description.method,
        description.task_set,
        reused.join(", ")
    );
    if !fresh.is_empty() {
        words += &format!("{} of this run fresh; ", fresh.join(", "));
    }
    if !left.is_empty() {
        words += &format!("{} of those weights not used; ", left.join(", "));
    }
    words += "optimiser, replay, exploration and counts begin afresh";
    if !renamed.is_empty() {
        words += &format!("; columns have other meanings: {}", renamed.join(", "));
    }
    words
}
