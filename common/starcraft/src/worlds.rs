//! Worlds that are played in real games. A game outlives an episode: it waits in a pool for the next battle, whichever
//! task that is of.

use crate::{
    battle::Battle,
    connection::Connection,
    error::StarCraftError,
    game::{Game, Setup},
    installation::{Installation, Wanted},
    process::{GameProcess, Starter},
};
use rit_env::{Environment, EnvironmentError, EnvironmentFactory, Spec, Task, combat::CombatSet};
use rit_episode::RunSeed;
use std::{
    fs,
    net::SocketAddr,
    sync::{
        Arc, Mutex, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// How real games are played.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Which game.
    pub wanted: Wanted,
    /// The first of the map's own unit types; 0 where it is to be found out.
    pub custom_types: u32,
    /// How long a game may be silent.
    pub timeout: Duration,
    /// Whether armies face each other at a random angle; as the set has it where `None`.
    pub spawn_rotate: Option<bool>,
    /// Games that one process plays at once.
    pub games_max: usize,
    /// What the games' own randomness follows from, as far as they let it.
    pub seed: RunSeed,
}

/// Where games come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    /// Processes that are started for it.
    Installed,
    /// The program that listens there gives one for each connection.
    At(SocketAddr),
}

/// Games that wait for their next battle, and how others are started.
#[derive(Debug)]
pub(crate) struct Games {
    source: Source,
    set: CombatSet,
    settings: Settings,
    idle: Mutex<Vec<Game>>,
    /// Games that were begun.
    begun: AtomicU64,
    starter: OnceLock<Starter>,
}

/// A game on its way.
#[derive(Debug)]
pub(crate) enum Coming {
    /// Ready for a battle, and told that one begins.
    Ready(Box<Game>),
    /// Its process has been started.
    Starting(GameProcess),
    /// It listens already.
    Listening(SocketAddr),
}

impl Games {
    /// One that is idle, which is told to begin, or else a new one.
    pub(crate) fn take(&self, steps_max: usize) -> Result<Coming, StarCraftError> {
        while let Some(mut game) = self.pop() {
            if game.is_spent(steps_max) {
                game.quit();
                continue;
            }
            match game.tell_to_begin() {
                Ok(()) => return Ok(Coming::Ready(Box::new(game))),
                // It died while it was idle, which costs no episode.
                Err(error) => tracing::warn!(%error, "an idle game is gone"),
            }
        }
        match self.source {
            Source::At(address) => Ok(Coming::Listening(address)),
            Source::Installed => {
                let installation = Installation::find(&self.settings.wanted)?;
                Ok(Coming::Starting(GameProcess::start(self.starter()?, &installation)?))
            }
        }
    }

    /// Waits until a game is ready for its battle.
    pub(crate) fn wait_for(&self, coming: Coming) -> Result<Game, StarCraftError> {
        let mut game = match coming {
            Coming::Ready(game) => return Ok(*game),
            Coming::Starting(process) => Game::begin(process, &self.setup()?)?,
            Coming::Listening(address) => {
                let connection = Connection::open(address, self.settings.timeout)?;
                Game::with(connection, &self.setup()?)?
            }
        };
        game.tell_to_begin()?;
        Ok(game)
    }

    /// Takes a game back whose battle is over.
    pub(crate) fn give_back(&self, game: Game) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(game);
    }

    fn pop(&self) -> Option<Game> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop()
    }

    fn starter(&self) -> Result<&Starter, StarCraftError> {
        if self.starter.get().is_none() {
            let failed = |error| StarCraftError::Launch { program: "a thread".into(), error };
            // Where two make one at once, the other's ends by itself.
            let _ = self.starter.set(Starter::new().map_err(failed)?);
        }
        self.starter.get().ok_or_else(|| StarCraftError::Launch {
            program: "a thread".into(),
            error: std::io::Error::other("it is not there"),
        })
    }

    fn setup(&self) -> Result<Setup, StarCraftError> {
        let Settings { custom_types, timeout, seed, .. } = self.settings;
        let (map, map_data) = match self.source {
            Source::At(_) => (self.settings.wanted.map.clone(), Vec::new()),
            Source::Installed => {
                let map = Installation::find(&self.settings.wanted)?.map;
                let shown = map.display().to_string();
                let unreadable =
                    |error| crate::installation::InstallationError::Map { map: shown.clone(), error };
                let data = fs::read(&map).map_err(unreadable)?;
                (shown, data)
            }
        };
        let random_seed = seed.derive("starcraft", self.begun.fetch_add(1, Ordering::Relaxed)).0 as u32;
        Ok(Setup { set: self.set, map, map_data, custom_types, random_seed, timeout })
    }
}

impl Games {
    /// Ends those that are idle, all at once.
    fn end_idle(&self) {
        let mut idle = std::mem::take(&mut *self.idle.lock().unwrap_or_else(PoisonError::into_inner));
        idle.iter_mut().for_each(Game::ask_to_quit);
        idle.into_iter().for_each(Game::quit);
    }
}

impl Drop for Games {
    fn drop(&mut self) {
        self.end_idle();
    }
}

/// The worlds of a combat set, in real games.
#[derive(Debug)]
pub struct StarCraft {
    games: Arc<Games>,
}

impl StarCraft {
    /// In games that are started on this machine when they are needed.
    pub fn installed(set: CombatSet, settings: Settings) -> Self {
        Self::of(Source::Installed, set, settings)
    }

    /// In games that are there already: the program that listens at this address gives one for each connection.
    pub fn at(address: SocketAddr, set: CombatSet, settings: Settings) -> Self {
        Self::of(Source::At(address), set, settings)
    }

    fn of(source: Source, set: CombatSet, settings: Settings) -> Self {
        let (idle, begun, starter) = (Mutex::default(), AtomicU64::new(0), OnceLock::new());
        Self { games: Arc::new(Games { source, set, settings, idle, begun, starter }) }
    }

    /// What is to be said of the game on this machine before it is played.
    ///
    /// # Errors
    /// When it cannot be.
    pub fn check(wanted: &Wanted) -> Result<Installation, StarCraftError> {
        Ok(Installation::find(wanted)?)
    }

    /// A game by itself: an idle one, or a new one.
    ///
    /// # Errors
    /// When it cannot be had.
    pub fn game(&self) -> Result<Game, StarCraftError> {
        let mut game = self.games.wait_for(self.games.take(0)?)?;
        game.forget_beginning()?;
        Ok(game)
    }

    /// Takes a game into the pool.
    pub fn give_back(&self, game: Game) {
        self.games.give_back(game);
    }
}

impl EnvironmentFactory for StarCraft {
    fn spec(&self, task: Task) -> Spec {
        // The game draws attack delays and the order of units by itself.
        Spec { is_reproducible: false, ..task.spec() }
    }

    fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
        let Task::Combat { set, allies, enemies } = task else {
            return Err(StarCraftError::Task { task }.into());
        };
        let rotate = self.games.settings.spawn_rotate.unwrap_or(set.rotates());
        let battle = Battle::new(Arc::clone(&self.games), self.spec(task), set, [allies, enemies], rotate);
        Ok(Box::new(battle))
    }

    fn rest(&self) {
        self.games.end_idle();
    }

    fn worlds_max(&self) -> usize {
        self.games.settings.games_max
    }
}
