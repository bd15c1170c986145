//! What a picture says around its plots, and where it all lies.

use super::{
    canvas::{Align, Canvas, Font, Point, Text},
    ink::{self, Ink},
    plot::{self, Plot},
    recording::{Film, Recording},
};
use rit_env::Task;

/// Width and height of one frame of an animation.
pub const FRAME: [u32; 2] = [520, 626];

/// Moments of an episode in a strip, its beginning and its end among them.
const MOMENTS: usize = 6;
/// Side of each.
const MOMENT: f32 = 320.0;
/// Of a strip, from one episode to the next: heading, plots, captions.
const STRIP: f32 = 30.0 + MOMENT + 34.0;

/// Side of the plot of a whole course.
const COURSE: f32 = 420.0;
/// Courses beside each other; the next begin a new row.
const COURSES: usize = 4;
/// Of a course with the words, the scale and the rewards around it.
const COURSE_CELL: Point = [COURSE + 56.0, COURSE + 68.0 + REWARDS];
/// Height of the rewards below a plot, and how far below it they begin.
const REWARDS: f32 = 36.0;
const TO_REWARDS: f32 = 28.0;

const GAP: f32 = 12.0;
const MARGIN: f32 = 18.0;
const HEADING: f32 = 44.0;
const LEGEND: f32 = 34.0;

/// One step of an episode.
pub fn frame(canvas: &mut dyn Canvas, film: &Film, index: usize, step: usize) {
    let [width, height] = FRAME.map(|size| size as f32);
    let (left, right) = (40.0, width - 12.0);
    let side = right - left;
    let recording = &film.episodes[index];
    canvas.rectangle([0.0, 0.0], [width, height], ink::PAPER);
    heading(canvas, film, [left, 18.0]);
    if film.episodes.len() > 1 {
        let words = format!("{}/{}", index + 1, film.episodes.len());
        write(canvas, [right, 18.0], Align::Right, Font::Small, ink::QUIET, &words);
    }
    // Columns of fixed width: the words stand still while the numbers change.
    let words = format!(
        "step {step:2}/{}  reward {:>7}  return {:>8}",
        recording.steps(),
        recording.reward(step).map_or_else(|| "-".to_owned(), |reward| decimal(reward.into())),
        decimal(recording.total(step))
    );
    write(canvas, [left, 42.0], Align::Left, Font::Large, ink::WORDS, &words);
    let plot = Plot::new(recording, [left, 58.0], side);
    plot.ground(canvas, true);
    plot.moment(canvas, step);
    let corner = [left, 58.0 + side + TO_REWARDS];
    plot::rewards(canvas, recording, corner, [side, REWARDS], step);
    legend(canvas, film, [left, height - 17.0], right, true);
}

/// Width and height of [`strips`].
pub fn strips_size(film: &Film) -> Point {
    let moments = MOMENTS as f32;
    [
        2.0 * MARGIN + moments * MOMENT + (moments - 1.0) * GAP,
        HEADING + film.episodes.len() as f32 * STRIP + LEGEND,
    ]
}

/// A row of moments for each episode.
pub fn strips(canvas: &mut dyn Canvas, film: &Film) {
    let size = strips_size(film);
    canvas.rectangle([0.0, 0.0], size, ink::PAPER);
    heading(canvas, film, [MARGIN, 24.0]);
    for (index, recording) in film.episodes.iter().enumerate() {
        let top = HEADING + index as f32 * STRIP;
        let words = course_words(index, recording);
        write(canvas, [MARGIN, top + 14.0], Align::Left, Font::Small, ink::WORDS, &words);
        for (column, step) in moments(recording.steps()).into_iter().enumerate() {
            let corner = [MARGIN + column as f32 * (MOMENT + GAP), top + 30.0];
            let plot = Plot::new(recording, corner, MOMENT);
            plot.ground(canvas, false);
            plot.moment(canvas, step);
            let [left, below] = [corner[0], corner[1] + MOMENT + 12.0];
            let words = format!("step {step}");
            write(canvas, [left, below], Align::Left, Font::Small, ink::WORDS, &words);
            if let Some(reward) = recording.reward(step) {
                let (reward, total) = (decimal(reward.into()), decimal(recording.total(step)));
                let words = format!("reward {reward}, return {total}");
                write(canvas, [left + MOMENT, below], Align::Right, Font::Small, ink::QUIET, &words);
            }
        }
    }
    legend(canvas, film, [MARGIN, size[1] - 20.0], size[0] - MARGIN, false);
}

/// Width and height of all courses with what is around them.
pub fn courses_size(film: &Film) -> Point {
    let count = film.episodes.len();
    [
        MARGIN + count.min(COURSES) as f32 * COURSE_CELL[0],
        HEADING + count.div_ceil(COURSES) as f32 * COURSE_CELL[1] + LEGEND,
    ]
}

/// What courses have around them: paper, heading and legend.
pub fn courses_surroundings(canvas: &mut dyn Canvas, film: &Film) {
    let size = courses_size(film);
    canvas.rectangle([0.0, 0.0], size, ink::PAPER);
    heading(canvas, film, [MARGIN, 24.0]);
    legend(canvas, film, [MARGIN, size[1] - 20.0], size[0] - MARGIN, true);
}

/// The whole course of an episode, side by side with the others'.
pub fn course(canvas: &mut dyn Canvas, film: &Film, index: usize) {
    let recording = &film.episodes[index];
    let left = MARGIN + (index % COURSES) as f32 * COURSE_CELL[0] + 30.0;
    let top = HEADING + (index / COURSES) as f32 * COURSE_CELL[1];
    let words = course_words(index, recording);
    write(canvas, [left, top + 12.0], Align::Left, Font::Small, ink::WORDS, &words);
    let plot = Plot::new(recording, [left, top + 26.0], COURSE);
    plot.ground(canvas, true);
    plot.course(canvas);
    let corner = [left, top + 26.0 + COURSE + TO_REWARDS];
    plot::rewards(canvas, recording, corner, [COURSE, REWARDS], recording.steps());
}

/// An episode in a few words.
pub fn course_words(index: usize, recording: &Recording) -> String {
    let steps = recording.steps();
    format!("episode {}: return {} in {steps} steps", index + 1, decimal(recording.total(steps)))
}

/// Evenly spread, no step twice.
fn moments(steps: usize) -> Vec<usize> {
    let count = MOMENTS.min(steps + 1);
    (0..count).map(|moment| (moment * steps + (count - 1) / 2) / (count - 1).max(1)).collect()
}

fn heading(canvas: &mut dyn Canvas, film: &Film, [left, y]: Point) {
    let task = film.task.to_string();
    write(canvas, [left, y], Align::Left, Font::LargeBold, ink::WORDS, &task);
    let after = left + (task.len() as f32 + 1.0) * Font::LargeBold.advance();
    write(canvas, [after, y], Align::Left, Font::Small, ink::QUIET, &film.policy);
}

/// What the numbers and the colours are, that of the rewards among them where those are drawn.
fn legend(canvas: &mut dyn Canvas, film: &Film, [left, y]: Point, right: f32, rewards: bool) {
    let kinds = film.kinds().map(|kind| (film.name_of(kind), ink::body(kind)));
    let fights = matches!(film.task, Task::Combat { .. });
    let combat = [("attack", ink::ATTACK), ("health, healing", ink::HEALTH), ("shield", ink::SHIELD)];
    let combat = combat.into_iter().filter(|_| fights);
    let mut x = left;
    for (name, ink) in kinds.chain(combat).chain(rewards.then_some(("reward", ink::REWARD))) {
        canvas.disc([x + 5.0, y], 5.0, ink);
        write(canvas, [x + 15.0, y], Align::Left, Font::Small, ink::WORDS, name);
        x += 15.0 + (name.len() as f32 + 2.0) * Font::Small.advance();
    }
    let words = if fights { "number: order" } else { "number: decision order" };
    write(canvas, [right, y], Align::Right, Font::Small, ink::QUIET, words);
}

fn write(canvas: &mut dyn Canvas, at: Point, align: Align, font: Font, ink: Ink, words: &str) {
    canvas.text(Text { at, align, font, ink, rim: None, words });
}

/// Two decimals, and no negative zero.
fn decimal(number: f64) -> String {
    let text = format!("{number:.2}");
    if text == "-0.00" { "0.00".to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_begin_and_end_with_the_episode() {
        assert_eq!(moments(25), [0, 5, 10, 15, 20, 25]);
        assert_eq!(moments(12), [0, 2, 5, 7, 10, 12]);
        for steps in 1..40 {
            let moments = moments(steps);
            assert_eq!((moments[0], moments[moments.len() - 1]), (0, steps));
            assert!(moments.is_sorted_by(|a, b| a < b), "{moments:?}");
        }
        assert_eq!(moments(0), [0]);
    }

    #[test]
    fn numbers_have_two_decimals_and_zero_no_sign() {
        assert_eq!([-0.001, 0.0, -12.345, 106.0].map(decimal), ["0.00", "0.00", "-12.35", "106.00"]);
    }
}
