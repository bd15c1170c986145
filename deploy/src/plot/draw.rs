//! Curves as SVG.

use super::curves::Series;
use crate::cli::{PlotMetric, PlotOptions};
use plotters::{
    coord::Shift,
    prelude::{
        ChartBuilder, Color as _, DrawingArea, IntoDrawingArea as _, IntoFont as _, LineSeries, PathElement,
        Polygon, RGBColor, SVGBackend, TextStyle, WHITE,
    },
    series::DashedLineSeries,
    style::text_anchor::{HPos, Pos, VPos},
};
use std::error::Error;

/// Width and height, in pixels.
const SIZE: (u32, u32) = (900, 480);

/// Okabe and Ito's, which people see apart whatever their eyes.
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];

/// Around the chart, and for the labels of its vertical axis, in pixels.
const MARGIN: i32 = 12;
const Y_LABELS: i32 = 64;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Draws the series in the order given.
pub fn draw(series: &[Series], options: &PlotOptions) -> Result<String, Box<dyn Error>> {
    let points = || series.iter().flat_map(|series| &series.curve);
    let steps_max = points().map(|(env_steps, _)| *env_steps).fold(1.0, f64::max);
    let (measure, whole): (_, &[f64]) = match options.metric {
        PlotMetric::MeanReturn => ("mean return, greedy", &[]),
        PlotMetric::WinRate => ("win rate, greedy", &[0.0, 1.0]),
    };
    let shown = || options.line.iter().chain(whole).copied();
    let bottom = points().map(|(_, [lowest, ..])| *lowest).chain(shown()).fold(f64::INFINITY, f64::min);
    let top = points().map(|(_, [.., highest])| *highest).chain(shown()).fold(f64::MIN, f64::max);
    let margin = ((top - bottom) * 0.05).max(0.01);

    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let below_title = area.margin(8, 0, 0, 0).titled(&options.title, ("sans-serif", 20))?;
        let chart_area = draw_legend(&below_title, series.iter().map(|series| &series.label))?;
        let mut chart = ChartBuilder::on(&chart_area)
            .margin(MARGIN)
            .x_label_area_size(44)
            .y_label_area_size(Y_LABELS)
            .build_cartesian_2d(0.0..steps_max / 1e6, bottom - margin..top + margin)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_desc("environment steps, millions")
            .y_desc(measure)
            .label_style(("sans-serif", 14))
            .draw()?;
        for (Series { curve, .. }, colour) in series.iter().zip(COLOURS.iter().cycle()) {
            let at = |which: usize| curve.iter().map(move |(steps, values)| (steps / 1e6, values[which]));
            let band: Vec<(f64, f64)> = at(0).chain(at(2).collect::<Vec<_>>().into_iter().rev()).collect();
            chart.draw_series(std::iter::once(Polygon::new(band, colour.mix(0.15))))?;
            chart.draw_series(LineSeries::new(at(1), colour.stroke_width(2)))?;
        }
        if let Some(line) = options.line {
            let ends = [(0.0, line), (steps_max / 1e6, line)];
            let grey = RGBColor(110, 110, 110);
            chart.draw_series(DashedLineSeries::new(ends, 6, 4, grey.stroke_width(1)))?;
        }
        area.present()?;
    }
    Ok(text)
}

/// Writes the labels in their colours above the chart, where no curve is hidden by them, in as many lines as that takes;
/// returns the area that is left.
fn draw_legend<'a>(
    area: &Area<'a>,
    labels: impl Iterator<Item = &'a String>,
) -> Result<Area<'a>, Box<dyn Error>> {
    const LEFT: i32 = MARGIN + Y_LABELS;
    const GAP: i32 = 20;
    const DASH: i32 = 18;
    const LINE: i32 = 20;
    let right = area.dim_in_pixel().0 as i32;
    let (mut x, mut y) = (LEFT, LINE / 2);
    for (label, colour) in labels.zip(COLOURS.iter().cycle()) {
        let text = TextStyle::from(("sans-serif", 14).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
        let width = DASH + 6 + area.estimate_text_size(label, &text)?.0 as i32;
        if x > LEFT && x + width > right {
            (x, y) = (LEFT, y + LINE);
        }
        area.draw(&PathElement::new([(x, y), (x + DASH, y)], colour.stroke_width(2)))?;
        area.draw_text(label, &text, (x + DASH + 6, y))?;
        x += width + GAP;
    }
    Ok(area.split_vertically(y + LINE / 2).1)
}

#[cfg(test)]
mod tests {
    use super::{super::curves::Curve, *};
    use std::path::PathBuf;

    fn options(metric: PlotMetric) -> PlotOptions {
        PlotOptions {
            runs: Vec::new(),
            out: PathBuf::new(),
            force: false,
            metric,
            compare: false,
            labels: Vec::new(),
            title: "all".into(),
            line: None,
        }
    }

    #[test]
    fn the_legend_takes_as_many_lines_as_the_labels_need() {
        let curve: Curve = vec![(0.0, [1.0; 3]), (5.0, [2.0; 3])];
        let series: Vec<Series> = (0..12)
            .map(|i| Series { label: format!("predator-prey-pro-{i:02}-2"), curve: curve.clone() })
            .collect();
        let svg = draw(&series, &options(PlotMetric::MeanReturn)).unwrap();
        let place = |name: &str| {
            let text = &svg[..svg.find(name).unwrap()];
            let number = |key: &str| {
                let at = text.rfind(key).unwrap() + key.len();
                text[at..].split('"').next().unwrap().parse::<i32>().unwrap()
            };
            (number(" y=\""), number(" x=\""))
        };
        let places: Vec<_> = series.iter().map(|series| place(&series.label)).collect();
        assert!(places.is_sorted_by(|a, b| a < b), "one after another: {places:?}");
        assert!(places.iter().all(|(_, x)| *x < 800), "within the picture: {places:?}");
        assert!(places.last().unwrap().0 > places[0].0, "several lines: {places:?}");
    }

    #[test]
    fn win_rates_are_shown_from_none_to_all() {
        let series = [Series { label: "a".into(), curve: vec![(0.0, [0.4; 3]), (5.0, [0.6; 3])] }];
        let svg = draw(&series, &options(PlotMetric::WinRate)).unwrap();
        assert!(svg.contains("win rate, greedy"));
        for tick in ["0.0", "1.0"] {
            assert!(svg.contains(&format!("\n{tick}\n")), "{tick} in {svg}");
        }
    }
}
