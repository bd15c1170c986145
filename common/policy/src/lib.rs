//! Trained policies, for programs that act with one: a weights file says what model it holds ([`Weights`]), and
//! [`TrainedPolicy`] is that model acting, for several episodes at once. No network and no learner is needed.
//!
//! ```no_run
//! use rit_episode::Observation;
//! use rit_policy::{State, TrainedPolicy};
//!
//! let mut policy = TrainedPolicy::load("runs/cooperative-navigation-1".as_ref())?;
//! let (agents, entities) = (3, 6);
//! policy.begin(0, agents, None)?;
//! let mut seen = Observation::new(agents, entities, policy.feature_dim(), policy.n_actions());
//! seen.see_and_allow_all();
//! // … the entities' features go in here …
//! policy.act(&[State { episode: 0, observation: &seen, previous_reward: 0.0 }])?;
//! println!("{:?}", policy.actions(0));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Description`]: what a weights file says of itself; [`weights_file`] writes and reads it.
//! - [`place`]: which file is meant by a run, a checkpoint or a path.
//! - [`carry_over`]: another model begins with these weights.

mod acting;
mod carry_over;
mod description;
pub mod place;
pub mod weights_file;

pub use acting::{ActError, State, TrainedPolicy};
pub use carry_over::{CarriedOver, CarryOverError, carry_over};
pub use description::{Description, DescriptionError, FORMAT_VERSION, TaskNames};
pub use weights_file::{Weights, WeightsFileError};
