//! What can be typed of real games.

use super::within;
use clap::{Args, ValueEnum};
use rit_config::count;
use rit_env::combat::{StatsVersion, world::ScriptedMedivac};
use std::{ffi::OsString, fmt, net::SocketAddr, path::PathBuf};

#[derive(Args, Debug)]
#[command(after_help = "\
It also takes the options of the game's own program, -listen HOST -port PORT and others, and then ends when its client asks \
it to quit: a script Versions/Base75689/SC2_x64 that executes `rit starcraft-endpoint \"$@\"` stands in for the game. \
SMAC's own maps (3m, 8m, 2s3z, 3s5z, MMM, 1c3s5z and others of the units that the simulator knows) bring their armies along; \
on any other map a client creates its units. A client may send its messages as text; answers are binary. There is no \
authentication: every program that can connect may play.")]
pub struct EndpointOptions {
    /// Where to listen; with port 0 one that is free, which is printed
    #[arg(long, value_name = "IP:PORT")]
    pub listen: SocketAddr,
    /// What the debug command control_enemy does: toggle, as the game; or sticky, for clients that say it every episode
    #[arg(long, value_enum, default_value_t = ControlEnemy::Toggle)]
    pub control_enemy: ControlEnemy,
    /// Number of the first of the map's own unit types; without it 1970 for full_map_template, 1935 for all others
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = within::<u32>(0, 1_000_000))]
    pub custom_types: u32,
    /// The units' numbers are those of current multiplayer games, not those that the maps have
    #[arg(long)]
    pub ladder_stats: bool,
    /// The opponent's medivacs heal where they stand
    #[arg(long)]
    pub medivacs_stay: bool,
    /// Seed of attack delays in games whose client gives none; without it another each time
    #[arg(long, value_parser = count)]
    pub seed: Option<u64>,
    /// End when a client asks the game to quit
    #[arg(long, hide = true)]
    pub as_a_game: bool,
}

/// What `control_enemy` does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ControlEnemy {
    /// Every second time takes the enemies away.
    Toggle,
    /// They stay under control.
    Sticky,
}

impl fmt::Display for ControlEnemy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Toggle => "toggle",
            Self::Sticky => "sticky",
        })
    }
}

impl EndpointOptions {
    /// As the endpoint takes them.
    pub fn to_endpoint(&self) -> rit_worlds::starcraft::endpoint::Options {
        rit_worlds::starcraft::endpoint::Options {
            stats: if self.ladder_stats { StatsVersion::Ladder } else { StatsVersion::Liberty },
            enemy_medivac: if self.medivacs_stay { ScriptedMedivac::Stay } else { ScriptedMedivac::Scan },
            sticky_control: self.control_enemy == ControlEnemy::Sticky,
            custom_types: self.custom_types,
            seed: self.seed,
            ..Default::default()
        }
    }
}

#[derive(Args, Debug)]
pub struct StarCraftCheckOptions {
    /// Experiment whose first training task is played: name or path of a TOML file
    #[arg(default_value = "3-8m")]
    pub experiment: String,
    /// Set any key, such as starcraft.map=full_map_template; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    /// Save the game's replay to this file
    #[arg(long, value_name = "FILE")]
    pub replay: Option<PathBuf>,
    /// Write over the file if it is there
    #[arg(long, requires = "replay")]
    pub force: bool,
}

#[derive(Args, Debug)]
pub struct GameOptions {
    /// Process whose end is the game's
    pub parent: u32,
    /// The game
    pub program: PathBuf,
    /// What it is told
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub arguments: Vec<OsString>,
}
