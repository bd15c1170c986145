//! Scripted policies of the combat sets: reference points between which a learned policy's win rate can be placed.
//! They read the observation only and play legal actions only, but look at the whole battle, not at what each agent
//! sees.

use super::{
    CombatSet, StatsVersion, UnitType,
    team::TEAM_MAX,
    translation::{FIRST_TARGET, NO_OP, STOP},
};
use rit_episode::{Action, Observation, Turn};

/// Half of the map's width: places are features in these units.
const MAP: f32 = 32.0;

/// What an agent of a script does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CombatScript {
    /// Attacks the nearest enemy it may attack, and otherwise walks towards the nearest.
    Nearest,
    /// Attacks the weakest enemy it may attack, and otherwise walks towards the nearest.
    Focus,
    /// As `Nearest`, but walks away from enemies that come close while the weapon is not ready. For ranged teams.
    Kite,
}

/// How near an enemy may come to a unit that kites.
const KITE_DISTANCE: f32 = 4.0;

/// A unit as a script reads it from its features.
#[derive(Clone, Copy, Debug)]
struct Unit {
    tag: usize,
    kind: UnitType,
    alive: bool,
    x: f32,
    y: f32,
    /// Health and shield.
    vitality: f32,
    /// Share of health.
    health: f32,
    /// Whether its weapon waits.
    cooling: bool,
}

impl Unit {
    fn distance(&self, other: &Self) -> f32 {
        let (x, y) = (other.x - self.x, other.y - self.y);
        (x * x + y * y).sqrt()
    }
}

impl CombatScript {
    /// Chooses every agent's action.
    pub fn act(self, turn: &mut Turn<'_>) {
        let Some(set) = set_of(turn.observation) else {
            turn.actions.fill(NO_OP);
            return;
        };
        let units: Vec<Unit> =
            (0..turn.observation.n_entities()).map(|entity| unit(turn.observation, set, entity)).collect();
        let (allies, enemies) = units.split_at(turn.observation.n_agents());
        for (agent, action) in turn.actions.iter_mut().enumerate() {
            let may = |action: Action| turn.observation.allows(agent, action);
            *action = self.choose(&allies[agent], allies, enemies, &may);
        }
    }

    fn choose(self, own: &Unit, allies: &[Unit], enemies: &[Unit], may: &dyn Fn(Action) -> bool) -> Action {
        if !own.alive {
            return NO_OP;
        }
        if own.kind == UnitType::Medivac {
            return heal_or_follow(own, allies, may);
        }
        let on = |target: &Unit| (FIRST_TARGET + target.tag) as Action;
        let can_hit = |enemy: &&Unit| enemy.alive && own.kind.can_hit(enemy.kind, StatsVersion::Liberty);
        let nearest = |enemies: &mut dyn Iterator<Item = &Unit>| -> Option<Unit> {
            enemies.min_by(|a, b| own.distance(a).total_cmp(&own.distance(b))).copied()
        };
        let Some(near) = nearest(&mut enemies.iter().filter(can_hit)) else { return STOP };
        if self == Self::Kite && own.cooling && own.distance(&near) < KITE_DISTANCE {
            return walk(own, [2.0 * own.x - near.x, 2.0 * own.y - near.y], may);
        }
        let mut targets = enemies.iter().filter(can_hit).filter(|&enemy| may(on(enemy)));
        let target = match self {
            Self::Nearest | Self::Kite => nearest(&mut targets),
            Self::Focus => targets.min_by(|a, b| a.vitality.total_cmp(&b.vitality)).copied(),
        };
        target.map_or_else(|| walk(own, [near.x, near.y], may), |target| on(&target))
    }
}

/// A medivac heals the worst hurt ally it may heal, and otherwise follows the nearest that does not fly.
fn heal_or_follow(own: &Unit, allies: &[Unit], may: &dyn Fn(Action) -> bool) -> Action {
    let on = |target: &Unit| (FIRST_TARGET + target.tag) as Action;
    let walkers = || allies.iter().filter(|ally| ally.alive && !ally.kind.flies());
    let patients = walkers().filter(|ally| ally.health < 1.0 && may(on(ally)));
    if let Some(patient) = patients.min_by(|a, b| a.health.total_cmp(&b.health)) {
        return on(patient);
    }
    let leader = walkers().min_by(|a, b| own.distance(a).total_cmp(&own.distance(b)));
    leader.map_or(STOP, |leader| walk(own, [leader.x, leader.y], may))
}

/// The move along the longer axis towards a place, or along the other where that is barred.
fn walk(own: &Unit, [x, y]: [f32; 2], may: &dyn Fn(Action) -> bool) -> Action {
    let (dx, dy) = (x - own.x, y - own.y);
    let along_x = if dx >= 0.0 { 4 } else { 5 };
    let along_y = if dy >= 0.0 { 2 } else { 3 };
    let moves = if dx.abs() >= dy.abs() { [along_x, along_y] } else { [along_y, along_x] };
    moves.into_iter().find(|&action| may(action)).unwrap_or(STOP)
}

/// The set whose features these are, told by their number.
fn set_of(observation: &Observation) -> Option<CombatSet> {
    CombatSet::ALL.into_iter().find(|set| set.feature_dim() + set.n_actions() == observation.entity_dim())
}

fn unit(observation: &Observation, set: CombatSet, entity: usize) -> Unit {
    let features = &observation.entities()[entity * observation.entity_dim()..][..set.feature_dim()];
    let tag = features[..2 * TEAM_MAX].iter().position(|&flag| flag == 1.0).unwrap_or_default();
    let types = 2 * TEAM_MAX + set.n_actions() - 2;
    let one_hot = set.one_hot();
    let kind = features[types..].iter().zip(one_hot).find(|(flag, _)| **flag == 1.0);
    let kind = kind.map_or(set.types()[0], |(_, &kind)| kind);
    let stats = kind.stats(StatsVersion::Liberty);
    let vitals = types + one_hot.len();
    let health = features[vitals];
    let shield = if set.has_shields() { features[vitals + 1] } else { 0.0 };
    let places = set.feature_dim() - 4;
    Unit {
        tag,
        kind,
        alive: health > 0.0,
        x: features[places] * MAP,
        y: features[places + 1] * MAP,
        vitality: health * stats.health as f32 + shield * stats.shield as f32,
        health,
        cooling: features[places - 1] > 0.0,
    }
}
