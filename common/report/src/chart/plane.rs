//! The plane of a chart: its frame, grid, numbers and words, and the ranges that it shows.

use super::{Area, FRAME, GRID, Plane, TICK, px};
use crate::measure::signed;
use plotters::prelude::{ChartBuilder, Color as _, IntoFont as _, TextStyle};
use std::error::Error;

/// What is written around a chart.
pub(super) struct Labels<'a> {
    pub(super) title: &'a str,
    pub(super) x: &'a str,
    pub(super) y: &'a str,
    /// About how many numbers stand below it.
    pub(super) x_ticks: usize,
}

/// A chart's frame with its grid and labels, ready to be drawn on.
pub(super) fn plane<'a>(
    area: &Area<'a>,
    labels: &Labels<'_>,
    [left, right]: [f64; 2],
    [bottom, top]: [f64; 2],
) -> Result<Plane<'a>, Box<dyn Error + Send + Sync>> {
    let mut plane = ChartBuilder::on(area)
        .margin(px(10))
        .margin_right(px(18))
        .caption(labels.title, text(18))
        .x_label_area_size(px(46))
        .y_label_area_size(px(66))
        .build_cartesian_2d(left..right, bottom..top)?;
    let (x_tick, y_tick) = (ticks(left, right), ticks(bottom, top));
    plane
        .configure_mesh()
        .max_light_lines(0)
        .set_all_tick_mark_size(px(TICK))
        .bold_line_style(GRID.stroke_width(px(1)))
        .axis_style(FRAME.stroke_width(px(1)))
        .x_labels(labels.x_ticks)
        .y_labels(6)
        .x_label_formatter(&|x| x_tick(*x))
        .y_label_formatter(&|y| y_tick(*y))
        .x_desc(labels.x)
        .y_desc(labels.y)
        .label_style(text(15))
        .axis_desc_style(text(16))
        .draw()?;
    Ok(plane)
}

/// Words of this size, in pixels.
pub(super) fn text(size: u32) -> TextStyle<'static> {
    TextStyle::from(("sans-serif", px(size)).into_font())
}

/// The lowest and the highest; where they are one, with room about it: an axis has a length.
pub(super) fn span(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let finite = values.filter(|value| value.is_finite());
    let ends = |[low, high]: [f64; 2], value: f64| [low.min(value), high.max(value)];
    match finite.fold([f64::INFINITY, f64::NEG_INFINITY], ends) {
        [low, high] if low > high => [0.0, 1.0],
        [low, high] if high - low <= low.abs().max(high.abs()) * 1e-9 => {
            let room = (low.abs() * 0.05).max(0.5);
            [low - room, high + room]
        }
        ends => ends,
    }
}

/// From a little below the lowest to a little above the highest.
pub(super) fn padded(values: impl Iterator<Item = f64>, share: f64) -> [f64; 2] {
    let [low, high] = span(values);
    [low - (high - low) * share, high + (high - low) * share]
}

/// How numbers of an axis are written: thousands and millions in short, as many decimals as tell them apart.
pub(super) fn ticks(low: f64, high: f64) -> impl Fn(f64) -> String {
    let span = high - low;
    let largest = low.abs().max(high.abs());
    let (unit, sign) = match largest {
        largest if largest >= 1e6 => (1e6, " M"),
        largest if largest >= 1e4 => (1e3, " k"),
        _ => (1.0, ""),
    };
    let decimals = (1.0 - (span / unit).log10()).ceil().clamp(0.0, 4.0) as usize;
    move |value| match signed(value / unit, decimals) {
        // Steps of a half would repeat a rounded number.
        zero if zero == "0" => zero,
        number => number + sign,
    }
}
