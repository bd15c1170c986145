//! Which part of the world a plot shows, and where in the picture that is.

use super::canvas::Point;
use rit_env::Scene;

/// Every plot shows at least ± this: the square in which episodes begin, and some room around it.
const AT_LEAST: f32 = 1.2;
/// Room around the bodies, for what is drawn beside them.
const MARGIN: f32 = 0.1;
/// Distances of grid lines that read well.
const GRID: [f32; 5] = [0.5, 1.0, 2.0, 5.0, 10.0];
/// More grid lines than this are too many.
const GRID_LINES: f32 = 8.0;

/// A square of the world in a square of the picture. Both axes have one scale; y grows upwards in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Middle of what is shown of the world.
    pub centre: Point,
    /// Half of its side.
    pub half: f32,
    /// Upper left corner in the picture.
    pub corner: Point,
    /// Side in the picture.
    pub side: f32,
}

impl View {
    /// Shows all that ever happens, since the world has no walls.
    pub fn around(scenes: &[Scene], corner: Point, side: f32) -> Self {
        // Battles lie anywhere on their map; only what happens is shown of it.
        let fights = scenes.iter().flat_map(|scene| &scene.bodies).any(|body| body.unit.is_some());
        let at_least = if fights { f32::NEG_INFINITY } else { AT_LEAST };
        let (mut low, mut high) = ([-at_least; 2], [at_least; 2]);
        for body in scenes.iter().flat_map(|scene| &scene.bodies) {
            let reach = body.radius + MARGIN;
            for (axis, place) in [body.x, body.y].into_iter().enumerate() {
                low[axis] = low[axis].min(place - reach);
                high[axis] = high[axis].max(place + reach);
            }
        }
        Self {
            centre: [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0],
            half: (high[0] - low[0]).max(high[1] - low[1]) / 2.0,
            corner,
            side,
        }
    }

    /// Where a place of the world is in the picture.
    pub fn point(&self, [x, y]: Point) -> Point {
        let middle = self.side / 2.0;
        let [right, up] = [x - self.centre[0], y - self.centre[1]].map(|length| self.length(length));
        [self.corner[0] + middle + right, self.corner[1] + middle - up]
    }

    /// How long a length of the world is in the picture.
    pub fn length(&self, length: f32) -> f32 {
        length * self.side / (2.0 * self.half)
    }

    /// Places in the world of the grid lines along one axis.
    pub fn grid(&self, axis: usize) -> Vec<f32> {
        let fits = |distance: &&f32| 2.0 * self.half / **distance <= GRID_LINES;
        let distance = *GRID.iter().find(fits).unwrap_or(&GRID[GRID.len() - 1]);
        let first = ((self.centre[axis] - self.half) / distance).ceil() as i32;
        let last = ((self.centre[axis] + self.half) / distance).floor() as i32;
        (first..=last).map(|line| line as f32 * distance).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::recording::tests::film;

    fn around(speed: f32) -> View {
        View::around(&film(speed).episodes[0].scenes, [10.0, 20.0], 100.0)
    }

    #[test]
    fn a_view_is_never_smaller_than_where_episodes_begin() {
        let view = around(0.0);
        assert_eq!((view.centre, view.half), ([0.0, 0.0], 1.2));
        assert_eq!(view.grid(0), [-1.0, -0.5, 0.0, 0.5, 1.0]);
    }

    #[test]
    fn a_view_holds_every_body_of_every_moment() {
        for speed in [-30.0, -1.0, 0.7, 2.0] {
            let view = around(speed);
            for body in film(speed).episodes[0].scenes.iter().flat_map(|scene| &scene.bodies) {
                let ([x, y], radius) = (view.point([body.x, body.y]), view.length(body.radius));
                assert!(x - radius > 10.0 && x + radius < 110.0, "{body:?}");
                assert!(y - radius > 20.0 && y + radius < 120.0, "{body:?}");
            }
            for axis in 0..2 {
                let lines = view.grid(axis);
                assert!((3..=9).contains(&lines.len()), "{speed}: {lines:?}");
                assert!(lines.iter().all(|line| (line - view.centre[axis]).abs() <= view.half));
            }
        }
    }

    #[test]
    fn a_view_turns_the_world_upside_down_and_keeps_its_shape() {
        let view = View { centre: [1.0, 0.0], half: 2.0, corner: [10.0, 20.0], side: 100.0 };
        assert_eq!(view.point([1.0, 0.0]), [60.0, 70.0]);
        assert_eq!(view.point([-1.0, 2.0]), [10.0, 20.0]);
        assert_eq!(view.point([3.0, -2.0]), [110.0, 120.0]);
        assert_eq!(view.length(1.0), 25.0);
    }
}
