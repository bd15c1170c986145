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
    time::Duration,
};

/// Games that are played at once, at most.
const GAMES_MAX: usize = 256;

/// How long no client is accepted after the system could not: without a pause, running out of files would take all CPU time
/// too.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

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

    /// Plays with every client that connects, many at once, until the process ends.
    pub fn serve(&self) {
        let games = Arc::new(AtomicUsize::new(0));
        loop {
            let (stream, client) = next_client(|| self.listener.accept());
            if games.load(Ordering::Relaxed) >= GAMES_MAX {
                tracing::warn!(%client, "refused: {GAMES_MAX} games are played already");
                continue;
            }
            let (options, playing) = (self.options.clone(), Playing::begin(&games));
            let play = move || {
                let _playing = playing;
                play(stream, client, options);
            };
            if let Err(error) = thread::Builder::new().name("game".into()).spawn(play) {
                tracing::error!(%client, %error, "refused: the system gives no thread for a game");
                thread::sleep(ACCEPT_PAUSE);
            }
        }
    }

    /// Plays with one client after another, as the game does, until one of them asks it to quit.
    pub fn serve_as_a_game(&self) {
        loop {
            let (stream, client) = next_client(|| self.listener.accept());
            if play(stream, client, self.options.clone()) {
                return;
            }
        }
    }
}

/// The next client. A client that has gone before it was accepted, or too many open files, end no game that is played: what
/// is wrong is logged once in a row, and tried again.
fn next_client(mut accept: impl FnMut() -> io::Result<(TcpStream, SocketAddr)>) -> (TcpStream, SocketAddr) {
    let mut logged = String::new();
    loop {
        let error = match accept() {
            Ok(client) => return client,
            Err(error) => error.to_string(),
        };
        if error != logged {
            tracing::error!(error, "cannot accept clients");
            logged = error;
        }
        thread::sleep(ACCEPT_PAUSE);
    }
}

/// A game that is played counts until this goes, however that comes about.
struct Playing(Arc<AtomicUsize>);

impl Playing {
    fn begin(games: &Arc<AtomicUsize>) -> Self {
        games.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(games))
    }
}

impl Drop for Playing {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_accepted_ends_no_listening() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let mut failures = vec![rustix::io::Errno::MFILE, rustix::io::Errno::CONNABORTED];
        let (_, address) = next_client(|| match failures.pop() {
            Some(failure) => Err(failure.into()),
            None => listener.accept(),
        });
        assert_eq!(address, client.local_addr().unwrap());
    }

    #[test]
    fn a_game_that_panics_is_no_longer_counted() {
        let games = Arc::new(AtomicUsize::new(0));
        let playing = Playing::begin(&games);
        assert_eq!(games.load(Ordering::Relaxed), 1);
        let game = thread::spawn(move || {
            let _playing = playing;
            panic!("a fault of the game");
        });
        assert!(game.join().is_err());
        assert_eq!(games.load(Ordering::Relaxed), 0);
    }
}
