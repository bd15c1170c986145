//! The translation against the published environment: snapshots of units in, and what its class made of them.
//! `RIT_SMAC_DIR` names a folder with other cases under `golden/`.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, clippy::print_stdout, reason = "test code")]

mod common;

use common::{folder, index, list, number, read, text};
use rit_env::combat::{
    CombatSet, UnitType,
    translation::{Pathing, RawUnit, Translation, UnitOrder},
    world::Side,
};
use rit_episode::{Action, End, Observation};
use serde_json::Value;
use std::fs;

const TOLERANCE: f64 = 1e-6;
/// Abilities of the game.
const STOP: u64 = 4;
const MOVE: u64 = 16;
const ATTACK: u64 = 23;
const HEAL: u64 = 386;

fn units(snapshot: &Value) -> Vec<RawUnit> {
    let unit = |unit: &Value| {
        let number = |name: &str| number(&unit[name]) as f32;
        let kind = UnitType::ALL.into_iter().find(|kind| format!("{kind:?}") == text(&unit["type"]));
        RawUnit {
            side: if unit["owner"] == 1 { Side::Ally } else { Side::Enemy },
            kind: kind.expect("a known type"),
            tag: unit["tag"].as_u64().expect("a tag"),
            x: number("x"),
            y: number("y"),
            health: number("health"),
            health_max: number("health_max"),
            shield: number("shield"),
            shield_max: number("shield_max"),
            energy: number("energy"),
            energy_max: number("energy_max"),
            weapon_cooldown: number("weapon_cooldown"),
        }
    };
    list(snapshot).iter().map(unit).collect()
}

fn pathing(value: &Value) -> Pathing {
    if let Some(hex) = value["data_hex"].as_str() {
        let byte = |at: usize| u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).expect("hexadecimal digits");
        let data: Vec<u8> = (0..hex.len() / 2).map(byte).collect();
        return Pathing::read(index(&value["bits_per_pixel"]) as u32, &data).expect("a grid");
    }
    let mut pathing = Pathing::default();
    for cell in list(&value["blocked"]) {
        pathing.block(index(&cell[0]), index(&cell[1]));
    }
    pathing
}

/// Row of the padded expectation that shows this entity.
fn padded(entity: usize, n_agents: usize) -> usize {
    if entity < n_agents { entity } else { 8 + entity - n_agents }
}

fn check_observation(translation: &Translation, set: CombatSet, expected: &Value, wrong: &mut Vec<String>) {
    let (n, m) = (translation.n_agents(), translation.n_entities());
    let mut observation = Observation::new(n, m, set.feature_dim(), set.n_actions());
    translation.observe(&mut observation);
    for entity in 0..m {
        let row = list(&expected["entities"][padded(entity, n)]);
        let found = &observation.entities()[entity * set.feature_dim()..][..set.feature_dim()];
        assert_eq!(row.len(), found.len());
        for (feature, (expected, found)) in row.iter().zip(found).enumerate() {
            if (number(expected) - f64::from(*found)).abs() > TOLERANCE {
                wrong.push(format!("entity {entity} feature {feature}: {found}, not {expected}"));
            }
        }
    }
    for agent in 0..n {
        let seen = text(&expected["observable"][agent]).as_bytes();
        let found: Vec<u8> = observation.observable()[agent * m..][..m].to_vec();
        let row: Vec<u8> = (0..m).map(|entity| seen[padded(entity, n)] - b'0').collect();
        if row != found {
            wrong.push(format!("agent {agent} sees {found:?}, not {row:?}"));
        }
        let row: Vec<u8> = text(&expected["available"][agent]).bytes().map(|flag| flag - b'0').collect();
        if row != observation.available_to(agent) {
            wrong.push(format!("agent {agent} may {:?}, not {row:?}", observation.available_to(agent)));
        }
    }
    let present: String =
        (0..16).map(|row| if (0..m).any(|entity| padded(entity, n) == row) { '1' } else { '0' }).collect();
    if present != text(&expected["present"]) {
        wrong.push(format!("present {present}, not {}", expected["present"]));
    }
}

fn order_of(order: &Value) -> (u64, UnitOrder) {
    let tag = order["units"][0].as_u64().expect("one unit");
    let target = || order["target_tag"].as_u64().expect("a unit's tag");
    let what = match order["ability_id"].as_u64() {
        Some(STOP) => UnitOrder::Stop,
        Some(MOVE) => UnitOrder::Move([number(&order["target"][0]), number(&order["target"][1])]),
        Some(ATTACK) => UnitOrder::Attack(target()),
        Some(HEAL) => UnitOrder::Heal(target()),
        other => panic!("ability {other:?}"),
    };
    (tag, what)
}

/// Places have 9 digits in the files.
fn is_same_order((unit, found): &(u64, UnitOrder), (of, expected): &(u64, UnitOrder)) -> bool {
    let same = match (found, expected) {
        (UnitOrder::Move(found), UnitOrder::Move(expected)) => {
            found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < TOLERANCE)
        }
        (found, expected) => found == expected,
    };
    unit == of && same
}

fn tags(values: &Value) -> Vec<usize> {
    list(values).iter().map(index).collect()
}

/// What of a case does not hold.
fn differences(case: &Value, set: CombatSet) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut translation = Translation::new(set);
    translation.set_pathing(pathing(&case["pathing"]));
    let spawned = units(&case["spawn"]["units"]);
    let (allies, enemies) = (tags(&case["ally_tags"]), tags(&case["enemy_tags"]));
    translation.begin(&spawned, [&allies, &enemies]).expect("a battle");
    for (side, name) in [(Side::Ally, "ally_order"), (Side::Enemy, "enemy_order")] {
        let expected: Vec<u64> = list(&case[name]).iter().map(|tag| tag.as_u64().expect("a tag")).collect();
        let found: Vec<u64> = translation.unit_tags(side).collect();
        if found != expected {
            wrong.push(format!("{name} {found:?}, not {expected:?}"));
        }
    }
    check_observation(&translation, set, &case["spawn"]["expected"], &mut wrong);
    let mut before = spawned;
    for (at, step) in list(&case["steps"]).iter().enumerate() {
        let now = units(&step["units"]);
        let expected = &step["expected"];
        let actions: Vec<Action> =
            list(&step["actions"]).iter().map(|action| index(action) as Action).collect();
        let repeat = index(&step["repeat"]);
        for again in 1..=repeat {
            let orders: Vec<(u64, UnitOrder)> = (0..translation.n_agents())
                .filter_map(|agent| translation.order(agent, actions[agent]))
                .collect();
            let expected_orders: Vec<_> = list(&expected["orders"]).iter().map(order_of).collect();
            let same = orders.len() == expected_orders.len()
                && orders
                    .iter()
                    .zip(&expected_orders)
                    .all(|(found, expected)| is_same_order(found, expected));
            if again == repeat && !same {
                wrong.push(format!("step {at}: orders {orders:?}, not {expected_orders:?}"));
            }
            let found = translation.advance(if again == repeat { &now } else { &before });
            if again < repeat {
                if found.end.is_some() {
                    wrong.push(format!("step {at}: ended when repeated for the {again}th time"));
                }
                continue;
            }
            if (f64::from(found.reward) - number(&expected["reward"])).abs() > TOLERANCE {
                wrong.push(format!("step {at}: reward {}, not {}", found.reward, expected["reward"]));
            }
            let end = match (expected["terminated"].as_bool(), expected["truncated"].as_bool()) {
                (Some(true), _) => Some(End::Terminated),
                (_, Some(true)) => Some(End::Truncated),
                _ => None,
            };
            if (found.end, Some(found.won)) != (end, expected["won"].as_bool()) {
                wrong.push(format!("step {at}: {found:?}, not {end:?} won {}", expected["won"]));
            }
        }
        check_observation(&translation, set, expected, &mut wrong);
        before = now;
    }
    wrong
}

#[test]
fn the_translation_is_the_published_one() {
    let mut wrong = Vec::new();
    let mut cases = 0;
    let golden = folder().join("golden");
    let mut files: Vec<_> = fs::read_dir(&golden)
        .unwrap_or_else(|error| panic!("{}: {error}", golden.display()))
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"))
        .filter(|name| name.ends_with(".json"))
        .collect();
    files.sort();
    for file in files {
        let golden = read(&format!("golden/{file}"));
        let set = CombatSet::ALL.into_iter().find(|set| set.to_string() == text(&golden["set"]));
        let set = set.unwrap_or_else(|| panic!("{file}: an unknown set"));
        assert_eq!(set.max_reward(), number(&golden["max_reward"]), "{file}");
        assert_eq!(set.n_actions(), index(&golden["n_actions"]), "{file}");
        assert_eq!(set.feature_dim(), index(&golden["entity_features"]), "{file}");
        for case in list(&golden["cases"]) {
            cases += 1;
            let name = text(&case["name"]);
            wrong.extend(differences(case, set).into_iter().map(|wrong| format!("{set} {name}: {wrong}")));
        }
    }
    assert!(cases > 0, "there are cases");
    assert!(wrong.is_empty(), "{} differences in {cases} cases:\n{}", wrong.len(), wrong.join("\n"));
}

/// The task lists that the paper's generator makes.
#[test]
fn tasks_are_those_of_the_generator() {
    let tasks = read("tasks.json");
    for entry in list(&tasks["sets"]) {
        let set =
            CombatSet::ALL.into_iter().find(|set| set.to_string() == text(&entry["name"])).expect("a set");
        let found: Vec<String> = set.teams().iter().map(ToString::to_string).collect();
        let expected: Vec<&str> = list(&entry["tasks"]).iter().map(|task| text(&task["name"])).collect();
        assert_eq!(found, expected, "{set}");
        assert_eq!(set.n_training(), index(&entry["n_training"]), "{set}");
        assert_eq!(set.steps_max(), index(&entry["episode_limit"]), "{set}");
        for (team, task) in set.teams().into_iter().zip(list(&entry["tasks"])) {
            assert_eq!(team.len(), index(&task["n_agents"]), "{team}");
        }
    }
}
