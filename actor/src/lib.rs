//! An actor: rolls the episodes it is leased and sends them to the learner, until either wants no more.
//!
//! [`run`] speaks gRPC on the runtime: leases come in, weights are watched. One thread of its own acts
//! and sends; it takes other weights only between leases.

mod losses;
mod rollout;
mod run;
mod sink;
mod weights;

pub use rollout::RolloutError;
pub use run::{ActorError, ActorOptions, Learner, run};
pub use weights::WeightsError;
