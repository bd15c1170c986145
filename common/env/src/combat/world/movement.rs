//! Movement: where units want to go, round the bodies that stand in their way, and bodies that push each other.

use super::{EPSILON, Layer, MAP_SIZE, Order, Point, World, distance};
use crate::combat::unit::TICKS_PER_SECOND;
use std::sync::LazyLock;

/// A unit looks this much farther along its way than the two bodies are thick.
const LOOK_AHEAD: f64 = 0.25;
/// How often a unit turns in one tick before it waits.
const TURNS_MAX: usize = 8;
/// Rounds of pushing in a tick.
const PUSHES: usize = 4;
/// Directions in which bodies with one centre are pushed apart.
const DIRECTIONS: usize = 16;
/// A way along a body's tangent is free.
const TANGENT: f64 = 1e-9;

/// Sixteen directions, evenly round. By libm: the same on every machine.
static COMPASS: LazyLock<[Point; DIRECTIONS]> = LazyLock::new(|| {
    std::array::from_fn(|at| {
        let angle = std::f64::consts::TAU * at as f64 / DIRECTIONS as f64;
        [libm::cos(angle), libm::sin(angle)]
    })
});

/// Where a unit wants to go in this tick.
#[derive(Clone, Copy, Debug)]
struct Intent {
    goal: Point,
    /// Not farther than this towards it.
    distance_max: f64,
    /// Not faster than this, per second.
    speed_max: f64,
}

impl World {
    /// Moves all units from their positions at the tick's start, then pushes overlapping bodies apart, then keeps all of them
    /// on the map.
    pub(super) fn move_units(&mut self) {
        let count = self.len();
        self.moving.clear();
        self.moving.resize(count, false);
        self.goals.clear();
        self.goals.extend_from_slice(&self.positions);
        // Distances to be gone, in the same place as the goals they are gone towards.
        self.steps.clear();
        self.steps.resize(count, 0.0);
        for unit in 0..count {
            let Some(intent) = self.intent(unit) else {
                self.speeds[unit] = 0.0;
                continue;
            };
            let acceleration = self.stats[unit].acceleration / TICKS_PER_SECOND;
            self.speeds[unit] = intent.speed_max.min(self.speeds[unit] + acceleration);
            self.moving[unit] = true;
            self.goals[unit] = intent.goal;
            self.steps[unit] = (self.speeds[unit] / TICKS_PER_SECOND).min(intent.distance_max);
        }
        if self.moving.contains(&true) {
            for unit in 0..count {
                // Positions stay those of the tick's start until every way is known.
                self.goals[unit] = if self.moving[unit] { self.way(unit) } else { self.positions[unit] };
            }
            std::mem::swap(&mut self.positions, &mut self.goals);
        }
        self.push_bodies();
        self.keep_inside();
    }

    fn intent(&self, unit: usize) -> Option<Intent> {
        if !self.alive[unit] || self.is_busy(unit) || self.wind_ups[unit].is_some() {
            return None;
        }
        let speed_max = self.stats[unit].speed;
        let to_point = |goal: Point, speed_max: f64| {
            let distance_max = distance(self.positions[unit], goal);
            (distance_max > 0.0).then_some(Intent { goal, distance_max, speed_max })
        };
        match (self.orders[unit], self.target(unit)) {
            (_, Some(target)) => {
                let distance_max = self.edge(unit, target) - self.reach(unit);
                let goal = self.positions[target];
                (distance_max > EPSILON).then_some(Intent { goal, distance_max, speed_max })
            }
            (Order::Move(point), None) => to_point(point, speed_max),
            (Order::AttackMove(point), None) => {
                let point = self.scripted_goal(unit, point)?;
                // Only medivacs wait for others.
                let speed_max =
                    if self.stats[unit].weapon.is_none() { self.escort_speed(unit) } else { speed_max };
                to_point(point, speed_max)
            }
            (Order::Stop | Order::Attack(_) | Order::Heal(_), None) => None,
        }
    }

    /// Where a unit gets to that goes so far towards its goal, round what stands in its way. It passes all bodies on
    /// the side on which it passes the first, and remembers that side until its way is free.
    fn way(&mut self, unit: usize) -> Point {
        let step = self.steps[unit];
        let (from, goal) = (self.positions[unit], self.goals[unit]);
        let length = distance(from, goal);
        let mut direction = [(goal[0] - from[0]) / length, (goal[1] - from[1]) / length];
        for turn in 0..=TURNS_MAX {
            let Some(body) = self.body_in_the_way(unit, direction) else {
                if turn == 0 {
                    self.detours[unit] = None;
                }
                return [from[0] + step * direction[0], from[1] + step * direction[1]];
            };
            if turn == TURNS_MAX {
                break;
            }
            let at = self.positions[body];
            let far = distance(from, at);
            if far <= 0.0 {
                break;
            }
            let towards = [(at[0] - from[0]) / far, (at[1] - from[1]) / far];
            // Positive where the body lies to the left of the way.
            let left = direction[0] * towards[1] - direction[1] * towards[0];
            // +1: it passes on the body's left, -1: on its right.
            let side = *self.detours[unit].get_or_insert(if left > TANGENT {
                -1.0
            } else if left < -TANGENT || unit.is_multiple_of(2) {
                1.0
            } else {
                -1.0
            });
            let sine = ((self.separations[unit] + self.separations[body]) / far).min(1.0);
            let cosine = (1.0 - sine * sine).sqrt();
            direction = [
                towards[0] * cosine - side * towards[1] * sine,
                towards[1] * cosine + side * towards[0] * sine,
            ];
        }
        // Barred on all sides: it waits.
        from
    }

    /// The nearest standing body of the unit's layer, other than its target, that it would run into.
    fn body_in_the_way(&self, unit: usize, direction: Point) -> Option<usize> {
        let (from, target) = (self.positions[unit], self.target(unit));
        let mut nearest: Option<(f64, usize)> = None;
        for other in 0..self.len() {
            if self.moving[other]
                || !self.alive[other]
                || other == unit
                || Some(other) == target
                || !self.share_a_layer(unit, other)
            {
                continue;
            }
            let to = [self.positions[other][0] - from[0], self.positions[other][1] - from[1]];
            let touch = self.separations[unit] + self.separations[other];
            let ahead = to[0] * direction[0] + to[1] * direction[1];
            let aside = to[0] * direction[1] - to[1] * direction[0];
            if ahead <= 0.0 || aside.abs() >= touch - TANGENT {
                continue;
            }
            // How far the unit gets before the bodies touch.
            let free = ahead - (touch * touch - aside * aside).sqrt();
            let squared = to[0] * to[0] + to[1] * to[1];
            if free <= touch + LOOK_AHEAD && nearest.is_none_or(|(least, _)| squared < least) {
                nearest = Some((squared, other));
            }
        }
        nearest.map(|(_, other)| other)
    }

    fn push_bodies(&mut self) {
        if !self.crowded && !self.moving.contains(&true) {
            return;
        }
        for _ in 0..PUSHES {
            let mut pushed = false;
            for a in 0..self.len() {
                if !self.alive[a] {
                    continue;
                }
                for b in a + 1..self.len() {
                    if self.alive[b] && self.share_a_layer(a, b) {
                        pushed |= self.push_apart(a, b);
                    }
                }
            }
            self.crowded = pushed;
            if !pushed {
                return;
            }
        }
    }

    /// Pushes two overlapping bodies apart; returns whether they overlapped.
    fn push_apart(&mut self, a: usize, b: usize) -> bool {
        let touch = self.separations[a] + self.separations[b];
        let ([ax, ay], [bx, by]) = (self.positions[a], self.positions[b]);
        let (x, y) = (bx - ax, by - ay);
        let squared = x * x + y * y;
        if squared >= touch * touch {
            return false;
        }
        let apart = squared.sqrt();
        let overlap = touch - apart;
        let [x, y] =
            if apart > 0.0 { [x / apart, y / apart] } else { COMPASS[(7 * a + 13 * b) % DIRECTIONS] };
        let share_a = match (self.moving[a], self.moving[b]) {
            (true, false) => 1.0,
            (false, true) => 0.0,
            (true, true) | (false, false) => 0.5,
        };
        let (of_a, of_b) = (overlap * share_a, overlap * (1.0 - share_a));
        self.positions[a] = [ax - x * of_a, ay - y * of_a];
        self.positions[b] = [bx + x * of_b, by + y * of_b];
        overlap > 0.0
    }

    fn keep_inside(&mut self) {
        for (position, stats) in self.positions.iter_mut().zip(&self.stats) {
            let margin = if stats.layer == Layer::Air { 0.0 } else { stats.separation };
            for place in position {
                *place = place.clamp(margin, MAP_SIZE - margin);
            }
        }
    }
}
