//! What each fuzz target does with an input. The fuzzer calls these functions, and so does `tests/corpus.rs` with
//! every kept input, so that a plain `cargo test` holds what fuzzing found.
//!
//! A check panics when something is wrong: that is how the fuzzer and the test learn of it.

pub mod checkpoint;
pub mod config;
pub mod frame;
pub mod starcraft;
pub mod worker;
