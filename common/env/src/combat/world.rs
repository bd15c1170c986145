//! The simulator: units, orders and the tick that moves them. Sixteen ticks make a second.
//!
//! A tick's phases go over living units in index order, each phase to its end before the next: recovery, effects
//! due, targets of scripted units, weapons, healing, movement. State is f64; only additions, products, divisions
//! and square roots are used, so a course is the same to the bit on every machine.

mod movement;
mod opponent;
mod weapons;

use super::unit::{
    ENERGY_PER_HEALTH, ENERGY_RATE, ENERGY_START, HEALING_RANGE, HEALING_RATE, Layer, SHIELD_DELAY_TICKS,
    SHIELD_RATE, Stats, StatsVersion, TICKS_PER_SECOND, UnitType,
};
use crate::LinkKind;
use rit_episode::Rng;
use weapons::{Effect, Release};

/// Every range test allows this much.
const EPSILON: f64 = 1e-4;

/// Side of the square map.
pub const MAP_SIZE: f64 = 32.0;

/// A tick so long ago that no shield waits for it.
const NEVER: i64 = i64::MIN / 2;

/// A place on the map.
pub type Point = [f64; 2];

/// Whose a unit is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// The agents' side.
    Ally,
    /// The opponent's.
    Enemy,
}

/// What a unit was told. Targets are indices of units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Order {
    /// Stand.
    #[default]
    Stop,
    /// Walk straight to a point, then stand.
    Move(Point),
    /// Attack a unit, and follow it.
    Attack(usize),
    /// Heal a unit, and follow it.
    Heal(usize),
    /// Walk to a point and fight what comes near: the scripted opponent.
    AttackMove(Point),
}

/// What the scripted opponent's medivacs do: see [`World::set_scripted_medivacs`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScriptedMedivac {
    /// Heals who is near, and otherwise follows the others to the point.
    #[default]
    Scan,
    /// Heals who is near, and never moves.
    Stay,
}

/// A wind-up under way.
#[derive(Clone, Copy, Debug)]
struct WindUp {
    ends_at: i64,
    target: usize,
}

/// Units and what is under way between them. Structure of arrays: index by unit.
#[derive(Debug, Default)]
pub struct World {
    stats_version: StatsVersion,
    scripted_medivac: ScriptedMedivac,
    /// Attack delays are drawn from it; none without.
    delays: Option<Rng>,
    now: i64,
    kinds: Vec<UnitType>,
    sides: Vec<Side>,
    stats: Vec<Stats>,
    // What the inner loops read of the stats.
    radii: Vec<f64>,
    separations: Vec<f64>,
    layers: Vec<Layer>,
    positions: Vec<Point>,
    health: Vec<f64>,
    shield: Vec<f64>,
    energy: Vec<f64>,
    alive: Vec<bool>,
    orders: Vec<Order>,
    /// Orders that came while the unit was busy.
    pending: Vec<Option<Order>>,
    /// Whom a scripted unit goes for, and whether only because it was hit by it.
    aims: Vec<Option<usize>>,
    avenging: Vec<bool>,
    /// Speed of what accelerates.
    speeds: Vec<f64>,
    last_hit: Vec<i64>,
    /// When the weapon may be used again.
    ready: Vec<i64>,
    wind_ups: Vec<Option<WindUp>>,
    busy_until: Vec<i64>,
    /// Which side a unit passes standing bodies on, while it goes round them.
    detours: Vec<Option<f64>>,
    /// Whether bodies may overlap although none has moved.
    crowded: bool,
    effects: Vec<Effect>,
    orders_refused: u64,
    /// Health and shield lost to hits so far, and gained by healing and recovery, by side.
    lost: [f64; 2],
    recovered: [f64; 2],
    /// Who attacked or healed whom since [`Self::forget_links`].
    links: Vec<(usize, usize, LinkKind)>,
    // Work space of a tick, kept from one to the next.
    releases: Vec<Release>,
    healed: Vec<bool>,
    moving: Vec<bool>,
    goals: Vec<Point>,
    steps: Vec<f64>,
}

impl World {
    /// Removes everything; units then have these numbers, and attack delays come from `delays`.
    pub fn clear(&mut self, stats_version: StatsVersion, delays: Option<Rng>) {
        self.stats_version = stats_version;
        self.delays = delays;
        (self.now, self.orders_refused) = (0, 0);
        (self.lost, self.recovered) = ([0.0; 2], [0.0; 2]);
        self.kinds.clear();
        self.sides.clear();
        self.stats.clear();
        self.radii.clear();
        self.separations.clear();
        self.layers.clear();
        self.crowded = true;
        self.positions.clear();
        self.health.clear();
        self.shield.clear();
        self.energy.clear();
        self.alive.clear();
        self.orders.clear();
        self.pending.clear();
        self.aims.clear();
        self.avenging.clear();
        self.speeds.clear();
        self.last_hit.clear();
        self.ready.clear();
        self.wind_ups.clear();
        self.busy_until.clear();
        self.detours.clear();
        self.effects.clear();
        self.links.clear();
    }

    /// Draws attack delays from this stream from now on; without one there are none.
    pub fn set_delays(&mut self, delays: Option<Rng>) {
        self.delays = delays;
    }

    /// What medivacs under [`Order::AttackMove`] do.
    pub fn set_scripted_medivacs(&mut self, scripted_medivac: ScriptedMedivac) {
        self.scripted_medivac = scripted_medivac;
    }

    /// Adds a unit in full health and returns its index.
    pub fn add(&mut self, side: Side, kind: UnitType, position: Point) -> usize {
        let stats = kind.stats(self.stats_version);
        self.kinds.push(kind);
        self.sides.push(side);
        self.stats.push(stats);
        self.radii.push(stats.radius);
        self.separations.push(stats.separation);
        self.layers.push(stats.layer);
        self.positions.push(position);
        self.health.push(stats.health);
        self.shield.push(stats.shield);
        self.energy.push(if stats.energy > 0.0 { ENERGY_START } else { 0.0 });
        self.alive.push(true);
        self.orders.push(Order::Stop);
        self.pending.push(None);
        self.aims.push(None);
        self.avenging.push(false);
        self.speeds.push(0.0);
        self.last_hit.push(NEVER);
        self.ready.push(0);
        self.wind_ups.push(None);
        self.busy_until.push(0);
        self.detours.push(None);
        self.kinds.len() - 1
    }

    /// Changes a unit's state as a scenario wants it.
    pub fn set_vitals(&mut self, unit: usize, health: Option<f64>, shield: Option<f64>, energy: Option<f64>) {
        self.health[unit] = health.unwrap_or(self.health[unit]);
        self.shield[unit] = shield.unwrap_or(self.shield[unit]);
        self.energy[unit] = energy.unwrap_or(self.energy[unit]);
    }

    /// Which numbers its units have.
    pub fn stats_version(&self) -> StatsVersion {
        self.stats_version
    }

    /// Number of units, the dead included.
    pub fn len(&self) -> usize {
        self.kinds.len()
    }

    /// Whether there is no unit.
    pub fn is_empty(&self) -> bool {
        self.kinds.is_empty()
    }

    /// Ticks that have run.
    pub fn now(&self) -> i64 {
        self.now
    }

    /// A unit's type.
    pub fn kind(&self, unit: usize) -> UnitType {
        self.kinds[unit]
    }

    /// Whose a unit is.
    pub fn side(&self, unit: usize) -> Side {
        self.sides[unit]
    }

    /// A unit's numbers.
    pub fn stats(&self, unit: usize) -> &Stats {
        &self.stats[unit]
    }

    /// Whether a unit lives.
    pub fn is_alive(&self, unit: usize) -> bool {
        self.alive[unit]
    }

    /// Where a unit is, or was when it died.
    pub fn position(&self, unit: usize) -> Point {
        self.positions[unit]
    }

    /// A unit's health.
    pub fn health(&self, unit: usize) -> f64 {
        self.health[unit]
    }

    /// A unit's shield.
    pub fn shield(&self, unit: usize) -> f64 {
        self.shield[unit]
    }

    /// A unit's energy.
    pub fn energy(&self, unit: usize) -> f64 {
        self.energy[unit]
    }

    /// Ticks until the weapon may be used again.
    pub fn cooldown(&self, unit: usize) -> i64 {
        (self.ready[unit] - self.now).max(0)
    }

    /// Whether the unit was damaged in the last tick.
    pub fn was_just_hit(&self, unit: usize) -> bool {
        self.last_hit[unit] == self.now - 1
    }

    /// Orders so far that the game would refuse.
    pub fn orders_refused(&self) -> u64 {
        self.orders_refused
    }

    /// Health and shield that hits have taken from a side so far.
    pub fn lost(&self, side: Side) -> f64 {
        self.lost[side as usize]
    }

    /// Health and shield that a side has regained so far.
    pub fn recovered(&self, side: Side) -> f64 {
        self.recovered[side as usize]
    }

    /// Who attacked or healed whom since [`Self::forget_links`].
    pub fn links(&self) -> &[(usize, usize, LinkKind)] {
        &self.links
    }

    /// Begins [`Self::links`] anew.
    pub fn forget_links(&mut self) {
        self.links.clear();
    }

    fn link(&mut self, from: usize, to: usize, kind: LinkKind) {
        if !self.links.contains(&(from, to, kind)) {
            self.links.push((from, to, kind));
        }
    }

    /// Gives an order, to be followed from the next tick on. A busy unit finishes first; one that winds up breaks
    /// off, unless the order is the one it follows. An order that the game would refuse is counted and changes
    /// nothing; says whether it was taken.
    pub fn order(&mut self, unit: usize, order: Order) -> bool {
        if !self.alive[unit] || !self.is_possible(unit, order) {
            self.orders_refused += 1;
            return false;
        }
        if self.orders[unit] == order {
            self.pending[unit] = None;
        } else if self.is_busy(unit) {
            self.pending[unit] = Some(order);
        } else {
            self.follow(unit, order);
        }
        true
    }

    /// Kills a unit at once, without a hit: nothing is added to [`Self::lost`].
    pub fn kill(&mut self, unit: usize) {
        self.health[unit] = 0.0;
        self.bury_the_dead();
    }

    fn is_possible(&self, unit: usize, order: Order) -> bool {
        match order {
            Order::Stop | Order::Move(_) | Order::AttackMove(_) => true,
            Order::Attack(target) => {
                target < self.len()
                    && self.alive[target]
                    && self.sides[target] != self.sides[unit]
                    && self.can_hit(unit, target)
            }
            Order::Heal(target) => {
                self.kinds[unit] == UnitType::Medivac
                    && target < self.len()
                    && self.can_be_healed(unit, target)
            }
        }
    }

    fn can_be_healed(&self, healer: usize, patient: usize) -> bool {
        patient != healer
            && self.alive[patient]
            && self.sides[patient] == self.sides[healer]
            && self.stats[patient].biological
            && self.health[patient] < self.stats[patient].health
    }

    fn follow(&mut self, unit: usize, order: Order) {
        if self.wind_ups[unit].take().is_some() {
            self.ready[unit] = self.now;
        }
        self.orders[unit] = order;
        self.aims[unit] = None;
        self.avenging[unit] = false;
    }

    fn can_hit(&self, unit: usize, target: usize) -> bool {
        let reaches = |hits_air| hits_air || !self.kinds[target].flies();
        self.stats[unit].weapon.is_some_and(|weapon| reaches(weapon.hits_air))
    }

    /// Between a unit's two blows, or while it fires along a line.
    fn is_busy(&self, unit: usize) -> bool {
        self.now < self.busy_until[unit]
    }

    /// Whom the unit attacks or heals, if any.
    fn target(&self, unit: usize) -> Option<usize> {
        match self.orders[unit] {
            Order::Attack(target) | Order::Heal(target) => Some(target),
            Order::AttackMove(_) => self.aims[unit],
            Order::Stop | Order::Move(_) => None,
        }
    }

    /// Distance from edge to edge; negative where discs overlap.
    fn edge(&self, a: usize, b: usize) -> f64 {
        distance(self.positions[a], self.positions[b]) - self.radii[a] - self.radii[b]
    }

    /// How near a unit must come to its target, from edge to edge.
    fn reach(&self, unit: usize) -> f64 {
        self.stats[unit].weapon.map_or(HEALING_RANGE, |weapon| weapon.range)
    }

    fn is_in_reach(&self, unit: usize, target: usize) -> bool {
        self.edge(unit, target) <= self.reach(unit) + EPSILON
    }

    /// Runs one tick.
    pub fn tick(&mut self) {
        self.take_up_pending_orders();
        self.recover();
        self.land_effects();
        self.aim_scripted_units();
        self.use_weapons();
        self.heal();
        self.finish_orders();
        self.move_units();
        self.now += 1;
    }

    fn take_up_pending_orders(&mut self) {
        for unit in 0..self.len() {
            if !self.is_busy(unit)
                && let Some(order) = self.pending[unit].take()
            {
                self.follow(unit, order);
            }
        }
    }

    fn recover(&mut self) {
        for unit in 0..self.len() {
            if !self.alive[unit] {
                continue;
            }
            let stats = &self.stats[unit];
            if stats.shield > 0.0 && self.now - self.last_hit[unit] >= SHIELD_DELAY_TICKS {
                let before = self.shield[unit];
                self.shield[unit] = (before + SHIELD_RATE / TICKS_PER_SECOND).min(stats.shield.max(before));
                self.recovered[self.sides[unit] as usize] += self.shield[unit] - before;
            }
            if stats.energy > 0.0 {
                self.energy[unit] = (self.energy[unit] + ENERGY_RATE / TICKS_PER_SECOND).min(stats.energy);
            }
        }
    }

    fn heal(&mut self) {
        self.healed.clear();
        self.healed.resize(self.len(), false);
        for unit in 0..self.len() {
            if !self.alive[unit] || self.kinds[unit] != UnitType::Medivac {
                continue;
            }
            let Some(patient) = self.target(unit) else { continue };
            if self.healed[patient] || !self.can_be_healed(unit, patient) || !self.is_in_reach(unit, patient)
            {
                continue;
            }
            let missing = self.stats[patient].health - self.health[patient];
            let healing =
                (HEALING_RATE / TICKS_PER_SECOND).min(missing).min(self.energy[unit] / ENERGY_PER_HEALTH);
            // Rounding must neither leave a patient hurt for ever nor energy below zero.
            self.health[patient] =
                if healing == missing { self.stats[patient].health } else { self.health[patient] + healing };
            self.recovered[self.sides[unit] as usize] += healing;
            self.energy[unit] = (self.energy[unit] - healing * ENERGY_PER_HEALTH).max(0.0);
            self.healed[patient] = true;
            self.link(unit, patient, LinkKind::Heal);
        }
    }

    /// Attack and heal orders that are done become stop.
    fn finish_orders(&mut self) {
        for unit in 0..self.len() {
            let done = match self.orders[unit] {
                Order::Attack(target) => !self.alive[target],
                Order::Heal(patient) => !self.can_be_healed(unit, patient),
                Order::Stop | Order::Move(_) | Order::AttackMove(_) => false,
            };
            if done && self.wind_ups[unit].is_none() {
                self.orders[unit] = Order::Stop;
            }
        }
    }

    fn bury_the_dead(&mut self) {
        for unit in 0..self.len() {
            if self.alive[unit] && self.health[unit] <= 0.0 {
                self.alive[unit] = false;
                self.wind_ups[unit] = None;
                self.pending[unit] = None;
                self.orders[unit] = Order::Stop;
                self.aims[unit] = None;
                self.speeds[unit] = 0.0;
            }
        }
    }
}

/// Distance between two points.
fn distance(a: Point, b: Point) -> f64 {
    let (x, y) = (b[0] - a[0], b[1] - a[1]);
    (x * x + y * y).sqrt()
}
