//! Charts as SVG: curves, intervals in rows, and points, several beside each other under one legend.

mod plane;
mod svg;

use crate::ReportError;
use plane::{Labels, padded, plane, span, text, ticks};
use plotters::{
    coord::{Shift, types::RangedCoordf64},
    prelude::{
        Cartesian2d, ChartBuilder, ChartContext, Circle, Color as _, DrawingArea, IntoDrawingArea as _,
        LineSeries, PathElement, Polygon, RGBColor, WHITE,
    },
    series::DashedLineSeries,
    style::text_anchor::{HPos, Pos, VPos},
};
use std::error::Error;
use svg::{PIXEL, Svg};

/// Width of a figure, in pixels.
const WIDTH: u32 = 960;
/// Height of one chart with curves or points.
const CHART_HEIGHT: u32 = 330;
/// Height of a row of intervals, and of what is above and below them.
const ROW_HEIGHT: u32 = 24;
const ROWS_FRAME: u32 = 84;
/// Length of the marks that numbers stand at.
const TICK: u32 = 5;
/// A line of the legend.
const LEGEND_LINE: i32 = 22;

/// A colour for each method of the paper's comparison, in the order in which methods are listed; what comes after them
/// begins again, dashed.
const COLOURS: [RGBColor; 16] = [
    RGBColor(204, 37, 41),
    RGBColor(237, 125, 28),
    RGBColor(140, 86, 40),
    RGBColor(0, 101, 189),
    RGBColor(86, 170, 225),
    RGBColor(68, 60, 160),
    RGBColor(150, 130, 215),
    RGBColor(0, 122, 84),
    RGBColor(110, 185, 85),
    RGBColor(205, 90, 160),
    RGBColor(120, 120, 120),
    RGBColor(0, 160, 165),
    RGBColor(165, 145, 0),
    RGBColor(40, 40, 40),
    RGBColor(225, 130, 130),
    RGBColor(95, 60, 120),
];
const GREY: RGBColor = RGBColor(105, 105, 105);
const FRAME: RGBColor = RGBColor(190, 190, 190);
const GRID: RGBColor = RGBColor(232, 232, 232);

/// Pixels in units of drawing.
const fn px(pixels: u32) -> u32 {
    pixels * PIXEL as u32
}

/// What a line, a row or points are called, and in which colour they are drawn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// In the legend.
    pub label: String,
    /// Its place among the colours.
    pub style: usize,
}

impl Key {
    fn colour(&self) -> RGBColor {
        COLOURS[self.style % COLOURS.len()]
    }

    fn is_dashed(&self) -> bool {
        self.style >= COLOURS.len()
    }
}

/// A line, with its interval or with the runs that it is the mean of.
#[derive(Clone, Debug)]
pub struct Line {
    /// Whose.
    pub key: Key,
    /// (x, y).
    pub points: Vec<(f64, f64)>,
    /// (x, lower end, upper end).
    pub band: Vec<(f64, f64, f64)>,
    /// Thin lines.
    pub runs: Vec<Vec<(f64, f64)>>,
}

/// One chart of curves.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    /// Above it.
    pub title: String,
    /// Below it.
    pub x: String,
    /// Beside it.
    pub y: String,
    /// What is always shown of the vertical axis.
    pub y_shown: Vec<f64>,
    /// Where the vertical axis ends, if it must.
    pub y_limits: Option<[f64; 2]>,
    /// A dashed line across it, for comparison.
    pub marked: Option<f64>,
    /// What is drawn.
    pub lines: Vec<Line>,
}

/// One interval of a chart of rows.
#[derive(Clone, Debug)]
pub struct Row {
    /// Whose.
    pub key: Key,
    /// A thick stroke; NaN for nothing.
    pub value: f64,
    /// A bar.
    pub interval: Option<(f64, f64)>,
    /// In place of the bar.
    pub runs: Vec<f64>,
}

/// One chart of rows.
#[derive(Clone, Debug)]
pub struct Rows {
    /// Above it.
    pub title: String,
    /// The same methods in all charts of a figure.
    pub rows: Vec<Row>,
    /// A dashed vertical line.
    pub line: Option<f64>,
    /// What is always shown of the axis.
    pub shown: Vec<f64>,
}

/// Points on a map.
#[derive(Clone, Debug)]
pub struct Points {
    /// Whose.
    pub key: Key,
    /// Where.
    pub places: Vec<[f64; 2]>,
    /// Drawn as rings.
    pub hollow: bool,
}

/// Pairs of numbers that should be the same: the diagonal is drawn.
#[derive(Clone, Debug)]
pub struct Scatter {
    /// Above it.
    pub title: String,
    /// Below it.
    pub x: String,
    /// Beside it.
    pub y: String,
    /// Whose.
    pub key: Key,
    /// Where.
    pub places: Vec<[f64; 2]>,
}

type Area<'a> = DrawingArea<Svg<'a>, Shift>;
type Drawn = Result<(), Box<dyn Error + Send + Sync>>;
type Plane<'a> = ChartContext<'a, Svg<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Charts of curves, two beside each other.
///
/// # Errors
/// When the library refuses.
pub fn curves(charts: &[Chart]) -> Result<String, ReportError> {
    let keys = keys(charts.iter().flat_map(|chart| chart.lines.iter().map(|line| &line.key)));
    let columns = charts.len().clamp(1, 2);
    let rows = charts.len().div_ceil(columns);
    figure(&keys, CHART_HEIGHT * rows as u32, |area| {
        for (chart, part) in charts.iter().zip(area.split_evenly((rows, columns))) {
            draw_curves(chart, &part)?;
        }
        Ok(())
    })
}

/// Charts of rows, all of the same methods, beside each other.
///
/// # Errors
/// When the library refuses.
pub fn rows(charts: &[Rows]) -> Result<String, ReportError> {
    let Some(first) = charts.first() else { return Ok(String::new()) };
    let height = ROWS_FRAME + ROW_HEIGHT * first.rows.len() as u32;
    let longest = first.rows.iter().map(|row| row.key.label.chars().count()).max().unwrap_or(0);
    let labels = (longest as i32 * 8 + 18).clamp(60, 330);
    figure(&[], height, |area| {
        let (left, right) = area.split_horizontally(labels * PIXEL);
        let mut heights = Vec::new();
        for (chart, part) in charts.iter().zip(right.split_evenly((1, charts.len()))) {
            heights = draw_rows(chart, &part)?;
        }
        for (row, y) in first.rows.iter().zip(heights) {
            let style = text(16).pos(Pos::new(HPos::Right, VPos::Center));
            left.draw_text(&row.key.label, &style, ((labels - 8) * PIXEL, y))?;
        }
        Ok(())
    })
}

/// A map of points.
///
/// # Errors
/// When the library refuses.
pub fn map(title: &str, points: &[Points]) -> Result<String, ReportError> {
    let keys = keys(points.iter().map(|points| &points.key));
    figure(&keys, 560, |area| {
        let all = || points.iter().flat_map(|points| &points.places);
        let span = |axis: usize| padded(all().map(|place| place[axis]), 0.05);
        let (x, y) = (span(0), span(1));
        let mut chart = ChartBuilder::on(area)
            .margin(px(14))
            .caption(title, text(18))
            .build_cartesian_2d(x[0]..x[1], y[0]..y[1])?;
        // A map's axes mean nothing: it gets a frame and no numbers.
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(0)
            .y_labels(0)
            .axis_style(FRAME.stroke_width(px(1)))
            .draw()?;
        for Points { key, places, hollow } in points {
            let style =
                if *hollow { key.colour().stroke_width(px(2)) } else { key.colour().mix(0.75).filled() };
            chart.draw_series(places.iter().map(|&[x, y]| Circle::new((x, y), px(4), style)))?;
        }
        Ok(())
    })
}

/// Pairs of numbers, then curves, beside each other.
///
/// # Errors
/// When the library refuses.
pub fn scatters(scatters: &[Scatter], charts: &[Chart]) -> Result<String, ReportError> {
    let count = scatters.len() + charts.len();
    figure(&[], CHART_HEIGHT, |area| {
        let parts = area.split_evenly((1, count));
        for (scatter, part) in scatters.iter().zip(&parts) {
            draw_scatter(scatter, part)?;
        }
        for (chart, part) in charts.iter().zip(&parts[scatters.len()..]) {
            draw_curves(chart, part)?;
        }
        Ok(())
    })
}

fn figure(keys: &[Key], height: u32, draw: impl FnOnce(&Area) -> Drawn) -> Result<String, ReportError> {
    let legend = legend_places(keys);
    let legend_height = legend.last().map_or(0, |(_, y)| y + LEGEND_LINE);
    let mut svg = String::new();
    let drawn = (|| -> Drawn {
        let area = Svg::new(&mut svg, (px(WIDTH), px(height + legend_height as u32))).into_drawing_area();
        area.fill(&WHITE)?;
        for (key, &(x, y)) in keys.iter().zip(&legend) {
            let (x, y) = (x * PIXEL, (y + LEGEND_LINE / 2) * PIXEL);
            let dashes = if key.is_dashed() { &[(0, 8), (13, 20)][..] } else { &[(0, 20)] };
            for (from, to) in dashes {
                let ends = [(x + from * PIXEL, y), (x + to * PIXEL, y)];
                area.draw(&PathElement::new(ends, key.colour().stroke_width(px(3))))?;
            }
            let style = text(16).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw_text(&key.label, &style, (x + 26 * PIXEL, y))?;
        }
        draw(&area.split_vertically(legend_height * PIXEL).1)?;
        Ok(area.present()?)
    })();
    drawn.map_err(|error| ReportError::Draw(error.to_string()))?;
    Ok(svg)
}

/// Where each label of the legend begins: as many lines as they need.
fn legend_places(keys: &[Key]) -> Vec<(i32, i32)> {
    let (left, mut x, mut y) = (70, 70, 0);
    let place = |key: &Key| {
        // No font is at hand to measure by; letters are about this wide.
        let width = 26 + (key.label.chars().count() as f64 * 7.4) as i32 + 22;
        if x > left && x + width > WIDTH as i32 - 10 {
            (x, y) = (left, y + LEGEND_LINE);
        }
        let place = (x, y);
        x += width;
        place
    };
    keys.iter().map(place).collect()
}

fn keys<'a>(all: impl Iterator<Item = &'a Key>) -> Vec<Key> {
    let mut keys: Vec<Key> = Vec::new();
    for key in all {
        if !keys.contains(key) {
            keys.push(key.clone());
        }
    }
    keys.sort_by_key(|key| key.style);
    keys
}

fn draw_curves(chart: &Chart, area: &Area) -> Drawn {
    let of_line = |line: &Line| {
        let runs = line.runs.iter().flatten().copied();
        let band = line.band.iter().flat_map(|&(x, low, high)| [(x, low), (x, high)]);
        line.points.iter().copied().chain(runs).chain(band).collect::<Vec<_>>()
    };
    let all: Vec<(f64, f64)> = chart.lines.iter().flat_map(of_line).collect();
    let [left, right] = span(all.iter().map(|point| point.0));
    let ys = all.iter().map(|point| point.1).chain(chart.y_shown.iter().copied()).chain(chart.marked);
    let [bottom, top] = chart.y_limits.unwrap_or_else(|| padded(ys, 0.05));
    let labels = Labels { title: &chart.title, x: &chart.x, y: &chart.y, x_ticks: 6 };
    let mut plane = plane(area, &labels, [left, right], [bottom, top])?;
    for line in &chart.lines {
        draw_line(line, &mut plane)?;
    }
    if let Some(y) = chart.marked {
        draw_dashes([(left, y), (right, y)], &mut plane)?;
    }
    Ok(())
}

/// A thin line that is no result: what results are held against.
fn draw_dashes(ends: [(f64, f64); 2], plane: &mut Plane) -> Drawn {
    plane.draw_series(DashedLineSeries::new(ends, 6 * PIXEL, 4 * PIXEL, GREY.stroke_width(px(1))))?;
    Ok(())
}

fn draw_scatter(scatter: &Scatter, area: &Area) -> Drawn {
    let [left, right] = padded(scatter.places.iter().map(|place| place[0]), 0.05);
    let [bottom, top] = padded(scatter.places.iter().map(|place| place[1]), 0.05);
    let labels = Labels { title: &scatter.title, x: &scatter.x, y: &scatter.y, x_ticks: 4 };
    let mut plane = plane(area, &labels, [left, right], [bottom, top])?;
    let (from, to) = (left.max(bottom), right.min(top));
    if from < to {
        draw_dashes([(from, from), (to, to)], &mut plane)?;
    }
    let style = scatter.key.colour().mix(0.5).filled();
    plane.draw_series(scatter.places.iter().map(|&[x, y]| Circle::new((x, y), px(2), style)))?;
    Ok(())
}

fn draw_line(line: &Line, plane: &mut Plane) -> Drawn {
    let colour = line.key.colour();
    if !line.band.is_empty() {
        let lower = line.band.iter().map(|&(x, low, _)| (x, low));
        let upper = line.band.iter().rev().map(|&(x, _, high)| (x, high));
        let outline: Vec<(f64, f64)> = lower.chain(upper).collect();
        plane.draw_series(std::iter::once(Polygon::new(outline, colour.mix(0.15))))?;
    }
    for run in &line.runs {
        plane.draw_series(LineSeries::new(run.iter().copied(), colour.mix(0.35).stroke_width(px(1))))?;
    }
    let points = line.points.iter().copied();
    if line.key.is_dashed() {
        plane.draw_series(DashedLineSeries::new(points, 8 * PIXEL, 5 * PIXEL, colour.stroke_width(px(2))))?;
    } else {
        plane.draw_series(LineSeries::new(points, colour.stroke_width(px(2))))?;
    }
    // Few points are shown as such: between them nothing was measured.
    if line.points.len() <= 12 {
        plane.draw_series(line.points.iter().map(|&point| Circle::new(point, px(3), colour.filled())))?;
    }
    Ok(())
}

/// Returns the height of each row, in pixels.
fn draw_rows(chart: &Rows, area: &Area) -> Result<Vec<i32>, Box<dyn Error + Send + Sync>> {
    let of_row = |row: &Row| {
        let ends = row.interval.map_or_else(Vec::new, |(low, high)| vec![low, high]);
        [vec![row.value], ends, row.runs.clone()].concat()
    };
    let all = chart.rows.iter().flat_map(of_row).chain(chart.line).chain(chart.shown.iter().copied());
    let [left, right] = padded(all, 0.06);
    let count = chart.rows.len() as f64;
    let mut plane = ChartBuilder::on(area)
        .margin_left(px(14))
        .margin_right(px(16))
        .margin_top(px(8))
        .margin_bottom(px(4))
        .caption(&chart.title, text(17))
        .x_label_area_size(px(34))
        .build_cartesian_2d(left..right, 0.0..count)?;
    let tick = ticks(left, right);
    plane
        .configure_mesh()
        .max_light_lines(0)
        .set_all_tick_mark_size(px(TICK))
        .bold_line_style(GRID.stroke_width(px(1)))
        .axis_style(FRAME.stroke_width(px(1)))
        .disable_y_mesh()
        .x_labels(4)
        .y_labels(0)
        .x_label_formatter(&|x| tick(*x))
        .label_style(text(15))
        .draw()?;
    if let Some(line) = chart.line {
        draw_dashes([(line, 0.0), (line, count)], &mut plane)?;
    }
    for (at, row) in chart.rows.iter().enumerate() {
        let (y, colour) = (count - at as f64 - 0.5, row.key.colour());
        if let Some((low, high)) = row.interval {
            let bar = [(low, y - 0.3), (high, y - 0.3), (high, y + 0.3), (low, y + 0.3)];
            plane.draw_series(std::iter::once(Polygon::new(bar.to_vec(), colour.mix(0.45))))?;
        }
        plane.draw_series(
            row.runs.iter().map(|&run| Circle::new((run, y), px(3), colour.mix(0.5).filled())),
        )?;
        if row.value.is_finite() {
            let stroke = [(row.value, y - 0.36), (row.value, y + 0.36)];
            plane.draw_series(LineSeries::new(stroke, colour.stroke_width(px(3))))?;
        }
    }
    let height = |at: usize| plane.backend_coord(&(left, count - at as f64 - 0.5)).1;
    Ok((0..chart.rows.len()).map(height).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(label: &str, style: usize) -> Line {
        let key = Key { label: label.to_owned(), style };
        let points = vec![(0.0, 1.0), (5e6, 2.0)];
        Line { key, points, band: vec![(0.0, 0.5, 1.5), (5e6, 1.0, 3.0)], runs: Vec::new() }
    }

    #[test]
    fn a_figure_has_each_label_once_within_its_width() {
        let lines: Vec<Line> = (0..14).map(|at| line(&format!("a-method-with-a-name-{at:02}"), at)).collect();
        let chart = Chart { title: "one".to_owned(), lines: lines.clone(), ..Chart::default() };
        let svg = curves(&[chart.clone(), chart]).unwrap();
        for line in &lines {
            assert_eq!(svg.matches(&line.key.label).count(), 1);
        }
        let places = legend_places(&keys(lines.iter().map(|line| &line.key)));
        assert!(
            places.iter().all(|(x, _)| *x < 800) && places.is_sorted_by_key(|&(x, y)| (y, x)),
            "{places:?}"
        );
        let parsed = roxmltree::Document::parse(&svg).unwrap();
        assert_eq!(parsed.root_element().tag_name().name(), "svg");
    }

    #[test]
    fn axes_are_labelled_with_numbers_that_differ() {
        let labels = |low: f64, high: f64, at: &[f64]| {
            let tick = ticks(low, high);
            at.iter().map(|&value| tick(value)).collect::<Vec<_>>()
        };
        assert_eq!(labels(0.0, 5_050_000.0, &[0.0, 2.5e6, 5e6]), ["0.0 M", "2.5 M", "5.0 M"]);
        assert_eq!(labels(0.0, 50_000.0, &[0.0, 1e4, 5e4]), ["0", "10 k", "50 k"]);
        assert_eq!(labels(0.0, 1.0, &[0.0, 0.25, 1.0]), ["0.0", "0.2", "1.0"]);
        assert_eq!(labels(-400.0, -200.0, &[-400.0, -250.0]), ["−400", "−250"]);
    }

    #[test]
    fn nothing_and_one_value_can_be_drawn() {
        let key = Key { label: "a".to_owned(), style: 20 };
        for value in [f64::NAN, 0.0, -3.5] {
            let row = Row { key: key.clone(), value, interval: None, runs: Vec::new() };
            let chart = Rows { title: "t".to_owned(), rows: vec![row], line: None, shown: Vec::new() };
            roxmltree::Document::parse(&rows(&[chart]).unwrap()).unwrap();
        }
        roxmltree::Document::parse(&curves(&[Chart::default()]).unwrap()).unwrap();
        let points = [Points { key, places: vec![[0.0, 0.0]], hollow: true }];
        roxmltree::Document::parse(&map("t", &points).unwrap()).unwrap();
    }
}
