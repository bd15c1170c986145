//! StarCraft micro-combat: a simulator of small battles, and the translation of units into entities, masks, actions
//! and rewards that it shares with the real game.
//!
//! After the paper's section VI-C and the environments of SMAC (Samvelyan et al. 2019) and REFIL (Iqbal et al. 2021).
//! What a simulator's win rates are is not comparable with the game's: engine, opponent, placement and collision
//! differ.

pub mod team;
pub mod unit;
pub mod world;

pub use team::{CombatSet, Team, TeamError};
pub use unit::{StatsVersion, UnitType};
