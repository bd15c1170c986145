//! One episode on a square of a canvas.

use super::{
    canvas::{Align, Canvas, Font, Point, Text},
    ink,
    recording::Recording,
    view::View,
};
use rit_env::{BodyKind, LinkKind, SceneBody, SceneUnit};

/// Steps after which a trail has faded.
const TRAIL: usize = 12;
/// Bodies let those below shine through.
const BODY: f32 = 0.88;
/// Smallest disc that is still seen under a number.
const ROOM_FOR_NUMBER: f32 = 6.5;
/// How much is still seen of a unit that is dead, right after it died; it fades over [`TRAIL`] steps.
const DEAD: f32 = 0.45;
/// Height of a bar of health or shield.
const VITALS: f32 = 3.0;
/// Share of its step that a bar of reward is wide.
const BAR: f32 = 0.7;

/// An episode and where it is drawn.
pub struct Plot<'a> {
    recording: &'a Recording,
    view: View,
}

impl<'a> Plot<'a> {
    /// In the square of this upper left corner and side.
    pub fn new(recording: &'a Recording, corner: Point, side: f32) -> Self {
        Self { recording, view: View::around(&recording.scenes, corner, side) }
    }

    /// The ground with its grid; with the scale beside it, if asked for.
    pub fn ground(&self, canvas: &mut dyn Canvas, scale: bool) {
        let View { corner: [left, top], side, .. } = self.view;
        let (right, bottom) = (left + side, top + side);
        canvas.rectangle([left, top], [side; 2], ink::GROUND);
        let ink = |line: f32| if line == 0.0 { ink::AXIS } else { ink::GRID };
        let number = |canvas: &mut dyn Canvas, at, align, line: f32| {
            let words = &line.to_string();
            canvas.text(Text { at, align, font: Font::Small, ink: ink::QUIET, rim: None, words });
        };
        for line in self.view.grid(0) {
            let [x, _] = self.view.point([line, 0.0]);
            canvas.line([x, top], [x, bottom], 1.0, ink(line));
            if scale {
                number(canvas, [x, bottom + 10.0], Align::Middle, line);
            }
        }
        for line in self.view.grid(1) {
            let [_, y] = self.view.point([0.0, line]);
            canvas.line([left, y], [right, y], 1.0, ink(line));
            if scale {
                number(canvas, [left - 5.0, y], Align::Right, line);
            }
        }
        let corners = [[left, top], [right, top], [right, bottom], [left, bottom]];
        for (at, &from) in corners.iter().enumerate() {
            canvas.line(from, corners[(at + 1) % corners.len()], 1.0, ink::FRAME);
        }
    }

    /// How things stand after a step: bodies, where they came from, and what the agents did.
    pub fn moment(&self, canvas: &mut dyn Canvas, step: usize) {
        for from in step.saturating_sub(TRAIL)..step {
            let age = (step - 1 - from) as f32 / TRAIL as f32;
            self.trail(canvas, from, 0.65 * (1.0 - age));
        }
        self.links(canvas, step);
        self.bodies(canvas, step);
        self.vitals(canvas, step);
        for (agent, body) in self.agents(step).filter(|(_, body)| is_alive(body)) {
            if let Some(push) = self.recording.push(agent, step) {
                self.action(canvas, body, push);
            }
        }
        self.numbers(canvas, step);
    }

    /// The whole course: where everything began, went, and ended.
    pub fn course(&self, canvas: &mut dyn Canvas) {
        let steps = self.recording.steps();
        for body in moving(&self.recording.scenes[0].bodies) {
            let radius = self.view.length(body.radius);
            canvas.ring(self.place(body), radius, 1.2, ink::body(body.kind).at(0.6));
        }
        for from in 0..steps {
            let opacity = 0.25 + 0.65 * (from + 1) as f32 / steps as f32;
            self.trail(canvas, from, opacity);
            for body in moving(&self.recording.scenes[from].bodies) {
                let radius = 0.9 * self.trail_width(body);
                canvas.disc(self.place(body), radius, ink::body(body.kind).at(opacity));
            }
        }
        self.bodies(canvas, steps);
        self.numbers(canvas, steps);
    }

    /// Where everything that moves went in the step after this scene.
    fn trail(&self, canvas: &mut dyn Canvas, from: usize, opacity: f32) {
        let scenes = &self.recording.scenes;
        for (body, next) in moving(&scenes[from].bodies).zip(moving(&scenes[from + 1].bodies)) {
            let ink = ink::body(body.kind).at(opacity);
            canvas.line(self.place(body), self.place(next), self.trail_width(body), ink);
        }
    }

    /// All bodies, the large ones below.
    fn bodies(&self, canvas: &mut dyn Canvas, step: usize) {
        let mut bodies: Vec<_> = self.recording.scenes[step].bodies.iter().collect();
        bodies.sort_by(|a, b| b.radius.total_cmp(&a.radius));
        for body in bodies {
            let (place, radius) = (self.place(body), self.view.length(body.radius));
            if !is_alive(body) {
                continue;
            }
            canvas.disc(place, radius, ink::body(body.kind).at(BODY));
            // Keeps bodies of one colour apart.
            canvas.ring(place, radius, 1.2, ink::WHITE.at(0.9));
        }
        for (index, body) in self.recording.scenes[step].bodies.iter().enumerate() {
            if is_alive(body) {
                continue;
            }
            let scenes = &self.recording.scenes[..=step];
            let died = scenes.iter().position(|scene| !is_alive(&scene.bodies[index])).unwrap_or(step);
            let age = (step - died) as f32 / TRAIL as f32;
            let ink = ink::body(body.kind).at(DEAD * (1.0 - age).max(0.25));
            let ([x, y], radius) = (self.place(body), self.view.length(body.radius));
            for aside in [-radius, radius] {
                canvas.line([x - radius, y - aside], [x + radius, y + aside], 1.6, ink);
            }
        }
    }

    /// Attacks and heals of the step before.
    fn links(&self, canvas: &mut dyn Canvas, step: usize) {
        let scene = &self.recording.scenes[step];
        for link in &scene.links {
            let (Some(from), Some(to)) = (scene.bodies.get(link.from), scene.bodies.get(link.to)) else {
                continue;
            };
            let (ink, width) = match link.kind {
                LinkKind::Attack => (ink::ATTACK.at(0.8), 1.4),
                LinkKind::Heal => (ink::HEALTH.at(0.9), 2.4),
            };
            canvas.line(self.place(from), self.place(to), width, ink);
        }
    }

    /// Bars of health and shield above each living unit.
    fn vitals(&self, canvas: &mut dyn Canvas, step: usize) {
        for body in &self.recording.scenes[step].bodies {
            let Some(SceneUnit { health, shield, .. }) = body.unit else { continue };
            if health <= 0.0 {
                continue;
            }
            let ([x, y], radius) = (self.place(body), self.view.length(body.radius));
            let width = (2.0 * radius).max(12.0);
            let mut top = y - radius - 2.0 - VITALS;
            for (share, ink) in [(Some(health), ink::HEALTH), (shield, ink::SHIELD)] {
                let Some(share) = share else { continue };
                let left = x - width / 2.0;
                canvas.rectangle([left, top], [width, VITALS], ink::LOST.at(0.35));
                canvas.rectangle([left, top], [width * share, VITALS], ink);
                top -= VITALS + 1.0;
            }
        }
    }

    /// An arrow where the action pushed the agent, a bar below it where it did not.
    fn action(&self, canvas: &mut dyn Canvas, body: &SceneBody, push: Point) {
        let ([x, y], radius) = (self.place(body), self.view.length(body.radius));
        let size = self.view.side / 60.0;
        if push == [0.0; 2] {
            let below = y + radius + 0.5 * size;
            canvas.line([x - 0.6 * size, below], [x + 0.6 * size, below], 2.0, ink::ACTION);
            return;
        }
        let (along, across) = ([push[0], -push[1]], [push[1], push[0]]);
        let point = |ahead: f32, aside: f32| {
            [x + ahead * along[0] + aside * across[0], y + ahead * along[1] + aside * across[1]]
        };
        let head = radius + size;
        canvas.line(point(radius + 1.0, 0.0), point(head, 0.0), 2.0, ink::ACTION);
        let corners = [point(head + size, 0.0), point(head, 0.6 * size), point(head, -0.6 * size)];
        canvas.triangle(corners, ink::ACTION);
    }

    /// Each agent's place in the decision order, and each unit's type: on it, or beside it where that would hide it.
    fn numbers(&self, canvas: &mut dyn Canvas, step: usize) {
        for (index, body) in self.recording.scenes[step].bodies.iter().enumerate() {
            let number = (body.kind == BodyKind::Agent).then(|| self.recording.place(index)).flatten();
            let number = number.map_or_else(String::new, |number| number.to_string());
            let letter = body.unit.map_or_else(String::new, |unit| unit.letter.to_string());
            if !is_alive(body) || (number.is_empty() && letter.is_empty()) {
                continue;
            }
            let ([x, y], radius) = (self.place(body), self.view.length(body.radius));
            let (at, ink, rim) = if radius >= ROOM_FOR_NUMBER {
                ([x, y], ink::WHITE, ink::ACTION)
            } else {
                ([x + radius + 5.0, y - radius - 5.0], ink::ACTION, ink::WHITE)
            };
            let words = &(number + &letter);
            canvas.text(Text { at, align: Align::Middle, font: Font::SmallBold, ink, rim: Some(rim), words });
        }
    }

    /// Agents come first in a scene, in the environment's order.
    fn agents(&self, step: usize) -> impl Iterator<Item = (usize, &SceneBody)> {
        let bodies = self.recording.scenes[step].bodies.iter().enumerate();
        bodies.filter(|(_, body)| body.kind == BodyKind::Agent)
    }

    fn place(&self, body: &SceneBody) -> Point {
        self.view.point([body.x, body.y])
    }

    fn trail_width(&self, body: &SceneBody) -> f32 {
        (0.15 * self.view.length(body.radius)).clamp(1.5, 3.0)
    }
}

/// The reward of each step up to this one as a bar, upwards from zero or downwards, in a box of this upper left
/// corner and size. The largest of the episode fills the box.
pub fn rewards(
    canvas: &mut dyn Canvas,
    recording: &Recording,
    [left, top]: Point,
    size: Point,
    until: usize,
) {
    let rewards = &recording.episode.rewards;
    let highest = rewards.iter().copied().fold(0.0, f32::max);
    let lowest = rewards.iter().copied().fold(0.0, f32::min);
    let scale = if highest > lowest { size[1] / (highest - lowest) } else { 0.0 };
    let (zero, pitch) = (top + highest * scale, size[0] / rewards.len().max(1) as f32);
    for (step, &reward) in rewards[..until].iter().enumerate() {
        let x = left + (step as f32 + (1.0 - BAR) / 2.0) * pitch;
        let height = reward.abs() * scale;
        canvas.rectangle(
            [x, if reward > 0.0 { zero - height } else { zero }],
            [BAR * pitch, height],
            ink::REWARD,
        );
    }
    canvas.line([left, zero], [left + size[0], zero], 1.0, ink::FRAME);
}

/// Whether a body takes part: only units die.
fn is_alive(body: &SceneBody) -> bool {
    body.unit.is_none_or(|unit| unit.health > 0.0)
}

fn moving(bodies: &[SceneBody]) -> impl Iterator<Item = &SceneBody> {
    bodies.iter().filter(|body| body.kind != BodyKind::Landmark)
}
