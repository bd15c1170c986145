//! What can go wrong with a real game, in a line that says what to do about it.

use crate::{connection::ConnectionError, installation::InstallationError};
use rit_env::{
    EnvironmentError, FailureKind, Task,
    combat::translation::{PathingError, WrongUnits},
};
use std::{io, time::Duration};

/// Why a game does not play.
#[derive(Debug, thiserror::Error)]
pub enum StarCraftError {
    /// The game is not installed as it must be.
    #[error(transparent)]
    Installation(#[from] InstallationError),
    /// The game cannot be started.
    #[error("cannot start {program}: {error}")]
    Launch {
        /// Its path.
        program: String,
        /// Why.
        error: io::Error,
    },
    /// The game ended before it could be spoken to.
    #[error("{program} ended before it could be spoken to ({status}); its last output: {output}")]
    Exited {
        /// Its path.
        program: String,
        /// How it ended.
        status: String,
        /// What it wrote last.
        output: String,
    },
    /// The game does not come up.
    #[error("the game does not answer {} s after its start: {last}", after.as_secs())]
    NotUp {
        /// How long it was waited for.
        after: Duration,
        /// What the last attempt came to.
        last: ConnectionError,
    },
    /// The connection failed.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    /// A version of the game that has no API.
    #[error(
        "StarCraft II {version} (build {build}) is too old; 3.16.1 (build 55958) and later will do, best 4.10"
    )]
    Version {
        /// As the game calls it.
        version: String,
        /// Its build.
        build: u32,
    },
    /// The game could not be created or joined.
    #[error("{request} failed with {error}: {details}; the map is {map}")]
    Game {
        /// Which request.
        request: &'static str,
        /// The error's name.
        error: String,
        /// In the game's words.
        details: String,
        /// The map.
        map: String,
    },
    /// The map is not one of those that battles are made for.
    #[error("{map} is {x} × {y} cells; the task sets need a map of 32 × 32, {}", crate::installation::MAPS)]
    MapSize {
        /// The map.
        map: String,
        /// Its width.
        x: i32,
        /// Its height.
        y: i32,
    },
    /// Its pathing grid cannot be read.
    #[error(transparent)]
    Pathing(#[from] PathingError),
    /// The map's own unit types were not found.
    #[error(
        "the numbers of the map's own unit types were not found; tried {tried}; set starcraft.custom_types to the \
         first of nine in a row (1935 with the game 4.6.2, 1970 in the authors' code)"
    )]
    UnitTypes {
        /// What was tried.
        tried: String,
    },
    /// Units do not come, or do not go.
    #[error("after {loops} game loops there are {found} units where there should be {wanted}")]
    Units {
        /// How long it was waited for.
        loops: u32,
        /// How many there are.
        found: usize,
        /// How many should be.
        wanted: usize,
    },
    /// The opponent's units cannot be sent.
    #[error(
        "the game refuses orders to the opponent's units (result {result}), before and after control_enemy"
    )]
    EnemyControl {
        /// The game's number of the reason.
        result: i32,
    },
    /// What the game shows of a unit cannot be.
    #[error("the game shows a unit that cannot be: {what}")]
    Unit {
        /// What is wrong with it.
        what: String,
    },
    /// Units that are no battle.
    #[error(transparent)]
    Battle(#[from] WrongUnits),
    /// The game went to another state.
    #[error("the game has ended by itself (status {status})")]
    Ended {
        /// Its state.
        status: String,
    },
    /// A task that real games do not play.
    #[error("{task} is no battle: the starcraft backend plays the combat sets")]
    Task {
        /// The task.
        task: Task,
    },
}

impl From<StarCraftError> for EnvironmentError {
    fn from(error: StarCraftError) -> Self {
        let kind = match &error {
            StarCraftError::NotUp { .. } | StarCraftError::Connection(ConnectionError::TimedOut { .. }) => {
                FailureKind::TimedOut
            }
            StarCraftError::Exited { .. }
            | StarCraftError::Ended { .. }
            | StarCraftError::Connection(ConnectionError::Closed { .. } | ConnectionError::NotReady { .. }) => {
                FailureKind::Died
            }
            StarCraftError::Connection(ConnectionError::Garbage { .. })
            | StarCraftError::Unit { .. }
            | StarCraftError::Units { .. }
            | StarCraftError::Pathing(_)
            | StarCraftError::Battle(_) => FailureKind::BadAnswer,
            StarCraftError::Installation(_)
            | StarCraftError::Launch { .. }
            | StarCraftError::Connection(ConnectionError::Refused { .. })
            | StarCraftError::Version { .. }
            | StarCraftError::Game { .. }
            | StarCraftError::MapSize { .. }
            | StarCraftError::UnitTypes { .. }
            | StarCraftError::EnemyControl { .. }
            | StarCraftError::Task { .. } => FailureKind::Raised,
        };
        Self::new(kind, error.to_string())
    }
}
