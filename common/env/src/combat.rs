//! StarCraft micro-combat: a simulator of small battles, and the translation of units into entities, masks, actions
//! and rewards that it shares with the real game.
//!
//! After the paper's section VI-C and the environments of SMAC (Samvelyan et al. 2019) and REFIL (Iqbal et al. 2021).
//! Win rates of the simulator are not comparable with the game's: engine, opponent, placement and collision differ.

mod scripts;
pub mod spawn;
pub mod team;
pub mod translation;
pub mod unit;
pub mod world;

pub use scripts::CombatScript;
pub use team::{CombatSet, Team, TeamError};
pub use unit::{StatsVersion, UnitType};

use crate::{
    BodyKind, Environment, EnvironmentError, FailureKind, Scene, SceneBody, SceneLink, SceneUnit, Spec, Step,
};
use rand::{RngExt as _, SeedableRng as _};
use rit_episode::{Action, Observation, Rng};
use serde::{Deserialize, Serialize};
use team::TEAM_MAX;
use translation::{RawUnit, Translation, UnitOrder};
use world::{Order, ScriptedMedivac, Side, World};

/// Ticks of one step.
pub const TICKS_PER_STEP: usize = 8;

/// How the battles of a run differ from what their set says. The default changes nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CombatOptions {
    /// Whether armies face each other at a random angle; as the set has it where `None`.
    pub spawn_rotate: Option<bool>,
    /// Which numbers units have.
    pub stats: StatsVersion,
    /// What the opponent's medivacs do.
    pub enemy_medivac: ScriptedMedivac,
    /// Allies follow the opponent's script, and actions do nothing: a mirror to measure the simulator by.
    pub mirror: bool,
}

impl CombatSet {
    /// Whether armies face each other at a random angle in the authors' code.
    pub fn rotates(self) -> bool {
        self != Self::StalkersZealots
    }
}

/// One battle of two teams, in the embedded simulator.
pub struct Combat {
    set: CombatSet,
    teams: [Team; 2],
    options: CombatOptions,
    world: World,
    translation: Translation,
    units: Vec<RawUnit>,
}

impl Combat {
    /// What a battle of these teams is.
    pub fn spec(set: CombatSet, [allies, enemies]: [Team; 2]) -> Spec {
        Spec {
            n_agents: allies.len(),
            n_entities: allies.len() + enemies.len(),
            feature_dim: set.feature_dim(),
            n_actions: set.n_actions(),
            steps_max: set.steps_max(),
            has_wins: true,
            has_scenes: true,
            is_reproducible: true,
        }
    }

    /// Battles of these teams, allies and enemies, as the set shows them.
    pub fn new(set: CombatSet, teams: [Team; 2], options: CombatOptions) -> Self {
        Self {
            set,
            teams,
            options,
            world: World::default(),
            translation: Translation::new(set),
            units: Vec::new(),
        }
    }

    /// The world of the episode under way.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Shows the living units as the game would.
    fn look(&mut self) {
        raw_units(&self.world, &mut self.units);
    }

    fn give_orders(&mut self, actions: &[Action]) {
        for (agent, &action) in actions.iter().enumerate() {
            if let Some((unit, order)) = self.translation.order(agent, action) {
                give_order(&mut self.world, unit as usize, order);
            }
        }
    }
}

/// The living units of a world as the game would show them; their tags are their indices.
pub fn raw_units(world: &World, to: &mut Vec<RawUnit>) {
    to.clear();
    for unit in 0..world.len() {
        if !world.is_alive(unit) {
            continue;
        }
        let stats = world.stats(unit);
        let [x, y] = world.position(unit);
        to.push(RawUnit {
            side: world.side(unit),
            kind: world.kind(unit),
            tag: unit as u64,
            x: x as f32,
            y: y as f32,
            health: world.health(unit) as f32,
            health_max: stats.health as f32,
            shield: world.shield(unit) as f32,
            shield_max: stats.shield as f32,
            energy: world.energy(unit) as f32,
            energy_max: stats.energy as f32,
            weapon_cooldown: world.cooldown(unit) as f32,
        });
    }
}

/// Gives a unit of a world an order; units are named as [`raw_units`] names them.
pub fn give_order(world: &mut World, unit: usize, order: UnitOrder) {
    let order = match order {
        UnitOrder::Stop => Order::Stop,
        UnitOrder::Move(point) => Order::Move(point),
        UnitOrder::Attack(target) => Order::Attack(target as usize),
        UnitOrder::Heal(target) => Order::Heal(target as usize),
    };
    world.order(unit, order);
}

/// What actions call the units of both teams: draws distinct numbers from 0 to 7 for the enemies, then from 8 to 15 for
/// the allies. Returns the allies', then the enemies'.
pub fn draw_tags([allies, enemies]: [Team; 2], rng: &mut Rng) -> [[usize; TEAM_MAX]; 2] {
    let mut draw = |count: usize, first: usize| {
        let mut tags: [usize; TEAM_MAX] = std::array::from_fn(|tag| first + tag);
        for at in 0..count {
            tags.swap(at, rng.random_range(at..TEAM_MAX));
        }
        tags
    };
    let enemy_tags = draw(enemies.len(), 0);
    [draw(allies.len(), TEAM_MAX), enemy_tags]
}

impl Environment for Combat {
    fn spec(&self) -> Spec {
        Self::spec(self.set, self.teams)
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        let rotate = self.options.spawn_rotate.unwrap_or(self.set.rotates());
        self.world.clear(self.options.stats, None);
        self.world.set_scripted_medivacs(self.options.enemy_medivac);
        spawn::spawn(&mut self.world, self.set, self.teams, rotate, rng);
        if self.options.mirror {
            spawn::send(&mut self.world, Side::Ally);
        }
        let [ally_tags, enemy_tags] = draw_tags(self.teams, rng);
        // Attack delays have a stream of their own.
        self.world.set_delays(Some(Rng::from_seed(rng.random())));
        self.look();
        let begun = self.translation.begin(&self.units, [&ally_tags, &enemy_tags]);
        begun.map_err(|error| EnvironmentError::new(FailureKind::BadAnswer, error.to_string()))
    }

    fn observe(&self, observation: &mut Observation) {
        self.translation.observe(observation);
    }

    fn step(&mut self, actions: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        if !self.options.mirror {
            self.give_orders(actions);
        }
        self.world.forget_links();
        for _ in 0..TICKS_PER_STEP {
            self.world.tick();
        }
        self.look();
        Ok(self.translation.advance(&self.units))
    }

    fn scene(&self) -> Option<Scene> {
        // Units of the world by the number that agents and features know them by.
        let units: Vec<usize> = [Side::Ally, Side::Enemy]
            .into_iter()
            .flat_map(|side| self.translation.unit_tags(side))
            .map(|tag| tag as usize)
            .collect();
        let body = |&unit: &usize| {
            let (stats, [x, y]) = (self.world.stats(unit), self.world.position(unit));
            let share = |left: f64, most: f64| (left / most) as f32;
            SceneBody {
                kind: match self.world.side(unit) {
                    Side::Ally => BodyKind::Agent,
                    Side::Enemy => BodyKind::Enemy,
                },
                x: x as f32,
                y: y as f32,
                radius: stats.radius as f32,
                unit: Some(SceneUnit {
                    letter: self.world.kind(unit).letter(),
                    health: share(self.world.health(unit), stats.health),
                    shield: (stats.shield > 0.0).then(|| share(self.world.shield(unit), stats.shield)),
                }),
            }
        };
        let number = |unit: usize| units.iter().position(|&other| other == unit);
        let links =
            self.world.links().iter().filter_map(|&(from, to, kind)| {
                Some(SceneLink { from: number(from)?, to: number(to)?, kind })
            });
        Some(Scene { bodies: units.iter().map(body).collect(), links: links.collect() })
    }
}
