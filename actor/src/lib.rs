//! An actor: rolls the episodes it is leased and sends them to the learner, until either wants no more.
//!
//! [`run`] speaks gRPC on the runtime: leases come in, messages go out. One thread of its own fetches the weights that
//! a lease names, acts and sends.

mod losses;
mod rollout;
mod run;
mod sink;
mod weights;

pub use rollout::RolloutError;
pub use run::{ActorError, ActorOptions, Learner, run};
pub use weights::WeightsError;
