//! Where a battle begins: two armies on opposite sides of the map's centre.

use super::{
    CombatSet, Team, UnitType,
    unit::Layer,
    world::{MAP_SIZE, Order, Point, Side, World},
};
use rand::RngExt as _;
use rit_episode::Rng;
use std::{f64::consts::PI, sync::LazyLock};

/// From the map's centre to an army's.
const ARMY_DISTANCE: f64 = 7.0;
/// Each group's point lies within ± this of its army's centre, in x and in y.
const JITTER: f64 = 1.0;
/// Room between the bodies of a group.
const GAP: f64 = 0.05;
/// Rings of the lattice on which a group is placed: more than the largest group needs beside two others.
const RINGS: i32 = 7;

/// Places of a hexagonal lattice of pitch 1, its first axis along x: the nearest first, ties counter-clockwise from
/// that axis. By libm: the same on every machine.
static LATTICE: LazyLock<Vec<Point>> = LazyLock::new(|| {
    let mut places = Vec::new();
    for i in -RINGS..=RINGS {
        for j in -RINGS..=RINGS {
            // Squared distance from the middle, exactly.
            let squared = i * i + i * j + j * j;
            let place = [f64::from(i) + f64::from(j) / 2.0, f64::from(j) * libm::sqrt(3.0) / 2.0];
            let angle = libm::atan2(place[1], place[0]);
            places.push((squared, if angle < -1e-9 { angle + 2.0 * PI } else { angle }, place));
        }
    }
    // Beyond the outermost whole ring, corners stick out.
    places.retain(|(squared, ..)| *squared <= RINGS * RINGS * 3 / 4);
    places.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    places.into_iter().map(|(_, _, place)| place).collect()
});

/// Units of one type that come together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Group {
    /// Whose they are.
    pub side: Side,
    /// Their type.
    pub kind: UnitType,
    /// How many.
    pub count: usize,
    /// Where.
    pub at: Point,
}

/// Where the groups of both armies come, the allies' first.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    /// The groups.
    pub groups: Vec<Group>,
    /// The direction from the enemies' army to the allies'.
    facing: Point,
}

impl Layout {
    /// Draws the angle (where the map is rotated), then the jitter of each ally group and of each enemy group.
    pub fn draw(set: CombatSet, [allies, enemies]: [Team; 2], rotate: bool, rng: &mut Rng) -> Self {
        let facing = if rotate {
            let angle = rng.random_range(0.0..2.0 * PI);
            [libm::cos(angle), libm::sin(angle)]
        } else {
            // Allies at the left.
            [-1.0, 0.0]
        };
        let mut groups = Vec::new();
        for (side, team, towards) in [(Side::Ally, allies, 1.0), (Side::Enemy, enemies, -1.0)] {
            let middle = facing.map(|part| MAP_SIZE / 2.0 + ARMY_DISTANCE * towards * part);
            for kind in set.types() {
                let count = team.count(kind);
                if count == 0 {
                    continue;
                }
                let jitter = [rng.random_range(-JITTER..JITTER), rng.random_range(-JITTER..JITTER)];
                groups.push(Group { side, kind, count, at: [middle[0] + jitter[0], middle[1] + jitter[1]] });
            }
        }
        Self { groups, facing }
    }
}

/// Fills a cleared world with both armies and sends the enemies to the allies' middle. Draws as [`Layout::draw`] does.
pub fn spawn(world: &mut World, set: CombatSet, teams: [Team; 2], rotate: bool, rng: &mut Rng) {
    let Layout { groups, facing: [x, y] } = Layout::draw(set, teams, rotate, rng);
    for Group { side, kind, count, at } in groups {
        let axis = match side {
            Side::Ally => [-x, -y],
            Side::Enemy => [x, y],
        };
        place_group(world, side, kind, count, at, axis);
    }
    send(world, Side::Enemy);
}

/// Places a group of units round a point, the lattice's first axis along `axis`.
pub fn place_group(world: &mut World, side: Side, kind: UnitType, count: usize, at: Point, axis: Point) {
    let stats = kind.stats(world.stats_version());
    let pitch = 2.0 * stats.separation + GAP;
    let margin = if stats.layer == Layer::Air { 0.0 } else { stats.separation };
    let mut placed = 0;
    for [x, y] in &*LATTICE {
        if placed == count {
            return;
        }
        let place =
            [at[0] + pitch * (x * axis[0] - y * axis[1]), at[1] + pitch * (x * axis[1] + y * axis[0])];
        let inside = place.iter().all(|place| (margin..=MAP_SIZE - margin).contains(place));
        let free = (0..world.len()).all(|other| {
            let [dx, dy] = [0, 1].map(|axis| world.position(other)[axis] - place[axis]);
            let touch = stats.separation + world.stats(other).separation;
            world.stats(other).layer != stats.layer || dx * dx + dy * dy >= touch * touch
        });
        if inside && free {
            world.add(side, kind, place);
            placed += 1;
        }
    }
    // Eight units a side fit wherever an army can stand; a group of a scenario may be larger.
    for _ in placed..count {
        world.add(side, kind, at);
    }
}

/// Every unit of a side walks to the middle of the other and fights what it meets.
pub fn send(world: &mut World, side: Side) {
    let others = (0..world.len()).filter(|&unit| world.side(unit) != side);
    let (mut sum, mut count) = ([0.0; 2], 0.0);
    for other in others {
        let [x, y] = world.position(other);
        sum = [sum[0] + x, sum[1] + y];
        count += 1.0;
    }
    let middle = sum.map(|sum| sum / f64::max(count, 1.0));
    for unit in 0..world.len() {
        if world.side(unit) == side {
            world.order(unit, Order::AttackMove(middle));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::combat::StatsVersion;
    use rit_episode::{RunSeed, Stream};

    fn spawned(set: CombatSet, team: Team, rotate: bool, number: u64) -> World {
        let mut world = World::default();
        world.clear(StatsVersion::Liberty, None);
        spawn(&mut world, set, [team; 2], rotate, &mut RunSeed(4).stream(Stream::Environment, number));
        world
    }

    #[test]
    fn the_lattice_begins_in_the_middle_and_goes_round() {
        let half = libm::sqrt(3.0) / 2.0;
        let first =
            [[0.0, 0.0], [1.0, 0.0], [0.5, half], [-0.5, half], [-1.0, 0.0], [-0.5, -half], [0.5, -half]];
        for (place, expected) in LATTICE.iter().zip(first) {
            assert!((place[0] - expected[0]).abs() < 1e-12 && (place[1] - expected[1]).abs() < 1e-12);
        }
        assert!(LATTICE.len() > 60);
    }

    #[test]
    fn armies_stand_apart_and_no_unit_stands_on_another() {
        for set in CombatSet::ALL {
            for (number, team) in set.teams().into_iter().enumerate() {
                let world = spawned(set, team, true, number as u64);
                assert_eq!(world.len(), 2 * team.len());
                for a in 0..world.len() {
                    let [x, y] = world.position(a);
                    for b in a + 1..world.len() {
                        let [dx, dy] = [world.position(b)[0] - x, world.position(b)[1] - y];
                        let touch = world.stats(a).separation + world.stats(b).separation;
                        let apart = (dx * dx + dy * dy).sqrt();
                        assert!(
                            apart >= touch - 1e-9 || world.stats(a).layer != world.stats(b).layer,
                            "{team}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn an_unrotated_army_of_allies_stands_at_the_left() {
        let team = Team::parse("3s", CombatSet::StalkersZealots).unwrap();
        for number in 0..20 {
            let world = spawned(CombatSet::StalkersZealots, team, false, number);
            let [x, y] = world.position(0);
            assert!((8.0..=10.0).contains(&x) && (15.0..=17.0).contains(&y), "{x} {y}");
            assert!(world.position(3)[0] >= 22.0);
        }
    }
}
