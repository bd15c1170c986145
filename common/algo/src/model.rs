//! A method's networks: which parameters they have, and which of these acting needs.

use crate::{ConfigError, Method, ModelConfig, Rit};
use rit_episode::Rng;
use rit_nn::Layout;
use std::{ops::Range, sync::Arc};

/// The networks of a method, of one set of sizes.
#[derive(Clone, Debug)]
pub struct Model {
    config: ModelConfig,
    pub(crate) network: Network,
}

/// Whose networks they are.
#[derive(Clone, Debug)]
pub(crate) enum Network {
    /// RIT's and its ablations'.
    Rit(Arc<Rit>),
}

impl Model {
    /// Declares the model.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn new(config: ModelConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let network = Network::Rit(Arc::new(Rit::new(config.rit())?));
        Ok(Self { config, network })
    }

    /// What it was made from.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Its method.
    pub fn method(&self) -> Method {
        self.config.method
    }

    /// Names and shapes of all parameters.
    pub fn layout(&self) -> &Layout {
        match &self.network {
            Network::Rit(rit) => &rit.layout,
        }
    }

    /// The parameters that acting needs.
    pub fn acting(&self) -> Range<usize> {
        match &self.network {
            Network::Rit(rit) => rit.acting(),
        }
    }

    /// Initial parameters.
    pub fn initial(&self, rng: &mut Rng) -> Vec<f32> {
        self.layout().initial(rng)
    }
}
