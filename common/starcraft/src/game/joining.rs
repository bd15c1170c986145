//! From a connection to a game that can be played: its version, its creation, its map.

use super::{Setup, odd};
use crate::{
    connection::{Connection, shown},
    error::StarCraftError,
    installation::BUILD_MIN,
    messages::{
        Difficulty, InterfaceOptions, LocalMap, PlayerSetup, PlayerType, Race, RequestCreateGame,
        RequestGameInfo, RequestJoinGame, RequestPing, ResponseCreateGame, ResponseJoinGame,
        request::Request, request_join_game::Participation, response::Response, response_create_game,
        response_join_game,
    },
};
use rit_env::combat::{
    CombatSet,
    translation::{CELLS, Pathing},
};
use std::path::Path;

/// The game's version and build, if it has an API.
pub(super) fn check_version(connection: &mut Connection) -> Result<(String, u32), StarCraftError> {
    let Response::Ping(ping) = connection.ask(Request::Ping(RequestPing {}))? else {
        return Err(odd("ping"));
    };
    let (version, build) = (shown(&ping.game_version()), ping.base_build());
    if build < BUILD_MIN { Err(StarCraftError::Version { version, build }) } else { Ok((version, build)) }
}

/// Creates a game against a computer of the set's race, and joins it.
pub(super) fn create(connection: &mut Connection, setup: &Setup) -> Result<(), StarCraftError> {
    let race = match setup.set {
        CombatSet::Marines | CombatSet::MarinesMaraudersMedivacs => Race::Terran,
        CombatSet::StalkersZealots | CombatSet::ColossiStalkersZealots => Race::Protoss,
    };
    let participant = PlayerSetup { r#type: Some(PlayerType::Participant.into()), ..PlayerSetup::default() };
    let computer = PlayerSetup {
        r#type: Some(PlayerType::Computer.into()),
        race: Some(race.into()),
        difficulty: Some(Difficulty::VeryHard.into()),
    };
    let request = RequestCreateGame {
        local_map: Some(LocalMap {
            map_path: Some(setup.map.clone()),
            map_data: Some(setup.map_data.clone()),
        }),
        player_setup: vec![participant, computer],
        realtime: Some(false),
        random_seed: Some(setup.random_seed),
        ..RequestCreateGame::default()
    };
    let failed = |request, error: String, details: &str| StarCraftError::Game {
        request,
        error,
        details: shown(&details),
        map: setup.map.clone(),
    };
    match connection.ask(Request::CreateGame(request))? {
        Response::CreateGame(ResponseCreateGame { error: None, .. }) => {}
        Response::CreateGame(created) => {
            let error = response_create_game::Error::try_from(created.error.unwrap_or_default());
            let name = error.map_or_else(|unknown| unknown.to_string(), |error| format!("{error:?}"));
            return Err(failed("create_game", name, created.error_details()));
        }
        _ => return Err(odd("create_game")),
    }
    let request = RequestJoinGame {
        options: Some(InterfaceOptions { raw: Some(true), score: Some(false) }),
        participation: Some(Participation::Race(race.into())),
    };
    match connection.ask(Request::JoinGame(request))? {
        Response::JoinGame(ResponseJoinGame { error: None, .. }) => Ok(()),
        Response::JoinGame(joined) => {
            let error = response_join_game::Error::try_from(joined.error.unwrap_or_default());
            let name = error.map_or_else(|unknown| unknown.to_string(), |error| format!("{error:?}"));
            Err(failed("join_game", name, joined.error_details()))
        }
        _ => Err(odd("join_game")),
    }
}

/// The map must have the size that battles are made for; returns which of its cells can be walked.
pub(super) fn look_at_the_map(connection: &mut Connection, setup: &Setup) -> Result<Pathing, StarCraftError> {
    let Response::GameInfo(info) = connection.ask(Request::GameInfo(RequestGameInfo {}))? else {
        return Err(odd("game_info"));
    };
    let raw = info.start_raw.unwrap_or_default();
    let size = raw.map_size.unwrap_or_default();
    let cells = CELLS as i32;
    if (size.x(), size.y()) != (cells, cells) {
        let map = Path::new(&setup.map).display().to_string();
        return Err(StarCraftError::MapSize { map, x: size.x(), y: size.y() });
    }
    let grid = raw.pathing_grid.unwrap_or_default();
    Ok(Pathing::read(grid.bits_per_pixel().unsigned_abs(), grid.data())?)
}
