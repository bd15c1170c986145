//! The methods, a network or a family of networks in a file. [`Model`](crate::Model) says which method has which.

pub mod mappo;
pub mod mat;
mod recurrent;
pub mod refil;
pub mod roma;
mod updet;

pub use recurrent::Recurrent;
pub use refil::Refil;
pub use roma::Roma;
pub use updet::Updet;
