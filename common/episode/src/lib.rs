//! The currency of the system: what an agent sees, what an episode is, in which order agents decide, where
//! randomness comes from, and how an episode travels through shared memory. No IO happens here.
//!
//! An [`Episode`] holds only rows that exist. Padding to the run's [`Dims`] happens in [`wire`], on the way
//! through shared memory, and nowhere else.

pub mod decision_order;
mod dims;
mod episode;
mod exploration;
mod observation;
mod policy;
mod seating;
pub mod streams;
pub mod wire;

pub use dims::{Dims, DimsError};
pub use episode::{End, Episode, EpisodeBuilder};
pub use exploration::{Choice, Exploration};
pub use observation::{Observation, ObservationFault};
pub use policy::{Policy, Turn};
pub use seating::Seating;
pub use streams::{Rng, RunSeed, Stream};

/// One agent's action: an index below [`Dims::n_actions`].
pub type Action = u8;
