//! Combat in real StarCraft II.
//!
//! - [`StarCraft`] is a factory of environments that are played in games of the real program, which it starts and speaks
//!   to by its API: protobuf messages over a WebSocket. The translation of units is the simulator's, in `rit-env`.
//! - [`endpoint`] is the other side: it speaks the same protocol over the simulator, for tests, and for other people's
//!   clients on machines without the game.
//!
//! Neither the game nor a map comes with this project, and nothing here was ever tried on a running game: what is
//! tested is the protocol, by the endpoint and by the published Python client.

mod battle;
mod connection;
pub mod endpoint;
mod error;
mod game;
mod installation;
pub mod messages;
pub mod process;
mod unit_types;
mod worlds;

pub use connection::{Connection, ConnectionError, read_response};
pub use error::StarCraftError;
pub use game::{Game, Setup};
pub use installation::{Installation, InstallationError, Wanted};
pub use unit_types::CustomTypes;
pub use worlds::{Settings, StarCraft};
