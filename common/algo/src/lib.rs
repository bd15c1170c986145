//! RIT: representing interactions and tasks. This crate knows no transport and does no IO.
//!
//! - [`Rows`]: the rows of a batch that exist, in the order the networks work on them.
//! - [`Rit`]: the model's parts and the layout of its parameters; [`RitConfig`] says which parts it has.
//! - [`encoder`], [`utility`], [`decoder`], [`task_encoder`], [`mixer`], [`contrastive`]: the parts, each
//!   forward with its backward below it.
//! - [`Update`]: one training step, from a batch of episodes to new weights.
//! - [`Acting`]: the same networks choosing joint actions, one row after another.

pub mod acting;
pub mod contrastive;
pub mod decoder;
pub mod encoder;
pub mod mixer;
mod rit;
mod rows;
pub mod task_encoder;
pub mod td;
mod update;
pub mod utility;

pub use acting::Acting;
pub use rit::{ConfigError, Mixing, Networks, Rit, RitConfig, TaskRepresentations};
pub use rows::{Rows, Step, TerminalStates};
pub use update::{Losses, Seen, Update, UpdateConfig};
