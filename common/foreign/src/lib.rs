//! Environments that live in processes of their own: a Python interpreter that holds several, spoken to over a socket.
//! Nothing that comes from there is trusted, and nothing there outlives this program.
//!
//! - [`protocol`]: the frames. [`describe`]: what tasks are, asked once before a run begins.
//! - [`PythonWorlds`]: the factory of a run's worlds.
//! - [`check`]: whether an environment keeps its promises, in words.

mod check;
mod describe;
pub mod protocol;
mod worker;
mod world;

pub use check::{Broken, Checked, check};
pub use describe::{DescribeError, Described, describe};
pub use worker::Launch;
pub use world::PythonWorlds;
