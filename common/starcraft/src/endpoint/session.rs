//! One client's game: which requests are in place when, and what they do to the world.

use super::{
    Options,
    arena::{Arena, Told},
    maps::{self, Map},
};
use crate::{
    connection::shown,
    messages::{
        Action, ActionRawUnitCommand, Alliance, DebugCommand, DebugGameState, ImageData, Observation,
        ObservationRaw, PlayerCommon, PlayerInfo, PlayerSetup, PlayerType, PointI, RectangleI, Request,
        RequestAction, RequestCreateGame, RequestDebug, RequestJoinGame, RequestStep, Response,
        ResponseAction, ResponseCreateGame, ResponseData, ResponseDebug, ResponseGameInfo, ResponseJoinGame,
        ResponseLeaveGame, ResponseObservation, ResponsePing, ResponseQuit, ResponseRestartGame,
        ResponseSaveReplay, ResponseStep, Size2Di, StartRaw, Status, UnitTypeData, action_raw,
        action_raw_unit_command::Target, debug_command::Command, request, response::Response as Body,
        response_create_game, response_join_game,
    },
    unit_types::CustomTypes,
};
use prost::Message as _;
use rit_env::combat::{UnitType, translation::CELLS, world::Side};

/// Most loops of one step request: what a client that means it sends again and again.
const LOOPS_MAX: u32 = 10_000;

/// The game's results of an action.
const SUCCESS: i32 = 1;
const NOT_SUPPORTED: i32 = 2;
const ERROR: i32 = 3;

/// Abilities, by the unit's own number and by the general one.
const STOP: [i32; 2] = [4, 3665];
const MOVE: [i32; 2] = [16, 3794];
const ATTACK: [i32; 2] = [23, 3674];
const SCAN_MOVE: [i32; 2] = [19, 3674];
const HEAL: [i32; 2] = [386, 386];

/// A game from its launch to its end.
#[derive(Debug)]
pub struct Session {
    options: Options,
    status: Status,
    /// The map's file, once there is a game, and what it stands for.
    map: Option<(String, Map)>,
    players: Vec<PlayerInfo>,
    seed: u64,
    arena: Option<Arena>,
    controls_enemy: bool,
}

/// Why a request is out of place, in words.
type Refusal = String;

impl Session {
    /// A game that has been launched. `seed` is taken where a client gives none.
    pub fn new(options: Options, seed: u64) -> Self {
        Self {
            options,
            status: Status::Launched,
            map: None,
            players: Vec::new(),
            seed,
            arena: None,
            controls_enemy: false,
        }
    }

    /// Whether the client has asked it to quit.
    pub fn has_quit(&self) -> bool {
        self.status == Status::Quit
    }

    /// Answers a message; whatever it is, there is an answer.
    pub fn answer(&mut self, message: &[u8]) -> Vec<u8> {
        let (id, answer) = match Request::decode(message) {
            Ok(Request { request: Some(request), id }) => (id, self.request(request)),
            Ok(Request { request: None, id }) => {
                (id, Err("no request that this endpoint knows; see `rit starcraft-endpoint --help`".into()))
            }
            Err(error) => (None, Err(format!("no message of StarCraft II: {error}"))),
        };
        let (body, error) = match answer {
            Ok(body) => (Some(body), vec![]),
            Err(refusal) => (None, vec![refusal]),
        };
        Response { response: body, id, error, status: Some(self.status.into()) }.encode_to_vec()
    }

    fn request(&mut self, request: request::Request) -> Result<Body, Refusal> {
        use request::Request as R;
        match request {
            R::Ping(_) => Ok(Body::Ping(self.ping())),
            R::Quit(_) => {
                self.status = Status::Quit;
                Ok(Body::Quit(ResponseQuit {}))
            }
            R::CreateGame(create) => self.create(create),
            R::JoinGame(join) => self.join(&join),
            R::LeaveGame(_) => {
                self.arena()?;
                (self.arena, self.map, self.status) = (None, None, Status::Launched);
                Ok(Body::LeaveGame(ResponseLeaveGame {}))
            }
            R::RestartGame(_) => {
                self.arena()?;
                self.begin();
                Ok(Body::RestartGame(ResponseRestartGame::default()))
            }
            R::GameInfo(_) => self.game_info(),
            R::Observation(_) => self.observation(),
            R::Data(_) => {
                self.arena()?;
                Ok(Body::Data(ResponseData { units: self.unit_data() }))
            }
            R::Action(RequestAction { actions }) => {
                self.arena()?;
                let result = actions.iter().map(|action| self.act(action)).collect();
                Ok(Body::Action(ResponseAction { result }))
            }
            R::Step(RequestStep { count }) => self.step(count.unwrap_or(1)),
            R::Debug(RequestDebug { debug }) => {
                self.arena()?;
                debug.into_iter().try_for_each(|command| self.debug(command))?;
                Ok(Body::Debug(ResponseDebug {}))
            }
            R::SaveReplay(_) => {
                let loops = self.arena()?.loops();
                let data = format!("{loops} loops of a simulator; StarCraft II has no replay of them\n");
                Ok(Body::SaveReplay(ResponseSaveReplay { data: Some(data.into_bytes()) }))
            }
        }
    }

    /// The world, where the game is under way.
    fn arena(&mut self) -> Result<&mut Arena, Refusal> {
        self.arena.as_mut().ok_or_else(|| "no game is under way: create one and join it first".into())
    }

    fn ping(&self) -> ResponsePing {
        let Options { game_version, base_build, .. } = &self.options;
        ResponsePing {
            game_version: Some(game_version.clone()),
            data_version: Some(String::new()),
            data_build: Some(*base_build),
            base_build: Some(*base_build),
        }
    }

    fn create(&mut self, create: RequestCreateGame) -> Result<Body, Refusal> {
        if !matches!(self.status, Status::Launched | Status::InGame | Status::Ended) {
            return Err("a game has been created already: join it".into());
        }
        let refused = |error: response_create_game::Error, details: &str| {
            let (error, error_details) = (Some(error.into()), Some(details.to_owned()));
            Ok(Body::CreateGame(ResponseCreateGame { error, error_details }))
        };
        let Some(map) = create.local_map.filter(|map| !map.map_path().is_empty()) else {
            return refused(response_create_game::Error::MissingMap, "give local_map.map_path");
        };
        let kinds: Vec<PlayerType> = create.player_setup.iter().map(PlayerSetup::r#type).collect();
        if kinds.is_empty() {
            return refused(
                response_create_game::Error::MissingPlayerSetup,
                "give a participant and a computer",
            );
        }
        if kinds != [PlayerType::Participant, PlayerType::Computer] {
            let details = "the endpoint plays one participant against one computer, in this order";
            return refused(response_create_game::Error::InvalidPlayerSetup, details);
        }
        let mut found = maps::of(map.map_path());
        if self.options.custom_types > 0 {
            found.types = self.options.custom_types;
        }
        let players = create.player_setup.iter().zip(1..);
        let info = |(player, id): (&PlayerSetup, u32)| PlayerInfo {
            player_id: Some(id),
            r#type: player.r#type,
            race_requested: player.race,
        };
        self.players = players.map(info).collect();
        self.seed = create.random_seed.map_or(self.seed, u64::from);
        self.map = Some((map.map_path().to_owned(), found));
        (self.arena, self.status) = (None, Status::InitGame);
        Ok(Body::CreateGame(ResponseCreateGame::default()))
    }

    fn join(&mut self, join: &RequestJoinGame) -> Result<Body, Refusal> {
        if self.status != Status::InitGame {
            return Err("no game waits for a client to join: create one first".into());
        }
        let refused = |error: response_join_game::Error, details: &str| {
            let (error, error_details) = (Some(error.into()), Some(details.to_owned()));
            Ok(Body::JoinGame(ResponseJoinGame { player_id: None, error, error_details }))
        };
        if join.participation.is_none() {
            return refused(response_join_game::Error::MissingParticipation, "give a race");
        }
        if !join.options.is_some_and(|options| options.raw()) {
            return refused(
                response_join_game::Error::FeatureUnsupported,
                "the endpoint has the raw interface only",
            );
        }
        self.begin();
        Ok(Body::JoinGame(ResponseJoinGame { player_id: Some(1), ..ResponseJoinGame::default() }))
    }

    /// The world as the map has it at the beginning.
    fn begin(&mut self) {
        let Options { stats, enemy_medivac, .. } = self.options;
        let Some((_, Map { armies, types })) = self.map else { return };
        self.arena = Some(Arena::new(stats, enemy_medivac, self.seed, armies, types));
        self.controls_enemy = false;
        self.status = Status::InGame;
    }

    fn game_info(&mut self) -> Result<Body, Refusal> {
        self.arena()?;
        let Some((map, _)) = &self.map else { return Err("there is no map".into()) };
        let cells = CELLS as i32;
        let size = Some(Size2Di { x: Some(cells), y: Some(cells) });
        let grid = |bits: i32, byte: u8| {
            let data = Some(vec![byte; CELLS * CELLS * bits as usize / 8]);
            Some(ImageData { bits_per_pixel: Some(bits), size, data })
        };
        let corner = |at: i32| Some(PointI { x: Some(at), y: Some(at) });
        let start_raw = StartRaw {
            map_size: size,
            // Every cell can be walked, and lies at the same height.
            pathing_grid: grid(1, 0xff),
            terrain_height: grid(8, 127),
            placement_grid: grid(1, 0xff),
            playable_area: Some(RectangleI { p0: corner(0), p1: corner(cells) }),
        };
        Ok(Body::GameInfo(ResponseGameInfo {
            map_name: Some(map.clone()),
            local_map_path: Some(map.clone()),
            player_info: self.players.clone(),
            start_raw: Some(start_raw),
            options: None,
        }))
    }

    fn observation(&mut self) -> Result<Body, Refusal> {
        let arena = self.arena()?;
        let units = arena.units();
        let own = units.iter().filter(|unit| unit.alliance() == Alliance::Self_).count() as u32;
        let observation = Observation {
            player_common: Some(PlayerCommon { player_id: Some(1), army_count: Some(own) }),
            raw_data: Some(ObservationRaw { units, event: None }),
            game_loop: Some(arena.loops()),
        };
        Ok(Body::Observation(ResponseObservation { observation: Some(observation), player_result: vec![] }))
    }

    fn step(&mut self, count: u32) -> Result<Body, Refusal> {
        if count > LOOPS_MAX {
            return Err(format!("{count} loops in one step are more than {LOOPS_MAX}"));
        }
        let arena = self.arena()?;
        arena.step(count);
        Ok(Body::Step(ResponseStep { simulation_loop: Some(arena.loops()) }))
    }

    /// The game's own types that the simulator knows, and the map's.
    fn unit_data(&self) -> Vec<UnitTypeData> {
        let own = |kind: UnitType| UnitTypeData {
            unit_id: Some(kind.standard_id()),
            name: Some(format!("{kind:?}")),
            available: Some(true),
        };
        let mut data: Vec<UnitTypeData> = UnitType::ALL.map(own).into();
        data.sort_unstable_by_key(UnitTypeData::unit_id);
        if let Some((_, map)) = &self.map {
            data.extend(CustomTypes::data(map.types));
        }
        if !self.options.names_types {
            data.iter_mut().for_each(|unit| unit.name = None);
        }
        data
    }

    fn debug(&mut self, DebugCommand { command }: DebugCommand) -> Result<(), Refusal> {
        let sticky = self.options.sticky_control;
        match command {
            Some(Command::CreateUnit(create)) => {
                let pos = create.pos.unwrap_or_default();
                let at = [f64::from(pos.x()), f64::from(pos.y())];
                let (number, count) = (create.unit_type(), create.quantity.unwrap_or(1) as usize);
                if !self.arena()?.create(create.owner(), number, count, at) {
                    return Err(shown(&format!(
                        "create_unit: {count} units of type {number} for player {} at {at:?} cannot be",
                        create.owner()
                    )));
                }
            }
            Some(Command::KillUnit(kill)) => {
                let arena = self.arena()?;
                kill.tag.into_iter().for_each(|tag| arena.kill(tag));
            }
            Some(Command::GameState(state)) => match DebugGameState::try_from(state) {
                Ok(DebugGameState::ControlEnemy) => self.controls_enemy = sticky || !self.controls_enemy,
                // There is no fog.
                Ok(DebugGameState::ShowMap) => {}
                _ => return Err(format!("debug state {state} is not there")),
            },
            None => return Err("a debug command that this endpoint does not know".into()),
        }
        Ok(())
    }

    /// What becomes of an action, as the game numbers it.
    fn act(&mut self, action: &Action) -> i32 {
        let command = action.action_raw.as_ref().and_then(|raw| raw.action.as_ref());
        let Some(action_raw::Action::UnitCommand(command)) = command else { return NOT_SUPPORTED };
        let Some(told) = told(command) else { return NOT_SUPPORTED };
        let controls_enemy = self.controls_enemy;
        let Ok(arena) = self.arena() else { return ERROR };
        let mut done = true;
        for &tag in &command.unit_tags {
            let may = match arena.owner(tag) {
                Some(Side::Ally) => true,
                Some(Side::Enemy) => controls_enemy,
                None => false,
            };
            done &= may && arena.order(tag, told);
        }
        if done { SUCCESS } else { ERROR }
    }
}

/// What a command tells its units.
fn told(command: &ActionRawUnitCommand) -> Option<Told> {
    let ability = command.ability_id();
    let place = |pos: &crate::messages::Point2D| [f64::from(pos.x()), f64::from(pos.y())];
    match &command.target {
        None if STOP.contains(&ability) => Some(Told::Stop),
        Some(Target::TargetWorldSpacePos(pos)) if !(pos.x().is_finite() && pos.y().is_finite()) => None,
        Some(Target::TargetWorldSpacePos(pos)) if MOVE.contains(&ability) => Some(Told::Move(place(pos))),
        Some(Target::TargetWorldSpacePos(pos))
            if ATTACK.contains(&ability) || SCAN_MOVE.contains(&ability) =>
        {
            Some(Told::AttackMove(place(pos)))
        }
        Some(Target::TargetUnitTag(tag)) if MOVE.contains(&ability) => Some(Told::MoveTo(*tag)),
        Some(Target::TargetUnitTag(tag)) if ATTACK.contains(&ability) => Some(Told::Attack(*tag)),
        Some(Target::TargetUnitTag(tag)) if HEAL.contains(&ability) => Some(Told::Heal(*tag)),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
