//! What a game of StarCraft II answers: see [`rit_starcraft::read_response`].

use prost::Message as _;
use rit_env::combat::{
    CombatSet, StatsVersion, UnitType,
    translation::{Pathing, RawUnit, Translation},
};
use rit_episode::Observation;
use rit_starcraft::{
    CustomTypes,
    messages::{
        self, Point, Response, ResponseAction, ResponseData, ResponseGameInfo, ResponseObservation,
        ResponsePing, ResponseStep, Status, Unit, UnitTypeData, response::Response as Body,
    },
    read_response,
};

/// The number of every request.
const ID: u32 = 7;
/// Where the row of the map's own types begins.
const ROW: u32 = 1970;
/// Units of a side at most.
const TEAM_MAX: usize = 8;
/// What requests are called.
const NAMES: [&str; 13] = [
    "create_game",
    "join_game",
    "restart_game",
    "leave_game",
    "quit",
    "game_info",
    "observation",
    "action",
    "step",
    "data",
    "save_replay",
    "ping",
    "debug",
];
const SETS: [CombatSet; 4] = [
    CombatSet::Marines,
    CombatSet::StalkersZealots,
    CombatSet::MarinesMaraudersMedivacs,
    CombatSet::ColossiStalkersZealots,
];

/// A battle, as far as it is known.
struct Battle {
    set: CombatSet,
    types: CustomTypes,
    translation: Translation,
    begun: bool,
}

/// Reads an input as the set (a byte) and the answers of a game: what was asked (a byte), the length (two bytes), the
/// message. What is accepted, written again and read again, is the same; units that are accepted make an observation that
/// may be. Returns whether there was an answer and all were accepted.
pub fn check(input: &[u8]) -> bool {
    let Some((&set, mut rest)) = input.split_first() else { return false };
    let set = SETS[usize::from(set) % SETS.len()];
    let translation = Translation::new(set);
    let mut battle = Battle { set, types: CustomTypes::row(ROW), translation, begun: false };
    let mut answers = 0;
    while let Some((&[name, low, high], after)) = rest.split_first_chunk::<3>() {
        let Some((message, behind)) = after.split_at_checked(usize::from(u16::from_le_bytes([low, high])))
        else {
            return false;
        };
        if !battle.take(message, NAMES[usize::from(name) % NAMES.len()]) {
            return false;
        }
        answers += 1;
        rest = behind;
    }
    answers > 0 && rest.is_empty()
}

impl Battle {
    /// Whether a message is accepted.
    fn take(&mut self, message: &[u8], request: &'static str) -> bool {
        let mut status = Status::Launched;
        let Ok(body) = read_response(message, request, ID, &mut status) else { return false };
        let written = encoded(&body, status);
        let again = read_response(&written, request, ID, &mut status).map(|body| encoded(&body, status));
        // Bytes, since a number that is none is not itself.
        assert_eq!(again.ok(), Some(written), "what is written can be read");
        match body {
            Body::GameInfo(info) => {
                let grid = info.start_raw.unwrap_or_default().pathing_grid.unwrap_or_default();
                match Pathing::read(grid.bits_per_pixel().unsigned_abs(), grid.data()) {
                    Ok(pathing) => self.translation.set_pathing(pathing),
                    Err(_) => return false,
                }
                true
            }
            Body::Data(data) => {
                CustomTypes::candidates(&data.units);
                if let Some(types) = CustomTypes::by_name(&data.units) {
                    self.types = types;
                }
                true
            }
            Body::Observation(seen) => {
                let units =
                    seen.observation.and_then(|it| it.raw_data).map(|raw| raw.units).unwrap_or_default();
                self.look(&units)
            }
            _ => true,
        }
    }

    fn look(&mut self, units: &[Unit]) -> bool {
        CustomTypes::by_looks(units);
        let mut raw: Vec<RawUnit> = Vec::new();
        if self.types.raw_units(units, &mut raw).is_err() {
            return false;
        }
        if self.begun {
            let step = self.translation.advance(&raw);
            assert!(step.reward.is_finite(), "a reward may be");
        } else {
            let tags: [Vec<usize>; 2] = [(TEAM_MAX..2 * TEAM_MAX).collect(), (0..TEAM_MAX).collect()];
            if self.translation.begin(&raw, [&tags[0], &tags[1]]).is_err() {
                return false;
            }
            self.begun = true;
        }
        let (agents, entities) = (self.translation.n_agents(), self.translation.n_entities());
        let n_actions = self.set.n_actions();
        let mut observation = Observation::new(agents, entities, self.set.feature_dim(), n_actions);
        self.translation.observe(&mut observation);
        assert_eq!(observation.check(), Ok(()), "accepted units make an observation that may be");
        for (agent, action) in (0..agents).flat_map(|agent| (0..n_actions).map(move |action| (agent, action)))
        {
            if observation.available_to(agent)[action] == 1 {
                self.translation.order(agent, action as u8);
            }
        }
        true
    }
}

fn encoded(body: &Body, status: Status) -> Vec<u8> {
    let (response, status) = (Some(body.clone()), Some(status.into()));
    Response { response, id: Some(ID), status, ..Response::default() }.encode_to_vec()
}

fn frame(request: &str, message: &[u8]) -> Vec<u8> {
    let name = NAMES.iter().position(|name| *name == request).unwrap_or(0) as u8;
    let [low, high] = (message.len() as u16).to_le_bytes();
    [&[name, low, high], message].concat()
}

fn answer(body: &Body) -> Vec<u8> {
    frame(body.name(), &encoded(body, Status::InGame))
}

fn unit(tag: u64, kind: UnitType, is_ally: bool, x: f32) -> Unit {
    let stats = kind.stats(StatsVersion::Liberty);
    let number = if is_ally { CustomTypes::row(ROW).number(kind) } else { kind.standard_id() };
    Unit {
        tag: Some(tag),
        unit_type: Some(number),
        owner: Some(if is_ally { 1 } else { 2 }),
        pos: Some(Point { x: Some(x), y: Some(16.0 + tag as f32), ..Point::default() }),
        health: Some(stats.health as f32),
        health_max: Some(stats.health as f32),
        shield: Some(stats.shield as f32),
        shield_max: Some(stats.shield as f32),
        weapon_cooldown: Some(0.5),
        ..Unit::default()
    }
}

fn observed(units: Vec<Unit>) -> Body {
    let raw_data = Some(messages::ObservationRaw { units, ..messages::ObservationRaw::default() });
    let observation =
        messages::Observation { raw_data, game_loop: Some(8), ..messages::Observation::default() };
    Body::Observation(ResponseObservation {
        observation: Some(observation),
        ..ResponseObservation::default()
    })
}

/// A battle's units: two of each kind on each side.
fn units(kinds: &[UnitType]) -> Vec<Unit> {
    let sides = [(true, 9.0), (false, 22.0)];
    let of_side = |(is_ally, x): (bool, f32)| {
        let pair = move |(at, &kind): (usize, &UnitType)| {
            (0..2).map(move |which| {
                let tag = 2 * at as u64 + which + if is_ally { 1 } else { 9 };
                unit(tag, kind, is_ally, x)
            })
        };
        kinds.iter().enumerate().flat_map(pair).collect::<Vec<_>>()
    };
    sides.into_iter().flat_map(of_side).collect()
}

fn kinds(set: CombatSet) -> &'static [UnitType] {
    match set {
        CombatSet::Marines => &[UnitType::Marine],
        CombatSet::StalkersZealots => &[UnitType::Stalker, UnitType::Zealot],
        CombatSet::MarinesMaraudersMedivacs => &[UnitType::Marine, UnitType::Marauder, UnitType::Medivac],
        CombatSet::ColossiStalkersZealots => &[UnitType::Colossus, UnitType::Stalker, UnitType::Zealot],
    }
}

/// Whole inputs to begin from, by name.
pub fn seeds() -> Vec<(String, Vec<u8>)> {
    let ping = Body::Ping(ResponsePing { game_version: Some("4.10".into()), ..ResponsePing::default() });
    let named = |at: u32, name: &str| UnitTypeData {
        unit_id: Some(ROW + at),
        name: Some(name.to_owned()),
        ..UnitTypeData::default()
    };
    let data = Body::Data(ResponseData { units: vec![named(4, "Marine_RL"), named(7, "Zealot_RL")] });
    let grid = messages::ImageData {
        bits_per_pixel: Some(1),
        data: Some(vec![0xff; 32 * 32 / 8]),
        ..messages::ImageData::default()
    };
    let start_raw = Some(messages::StartRaw { pathing_grid: Some(grid), ..messages::StartRaw::default() });
    let info = Body::GameInfo(ResponseGameInfo { start_raw, ..ResponseGameInfo::default() });
    let acted = Body::Action(ResponseAction { result: vec![1, 1, 2] });
    let stepped = Body::Step(ResponseStep::default());
    let mut seeds: Vec<(String, Vec<u8>)> = Vec::new();
    for (at, set) in SETS.into_iter().enumerate() {
        let all = units(kinds(set));
        let mut later = all[1..].to_vec();
        later.iter_mut().for_each(|unit| unit.health = unit.health.map(|health| health / 2.0));
        let name = set.to_string().to_lowercase();
        let first = answer(&observed(all));
        seeds.push((format!("units-{name}"), [&[at as u8][..], &first].concat()));
        let step = [answer(&acted), answer(&stepped), answer(&observed(later))].concat();
        seeds.push((format!("step-{name}"), [&[at as u8][..], &first, &step].concat()));
    }
    for (name, body) in
        [("ping", ping), ("data", data), ("game-info", info), ("action", acted), ("step", stepped)]
    {
        seeds.push((name.to_owned(), [&[0][..], &answer(&body)].concat()));
    }
    seeds
}

/// Inputs that are refused, by what is wrong with them.
pub fn refused() -> Vec<(String, Vec<u8>)> {
    let marines = || units(&[UnitType::Marine]);
    let with = |change: fn(&mut Unit)| {
        let mut all = marines();
        change(&mut all[0]);
        answer(&observed(all))
    };
    let message = |response: Response| frame("ping", &response.encode_to_vec());
    let status = Some(Status::Launched.into());
    let ping = || Some(Body::Ping(ResponsePing::default()));
    let inputs = [
        ("error", message(Response { error: vec!["not in a game".into()], status, ..Response::default() })),
        ("other-number", message(Response { response: ping(), id: Some(8), status, ..Response::default() })),
        ("no-status", message(Response { response: ping(), ..Response::default() })),
        ("empty", message(Response { status, ..Response::default() })),
        ("other-answer", frame("step", &encoded(&Body::Ping(ResponsePing::default()), Status::Launched))),
        ("no-message", frame("ping", &[0xff; 16])),
        ("health-nan", with(|unit| unit.health = Some(f32::NAN))),
        ("health-none", with(|unit| unit.health_max = None)),
        ("health-tiny", with(|unit| unit.health_max = Some(f32::MIN_POSITIVE))),
        ("place-far", with(|unit| unit.pos = Some(Point { x: Some(f32::MAX), ..Point::default() }))),
        ("type-unknown", with(|unit| unit.unit_type = Some(1))),
        ("type-last", with(|unit| unit.unit_type = Some(u32::MAX))),
        ("no-enemy", answer(&observed(marines()[..2].to_vec()))),
        ("too-many", answer(&observed([marines(), marines(), marines(), marines(), marines()].concat()))),
    ];
    inputs.into_iter().map(|(name, input)| (name.to_owned(), [&[0][..], &input].concat())).collect()
}
