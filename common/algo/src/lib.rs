//! RIT, representing interactions and tasks, and the algorithms that it is compared with. This crate knows no transport
//! and does no IO.
//!
//! - [`Method`]: the algorithms there are. [`Model`]: one's networks; the only module that tells all methods apart.
//!   [`Learner`]: one under training, and all that a trainer knows of it. [`Acting`]: its networks choosing joint
//!   actions.
//! - [`Rows`]: the rows of a batch that exist, in the order the networks work on them.
//! - [`blocks`]: the parts of networks. [`methods`]: networks put together of them, a method or a family in a file.
//! - [`drive`]: shards, threads, sums, objectives, the optimiser's step, and acting: what is the same for all.
//! - [`on_policy`]: proximal policy optimisation, for [`Mappo`] and [`Mat`].
//! - [`estimators`]: targets, losses and their gradients, as pure functions.

pub mod blocks;
mod config;
pub mod drive;
pub mod estimators;
pub mod flat;
pub mod learner;
pub mod method;
pub mod methods;
mod model;
pub mod networks;
pub mod on_policy;
mod rows;

pub use config::{ConfigError, ModelConfig, PpoConfig, RoleConfig, UpdateConfig};
pub use learner::Learner;
pub use method::{Method, Regime};
pub use methods::{
    mappo::{Mappo, MappoActing, MappoConfig},
    mat::{Mat, MatActing, MatConfig},
};
pub use model::{Acting, Model};
pub use networks::{Actor, EpisodeValues};
pub use rows::{Rows, Step, TerminalStates};
