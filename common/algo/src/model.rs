//! A method's networks: which parameters they have, and which of these acting needs.

use crate::{ConfigError, Method, ModelConfig, drive::ValueNetwork as _, methods::Recurrent};
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
    /// RIT's, its ablations' and those of the rivals that differ from it in one part.
    Recurrent(Arc<Recurrent>),
}

impl Model {
    /// Declares the model.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn new(config: ModelConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let network = Network::Recurrent(Arc::new(Recurrent::new(&config)));
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
            Network::Recurrent(network) => &network.parts().layout,
        }
    }

    /// The parameters that acting needs.
    pub fn acting(&self) -> Range<usize> {
        match &self.network {
            Network::Recurrent(network) => network.parts().acting.clone(),
        }
    }

    /// Initial parameters.
    pub fn initial(&self, rng: &mut Rng) -> Vec<f32> {
        self.layout().initial(rng)
    }
}
