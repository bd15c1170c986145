use super::*;
use crate::messages::{
    ActionRaw, DebugCreateUnit, DebugKillUnit, Difficulty, InterfaceOptions, LocalMap, PlayerSetup, Point2D,
    Race, RequestData, RequestGameInfo, RequestLeaveGame, RequestObservation, RequestPing, RequestQuit,
    RequestRestartGame, RequestSaveReplay, Unit, request::Request as R, request_join_game::Participation,
};
use rand::RngExt as _;
use rit_episode::{RunSeed, Stream};

fn session(options: Options) -> Session {
    Session::new(options, 3)
}

/// What a request comes to, with the state after it.
fn asked(session: &mut Session, request: R) -> (Result<Body, String>, Status) {
    let message = Request { request: Some(request), id: Some(9) }.encode_to_vec();
    let response = Response::decode(session.answer(&message).as_slice()).unwrap();
    assert_eq!(response.id, Some(9), "it carries the request's number");
    let status = response.status();
    (response.response.ok_or_else(|| response.error.join("; ")), status)
}

fn done(session: &mut Session, request: R) -> Body {
    asked(session, request).0.unwrap()
}

fn create(map: &str) -> R {
    let participant = PlayerSetup { r#type: Some(PlayerType::Participant.into()), ..PlayerSetup::default() };
    let computer = PlayerSetup {
        r#type: Some(PlayerType::Computer.into()),
        race: Some(Race::Terran.into()),
        difficulty: Some(Difficulty::VeryHard.into()),
    };
    R::CreateGame(RequestCreateGame {
        local_map: Some(LocalMap { map_path: Some(map.into()), map_data: None }),
        player_setup: vec![participant, computer],
        ..RequestCreateGame::default()
    })
}

fn join() -> R {
    R::JoinGame(RequestJoinGame {
        options: Some(InterfaceOptions { raw: Some(true), score: Some(false) }),
        participation: Some(Participation::Race(Race::Terran.into())),
    })
}

fn playing(map: &str, options: Options) -> Session {
    let mut session = session(options);
    done(&mut session, create(map));
    done(&mut session, join());
    session
}

fn units(session: &mut Session) -> Vec<Unit> {
    let Body::Observation(seen) = done(session, R::Observation(RequestObservation::default())) else {
        panic!()
    };
    seen.observation.unwrap().raw_data.unwrap().units
}

fn debug(command: Command) -> R {
    R::Debug(RequestDebug { debug: vec![DebugCommand { command: Some(command) }] })
}

fn create_unit(unit_type: u32, owner: i32, at: [f32; 2], quantity: u32) -> R {
    let pos = Some(Point2D { x: Some(at[0]), y: Some(at[1]) });
    let (unit_type, owner, quantity) = (Some(unit_type), Some(owner), Some(quantity));
    debug(Command::CreateUnit(DebugCreateUnit { unit_type, owner, pos, quantity }))
}

fn step(count: u32) -> R {
    R::Step(RequestStep { count: Some(count) })
}

/// What becomes of a command to these units.
fn act(session: &mut Session, tags: &[u64], ability: i32, target: Option<Target>) -> i32 {
    let command = ActionRawUnitCommand {
        ability_id: Some(ability),
        target,
        unit_tags: tags.to_vec(),
        queue_command: Some(false),
    };
    let action =
        Action { action_raw: Some(ActionRaw { action: Some(action_raw::Action::UnitCommand(command)) }) };
    let Body::Action(acted) = done(session, R::Action(RequestAction { actions: vec![action] })) else {
        panic!()
    };
    acted.result[0]
}

fn place(x: f32, y: f32) -> Option<Target> {
    Some(Target::TargetWorldSpacePos(Point2D { x: Some(x), y: Some(y) }))
}

fn of(units: &[Unit], owner: i32) -> Vec<u64> {
    units.iter().filter(|unit| unit.owner() == owner).map(Unit::tag).collect()
}

#[test]
fn a_request_out_of_place_is_answered_with_an_error_and_changes_nothing() {
    let mut session = session(Options::default());
    let in_game = [
        R::GameInfo(RequestGameInfo {}),
        R::Observation(RequestObservation::default()),
        R::Action(RequestAction::default()),
        step(1),
        R::Data(RequestData::default()),
        R::Debug(RequestDebug::default()),
        R::SaveReplay(RequestSaveReplay {}),
        R::RestartGame(RequestRestartGame {}),
        R::LeaveGame(RequestLeaveGame {}),
    ];
    for request in in_game.clone() {
        let name = request.name();
        let (answer, status) = asked(&mut session, request);
        assert!(answer.unwrap_err().starts_with("no game is under way"), "{name}");
        assert_eq!(status, Status::Launched);
    }
    assert!(asked(&mut session, join()).0.unwrap_err().starts_with("no game waits"));
    assert_eq!(asked(&mut session, create("empty_passive.SC2Map")).1, Status::InitGame);
    assert!(asked(&mut session, create("empty_passive.SC2Map")).0.unwrap_err().contains("join it"));
    assert_eq!(asked(&mut session, join()).1, Status::InGame);
    for request in in_game {
        let name = request.name();
        assert_eq!(asked(&mut session, request).0.unwrap().name(), name);
    }
    assert_eq!(asked(&mut session, R::Ping(RequestPing {})).1, Status::Launched, "it was left");
    assert_eq!(asked(&mut session, R::Quit(RequestQuit {})).1, Status::Quit);
    assert!(session.has_quit());
}

#[test]
fn what_is_no_request_is_answered_too() {
    let mut session = session(Options::default());
    let error = |session: &mut Session, message: &[u8]| {
        let response = Response::decode(session.answer(message).as_slice()).unwrap();
        assert!(response.response.is_none() && response.status() == Status::Launched);
        response.error.join("; ")
    };
    assert!(error(&mut session, &[0xff; 40]).starts_with("no message of StarCraft II"));
    assert!(error(&mut session, &[]).starts_with("no request that this endpoint knows"));
    // replay_info, which is a request of the game's.
    assert!(error(&mut session, &[0x82, 0x01, 0x00]).starts_with("no request that this endpoint knows"));
}

#[test]
fn a_game_that_cannot_be_is_refused_by_the_games_own_errors() {
    let mut session = session(Options::default());
    let mut refused = |request: R| match done(&mut session, request) {
        Body::CreateGame(created) => format!("{:?}", created.error()),
        Body::JoinGame(joined) => format!("{:?}", joined.error()),
        other => panic!("{other:?}"),
    };
    assert_eq!(refused(create("")), "MissingMap");
    let R::CreateGame(good) = create("3m.SC2Map") else { panic!() };
    let players = |player_setup| R::CreateGame(RequestCreateGame { player_setup, ..good.clone() });
    assert_eq!(refused(players(vec![])), "MissingPlayerSetup");
    assert_eq!(refused(players(good.player_setup[..1].to_vec())), "InvalidPlayerSetup");
    refused(create("3m.SC2Map"));
    assert_eq!(refused(R::JoinGame(RequestJoinGame::default())), "MissingParticipation");
    let R::JoinGame(good) = join() else { panic!() };
    assert_eq!(refused(R::JoinGame(RequestJoinGame { options: None, ..good })), "FeatureUnsupported");
}

#[test]
fn a_map_of_smac_brings_its_armies_again_and_again() {
    let mut session = playing("SMAC_Maps/1c3s5z.SC2Map", Options::default());
    let army = units(&mut session);
    let of_type = |owner: i32, number: u32| {
        army.iter().filter(|unit| unit.owner() == owner && unit.unit_type() == number).count()
    };
    // The allies' types in a row, the enemies' the game's own.
    assert_eq!([1935, 1936, 1937].map(|number| of_type(1, number)), [1, 3, 5]);
    assert_eq!([4, 74, 73].map(|number| of_type(2, number)), [1, 3, 5]);
    assert!(army.iter().all(|unit| (unit.pos.unwrap().x() < 16.0) == (unit.owner() == 1)));
    // The enemies come by themselves.
    done(&mut session, step(16));
    let moved = |now: &[Unit], owner: i32| {
        let far = |unit: &Unit| {
            let then = army.iter().find(|other| other.tag() == unit.tag()).unwrap().pos.unwrap();
            (unit.pos.unwrap().x() - then.x()).abs() > 1.0
        };
        now.iter().filter(|unit| unit.owner() == owner).filter(|unit| far(unit)).count()
    };
    let now = units(&mut session);
    assert_eq!((moved(&now, 1), moved(&now, 2)), (0, 9));
    // All are killed: two loops later all are back, with other tags.
    let tag = now.iter().map(Unit::tag).collect();
    done(&mut session, debug(Command::KillUnit(DebugKillUnit { tag })));
    assert!(units(&mut session).is_empty());
    done(&mut session, step(2));
    let again = units(&mut session);
    assert_eq!(again.len(), 18);
    assert!(again.iter().all(|unit| army.iter().all(|other| other.tag() != unit.tag())));
}

#[test]
fn the_enemies_take_orders_while_they_are_controlled() {
    for (sticky_control, after_two) in [(false, ERROR), (true, SUCCESS)] {
        let mut session = playing("empty.SC2Map", Options { sticky_control, ..Options::default() });
        done(&mut session, create_unit(48, 2, [20.0, 16.0], 2));
        done(&mut session, create_unit(1939, 1, [10.0, 16.0], 1));
        done(&mut session, step(1));
        let all = units(&mut session);
        let (ours, theirs) = (of(&all, 1), of(&all, 2));
        assert_eq!((ours.len(), theirs.len()), (1, 2));
        assert_eq!(act(&mut session, &theirs, 23, place(10.0, 16.0)), ERROR);
        let toggle = || debug(Command::GameState(DebugGameState::ControlEnemy.into()));
        done(&mut session, toggle());
        assert_eq!(act(&mut session, &theirs, 23, place(10.0, 16.0)), SUCCESS);
        done(&mut session, toggle());
        assert_eq!(act(&mut session, &theirs, 23, place(10.0, 16.0)), after_two);
    }
}

#[test]
fn orders_that_the_game_would_refuse_are_refused() {
    let mut session = playing("empty.SC2Map", Options::default());
    // Marines of the map's and of the game's; a medivac.
    for (number, owner, x) in [(1939, 1, 10.0), (48, 2, 14.0), (1940, 1, 9.0)] {
        done(&mut session, create_unit(number, owner, [x, 16.0], 1));
    }
    done(&mut session, step(1));
    let all = units(&mut session);
    let tag = |number: u32| all.iter().find(|unit| unit.unit_type() == number).unwrap().tag();
    let (marine, enemy, medivac) = (tag(1939), tag(48), tag(1940));
    let unit = |tag| Some(Target::TargetUnitTag(tag));
    for (who, ability, target, result) in [
        (marine, 4, None, SUCCESS),
        (marine, 16, place(11.0, 16.0), SUCCESS),
        (marine, 16, unit(medivac), SUCCESS),
        (marine, 23, unit(enemy), SUCCESS),
        (marine, 3674, unit(enemy), SUCCESS),
        (marine, 23, unit(medivac), ERROR),
        (marine, 23, unit(12), ERROR),
        (marine, 386, unit(medivac), ERROR),
        (medivac, 386, unit(marine), ERROR),
        (marine, 16, place(f32::NAN, 1.0), NOT_SUPPORTED),
        (marine, 1, None, NOT_SUPPORTED),
        (12, 4, None, ERROR),
    ] {
        assert_eq!(act(&mut session, &[who], ability, target), result, "ability {ability} of {who}");
    }
}

#[test]
fn what_would_take_for_ever_or_all_memory_is_refused() {
    let mut session = playing("empty.SC2Map", Options::default());
    assert!(asked(&mut session, step(u32::MAX)).0.unwrap_err().contains("loops in one step"));
    for (number, owner, at, quantity) in [
        (48, 1, [16.0, 16.0], u32::MAX),
        (48, 3, [16.0, 16.0], 1),
        (9999, 1, [16.0, 16.0], 1),
        (48, 1, [f32::NAN, 16.0], 1),
        (48, 1, [16.0, 33.0], 1),
    ] {
        let error = asked(&mut session, create_unit(number, owner, at, quantity)).0.unwrap_err();
        assert!(error.starts_with("create_unit:"), "{error}");
    }
    assert!(units(&mut session).is_empty());
    // As often as one likes, but not all at once.
    let mut refused = 0;
    for _ in 0..20 {
        refused += u32::from(asked(&mut session, create_unit(48, 1, [16.0, 16.0], 40)).0.is_err());
        done(&mut session, step(1));
    }
    assert!(refused > 0 && units(&mut session).len() <= 512);
}

/// Requests with bytes changed, cut off or doubled at random: each has an answer, and the game goes on.
#[test]
fn whatever_comes_is_answered() {
    let requests = [
        create("3m.SC2Map"),
        join(),
        step(3),
        create_unit(48, 2, [20.0, 16.0], 2),
        debug(Command::KillUnit(DebugKillUnit { tag: vec![(1 << 32) + 1] })),
        R::Observation(RequestObservation::default()),
        R::Data(RequestData::default()),
    ];
    let requests = requests.map(|request| Request { request: Some(request), id: Some(9) }.encode_to_vec());
    let mut rng = RunSeed(5).stream(Stream::Exploration, 0);
    let mut session = session(Options::default());
    for _ in 0..3000 {
        let mut message = requests[rng.random_range(0..requests.len())].clone();
        for _ in 0..rng.random_range(0..4) {
            let at = rng.random_range(0..message.len());
            match rng.random_range(0..3) {
                0 => message[at] = rng.random(),
                1 => message.truncate(at.max(1)),
                _ => message.extend_from_within(at..),
            }
        }
        let response = Response::decode(session.answer(&message).as_slice()).unwrap();
        assert!(response.response.is_some() == response.error.is_empty() && response.status.is_some());
        if session.has_quit() {
            session = Session::new(Options::default(), 3);
        }
    }
}
