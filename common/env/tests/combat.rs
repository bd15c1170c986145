//! Whole battles: what every environment promises, what every battle keeps, and how scripts fare.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, clippy::print_stdout, reason = "test code")]

use rit_env::{
    Environment,
    combat::{Combat, CombatOptions, CombatScript, CombatSet, Team, world::Side},
    conformance,
};
use rit_episode::{Action, Exploration, Observation, RunSeed, Stream, Turn};

const SEED: RunSeed = RunSeed(11);

fn teams(set: CombatSet, name: &str) -> [Team; 2] {
    [Team::parse(name, set).unwrap(); 2]
}

fn set_of(name: &str) -> CombatSet {
    CombatSet::ALL.into_iter().find(|set| set.teams().iter().any(|team| team.to_string() == name)).unwrap()
}

#[test]
fn every_set_conforms() {
    for set in CombatSet::ALL {
        let all = set.teams();
        for team in [all[0], all[all.len() / 2], all[all.len() - 1]] {
            conformance::check(|| Box::new(Combat::new(set, [team; 2], CombatOptions::default())));
        }
    }
    let uneven =
        [Team::parse("3m", CombatSet::Marines).unwrap(), Team::parse("4m", CombatSet::Marines).unwrap()];
    conformance::check(|| Box::new(Combat::new(CombatSet::Marines, uneven, CombatOptions::default())));
}

/// Plays one battle with a policy; returns its return, and whether it was won.
fn battle(
    combat: &mut Combat,
    number: u64,
    mut act: impl FnMut(&mut Turn<'_>),
    mut look: impl FnMut(&Combat),
) -> (f32, bool) {
    let spec = combat.spec();
    let rng = &mut SEED.stream(Stream::Environment, number);
    let mut exploration = Exploration::new(
        rit_episode::Choice::Greedy,
        0.0,
        spec.n_agents,
        SEED.stream(Stream::Exploration, number),
    );
    combat.reset(rng).unwrap();
    look(combat);
    let mut actions: Vec<Action> = vec![0; spec.n_agents];
    let mut total = 0.0;
    loop {
        // As an actor shows it: features, then room for the last action.
        let width = spec.entity_dim();
        let mut observation = Observation::new(spec.n_agents, spec.n_entities, width, spec.n_actions);
        combat.observe(&mut observation);
        let mut turn = Turn {
            slot: 0,
            observation: &observation,
            previous_reward: 0.0,
            exploration: &mut exploration,
            actions: &mut actions,
        };
        act(&mut turn);
        for (agent, &action) in actions.iter().enumerate() {
            assert!(observation.allows(agent, action), "agent {agent} plays {action}");
        }
        let step = combat.step(&actions, rng).unwrap();
        total += step.reward;
        look(combat);
        if step.end.is_some() {
            return (total, step.won);
        }
    }
}

fn randomly(turn: &mut Turn<'_>) {
    for (agent, to) in turn.actions.iter_mut().enumerate() {
        *to = turn.exploration.any(turn.observation.available_to(agent));
    }
}

/// What both sides had and have not is what hits took, less what came back; no unit leaves the map; no NaN.
#[test]
fn battles_keep_their_accounts() {
    for name in ["8m", "2s3z", "3m3M", "2m2M2v", "2s2z2c"] {
        let set = set_of(name);
        for mirror in [false, true] {
            let options = CombatOptions { mirror, ..CombatOptions::default() };
            let mut combat = Combat::new(set, teams(set, name), options);
            for number in 0..20 {
                battle(&mut combat, number, randomly, |combat| {
                    let world = combat.world();
                    let mut missing = [0.0; 2];
                    for unit in 0..world.len() {
                        let (stats, [x, y]) = (world.stats(unit), world.position(unit));
                        assert!((0.0..=32.0).contains(&x) && (0.0..=32.0).contains(&y), "{name}: {x} {y}");
                        assert!((0.0..=stats.health).contains(&world.health(unit)), "{name}");
                        assert!((0.0..=stats.shield).contains(&world.shield(unit)), "{name}");
                        assert!((0.0..=stats.energy).contains(&world.energy(unit)), "{name}");
                        assert_eq!(world.is_alive(unit), world.health(unit) > 0.0);
                        let have = world.health(unit) + world.shield(unit);
                        missing[world.side(unit) as usize] += stats.health + stats.shield - have;
                    }
                    for side in [Side::Ally, Side::Enemy] {
                        let (missing, lost) = (missing[side as usize], world.lost(side));
                        let back = world.recovered(side);
                        assert!(
                            (missing - (lost - back)).abs() < 1e-6,
                            "{name}: {missing} is not {lost} - {back}"
                        );
                    }
                });
            }
        }
    }
}

/// Allies that follow the opponent's rule win and lose equally often.
#[test]
fn the_simulator_favours_neither_side() {
    for name in ["3m", "4s4z", "3s3z2c"] {
        let set = set_of(name);
        let options = CombatOptions { mirror: true, ..CombatOptions::default() };
        let mut combat = Combat::new(set, teams(set, name), options);
        let (mut won, mut lost) = (0.0, 0.0);
        for number in 0..1000 {
            let (_, wins) = battle(&mut combat, number, still, |_| {});
            let world = combat.world();
            let allies_live =
                (0..world.len()).any(|unit| world.is_alive(unit) && world.side(unit) == Side::Ally);
            won += f64::from(u8::from(wins));
            lost += f64::from(u8::from(!allies_live && !wins));
        }
        let difference = (won - lost) / 1000.0;
        assert!(difference.abs() <= 0.1, "{name}: won {won}, lost {lost}");
    }
}

fn still(turn: &mut Turn<'_>) {
    for (agent, to) in turn.actions.iter_mut().enumerate() {
        *to = u8::from(turn.observation.allows(agent, 1));
    }
}

/// Win rates of scripts are of the reference's order. It played 100 battles of each, so 0.15 and twice its standard
/// error are allowed.
#[test]
fn scripts_fare_as_in_the_reference() {
    let table = [
        ("3m", [0.53, 0.14, 0.28]),
        ("8m", [0.45, 0.28, 0.21]),
        ("2s3z", [0.49, 0.51, 0.33]),
        ("4s4z", [0.43, 0.44, 0.11]),
        ("3m3M2v", [0.48, 0.01, 0.03]),
        ("3s3z2c", [0.41, 0.04, 0.07]),
    ];
    let mut wrong = Vec::new();
    for (name, expected) in table {
        let set = set_of(name);
        for (script, expected) in
            [None, Some(CombatScript::Nearest), Some(CombatScript::Focus)].into_iter().zip(expected)
        {
            let options = CombatOptions { mirror: script.is_none(), ..CombatOptions::default() };
            let mut combat = Combat::new(set, teams(set, name), options);
            let play = |turn: &mut Turn<'_>| match script {
                Some(script) => script.act(turn),
                None => still(turn),
            };
            let won = (0..300).filter(|&number| battle(&mut combat, number, play, |_| {}).1).count();
            let rate = won as f64 / 300.0;
            println!("{name} {script:?}: {rate:.2}, reference {expected}");
            let sampling = 2.0 * (expected * (1.0 - expected) / 100.0_f64).sqrt();
            if (rate - expected).abs() > 0.15 + sampling {
                wrong.push(format!("{name} {script:?}: {rate}, not about {expected}"));
            }
        }
        let mut combat = Combat::new(set, teams(set, name), CombatOptions::default());
        let won = (0..50).filter(|&number| battle(&mut combat, number, randomly, |_| {}).1).count();
        assert_eq!(won, 0, "random actions win nothing: {name}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
