//! f32 networks on faer's matrix products. This crate knows no reinforcement learning.
//!
//! - Parameters, gradients and optimiser moments are one flat buffer each; [`layout`] declares names and
//!   shapes once, and layers hold ranges into the buffer.
//! - Each layer's forward stands directly above its backward. Backward *adds* to the gradients it is given
//!   for parameters, and writes or adds to input gradients as its documentation says.
//! - A network is written as its forward pass on a [`tape`], whose operations are these layers.
//! - Matrices are row-major [`View`]s; [`matmul`] is the one place that speaks to faer.
//! - Everything runs on the calling thread. A caller that wants threads splits the batch.

pub mod activation;
pub mod attention;
pub mod categorical;
pub mod derived;
pub mod gaussian;
pub mod generated;
pub mod gradcheck;
pub mod gru;
pub mod hidden_token;
pub mod layer_norm;
pub mod layout;
pub mod linear;
pub mod math;
pub mod matmul;
pub mod optimizer;
pub mod post_norm;
pub mod random;
mod scratch;
pub mod tape;
mod view;

pub use attention::Attention;
pub use derived::Derived;
pub use generated::Generated;
pub use gru::Gru;
pub use hidden_token::HiddenToken;
pub use layer_norm::LayerNorm;
pub use layout::{Initial, Layout, LayoutBuilder, Param};
pub use linear::Linear;
pub use matmul::Accum;
pub use optimizer::{Optimizer, OptimizerKind};
pub use post_norm::PostNorm;
pub use scratch::{Buffer, Scratch};
pub use tape::{Stock, Tape, Var};
pub use view::{View, ViewMut};
