//! RIT: representing interactions and tasks. This crate knows no transport and does no IO.
//!
//! - [`Method`]: the algorithms there are. [`Model`]: one's networks. [`Learner`]: one under training, and all that
//!   a trainer knows of it. [`Acting`]: its networks choosing joint actions.
//! - [`Rows`]: the rows of a batch that exist, in the order the networks work on them.
//! - [`Rit`]: RIT's parts and the layout of its parameters; [`RitConfig`] says which parts it has.
//! - [`encoder`], [`utility`], [`decoder`], [`task_encoder`], [`mixer`], [`contrastive`]: the parts, each
//!   forward with its backward below it.
//! - [`on_policy`]: proximal policy optimisation, for [`Mappo`] and [`Mat`].
//! - [`Update`]: one training step, from a batch of episodes to new weights.
//! - [`RitActing`]: the same networks choosing joint actions, one row after another.

mod acting;
mod config;
pub mod contrastive;
pub mod decoder;
pub mod encoder;
pub mod estimators;
pub mod flat;
pub mod learner;
pub mod method;
mod methods;
pub mod mixer;
mod model;
pub mod on_policy;
mod rit;
mod rows;
pub mod task_encoder;
pub mod td;
mod update;
pub mod utility;

pub use acting::RitActing;
pub use config::{ConfigError, ModelConfig};
pub use learner::Learner;
pub use method::{Method, Regime};
pub use methods::{
    Acting, learner,
    mappo::{Mappo, MappoActing, MappoConfig},
    mat::{Mat, MatActing, MatConfig},
};
pub use model::Model;
pub use rit::{Mixing, Networks, Rit, RitConfig, TaskRepresentations};
pub use rows::{Rows, Step, TerminalStates};
pub use update::{Losses, Seen, Update, UpdateConfig};
