//! The learner: receives episodes, updates the weights, and answers questions and commands.
//!
//! Four threads and a runtime. [`receive`] reads shared memory; [`trainer`] owns replay and weights; [`writer`]
//! writes replay and checkpoints; a [`Learner`](rit_algo::Learner)'s own threads work on batches. On the runtime,
//! [`coordinator`] owns the [`ledger`]; the gRPC services and the [`web`] page turn calls into its events, by a
//! [`run_handle`].

pub mod append_file;
pub mod checkpoint;
pub mod control_service;
pub mod coordinator;
pub mod cpu_time;
mod damaged;
pub mod episodes_service;
pub mod evaluation;
pub mod gauges;
mod initial;
pub mod ledger;
pub mod life;
pub mod messages;
pub mod metrics;
pub mod metrics_repair;
pub mod prometheus;
pub mod receive;
pub mod replay;
pub mod replay_log;
pub mod rollout_service;
mod run;
pub mod run_handle;
pub mod summary;
pub mod tensorboard;
pub mod trainer;
pub mod web;
pub mod weights;
pub mod write_queue;
pub mod writer;

pub use initial::InitialError;
pub use run::{LearnerError, expected, run};
