//! Battles in a real game, as an environment: the game's units go through the translation that the simulator's go
//! through.

use crate::{
    error::StarCraftError,
    game::Game,
    messages::Unit,
    worlds::{Coming, Games},
};
use rit_env::{
    BodyKind, Environment, EnvironmentError, Scene, SceneBody, SceneUnit, Spec, Step,
    combat::{
        CombatSet, StatsVersion, Team, draw_tags, spawn,
        translation::{RawUnit, Translation},
        world::Side,
    },
};
use rit_episode::{Action, Observation, Rng};
use std::{mem, sync::Arc};

/// The game of a battle.
#[derive(Debug)]
enum Seat {
    /// None; its last battle is over.
    Empty,
    /// One that begins.
    Coming(Coming),
    /// One that plays.
    Playing(Box<Game>),
}

/// Battles of two teams, in real games.
pub(crate) struct Battle {
    games: Arc<Games>,
    spec: Spec,
    set: CombatSet,
    teams: [Team; 2],
    rotate: bool,
    translation: Translation,
    units: Vec<RawUnit>,
    seat: Seat,
}

impl Battle {
    pub(crate) fn new(games: Arc<Games>, spec: Spec, set: CombatSet, teams: [Team; 2], rotate: bool) -> Self {
        let translation = Translation::new(set);
        Self { games, spec, set, teams, rotate, translation, units: Vec::new(), seat: Seat::Empty }
    }

    fn playing(&mut self) -> Result<&mut Game, StarCraftError> {
        match &mut self.seat {
            Seat::Playing(game) => Ok(game),
            Seat::Empty | Seat::Coming(_) => Err(StarCraftError::Ended { status: "not begun".into() }),
        }
    }

    fn look(&mut self, units: &[Unit]) -> Result<(), StarCraftError> {
        let mut raw = mem::take(&mut self.units);
        let looked = self.playing().and_then(|game| game.raw_units(units, &mut raw));
        self.units = raw;
        looked
    }

    fn begin_battle(&mut self, rng: &mut Rng) -> Result<(), StarCraftError> {
        let coming = match mem::replace(&mut self.seat, Seat::Empty) {
            Seat::Coming(coming) => coming,
            Seat::Empty | Seat::Playing(_) => self.games.take(self.spec.steps_max)?,
        };
        let game = self.games.wait_for(coming)?;
        self.translation.set_pathing(game.pathing().clone());
        self.seat = Seat::Playing(Box::new(game));
        let layout = spawn::Layout::draw(self.set, self.teams, self.rotate, rng);
        let tags = draw_tags(self.teams, rng);
        let units = self.playing()?.begin_battle(&layout.groups)?;
        self.look(&units)?;
        self.translation.begin(&self.units, [&tags[0], &tags[1]])?;
        Ok(())
    }

    fn finish_step(&mut self) -> Result<Step, StarCraftError> {
        let units = self.playing()?.finish_step()?;
        self.look(&units)?;
        let step = self.translation.advance(&self.units);
        if step.end.is_some()
            && let Seat::Playing(game) = mem::replace(&mut self.seat, Seat::Empty)
        {
            self.games.give_back(*game);
        }
        Ok(step)
    }
}

impl Environment for Battle {
    fn spec(&self) -> Spec {
        self.spec
    }

    fn begin_reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
        self.seat = Seat::Coming(self.games.take(self.spec.steps_max)?);
        Ok(())
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        Ok(self.begin_battle(rng)?)
    }

    fn observe(&self, observation: &mut Observation) {
        self.translation.observe(observation);
    }

    fn begin_step(&mut self, actions: &[Action]) -> Result<(), EnvironmentError> {
        let orders: Vec<_> = actions
            .iter()
            .enumerate()
            .filter_map(|(agent, &action)| self.translation.order(agent, action))
            .collect();
        Ok(self.playing()?.begin_step(orders.into_iter())?)
    }

    fn step(&mut self, _: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        Ok(self.finish_step()?)
    }

    fn scene(&self) -> Option<Scene> {
        let body = |(unit, alive): (&RawUnit, bool)| {
            let share = |left: f32, most: f32| if alive && most > 0.0 { left / most } else { 0.0 };
            SceneBody {
                kind: match unit.side {
                    Side::Ally => BodyKind::Agent,
                    Side::Enemy => BodyKind::Enemy,
                },
                x: unit.x,
                y: unit.y,
                radius: unit.kind.stats(StatsVersion::Liberty).radius as f32,
                unit: Some(SceneUnit {
                    letter: unit.kind.letter(),
                    health: share(unit.health, unit.health_max),
                    shield: (unit.shield_max > 0.0).then(|| share(unit.shield, unit.shield_max)),
                }),
            }
        };
        Some(Scene { bodies: self.translation.units().map(body).collect(), links: Vec::new() })
    }
}
