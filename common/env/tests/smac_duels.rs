//! The simulator against an independent reference: duels with orders by tick, their deaths, first hits and states.
//! `RIT_SMAC_DIR` names a folder with another `duels.json`.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, clippy::print_stdout, reason = "test code")]

mod common;

use common::{index, list, number, read, text};
use rit_env::combat::{
    StatsVersion, UnitType,
    world::{Order, Point, Side, World},
};
use serde_json::Value;
use std::collections::BTreeMap;

fn kind(name: &str) -> UnitType {
    UnitType::ALL
        .into_iter()
        .find(|kind| format!("{kind:?}") == name)
        .unwrap_or_else(|| panic!("unit type {name}"))
}

fn world_of(scenario: &Value) -> World {
    let mut world = World::default();
    world.clear(StatsVersion::Liberty, None);
    for unit in list(&scenario["units"]) {
        let side = if unit["side"] == "ally" { Side::Ally } else { Side::Enemy };
        let at = world.add(side, kind(text(&unit["type"])), [number(&unit["x"]), number(&unit["y"])]);
        world.set_vitals(at, unit["health"].as_f64(), unit["shield"].as_f64(), unit["energy"].as_f64());
    }
    world
}

fn order_of(order: &Value) -> Order {
    let point = || -> Point { [number(&order["to"][0]), number(&order["to"][1])] };
    match text(&order["order"]) {
        "stop" => Order::Stop,
        "move" => Order::Move(point()),
        "attack_move" => Order::AttackMove(point()),
        "attack" => Order::Attack(index(&order["target"])),
        "heal" => Order::Heal(index(&order["target"])),
        other => panic!("order {other}"),
    }
}

fn give_orders(world: &mut World, scenario: &Value, tick: usize) {
    for order in list(&scenario["orders"]).iter().filter(|order| index(&order["tick"]) == tick) {
        world.order(index(&order["unit"]), order_of(order));
    }
}

/// What of a scenario's expectations does not hold.
fn differences(scenario: &Value) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut world = world_of(scenario);
    let expect = &scenario["expect"];
    let within = number(&scenario["tolerance"]["values"]);
    let late = index(&scenario["tolerance"]["ticks"]) as i64;
    let mut deaths = BTreeMap::new();
    let mut first_hit = None;
    for tick in 0..index(&scenario["ticks"]) {
        give_orders(&mut world, scenario, tick);
        let lived: Vec<bool> = (0..world.len()).map(|unit| world.is_alive(unit)).collect();
        world.tick();
        for (unit, lived) in lived.into_iter().enumerate() {
            if lived && !world.is_alive(unit) {
                deaths.insert(unit, tick as i64);
            }
            if world.was_just_hit(unit) {
                first_hit.get_or_insert(tick as i64);
            }
        }
        let snapshot = list(&expect["after_tick"][(tick + 1).to_string()]);
        for (unit, state) in snapshot.iter().enumerate() {
            if state.is_null() {
                if world.is_alive(unit) {
                    wrong.push(format!("unit {unit} lives after {} ticks", tick + 1));
                }
                continue;
            }
            let [x, y] = world.position(unit);
            let found = [
                ("x", x),
                ("y", y),
                ("health", world.health(unit)),
                ("shield", world.shield(unit)),
                ("energy", world.energy(unit)),
            ];
            for (name, found) in found {
                let expected = number(&state[name]);
                if (found - expected).abs() > within {
                    wrong.push(format!("unit {unit} after {}: {name} {found}, not {expected}", tick + 1));
                }
            }
        }
    }
    let expected: BTreeMap<usize, i64> = list(&expect["deaths"])
        .iter()
        .map(|death| (index(&death["unit"]), index(&death["tick"]) as i64))
        .collect();
    let same = expected.keys().eq(deaths.keys())
        && expected.values().zip(deaths.values()).all(|(a, b)| (a - b).abs() <= late);
    if !same {
        wrong.push(format!("deaths {deaths:?}, not {expected:?}"));
    }
    if let Some(expected) = expect.get("first_hit_tick") {
        let same = match (expected.as_i64(), first_hit) {
            (Some(expected), Some(found)) => (expected - found).abs() <= late,
            (expected, found) => expected == found,
        };
        if !same {
            wrong.push(format!("first hit {first_hit:?}, not {expected}"));
        }
    }
    wrong
}

#[test]
fn every_duel_goes_as_in_the_reference() {
    let duels = read("duels.json");
    let scenarios = list(&duels["scenarios"]);
    assert!(!scenarios.is_empty(), "there are duels");
    let wrong: Vec<String> = scenarios
        .iter()
        .flat_map(|scenario| {
            let id = text(&scenario["id"]).to_owned();
            differences(scenario).into_iter().map(move |wrong| format!("{id}: {wrong}"))
        })
        .collect();
    assert!(wrong.is_empty(), "{} of {} scenarios:\n{}", wrong.len(), scenarios.len(), wrong.join("\n"));
}

fn pairs(world: &World) -> impl Iterator<Item = (usize, usize)> {
    let count = world.len();
    (0..count).flat_map(move |a| (a + 1..count).map(move |b| (a, b)))
}

fn distance(world: &World, a: usize, to: Point) -> f64 {
    let [x, y] = world.position(a);
    (x - to[0]).hypot(y - to[1])
}

/// Properties of crowds, where no exact course is prescribed.
#[test]
fn crowds_behave_as_crowds() {
    let duels = read("duels.json");
    for property in list(&duels["properties"]) {
        let id = text(&property["id"]);
        let mut world = world_of(property);
        match id {
            "surround" => {
                let before = index(&property["all_hit_before_tick"]);
                let overlap_max = number(&property["overlap_share_max"]);
                let attackers: Vec<usize> =
                    (0..world.len()).filter(|&unit| world.side(unit) == Side::Ally).collect();
                // The target is beyond killing; each attacker's weapon tells whether it has struck.
                let mut struck = vec![false; world.len()];
                for tick in 0..before {
                    give_orders(&mut world, property, tick);
                    world.tick();
                    for &unit in &attackers {
                        struck[unit] |= world.cooldown(unit) > 0;
                    }
                    for (a, b) in pairs(&world) {
                        let touch = world.stats(a).separation + world.stats(b).separation;
                        let overlap = touch - distance(&world, a, world.position(b));
                        assert!(
                            overlap <= overlap_max * touch,
                            "{id}: {a} and {b} overlap by {overlap} at {tick}"
                        );
                    }
                }
                assert!(attackers.iter().all(|&unit| struck[unit]), "{id}: {struck:?}");
            }
            "crowd" => {
                for tick in 0..index(&property["ticks"]) {
                    give_orders(&mut world, property, tick);
                    world.tick();
                }
                let goal = &property["orders"][0]["to"];
                let goal = [number(&goal[0]), number(&goal[1])];
                for (a, b) in pairs(&world) {
                    let far = distance(&world, a, world.position(b));
                    assert!(
                        far >= number(&property["pair_distance_min"]),
                        "{id}: {a} and {b} are {far} apart"
                    );
                }
                for unit in 0..world.len() {
                    let far = distance(&world, unit, goal);
                    assert!(far <= number(&property["point_distance_max"]), "{id}: {unit} is {far} away");
                }
            }
            other => panic!("property {other} is not known"),
        }
    }
}
