//! The learner: receives episodes, updates the weights, and serves whoever asks.
//!
//! Three threads and a runtime. [`receive`] reads shared memory; [`trainer`] owns replay and weights; on the
//! runtime, [`coordinator`] owns the [`ledger`] and the gRPC services turn calls into its events.

pub mod checkpoint;
pub mod control_service;
pub mod coordinator;
pub mod evaluation;
pub mod ledger;
pub mod metrics;
pub mod receive;
pub mod replay;
pub mod rollout_service;
mod run;
pub mod trainer;
pub mod weights;

pub use run::{LearnerError, run};
