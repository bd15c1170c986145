//! The client against the endpoint, over real sockets: step for step what the simulator gives directly.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, reason = "test code")]

mod common;

use common::{at, endpoint, settings, task};
use rand::RngExt as _;
use rit_env::{
    EnvironmentFactory as _, Script, Task,
    combat::{
        CombatScript, CombatSet, Team, draw_tags, give_order, raw_units,
        spawn::{Layout, place_group},
        translation::{RawUnit, Translation, UnitOrder},
        world::{Order, Side, World},
    },
    conformance,
    rollout::{Job, Rollout},
};
use rit_episode::{Action, Choice, Observation, RunSeed, Stream};
use rit_starcraft::{
    CustomTypes, StarCraft,
    endpoint::{Options, arena::delays},
};
use std::sync::Arc;

const SEED: RunSeed = RunSeed(7);
/// Loops from the units' creation to the first orders.
const SETTLE: usize = 6;

/// What goes over the wire as f32.
fn wire(place: [f64; 2]) -> [f64; 2] {
    place.map(|place| f64::from(place as f32))
}

/// A battle in the simulator, without a client, a protocol or an endpoint in between.
struct Direct {
    world: World,
    translation: Translation,
    units: Vec<RawUnit>,
}

impl Direct {
    /// The same battle as the game's of this number, begun with the same stream.
    fn begin(set: CombatSet, teams: [Team; 2], battle: u64, episode: u64) -> Self {
        let rng = &mut SEED.stream(Stream::Environment, episode);
        let layout = Layout::draw(set, teams, set.rotates(), rng);
        let tags = draw_tags(teams, rng);
        let game_seed = u64::from(SEED.derive("starcraft", 0).0 as u32);
        let mut world = World::default();
        world.clear(Default::default(), Some(delays(game_seed, battle)));
        let middle = |side: Side| {
            let places: Vec<_> =
                layout.groups.iter().filter(|group| group.side == side).map(|group| wire(group.at)).collect();
            [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / places.len() as f64)
        };
        let (allies, enemies) = (middle(Side::Ally), middle(Side::Enemy));
        for group in &layout.groups {
            let (from, to) = if group.side == Side::Ally { (allies, enemies) } else { (enemies, allies) };
            let [x, y] = [to[0] - from[0], to[1] - from[1]];
            let length = (x * x + y * y).sqrt();
            place_group(
                &mut world,
                group.side,
                group.kind,
                group.count,
                wire(group.at),
                [x / length, y / length],
            );
        }
        (0..SETTLE).for_each(|_| world.tick());
        let mut direct = Self { world, translation: Translation::new(set), units: Vec::new() };
        direct.look();
        let begun = direct.translation.begin(&direct.units, [&tags[0], &tags[1]]);
        begun.unwrap();
        let allies: Vec<_> = direct.units.iter().filter(|unit| unit.side == Side::Ally).collect();
        let mean = |of: fn(&RawUnit) -> f32| {
            allies.iter().map(|unit| f64::from(of(unit))).sum::<f64>() / allies.len() as f64
        };
        let middle = wire([mean(|unit| unit.x), mean(|unit| unit.y)]);
        for unit in 0..direct.world.len() {
            if direct.world.side(unit) == Side::Enemy {
                direct.world.order(unit, Order::AttackMove(middle));
            }
        }
        direct
    }

    fn look(&mut self) {
        raw_units(&self.world, &mut self.units);
    }

    fn step(&mut self, actions: &[Action]) -> rit_env::Step {
        for (agent, &action) in actions.iter().enumerate() {
            if let Some((unit, order)) = self.translation.order(agent, action) {
                let order = match order {
                    UnitOrder::Move(to) => UnitOrder::Move(wire(to)),
                    order => order,
                };
                give_order(&mut self.world, unit as usize, order);
            }
        }
        (0..8).for_each(|_| self.world.tick());
        self.look();
        self.translation.advance(&self.units)
    }
}

#[test]
fn the_client_over_the_endpoint_gives_what_the_simulator_gives() {
    for (set, name) in [
        (CombatSet::Marines, "3m"),
        (CombatSet::Marines, "8m-vs-5m"),
        (CombatSet::StalkersZealots, "2s3z"),
        (CombatSet::MarinesMaraudersMedivacs, "3m3M2v"),
        (CombatSet::ColossiStalkersZealots, "2s2z2c"),
    ] {
        let task = task(set, name);
        let Task::Combat { allies, enemies, .. } = task else { unreachable!() };
        let worlds = at(endpoint(Options::default()), set);
        let mut world = worlds.build(task).unwrap();
        let spec = worlds.spec(task);
        let [mut ours, mut theirs] = [Observation::default(), Observation::default()];
        for battle in 0..3 {
            let rng = &mut SEED.stream(Stream::Environment, battle);
            // The arena of a game that begins counts as its first battle.
            let mut direct = Direct::begin(set, [allies, enemies], battle + 1, battle);
            world.begin_reset(rng).unwrap();
            world.reset(rng).unwrap();
            let mut choices = SEED.stream(Stream::Exploration, battle);
            for step in 0.. {
                for observation in [&mut ours, &mut theirs] {
                    observation.reset(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
                }
                direct.translation.observe(&mut theirs);
                world.observe(&mut ours);
                assert_eq!(ours, theirs, "{name}, battle {battle}, step {step}");
                let actions: Vec<Action> = (0..spec.n_agents)
                    .map(|agent| {
                        let available = ours.available_to(agent);
                        // Units that can shoot do so mostly; others wander, so that battles come about.
                        let first = (6..available.len()).find(|&action| available[action] == 1);
                        let any: Vec<usize> = (0..available.len()).filter(|&a| available[a] == 1).collect();
                        let random = any[choices.random_range(0..any.len())];
                        first.filter(|_| choices.random_range(0..4) > 0).unwrap_or(random) as Action
                    })
                    .collect();
                world.begin_step(&actions).unwrap();
                let (stepped, expected) = (world.step(&actions, rng).unwrap(), direct.step(&actions));
                assert_eq!(stepped, expected, "{name}, battle {battle}, step {step}");
                if stepped.end.is_some() {
                    assert!(step > 3, "a battle, not a misunderstanding");
                    break;
                }
            }
        }
    }
}

#[test]
fn it_conforms_to_what_every_environment_promises() {
    let task = task(CombatSet::Marines, "3m");
    let worlds = at(endpoint(Options::default()), CombatSet::Marines);
    conformance::check(|| worlds.build(task).unwrap());
}

#[test]
fn several_games_play_at_once_and_are_used_again() {
    let set = CombatSet::StalkersZealots;
    let task = task(set, "3s");
    let worlds = Arc::new(at(endpoint(Options::default()), set));
    let mut rollout = Rollout::new(vec![task], Arc::<StarCraft>::clone(&worlds), SEED, true);
    let job = |number| Job { number, weights_version: 0, choice: Choice::Greedy, task: Some(0) };
    let mut script = Script::Combat(CombatScript::Nearest);
    for round in 0..3 {
        let jobs: Vec<Job> = (4 * round..4 * round + 4).map(job).collect();
        let episodes = rollout.roll_all(&mut script, &jobs).unwrap();
        assert!(episodes.iter().all(|episode| episode.steps() > 3));
    }
    // Four games were begun, not twelve: the next one taken is one of those.
    let game = worlds.game().unwrap();
    assert!(!game.is_spent(150) && game.is_spent(1 << 16));
    assert_eq!(game.version(), ("4.10.0", 75_689));
}

#[test]
fn custom_types_are_found_by_name_by_looks_or_by_setting() {
    let set = CombatSet::Marines;
    let found = |options, settings| {
        let address = endpoint(options);
        StarCraft::at(address, set, settings).game().map(|game| game.custom_types().clone())
    };
    assert_eq!(found(Options::default(), settings()).unwrap(), CustomTypes::row(1935));
    let nameless = Options { names_types: false, custom_types: 1970, ..Options::default() };
    assert_eq!(found(nameless.clone(), settings()).unwrap(), CustomTypes::row(1970));
    let set_to = rit_starcraft::Settings { custom_types: 1970, ..settings() };
    assert_eq!(found(nameless, set_to).unwrap(), CustomTypes::row(1970));
    let hidden = Options { names_types: false, custom_types: 100, ..Options::default() };
    let error = found(hidden, settings()).unwrap_err().to_string();
    assert!(error.contains("were not found") && error.contains("starcraft.custom_types"), "{error}");
}

/// A client that says `control_enemy` each time takes the enemies out of control every second time; the client notices.
#[test]
fn control_of_the_enemies_is_taken_back_when_it_was_toggled_away() {
    let set = CombatSet::Marines;
    for sticky_control in [false, true] {
        let worlds = at(endpoint(Options { sticky_control, ..Options::default() }), set);
        let mut world = worlds.build(task(set, "3m")).unwrap();
        for episode in 0..3 {
            let rng = &mut SEED.stream(Stream::Environment, episode);
            world.begin_reset(rng).unwrap();
            world.reset(rng).unwrap();
            // The enemies come: a unit is hit in the end, though no ally moves.
            let mut end = None;
            while end.is_none() {
                let mut observation = Observation::new(3, 6, 35, 14);
                world.observe(&mut observation);
                let actions: Vec<Action> =
                    (0..3).map(|agent| Action::from(observation.allows(agent, 1))).collect();
                world.begin_step(&actions).unwrap();
                end = world.step(&actions, rng).unwrap().end;
            }
            assert_eq!(end, Some(rit_episode::End::Terminated), "standing still loses");
        }
    }
}
