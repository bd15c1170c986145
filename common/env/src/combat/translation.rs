//! The translation that the simulator and the real game share: raw units into entities, masks, rewards and the
//! episode's end, and actions into orders. Numbers arrive as f32, as the game sends them, are worked on in f64, and
//! are rounded once.

use super::{CombatSet, UnitType, team::TEAM_MAX, world::Side};
use crate::Step;
use rit_episode::{Action, End, Observation};

/// The action of the dead.
pub const NO_OP: Action = 0;
/// Stand still.
pub const STOP: Action = 1;
/// Up to here and not including it: north, south, east, west.
const MOVES: std::ops::Range<usize> = 2..6;
/// The action on the unit of tag 0.
pub const FIRST_TARGET: usize = MOVES.end;
/// Direction of each move action: north, south, east, west.
const DIRECTIONS: [[f64; 2]; 4] = [[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]];
/// A move needs a walkable cell this far in its direction.
const MOVE_CHECK: f64 = 1.0;
/// A move is ordered this far.
const MOVE_ORDER: f64 = 2.0;
/// An agent sees so far, from centre to centre.
const SIGHT: f64 = 9.0;
/// An agent may attack or heal so far, from centre to centre.
pub const SHOOT_RANGE: f64 = 6.0;
/// What killing an enemy pays, before scaling.
const KILL_REWARD: f64 = 10.0;
/// What winning pays, before scaling.
const WIN_REWARD: f64 = 200.0;
/// Scaled rewards of a win come to about this.
const REWARD_SCALE: f64 = 20.0;
/// Width and height of the map, and cells of its grid.
pub const CELLS: usize = 32;
const MAP: f64 = CELLS as f64;

/// One unit as the game shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs, reason = "the game's own names")]
pub struct RawUnit {
    pub side: Side,
    pub kind: UnitType,
    pub tag: u64,
    pub x: f32,
    pub y: f32,
    pub health: f32,
    pub health_max: f32,
    pub shield: f32,
    pub shield_max: f32,
    pub energy: f32,
    pub energy_max: f32,
    /// Game loops until the weapon may be used again.
    pub weapon_cooldown: f32,
}

/// Which cells of the map can be walked, `[x][y]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pathing(Box<[[bool; CELLS]; CELLS]>);

/// A pathing grid that cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a pathing grid of {bits_per_pixel} bits a cell and {bytes} bytes is none of {CELLS} × {CELLS} cells"
)]
pub struct PathingError {
    /// Bits of one cell.
    pub bits_per_pixel: u32,
    /// Length of the data.
    pub bytes: usize,
}

impl Default for Pathing {
    fn default() -> Self {
        Self(Box::new([[true; CELLS]; CELLS]))
    }
}

impl Pathing {
    /// The grid as the game sends it: one bit a cell, row y = 0 first, the high bit the lowest x, 1 walkable; or, from
    /// older versions, one byte a cell, the top row first, 255 blocked.
    ///
    /// # Errors
    /// When it is neither.
    pub fn read(bits_per_pixel: u32, data: &[u8]) -> Result<Self, PathingError> {
        let mut pathing = Self::default();
        let is_walkable: &dyn Fn(usize, usize) -> bool = match (bits_per_pixel, data.len()) {
            (1, bytes) if bytes == CELLS * CELLS / 8 => {
                &|x, y| data[(y * CELLS + x) / 8] >> (7 - x % 8) & 1 == 1
            }
            (8, bytes) if bytes == CELLS * CELLS => &|x, y| data[(CELLS - 1 - y) * CELLS + x] != 255,
            (bits_per_pixel, bytes) => return Err(PathingError { bits_per_pixel, bytes }),
        };
        for (x, column) in pathing.0.iter_mut().enumerate() {
            for (y, cell) in column.iter_mut().enumerate() {
                *cell = is_walkable(x, y);
            }
        }
        Ok(pathing)
    }

    /// Bars one cell.
    pub fn block(&mut self, x: usize, y: usize) {
        self.0[x][y] = false;
    }

    /// Whether the cell of a place is there and can be walked. Places are cut off towards zero, so that −0.5 is in
    /// cell 0, as in the published environment.
    fn is_walkable(&self, [x, y]: [f64; 2]) -> bool {
        let cell = |place: f64| {
            let place = place.trunc();
            (0.0..MAP).contains(&place).then_some(place as usize)
        };
        cell(x).zip(cell(y)).is_some_and(|(x, y)| self.0[x][y])
    }
}

/// What an agent's action asks of the game. Units are named by their tags in the game.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum UnitOrder {
    /// Stand still.
    Stop,
    /// Walk to a place.
    Move([f64; 2]),
    /// Attack a unit.
    Attack(u64),
    /// Heal a unit.
    Heal(u64),
}

/// Units that do not make up the battle they should.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WrongUnits {
    /// Too few or too many.
    #[error("{found} units of the {side:?} side where there should be 1 to {TEAM_MAX}")]
    Count {
        /// The side.
        side: Side,
        /// How many it has.
        found: usize,
    },
    /// One that the set does not have.
    #[error("a {kind:?} in a battle of {set}")]
    Kind {
        /// What it is.
        kind: UnitType,
        /// The set.
        set: CombatSet,
    },
}

/// A unit as the agents know it: one row of the observation.
#[derive(Clone, Copy, Debug)]
struct Row {
    /// As last seen; dead units stay where they were.
    unit: RawUnit,
    /// What actions call it: enemies 0 to 7, allies 8 to 15.
    tag: usize,
    alive: bool,
}

impl Row {
    fn place(&self) -> [f64; 2] {
        [f64::from(self.unit.x), f64::from(self.unit.y)]
    }

    fn distance(&self, other: &Self) -> f64 {
        let ([ax, ay], [bx, by]) = (self.place(), other.place());
        ((bx - ax) * (bx - ax) + (by - ay) * (by - ay)).sqrt()
    }
}

/// One episode's view of a battle. Rows are the allies in the order of their numbers, then the enemies in theirs.
#[derive(Clone, Debug)]
pub struct Translation {
    set: CombatSet,
    max_reward: f64,
    pathing: Pathing,
    rows: Vec<Row>,
    n_allies: usize,
    steps: usize,
}

impl Translation {
    /// A view of battles of this set.
    pub fn new(set: CombatSet) -> Self {
        Self {
            set,
            max_reward: set.max_reward(),
            pathing: Pathing::default(),
            rows: Vec::new(),
            n_allies: 0,
            steps: 0,
        }
    }

    /// Which cells can be walked from now on.
    pub fn set_pathing(&mut self, pathing: Pathing) {
        self.pathing = pathing;
    }

    /// Begins an episode with these units. Units are numbered by type, x and y, ties by the game's tag; `tags` are what
    /// actions call them, by that number: the allies' (8 to 15), then the enemies' (0 to 7).
    ///
    /// # Errors
    /// When a unit is none of the set's, or a side has no unit or too many.
    pub fn begin(&mut self, units: &[RawUnit], tags: [&[usize]; 2]) -> Result<(), WrongUnits> {
        self.rows.clear();
        self.steps = 0;
        if let Some(other) = units.iter().find(|unit| !self.set.has(unit.kind)) {
            return Err(WrongUnits::Kind { kind: other.kind, set: self.set });
        }
        for (side, tags) in [Side::Ally, Side::Enemy].into_iter().zip(tags) {
            let first = self.rows.len();
            let of_side = units.iter().filter(|unit| unit.side == side);
            self.rows.extend(of_side.map(|&unit| Row { unit, tag: 0, alive: true }));
            let rows = &mut self.rows[first..];
            if !(1..=TEAM_MAX).contains(&rows.len()) || tags.len() < rows.len() {
                return Err(WrongUnits::Count { side, found: rows.len() });
            }
            let rank = |unit: &RawUnit| match side {
                Side::Ally => unit.kind.ally_rank() as u32,
                Side::Enemy => unit.kind.standard_id(),
            };
            rows.sort_by(|a, b| {
                let (a, b) = (&a.unit, &b.unit);
                let by_place = a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y));
                rank(a).cmp(&rank(b)).then(by_place).then(a.tag.cmp(&b.tag))
            });
            for (row, &tag) in rows.iter_mut().zip(tags) {
                row.tag = tag;
            }
            if side == Side::Ally {
                self.n_allies = self.rows.len();
            }
        }
        Ok(())
    }

    /// The game's tags of one side's units, by their number.
    pub fn unit_tags(&self, side: Side) -> impl Iterator<Item = u64> {
        self.rows.iter().filter(move |row| row.unit.side == side).map(|row| row.unit.tag)
    }

    /// All units as they were last seen, the allies by their number, then the enemies by theirs; and whether they live.
    pub fn units(&self) -> impl Iterator<Item = (&RawUnit, bool)> {
        self.rows.iter().map(|row| (&row.unit, row.alive))
    }

    /// Number of agents.
    pub fn n_agents(&self) -> usize {
        self.n_allies
    }

    /// Number of units.
    pub fn n_entities(&self) -> usize {
        self.rows.len()
    }

    /// Writes the state, as [`crate::Environment::observe`].
    pub fn observe(&self, observation: &mut Observation) {
        for (agent, ally) in self.rows[..self.n_allies].iter().enumerate() {
            self.write_available(ally, observation.available_mut(agent));
            let observable = observation.observable_mut(agent);
            for (entity, (seen, other)) in observable.iter_mut().zip(&self.rows).enumerate() {
                let sees = ally.alive && other.alive && ally.distance(other) <= SIGHT;
                *seen = u8::from(entity == agent || sees);
            }
        }
        let (middle, spread) = self.middle_and_spread();
        for (entity, row) in self.rows.iter().enumerate() {
            let mut available = [0; 6 + 2 * TEAM_MAX];
            let n_actions = self.set.n_actions();
            if entity < self.n_allies {
                available[..n_actions].copy_from_slice(observation.available_to(entity));
            }
            let features = observation.entity_mut(entity);
            self.write_features(row, &available[..n_actions], middle, spread, features);
        }
    }

    /// Mean place of all units, the dead where they fell, and the greatest distance from it.
    fn middle_and_spread(&self) -> ([f64; 2], f64) {
        let count = self.rows.len() as f64;
        let mean = |axis: usize| self.rows.iter().map(|row| row.place()[axis]).sum::<f64>() / count;
        let middle = [mean(0), mean(1)];
        let distance = |row: &Row| {
            let [x, y] = row.place();
            ((x - middle[0]) * (x - middle[0]) + (y - middle[1]) * (y - middle[1])).sqrt()
        };
        (middle, self.rows.iter().map(distance).fold(0.0, f64::max))
    }

    fn write_features(&self, row: &Row, available: &[u8], middle: [f64; 2], spread: f64, to: &mut [f32]) {
        let is_ally = row.unit.side == Side::Ally;
        to[row.tag] = 1.0;
        let actions = 2 * TEAM_MAX;
        let types = actions + available.len() - MOVES.start;
        let one_hot = self.set.one_hot();
        if let Some(at) = one_hot.iter().position(|&kind| kind == row.unit.kind) {
            to[types + at] = 1.0;
        }
        if !row.alive {
            return;
        }
        for (to, &available) in to[actions..types].iter_mut().zip(&available[MOVES.start..]) {
            *to = f32::from(available);
        }
        let unit = &row.unit;
        let share = |value: f32, most: f32| {
            if most > 0.0 { (f64::from(value) / f64::from(most)) as f32 } else { 0.0 }
        };
        let mut at = types + one_hot.len();
        let mut put = |value: f32| {
            to[at] = value;
            at += 1;
        };
        put(share(unit.health, unit.health_max));
        if self.set.has_shields() {
            put(share(unit.shield, unit.shield_max));
        }
        let cooldown = f64::from(unit.weapon_cooldown) / unit.kind.cooldown_scale();
        put(if is_ally { share(unit.energy, unit.energy_max) } else { 0.0 });
        put(if is_ally { cooldown as f32 } else { 0.0 });
        let [x, y] = row.place();
        put(((x - MAP / 2.0) / MAP) as f32);
        put(((y - MAP / 2.0) / MAP) as f32);
        // All units in one place are nowhere relative to it.
        let relative = |offset: f64| if spread > 0.0 { (offset / spread) as f32 } else { 0.0 };
        put(relative(x - middle[0]));
        put(relative(y - middle[1]));
    }

    fn write_available(&self, ally: &Row, to: &mut [u8]) {
        to.fill(0);
        if !ally.alive {
            to[usize::from(NO_OP)] = 1;
            return;
        }
        to[usize::from(STOP)] = 1;
        let [x, y] = ally.place();
        for (action, [dx, dy]) in MOVES.zip(DIRECTIONS) {
            to[action] = u8::from(self.pathing.is_walkable([x + MOVE_CHECK * dx, y + MOVE_CHECK * dy]));
        }
        let heals = ally.unit.kind == UnitType::Medivac;
        for other in self.rows.iter().filter(|other| other.alive) {
            let is_target = if heals {
                other.unit.side == Side::Ally && !other.unit.kind.flies()
            } else {
                other.unit.side == Side::Enemy
            };
            if is_target && ally.distance(other) <= SHOOT_RANGE {
                to[FIRST_TARGET + other.tag] = 1;
            }
        }
    }

    /// Where an action walks to, as a direction; nowhere for all that are no moves.
    pub fn direction(action: Action) -> [f32; 2] {
        let moves = usize::from(action).checked_sub(MOVES.start).and_then(|at| DIRECTIONS.get(at));
        moves.map_or([0.0; 2], |direction| direction.map(|part| part as f32))
    }

    /// What an agent's action asks of the game; nothing for the dead. The unit is named by its tag in the game.
    pub fn order(&self, agent: usize, action: Action) -> Option<(u64, UnitOrder)> {
        let ally = self.rows[..self.n_allies].get(agent).filter(|ally| ally.alive)?;
        let action = usize::from(action);
        let order = if action == usize::from(STOP) {
            UnitOrder::Stop
        } else if MOVES.contains(&action) {
            let ([x, y], [dx, dy]) = (ally.place(), DIRECTIONS[action - MOVES.start]);
            UnitOrder::Move([x + MOVE_ORDER * dx, y + MOVE_ORDER * dy])
        } else {
            let tag = action.checked_sub(FIRST_TARGET)?;
            let target = self.rows.iter().find(|row| row.tag == tag)?.unit.tag;
            let heals = ally.unit.kind == UnitType::Medivac;
            if heals { UnitOrder::Heal(target) } else { UnitOrder::Attack(target) }
        };
        Some((ally.unit.tag, order))
    }

    /// Takes the units after a step. A unit that is missing, or whose tag now has another side or type, is dead. Returns the
    /// reward, and whether the episode has ended.
    pub fn advance(&mut self, units: &[RawUnit]) -> Step {
        self.steps += 1;
        let mut earned = 0.0;
        for row in &mut self.rows {
            let who = |unit: &RawUnit| (unit.tag, unit.side, unit.kind);
            let now = units.iter().find(|unit| who(unit) == who(&row.unit)).filter(|unit| unit.health > 0.0);
            let vitality = |unit: &RawUnit| f64::from(unit.health) + f64::from(unit.shield);
            if row.alive && row.unit.side == Side::Enemy {
                let before = vitality(&row.unit);
                earned += now.map_or(before + KILL_REWARD, |now| before - vitality(now));
            }
            match now {
                Some(&now) if row.alive => row.unit = now,
                _ => {
                    row.alive = false;
                    row.unit = RawUnit { health: 0.0, shield: 0.0, ..row.unit };
                }
            }
        }
        let (over, won) = self.outcome();
        let reward = earned.abs() + if won { WIN_REWARD } else { 0.0 };
        let reward = (reward * REWARD_SCALE / self.max_reward) as f32;
        let end = if over {
            Some(End::Terminated)
        } else {
            (self.steps >= self.set.steps_max()).then_some(End::Truncated)
        };
        Step { reward, shaping: 0.0, end, won }
    }

    /// Whether the battle is over, and whether the allies have won it. A side of medivacs alone has lost.
    fn outcome(&self) -> (bool, bool) {
        let of = |side: Side| self.rows.iter().filter(move |row| row.alive && row.unit.side == side);
        let fights = |row: &Row| row.unit.kind != UnitType::Medivac;
        let lives = |side| of(side).next().is_some();
        let can_fight = |side| of(side).any(fights);
        let by_medivacs = self.set.has_medivacs();
        if (!lives(Side::Ally) && lives(Side::Enemy)) || (by_medivacs && !can_fight(Side::Ally)) {
            (true, false)
        } else if (lives(Side::Ally) && !lives(Side::Enemy)) || (by_medivacs && !can_fight(Side::Enemy)) {
            (true, true)
        } else {
            (!lives(Side::Ally) && !lives(Side::Enemy), false)
        }
    }
}
