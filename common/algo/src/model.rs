//! A method's networks: which parameters they have, and which of these acting needs.

use crate::{
    ConfigError, Mappo, MappoConfig, Mat, MatConfig, Method, ModelConfig,
    drive::ValueNetwork as _,
    flat::Slots,
    methods::{Recurrent, Refil, Roma, Updet},
    on_policy::ActorCritic as _,
};
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
    /// MAPPO's.
    Mappo(Arc<Mappo>),
    /// MAT's.
    Mat(Arc<Mat>),
    /// UPDeT's.
    Updet(Arc<Updet>),
    /// REFIL's.
    Refil(Arc<Refil>),
    /// ROMA's.
    Roma(Arc<Roma>),
}

impl Model {
    /// Declares the model.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn new(config: ModelConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let ModelConfig { entity_dim, n_actions, agents_max, entities_max, hidden_dim, .. } = config;
        let slots = Slots { agents_max, entities_max, entity_dim };
        let network = match config.method {
            Method::Mappo => {
                Network::Mappo(Arc::new(Mappo::new(MappoConfig { slots, n_actions, hidden_dim })))
            }
            Method::Mat => {
                let ModelConfig { hidden_dim: embed_dim, n_heads, n_blocks, .. } = config;
                let sizes = MatConfig { slots, n_actions, embed_dim, n_heads, n_blocks };
                Network::Mat(Arc::new(Mat::new(sizes)))
            }
            Method::UpdetMix | Method::UpdetVdn => Network::Updet(Arc::new(Updet::new(&config))),
            Method::Refil => Network::Refil(Arc::new(Refil::new(&config))),
            Method::Roma => Network::Roma(Arc::new(Roma::new(&config))),
            _ => Network::Recurrent(Arc::new(Recurrent::new(&config))),
        };
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
            Network::Updet(network) => &network.parts().layout,
            Network::Refil(network) => &network.parts().layout,
            Network::Roma(network) => &network.parts().layout,
            Network::Mappo(network) => network.layout(),
            Network::Mat(network) => network.layout(),
        }
    }

    /// The parameters that acting needs.
    pub fn acting(&self) -> Range<usize> {
        match &self.network {
            Network::Recurrent(network) => network.parts().acting.clone(),
            Network::Updet(network) => network.parts().acting.clone(),
            Network::Refil(network) => network.parts().acting.clone(),
            Network::Roma(network) => network.parts().acting.clone(),
            Network::Mappo(network) => network.acting(),
            Network::Mat(network) => network.acting(),
        }
    }

    /// Initial parameters.
    pub fn initial(&self, rng: &mut Rng) -> Vec<f32> {
        self.layout().initial(rng)
    }
}
