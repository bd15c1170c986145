//! The parts that methods' networks are put together from, each a forward pass on the tape or an operation of its own.

pub mod decoder;
mod discriminator;
mod encoder;
mod gaussian_head;
mod mixer;
mod task_encoder;
#[cfg(test)]
mod testing;

pub use decoder::{Decoder, DecoderPass};
pub use discriminator::{Discriminator, draw_pairing};
pub use encoder::{Encoder, Entities};
pub use gaussian_head::{GaussianHead, NormalVars};
pub use mixer::{Mixer, MixerWeights};
pub use task_encoder::TaskEncoder;
