//! The scripted opponent: units under an attack-move order fight what comes near their way.

use super::{Order, Point, ScriptedMedivac, World, distance};
use crate::combat::unit::{HEALING_ENERGY_MIN, HEALING_SCAN_RANGE, UnitType};

/// How near an opponent must come to be noticed, from edge to edge, where the weapon does not reach farther.
const NOTICE_RANGE: f64 = 5.0;

impl World {
    /// Chooses whom scripted units go for.
    pub(super) fn aim_scripted_units(&mut self) {
        for unit in 0..self.len() {
            if !self.alive[unit] || !matches!(self.orders[unit], Order::AttackMove(_)) {
                continue;
            }
            if self.kinds[unit] == UnitType::Medivac {
                self.aims[unit] = self.patient(unit);
            } else if self.wind_ups[unit].is_none() && !self.is_busy(unit) {
                self.aim(unit);
            }
        }
    }

    fn aim(&mut self, unit: usize) {
        let living = self.aims[unit].filter(|&target| self.alive[target]);
        if living.is_some_and(|target| self.is_in_reach(unit, target)) {
            return;
        }
        let nearest = self.nearest_opponent(unit);
        // A unit that hit it from farther away stays its target until another comes near or it is out of sight.
        let avenged = living.filter(|&target| {
            nearest.is_none() && self.avenging[unit] && self.edge(unit, target) <= self.stats[unit].sight
        });
        self.avenging[unit] = avenged.is_some();
        self.aims[unit] = nearest.or(avenged);
    }

    fn nearest_opponent(&self, unit: usize) -> Option<usize> {
        let notice = self.reach(unit).max(NOTICE_RANGE) + super::EPSILON;
        let mut nearest: Option<(f64, usize)> = None;
        for other in 0..self.len() {
            if !self.alive[other] || self.sides[other] == self.sides[unit] || !self.can_hit(unit, other) {
                continue;
            }
            let edge = self.edge(unit, other);
            if edge <= notice && nearest.is_none_or(|(least, _)| edge < least) {
                nearest = Some((edge, other));
            }
        }
        nearest.map(|(_, other)| other)
    }

    /// A scripted unit without a target goes for the unit that hits it.
    pub(super) fn notice_attacker(&mut self, unit: usize, attacker: usize) {
        let idle = matches!(self.orders[unit], Order::AttackMove(_)) && self.aims[unit].is_none();
        if idle && self.alive[attacker] && self.can_hit(unit, attacker) {
            self.aims[unit] = Some(attacker);
            self.avenging[unit] = true;
        }
    }

    /// Whom a scripted medivac heals: its patient until that is well, dead or out of range; then the friend with the
    /// lowest share of health, then the nearest, then the lowest index.
    fn patient(&self, unit: usize) -> Option<usize> {
        let is_near = |&other: &usize| {
            self.can_be_healed(unit, other) && self.edge(unit, other) <= HEALING_SCAN_RANGE + super::EPSILON
        };
        if let Some(patient) = self.aims[unit].filter(is_near) {
            return Some(patient);
        }
        if self.energy[unit] < HEALING_ENERGY_MIN {
            return None;
        }
        let need = |&other: &usize| {
            let share = self.health[other] / self.stats[other].health;
            (share, distance(self.positions[unit], self.positions[other]))
        };
        let order = |a: &usize, b: &usize| {
            let ((share_a, far_a), (share_b, far_b)) = (need(a), need(b));
            share_a.total_cmp(&share_b).then(far_a.total_cmp(&far_b))
        };
        // The first of equals is the lowest index.
        (0..self.len()).filter(is_near).min_by(order)
    }

    /// Where a scripted unit without a target goes.
    pub(super) fn scripted_goal(&self, unit: usize, point: Point) -> Option<Point> {
        let stays = self.kinds[unit] == UnitType::Medivac && self.scripted_medivac == ScriptedMedivac::Stay;
        (!stays).then_some(point)
    }

    /// How fast a scripted medivac goes to its point: no faster than the slowest of the others.
    pub(super) fn escort_speed(&self, unit: usize) -> f64 {
        let others = (0..self.len())
            .filter(|&other| other != unit && self.alive[other] && self.sides[other] == self.sides[unit]);
        others.fold(self.stats[unit].speed, |slowest, other| slowest.min(self.stats[other].speed))
    }

    /// Whether two units push each other.
    pub(super) fn share_a_layer(&self, a: usize, b: usize) -> bool {
        self.layers[a] == self.layers[b]
    }
}
