//! Weapons: wind-up, release, what flies, and what a hit does.

use super::{EPSILON, Layer, Order, WindUp, World, distance};
use crate::LinkKind;
use crate::combat::unit::{Delivery, Stats, TICKS_PER_SECOND, Weapon, ticks};
use rand::RngExt as _;

/// Seconds by which an attack may come earlier or later than its weapon's period: uniform between these.
const DELAY: [f64; 2] = [-0.0625, 0.125];
/// Half the length of a colossus's line, and the points it burns on either side of the middle one.
const LINE_HALF: f64 = 1.25;
const LINE_POINTS: i32 = 5;
/// How near to such a point a disc must come to be burnt.
const LINE_REACH: f64 = 0.15;
/// Hits that a line deals to everyone it burns.
const LINE_HITS: usize = 2;

/// Something that happens to a unit at a later tick.
#[derive(Clone, Copy, Debug)]
pub(super) struct Effect {
    due: i64,
    from: usize,
    target: usize,
    what: EffectKind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum EffectKind {
    /// Lands whether its shooter lives or not.
    Missile,
    /// A second blow, if the attacker lives.
    Blow,
    /// A line, if the attacker lives.
    Line,
}

/// An attack that leaves in this tick.
#[derive(Clone, Copy, Debug)]
pub(super) struct Release {
    from: usize,
    target: usize,
}

impl World {
    pub(super) fn land_effects(&mut self) {
        if self.effects.is_empty() {
            return;
        }
        // Oldest first: effects lie in the order in which they were released.
        let mut kept = 0;
        for at in 0..self.effects.len() {
            let effect = self.effects[at];
            if effect.due > self.now {
                self.effects[kept] = effect;
                kept += 1;
                continue;
            }
            let attacker_lives = self.alive[effect.from];
            match effect.what {
                EffectKind::Missile => self.hit(effect.from, effect.target),
                EffectKind::Blow if attacker_lives => self.hit(effect.from, effect.target),
                EffectKind::Line if attacker_lives => self.burn_line(effect.from, effect.target),
                EffectKind::Blow | EffectKind::Line => {}
            }
        }
        self.effects.truncate(kept);
        self.bury_the_dead();
    }

    /// Wind-ups that end and attacks that begin; all that is released then lands together.
    pub(super) fn use_weapons(&mut self) {
        let mut releases = std::mem::take(&mut self.releases);
        releases.clear();
        for unit in 0..self.len() {
            let Some(weapon) = self.stats[unit].weapon.filter(|_| self.alive[unit]) else { continue };
            if let Some(WindUp { ends_at, target }) = self.wind_ups[unit] {
                if ends_at > self.now {
                    continue;
                }
                self.wind_ups[unit] = None;
                let reach = weapon.range + weapon.slop + EPSILON;
                if self.alive[target] && self.edge(unit, target) <= reach {
                    releases.push(Release { from: unit, target });
                } else {
                    self.ready[unit] = self.now;
                }
            } else if !self.is_busy(unit) && self.now >= self.ready[unit] {
                let may_attack = |&target: &usize| {
                    self.alive[target] && self.can_hit(unit, target) && self.is_in_reach(unit, target)
                };
                let attacks = matches!(self.orders[unit], Order::Attack(_) | Order::AttackMove(_));
                let Some(target) = self.target(unit).filter(|_| attacks).filter(may_attack) else { continue };
                let delay = self.delays.as_mut().map_or(0.0, |rng| rng.random_range(DELAY[0]..DELAY[1]));
                self.ready[unit] = self.now + ticks(weapon.period + delay);
                let winding = ticks(weapon.damage_point);
                if winding == 0 {
                    releases.push(Release { from: unit, target });
                } else {
                    self.wind_ups[unit] = Some(WindUp { ends_at: self.now + winding, target });
                }
            }
        }
        for &release in &releases {
            self.release(release);
        }
        if !releases.is_empty() {
            self.bury_the_dead();
        }
        self.releases = releases;
    }

    fn release(&mut self, Release { from, target }: Release) {
        let Some(Weapon { delivery, .. }) = self.stats[from].weapon else { return };
        self.link(from, target, LinkKind::Attack);
        let later = |due, what| Effect { due, from, target, what };
        match delivery {
            Delivery::Instant => self.hit(from, target),
            Delivery::Missile(speed) => {
                let flight = ticks(self.edge(from, target) / speed);
                if flight <= 0 {
                    self.hit(from, target);
                } else {
                    self.effects.push(later(self.now + flight, EffectKind::Missile));
                }
            }
            Delivery::TwoBlows(after) => {
                self.hit(from, target);
                self.busy_until[from] = self.now + ticks(after);
                self.effects.push(later(self.busy_until[from], EffectKind::Blow));
            }
            Delivery::Line(after) => {
                self.busy_until[from] = self.now + ticks(after);
                self.effects.push(later(self.busy_until[from], EffectKind::Line));
            }
        }
    }

    /// One hit: shield first, then armour, then health. What is dead takes none; what is beyond is lost.
    fn hit(&mut self, from: usize, target: usize) {
        let Some(weapon) = self.stats[from].weapon else { return };
        if !self.alive[target] || self.health[target] <= 0.0 {
            return;
        }
        let Stats { attribute, armour, .. } = self.stats[target];
        let bonus = weapon.bonus.filter(|(against, _)| *against == attribute).map_or(0.0, |(_, more)| more);
        let damage = weapon.damage + bonus;
        let on_shield = damage.min(self.shield[target]);
        let through = damage - on_shield;
        let on_health =
            if through > 0.0 { (through - armour).max(0.0).min(self.health[target]) } else { 0.0 };
        self.shield[target] -= on_shield;
        self.health[target] -= on_health;
        self.lost[self.sides[target] as usize] += on_shield + on_health;
        self.last_hit[target] = self.now;
        self.notice_attacker(target, from);
    }

    /// The line of a colossus, across its target. No friend is burnt, and no flyer.
    fn burn_line(&mut self, from: usize, target: usize) {
        let (middle, colossus) = (self.positions[target], self.positions[from]);
        let length = distance(colossus, middle);
        let [across_x, across_y] = if length > 0.0 {
            [-(middle[1] - colossus[1]) / length, (middle[0] - colossus[0]) / length]
        } else {
            [1.0, 0.0]
        };
        for unit in 0..self.len() {
            if !self.alive[unit] || self.sides[unit] == self.sides[from] {
                continue;
            }
            let is_touched = || {
                (-LINE_POINTS..=LINE_POINTS).any(|point| {
                    let along = f64::from(point) * LINE_HALF / f64::from(LINE_POINTS);
                    let place = [middle[0] + along * across_x, middle[1] + along * across_y];
                    distance(place, self.positions[unit]) <= LINE_REACH + self.stats[unit].radius
                })
            };
            if unit == target || (self.stats[unit].layer != Layer::Air && is_touched()) {
                for _ in 0..LINE_HITS {
                    self.hit(from, unit);
                }
            }
        }
    }
}

const _: () = assert!(TICKS_PER_SECOND == 16.0);
