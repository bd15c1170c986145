//! The simulator as a game: units with tags and owners that come, go, and take orders.

use super::maps::Armies;
use crate::{
    messages::{Alliance, DisplayType, Point, Unit},
    unit_types::{CustomTypes, standard_kind},
};
use rit_env::combat::{
    StatsVersion,
    spawn::{self, Group, place_group},
    world::{MAP_SIZE, Order, Point as Place, ScriptedMedivac, Side, World},
};
use rit_episode::{Rng, RunSeed, Stream};

/// Where the armies of SMAC's own maps stand: at the left and at the right.
const HOMES: [(Side, Place, Place); 2] =
    [(Side::Ally, [9.0, 16.0], [1.0, 0.0]), (Side::Enemy, [23.0, 16.0], [-1.0, 0.0])];

/// Loops after the death of the last unit until such a map brings all back.
const RETURN_AFTER: u32 = 2;

/// Most units that a world may have, the dead of the battle included.
pub const UNITS_MAX: usize = 512;

/// The game's tags: large and far apart.
const FIRST_TAG: u64 = (1 << 32) + 1;
const TAG_STEP: u64 = 1 << 18;

/// What a unit is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Told {
    /// Stand still.
    Stop,
    /// Walk to a place.
    Move(Place),
    /// Walk to where a unit is now.
    MoveTo(u64),
    /// Attack a unit.
    Attack(u64),
    /// Walk to a place and fight what comes near.
    AttackMove(Place),
    /// Heal a unit.
    Heal(u64),
}

/// A world with units of two players, who are 1 and 2.
#[derive(Debug)]
pub struct Arena {
    stats: StatsVersion,
    medivacs: ScriptedMedivac,
    seed: u64,
    armies: Option<Armies>,
    first_type: u32,
    custom: CustomTypes,
    world: World,
    /// By index in the world.
    tags: Vec<u64>,
    types: Vec<u32>,
    next_tag: u64,
    /// Units that come with the next loop.
    coming: Vec<(Group, u32)>,
    battles: u64,
    loops: u32,
    returns_at: Option<u32>,
}

/// The stream that attack delays of a game's battle are drawn from.
pub fn delays(seed: u64, battle: u64) -> Rng {
    RunSeed(seed).stream(Stream::Environment, battle)
}

impl Arena {
    /// An empty world, or one with the armies that the map brings along.
    pub fn new(
        stats: StatsVersion,
        medivacs: ScriptedMedivac,
        seed: u64,
        armies: Option<Armies>,
        first_type: u32,
    ) -> Self {
        let mut arena = Self {
            stats,
            medivacs,
            seed,
            armies,
            first_type,
            custom: CustomTypes::row(first_type),
            world: World::default(),
            tags: Vec::new(),
            types: Vec::new(),
            next_tag: FIRST_TAG,
            coming: Vec::new(),
            battles: 0,
            loops: 0,
            returns_at: None,
        };
        arena.begin_battle();
        arena.bring_armies();
        arena
    }

    /// Loops that have run.
    pub fn loops(&self) -> u32 {
        self.loops
    }

    /// Lets units come with the next loop; says whether there is such a type, and room.
    pub fn create(&mut self, owner: i32, number: u32, count: usize, at: Place) -> bool {
        let Some(side) = side(owner) else { return false };
        if self.custom.kind(number).is_none() && CustomTypes::row_at(self.first_type).contains(&number) {
            // Types of the map that the simulator does not know: none comes.
            return true;
        }
        let kind = self.custom.kind(number).or_else(|| standard_kind(number));
        let coming: usize = self.coming.iter().map(|(group, _)| group.count).sum();
        let room =
            self.world.len() + coming + count <= UNITS_MAX || self.living() + coming + count <= UNITS_MAX / 2;
        let inside = at.iter().all(|place| (0.0..=MAP_SIZE).contains(place));
        let Some(kind) = kind.filter(|_| room && inside && count > 0 && count <= UNITS_MAX) else {
            return false;
        };
        self.coming.push((Group { side, kind, count, at }, number));
        true
    }

    /// Kills a unit, if it lives.
    pub fn kill(&mut self, tag: u64) {
        if let Some(unit) = self.find(tag) {
            self.world.kill(unit);
        }
    }

    /// Whose a living unit is.
    pub fn owner(&self, tag: u64) -> Option<Side> {
        self.find(tag).map(|unit| self.world.side(unit))
    }

    /// Gives a living unit an order; says whether the game would take it.
    pub fn order(&mut self, tag: u64, told: Told) -> bool {
        let target = |tag: u64| self.find(tag);
        let order = match told {
            Told::Stop => Some(Order::Stop),
            Told::Move(to) => Some(Order::Move(to)),
            Told::MoveTo(tag) => target(tag).map(|unit| Order::Move(self.world.position(unit))),
            Told::Attack(tag) => target(tag).map(Order::Attack),
            Told::AttackMove(to) => Some(Order::AttackMove(to)),
            Told::Heal(tag) => target(tag).map(Order::Heal),
        };
        match (self.find(tag), order) {
            (Some(unit), Some(order)) => self.world.order(unit, order),
            _ => false,
        }
    }

    /// Runs so many loops.
    pub fn step(&mut self, loops: u32) {
        for _ in 0..loops {
            self.let_come();
            self.world.tick();
            self.loops += 1;
            if self.living() == 0 && self.coming.is_empty() {
                let due = *self.returns_at.get_or_insert(self.loops + RETURN_AFTER - 1);
                if self.armies.is_some() && self.loops >= due {
                    self.begin_battle();
                    self.bring_armies();
                }
            }
        }
    }

    /// The living units as the game shows them.
    pub fn units(&self) -> Vec<Unit> {
        (0..self.world.len()).filter(|&unit| self.world.is_alive(unit)).map(|unit| self.show(unit)).collect()
    }

    fn show(&self, unit: usize) -> Unit {
        let (world, stats) = (&self.world, self.world.stats(unit));
        let [x, y] = world.position(unit).map(|place| Some(place as f32));
        let (owner, alliance) = match world.side(unit) {
            Side::Ally => (1, Alliance::Self_),
            Side::Enemy => (2, Alliance::Enemy),
        };
        Unit {
            display_type: Some(DisplayType::Visible.into()),
            alliance: Some(alliance.into()),
            tag: Some(self.tags[unit]),
            unit_type: Some(self.types[unit]),
            owner: Some(owner),
            pos: Some(Point { x, y, z: Some(0.0) }),
            facing: Some(0.0),
            radius: Some(stats.radius as f32),
            build_progress: Some(1.0),
            health: Some(world.health(unit) as f32),
            health_max: Some(stats.health as f32),
            shield: Some(world.shield(unit) as f32),
            shield_max: Some(stats.shield as f32),
            energy: Some(world.energy(unit) as f32),
            energy_max: Some(stats.energy as f32),
            is_flying: Some(world.kind(unit).flies()),
            weapon_cooldown: Some(world.cooldown(unit) as f32),
        }
    }

    fn find(&self, tag: u64) -> Option<usize> {
        self.tags.iter().position(|&other| other == tag).filter(|&unit| self.world.is_alive(unit))
    }

    fn living(&self) -> usize {
        (0..self.world.len()).filter(|&unit| self.world.is_alive(unit)).count()
    }

    /// Forgets the dead.
    fn begin_battle(&mut self) {
        self.world.clear(self.stats, Some(delays(self.seed, self.battles)));
        self.world.set_scripted_medivacs(self.medivacs);
        self.battles += 1;
        self.tags.clear();
        self.types.clear();
        self.returns_at = None;
    }

    /// Places the groups that come, each army's first axis towards the other one's middle.
    fn let_come(&mut self) {
        if self.coming.is_empty() {
            return;
        }
        if self.living() == 0 {
            self.begin_battle();
        }
        let coming = std::mem::take(&mut self.coming);
        let middles = [Side::Ally, Side::Enemy].map(|side| self.middle(side, &coming));
        for (group, number) in coming {
            let axis = axis(middles[group.side as usize], middles[1 - group.side as usize]);
            self.place(group, axis, number);
        }
    }

    /// Where an army is: the mean of the points at which its groups come, or of its units.
    fn middle(&self, side: Side, coming: &[(Group, u32)]) -> Option<Place> {
        let of_side = coming.iter().filter(|(group, _)| group.side == side).map(|(group, _)| group.at);
        mean(of_side).or_else(|| {
            let of_side = (0..self.world.len())
                .filter(|&unit| self.world.is_alive(unit) && self.world.side(unit) == side);
            mean(of_side.map(|unit| self.world.position(unit)))
        })
    }

    fn place(&mut self, group: Group, axis: Place, number: u32) {
        let Group { side, kind, count, at } = group;
        place_group(&mut self.world, side, kind, count, at, axis);
        while self.tags.len() < self.world.len() {
            self.tags.push(self.next_tag);
            self.types.push(number);
            self.next_tag += TAG_STEP;
        }
    }

    /// The armies of the map, the enemies on their way to the allies.
    fn bring_armies(&mut self) {
        let Some(Armies { allies, enemies }) = self.armies else { return };
        for ((side, at, axis), army) in HOMES.into_iter().zip([allies, enemies]) {
            for (place, &(kind, count)) in army.iter().enumerate() {
                let number = match side {
                    // Such a map has the types of its allies alone, in a row by their names.
                    Side::Ally => self.first_type + place as u32,
                    Side::Enemy => kind.standard_id(),
                };
                self.place(Group { side, kind, count, at }, axis, number);
            }
        }
        spawn::send(&mut self.world, Side::Enemy);
    }
}

fn side(owner: i32) -> Option<Side> {
    match owner {
        1 => Some(Side::Ally),
        2 => Some(Side::Enemy),
        _ => None,
    }
}

fn mean(places: impl Iterator<Item = Place>) -> Option<Place> {
    let (mut sum, mut count) = ([0.0; 2], 0.0);
    for [x, y] in places {
        sum = [sum[0] + x, sum[1] + y];
        count += 1.0;
    }
    (count > 0.0).then(|| sum.map(|sum| sum / count))
}

/// The direction from one place to another; east where there is none.
fn axis(from: Option<Place>, to: Option<Place>) -> Place {
    const EAST: Place = [1.0, 0.0];
    let (Some(from), Some(to)) = (from, to) else { return EAST };
    let [x, y] = [to[0] - from[0], to[1] - from[1]];
    let length = (x * x + y * y).sqrt();
    if length > 0.0 { [x / length, y / length] } else { EAST }
}
