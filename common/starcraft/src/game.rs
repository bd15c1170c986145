//! One game: from its start to battles in it.

mod joining;

use crate::{
    connection::{Connection, ConnectionError},
    error::StarCraftError,
    messages::{
        Action, ActionRaw, ActionRawUnitCommand, DebugCommand, DebugCreateUnit, DebugGameState,
        DebugKillUnit, Point2D, RequestAction, RequestData, RequestDebug, RequestObservation, RequestQuit,
        RequestSaveReplay, RequestStep, Status, Unit, action_raw, action_raw_unit_command::Target,
        debug_command::Command, request::Request, response::Response,
    },
    process::GameProcess,
    unit_types::CustomTypes,
};
use joining::{check_version, create, look_at_the_map};
use rit_env::combat::{
    CombatSet, TICKS_PER_STEP,
    spawn::Group,
    translation::{Pathing, RawUnit, UnitOrder},
    world::{Point, Side},
};
use std::{
    thread,
    time::{Duration, Instant},
};

/// How long a game may take to come up, and from one attempt to speak to it to the next.
const START_TIMEOUT: Duration = Duration::from_secs(120);
const RETRY_EVERY: Duration = Duration::from_millis(250);

/// Loops within which units that were created, or killed, must be there, or gone.
const UNITS_WITHIN: u32 = 64;
/// Loops of the first wait for them.
const UNITS_FIRST: u32 = 2;
/// Loops between the units' creation and the first orders.
const SETTLE: u32 = 4;

/// The engine stops at so many loops; a game is left before a battle could get there.
const LOOPS_MAX: u32 = 1 << 19;

/// The game's result of an action that is done.
const SUCCESS: i32 = 1;

/// Abilities of the game.
const STOP: i32 = 4;
const MOVE: i32 = 16;
const ATTACK: i32 = 23;
const HEAL: i32 = 386;

/// What a game is to be made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Setup {
    /// The set, whose race the opponent is of.
    pub set: CombatSet,
    /// The map's file, as the game is told it, and what it holds.
    pub map: String,
    /// The map's content.
    pub map_data: Vec<u8>,
    /// The first of the map's own unit types; 0 where it is to be found out.
    pub custom_types: u32,
    /// What the game's own randomness follows from.
    pub random_seed: u32,
    /// How long a response is waited for.
    pub timeout: Duration,
}

/// A game that was joined, and can play battle after battle.
#[derive(Debug)]
pub struct Game {
    connection: Connection,
    /// `None` where another program has started it.
    process: Option<GameProcess>,
    custom: CustomTypes,
    pathing: Pathing,
    loops: u32,
    /// Whether the opponent's units were put under control.
    controls_enemy: bool,
    /// Orders that the game has refused.
    refused: u64,
    /// Whether it was asked to quit.
    quits: bool,
    /// What it says of itself.
    version: String,
    build: u32,
}

impl Game {
    /// Speaks to a game that was started, once it is up, and makes it ready for battles.
    ///
    /// # Errors
    /// When it does not come up, or is not what it must be.
    pub(crate) fn begin(mut process: GameProcess, setup: &Setup) -> Result<Self, StarCraftError> {
        let (address, begun) = (process.address(), Instant::now());
        let connection = loop {
            match Connection::open(address, setup.timeout) {
                Ok(connection) => break connection,
                Err(last @ (ConnectionError::NotReady { .. } | ConnectionError::TimedOut { .. })) => {
                    if let Some(ended) = process.ended() {
                        return Err(ended);
                    }
                    if begun.elapsed() >= START_TIMEOUT {
                        return Err(StarCraftError::NotUp { after: START_TIMEOUT, last });
                    }
                    thread::sleep(RETRY_EVERY);
                }
                Err(error) => return Err(error.into()),
            }
        };
        Self::join(connection, Some(process), setup)
    }

    /// Makes a game ready that another program has started, by a connection to it.
    ///
    /// # Errors
    /// When it is not what it must be.
    pub fn with(connection: Connection, setup: &Setup) -> Result<Self, StarCraftError> {
        Self::join(connection, None, setup)
    }

    fn join(
        mut connection: Connection,
        process: Option<GameProcess>,
        setup: &Setup,
    ) -> Result<Self, StarCraftError> {
        let (version, build) = check_version(&mut connection)?;
        create(&mut connection, setup)?;
        let pathing = look_at_the_map(&mut connection, setup)?;
        let mut game = Self {
            connection,
            process,
            custom: CustomTypes::row(setup.custom_types),
            pathing,
            loops: 0,
            controls_enemy: false,
            refused: 0,
            quits: false,
            version,
            build,
        };
        if setup.custom_types == 0 {
            game.custom = game.find_custom_types()?;
        }
        tracing::info!(version = game.version, build, custom = ?game.custom, "a game is ready");
        Ok(game)
    }

    /// Its version, as it calls itself, and its build.
    pub fn version(&self) -> (&str, u32) {
        (&self.version, self.build)
    }

    /// The numbers of the map's own types.
    pub fn custom_types(&self) -> &CustomTypes {
        &self.custom
    }

    /// Which cells can be walked.
    pub fn pathing(&self) -> &Pathing {
        &self.pathing
    }

    /// Orders that it has refused so far.
    pub fn orders_refused(&self) -> u64 {
        self.refused
    }

    /// Whether it is too old for another battle of so many steps.
    pub fn is_spent(&self, steps_max: usize) -> bool {
        is_spent(self.loops, steps_max)
    }

    /// Asks for what [`Self::begin_battle`] needs first, so that several games get to it at once.
    ///
    /// # Errors
    /// When it cannot be asked.
    pub fn tell_to_begin(&mut self) -> Result<(), StarCraftError> {
        Ok(self.connection.send(observation())?)
    }

    /// Takes [`Self::tell_to_begin`] back.
    pub(crate) fn forget_beginning(&mut self) -> Result<(), StarCraftError> {
        self.observed().map(drop)
    }

    /// Clears the map, creates these units, and sends the opponent's to the middle of the others. Returns all units as
    /// they stand. [`Self::tell_to_begin`] comes before.
    ///
    /// # Errors
    /// When the game does not do so.
    pub fn begin_battle(&mut self, groups: &[Group]) -> Result<Vec<Unit>, StarCraftError> {
        let left = self.observed()?;
        self.clear(&left)?;
        let create = groups.iter().map(|group| Command::CreateUnit(self.creation(group))).collect();
        self.debug(create)?;
        let wanted = groups.iter().map(|group| group.count).sum();
        self.step_until(wanted)?;
        if !self.controls_enemy {
            self.toggle_enemy_control()?;
            self.controls_enemy = true;
        }
        self.step(SETTLE)?;
        let units = self.observe()?;
        self.send_enemies(&units)?;
        Ok(units)
    }

    /// Gives orders and runs one step of the environment; [`Self::finish_step`] gives what it led to.
    ///
    /// # Errors
    /// When the game cannot be told.
    pub fn begin_step(
        &mut self,
        orders: impl Iterator<Item = (u64, UnitOrder)>,
    ) -> Result<(), StarCraftError> {
        let actions = orders.map(|(unit, order)| command(&[unit], order)).collect();
        self.connection.send(Request::Action(RequestAction { actions }))?;
        self.connection.send(Request::Step(RequestStep { count: Some(TICKS_PER_STEP as u32) }))?;
        Ok(self.connection.send(observation())?)
    }

    /// The units after a step.
    ///
    /// # Errors
    /// When the game does not go on.
    pub fn finish_step(&mut self) -> Result<Vec<Unit>, StarCraftError> {
        let Response::Action(acted) = self.connection.receive()? else { return Err(odd("action")) };
        let refused = acted.result.iter().filter(|&&result| result != SUCCESS).count();
        if refused > 0 {
            tracing::debug!(refused, results = ?acted.result, "the game refuses orders");
            self.refused += refused as u64;
        }
        self.connection.receive()?;
        self.observed()
    }

    /// The game's units as the translation takes them.
    ///
    /// # Errors
    /// When one cannot be.
    pub fn raw_units(&self, units: &[Unit], to: &mut Vec<RawUnit>) -> Result<(), StarCraftError> {
        self.custom.raw_units(units, to)
    }

    /// The replay of all that was played in this game.
    ///
    /// # Errors
    /// When the game gives none.
    pub fn save_replay(&mut self) -> Result<Vec<u8>, StarCraftError> {
        match self.connection.ask(Request::SaveReplay(RequestSaveReplay {}))? {
            Response::SaveReplay(replay) => Ok(replay.data.unwrap_or_default()),
            _ => Err(odd("save_replay")),
        }
    }

    /// Asks the game to end; [`Self::quit`] waits for it.
    pub(crate) fn ask_to_quit(&mut self) {
        if !std::mem::replace(&mut self.quits, true)
            && let Err(error) = self.connection.send(Request::Quit(RequestQuit {}))
        {
            tracing::debug!(%error, "a game could not be asked to quit");
        }
    }

    /// Ends the game gracefully, and waits for its end.
    pub fn quit(mut self) {
        self.ask_to_quit();
        if let Some(process) = self.process.take() {
            process.quit();
        }
    }

    fn clear(&mut self, units: &[Unit]) -> Result<(), StarCraftError> {
        if units.is_empty() {
            return Ok(());
        }
        let tag = units.iter().map(Unit::tag).collect();
        self.debug(vec![Command::KillUnit(DebugKillUnit { tag })])?;
        self.step_until(0)
    }

    /// Steps until there are so many units.
    fn step_until(&mut self, wanted: usize) -> Result<(), StarCraftError> {
        let (mut loops, mut count) = (0, UNITS_FIRST);
        loop {
            self.step(count)?;
            loops += count;
            let found = self.observe()?.len();
            if found == wanted {
                return Ok(());
            }
            if loops >= UNITS_WITHIN {
                return Err(StarCraftError::Units { loops, found, wanted });
            }
            count = 1;
        }
    }

    fn creation(&self, group: &Group) -> DebugCreateUnit {
        let (owner, unit_type) = match group.side {
            Side::Ally => (1, self.custom.number(group.kind)),
            Side::Enemy => (2, group.kind.standard_id()),
        };
        DebugCreateUnit {
            unit_type: Some(unit_type),
            owner: Some(owner),
            pos: Some(point(group.at)),
            quantity: Some(group.count as u32),
        }
    }

    /// Sends the opponent's units to the middle of the others, attacking what they meet. Where the game refuses, control
    /// of them was toggled away before, and is toggled back.
    fn send_enemies(&mut self, units: &[Unit]) -> Result<(), StarCraftError> {
        let of = |owner: i32| units.iter().filter(move |unit| unit.owner() == owner);
        let count = of(1).count().max(1) as f64;
        let mean = |axis: fn(&crate::messages::Point) -> f32| {
            of(1).filter_map(|unit| unit.pos.as_ref()).map(|pos| f64::from(axis(pos))).sum::<f64>() / count
        };
        let middle = [mean(crate::messages::Point::x), mean(crate::messages::Point::y)];
        let target = Some(Target::TargetWorldSpacePos(point(middle)));
        let unit_tags: Vec<u64> = of(2).map(Unit::tag).collect();
        for attempt in 0..2 {
            let order = ActionRawUnitCommand {
                ability_id: Some(ATTACK),
                target,
                unit_tags: unit_tags.clone(),
                queue_command: Some(false),
            };
            let request = Request::Action(RequestAction { actions: vec![action(order)] });
            let Response::Action(acted) = self.connection.ask(request)? else { return Err(odd("action")) };
            let Some(&result) = acted.result.iter().find(|&&result| result != SUCCESS) else { return Ok(()) };
            if attempt == 1 {
                return Err(StarCraftError::EnemyControl { result });
            }
            self.toggle_enemy_control()?;
        }
        Ok(())
    }

    fn toggle_enemy_control(&mut self) -> Result<(), StarCraftError> {
        self.debug(vec![Command::GameState(DebugGameState::ControlEnemy.into())])
    }

    /// By their names in the game's data, or else by creating one of each that may be one and looking at it.
    fn find_custom_types(&mut self) -> Result<CustomTypes, StarCraftError> {
        let request = RequestData { unit_type_id: Some(true), ..RequestData::default() };
        let Response::Data(data) = self.connection.ask(Request::Data(request))? else {
            return Err(odd("data"));
        };
        if let Some(custom) = CustomTypes::by_name(&data.units) {
            return Ok(custom);
        }
        let candidates = CustomTypes::candidates(&data.units);
        let left = self.observe()?;
        self.clear(&left)?;
        let create = |(at, &id): (usize, &u32)| {
            let place = [2.0 + 3.5 * (at % 8) as f64, 2.0 + 3.5 * (at / 8) as f64];
            Command::CreateUnit(DebugCreateUnit {
                unit_type: Some(id),
                owner: Some(1),
                pos: Some(point(place)),
                quantity: Some(1),
            })
        };
        self.debug(candidates.iter().enumerate().map(create).collect())?;
        self.step(UNITS_FIRST)?;
        let units = self.observe()?;
        CustomTypes::by_looks(&units).ok_or_else(|| StarCraftError::UnitTypes {
            tried: format!(
                "names ending in _RL, and the looks of {} types numbered {:?} to {:?}",
                candidates.len(),
                candidates.first(),
                candidates.last()
            ),
        })
    }

    fn debug(&mut self, commands: Vec<Command>) -> Result<(), StarCraftError> {
        let debug = commands.into_iter().map(|command| DebugCommand { command: Some(command) }).collect();
        self.connection.ask(Request::Debug(RequestDebug { debug }))?;
        Ok(())
    }

    fn step(&mut self, count: u32) -> Result<(), StarCraftError> {
        self.connection.ask(Request::Step(RequestStep { count: Some(count) }))?;
        Ok(())
    }

    fn observe(&mut self) -> Result<Vec<Unit>, StarCraftError> {
        self.connection.send(observation())?;
        self.observed()
    }

    /// The units of both players in the observation that is on its way.
    fn observed(&mut self) -> Result<Vec<Unit>, StarCraftError> {
        let Response::Observation(seen) = self.connection.receive()? else { return Err(odd("observation")) };
        if self.connection.status() != Status::InGame {
            return Err(StarCraftError::Ended { status: format!("{:?}", self.connection.status()) });
        }
        let observation = seen.observation.unwrap_or_default();
        self.loops = observation.game_loop();
        let units = observation.raw_data.map(|raw| raw.units).unwrap_or_default();
        Ok(units.into_iter().filter(|unit| matches!(unit.owner(), 1 | 2)).collect())
    }
}

/// Whether a game of so many loops is too old for another battle. The game says how many loops there were, so that may be any
/// number.
fn is_spent(loops: u32, steps_max: usize) -> bool {
    let battle = (TICKS_PER_STEP * steps_max) as u32 + UNITS_WITHIN * 2 + SETTLE;
    loops.saturating_add(battle) >= LOOPS_MAX
}

fn observation() -> Request {
    Request::Observation(RequestObservation::default())
}

fn point([x, y]: Point) -> Point2D {
    Point2D { x: Some(x as f32), y: Some(y as f32) }
}

fn action(command: ActionRawUnitCommand) -> Action {
    Action { action_raw: Some(ActionRaw { action: Some(action_raw::Action::UnitCommand(command)) }) }
}

fn command(units: &[u64], order: UnitOrder) -> Action {
    let (ability, target) = match order {
        UnitOrder::Stop => (STOP, None),
        UnitOrder::Move(to) => (MOVE, Some(Target::TargetWorldSpacePos(point(to)))),
        UnitOrder::Attack(tag) => (ATTACK, Some(Target::TargetUnitTag(tag))),
        UnitOrder::Heal(tag) => (HEAL, Some(Target::TargetUnitTag(tag))),
    };
    action(ActionRawUnitCommand {
        ability_id: Some(ability),
        target,
        unit_tags: units.to_vec(),
        queue_command: Some(false),
    })
}

/// [`Connection`] has compared the names, so this does not come about.
fn odd(request: &'static str) -> StarCraftError {
    ConnectionError::Garbage { request, reason: "it answers another request".into() }.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_game_is_spent_however_many_loops_it_says_it_has_run() {
        assert!(!is_spent(0, 60));
        for loops in [LOOPS_MAX - 1, LOOPS_MAX, u32::MAX] {
            assert!(is_spent(loops, 60), "{loops}");
        }
    }
}
