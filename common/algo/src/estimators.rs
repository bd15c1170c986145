//! What learning is made of, as pure functions of numbers: each with a table by hand as its test.

pub mod contrastive;
pub mod dissimilarity;
pub mod gae;
pub mod greedy;
pub mod ppo;
pub mod roles;
pub mod td;
pub mod value_loss;
pub mod value_norm;
