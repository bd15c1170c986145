//! An endpoint that speaks StarCraft II's protocol over the simulator: for tests, and for clients of the game on
//! machines without it. Each connection is a game of its own.

pub mod arena;
mod frames;
mod maps;
mod session;

use frames::Frames;
use rit_env::combat::{StatsVersion, world::ScriptedMedivac};
use session::Session;
use std::{
    io,
    net::{SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

/// Games that are played at once, at most.
const GAMES_MAX: usize = 256;

/// What the endpoint plays, and what it says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// The units' numbers.
    pub stats: StatsVersion,
    /// What the opponent's medivacs do.
    pub enemy_medivac: ScriptedMedivac,
    /// Whether `control_enemy` puts the opponent's units under control however often it is said; as the game has it,
    /// every second time takes them away.
    pub sticky_control: bool,
    /// The first of the map's own unit types; as the map has it where 0.
    pub custom_types: u32,
    /// Whether the data of unit types say their names.
    pub names_types: bool,
    /// Seed of the attack delays in games whose client gives none; as the game has it, another each time where `None`.
    pub seed: Option<u64>,
    /// The version that it calls itself.
    pub game_version: String,
    /// Its build.
    pub base_build: u32,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            stats: StatsVersion::default(),
            enemy_medivac: ScriptedMedivac::default(),
            sticky_control: false,
            custom_types: 0,
            names_types: true,
            seed: None,
            game_version: "4.10.0".into(),
            base_build: 75_689,
        }
    }
}

/// An endpoint that listens.
#[derive(Debug)]
pub struct Endpoint {
    listener: TcpListener,
    options: Options,
}

impl Endpoint {
    /// Listens there.
    ///
    /// # Errors
    /// When the system does not let it.
    pub fn bind(address: SocketAddr, options: Options) -> io::Result<Self> {
        Ok(Self { listener: TcpListener::bind(address)?, options })
    }

    /// Where it listens.
    ///
    /// # Errors
    /// When the system does not say.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Plays with every client that connects, many at once, as long as it can listen.
    ///
    /// # Errors
    /// When it cannot any more.
    pub fn serve(&self) -> io::Result<()> {
        let games = Arc::new(AtomicUsize::new(0));
        loop {
            let (stream, client) = self.listener.accept()?;
            if games.load(Ordering::Relaxed) >= GAMES_MAX {
                tracing::warn!(%client, "refused: {GAMES_MAX} games are played already");
                continue;
            }
            games.fetch_add(1, Ordering::Relaxed);
            let (options, playing) = (self.options.clone(), Arc::clone(&games));
            let play = move || {
                play(stream, client, options);
                playing.fetch_sub(1, Ordering::Relaxed);
            };
            thread::Builder::new().name("game".into()).spawn(play)?;
        }
    }

    /// Plays with one client after another, as the game does, until one of them asks it to quit.
    ///
    /// # Errors
    /// When it cannot listen any more.
    pub fn serve_as_a_game(&self) -> io::Result<()> {
        loop {
            let (stream, client) = self.listener.accept()?;
            if play(stream, client, self.options.clone()) {
                return Ok(());
            }
        }
    }
}

/// Plays with a client until it has gone; says whether it asked the game to quit.
fn play(stream: TcpStream, client: SocketAddr, options: Options) -> bool {
    let mut frames = match Frames::accept(stream) {
        Ok(frames) => frames,
        Err(error) => {
            tracing::debug!(%client, %error, "no client");
            return false;
        }
    };
    tracing::info!(%client, "a client plays");
    let seed = options.seed.unwrap_or_else(fresh_seed);
    let mut session = Session::new(options, seed);
    loop {
        let message = match frames.receive() {
            Ok(Some(message)) => message,
            Ok(None) => break,
            Err(error) => {
                tracing::warn!(%client, %error, "a client's connection is given up");
                break;
            }
        };
        if let Err(error) = frames.send(session.answer(&message)) {
            tracing::debug!(%client, %error, "a client has gone before its answer");
            break;
        }
        if session.has_quit() {
            break;
        }
    }
    tracing::info!(%client, "a client has gone");
    session.has_quit()
}

/// As the game has it, a game without a seed is another each time.
fn fresh_seed() -> u64 {
    let mut bytes = [0; size_of::<u64>()];
    // So few bytes come at once; without them all such games are the same.
    let _ = rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty());
    u64::from_le_bytes(bytes)
}
