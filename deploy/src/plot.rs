//! `rit plot`: learning curves of one or several runs of an experiment, as SVG.

use crate::{cli::PlotOptions, failure::Failure};
use plotters::{
    coord::Shift,
    prelude::{
        ChartBuilder, Color as _, DrawingArea, IntoDrawingArea as _, IntoFont as _, LineSeries, PathElement,
        Polygon, RGBColor, SVGBackend, TextStyle, WHITE,
    },
    series::DashedLineSeries,
    style::text_anchor::{HPos, Pos, VPos},
};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    error::Error,
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

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

/// Means of one task over runs, by environment steps: lowest, mean, highest.
type Curve = Vec<(f64, [f64; 3])>;

/// `rit plot`.
///
/// # Errors
/// When a run has no evaluations, or the file cannot be written.
pub fn run(options: &PlotOptions) -> Result<ExitCode, Failure> {
    if options.out.extension().is_none_or(|ending| ending != "svg") {
        return Err(Failure::input_message("--out must end in .svg"));
    }
    let mut evaluations = Vec::new();
    for run in &options.runs {
        evaluations.push(read(run)?);
    }
    let curves = curves(&evaluations);
    let text = draw(&curves, options).map_err(|error| Failure::runtime_message(error.to_string()))?;
    fs::write(&options.out, text).map_err(Failure::runtime)?;
    Ok(ExitCode::SUCCESS)
}

/// A run's greedy evaluations: by task, by environment steps, the mean return.
type Evaluations = BTreeMap<String, BTreeMap<u64, f64>>;

fn read(run: &Path) -> Result<Evaluations, Failure> {
    let path = if run.is_dir() { run.join("metrics.jsonl") } else { PathBuf::from(run) };
    let named = |what: &str| Failure::input_message(format!("{}: {what}", path.display()));
    let text = fs::read_to_string(&path).map_err(|error| named(&error.to_string()))?;
    let mut evaluations = Evaluations::new();
    for line in text.lines() {
        let line: Value = serde_json::from_str(line).map_err(|error| named(&error.to_string()))?;
        if line["kind"] != "evaluation" {
            continue;
        }
        let env_steps = line["env_steps"].as_u64().unwrap_or_default();
        for (task, result) in line["tasks"].as_object().into_iter().flatten() {
            if let Some(mean_return) = result["mean_return"].as_f64() {
                evaluations.entry(task.clone()).or_default().insert(env_steps, mean_return);
            }
        }
    }
    if evaluations.is_empty() {
        return Err(named("it holds no evaluation yet"));
    }
    Ok(evaluations)
}

/// What all runs have in common: points at which each was evaluated.
fn curves(runs: &[Evaluations]) -> BTreeMap<String, Curve> {
    let mut curves = BTreeMap::new();
    for task in runs.iter().flat_map(BTreeMap::keys) {
        let tasks: Vec<_> = runs.iter().filter_map(|run| run.get(task)).collect();
        let curve: Curve = tasks[0]
            .keys()
            .filter_map(|env_steps| {
                let values: Option<Vec<f64>> =
                    tasks.iter().map(|points| points.get(env_steps).copied()).collect();
                let values = values?;
                let lowest = values.iter().copied().fold(f64::INFINITY, f64::min);
                let highest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let mean = values.iter().sum::<f64>() / values.len() as f64;
                Some((*env_steps as f64, [lowest, mean, highest]))
            })
            .collect();
        curves.insert(task.clone(), curve);
    }
    curves
}

fn draw(curves: &BTreeMap<String, Curve>, options: &PlotOptions) -> Result<String, Box<dyn Error>> {
    let points = || curves.values().flatten();
    let steps_max = points().map(|(env_steps, _)| *env_steps).fold(1.0, f64::max);
    let bottom = points().map(|(_, [lowest, ..])| *lowest).chain(options.line).fold(f64::INFINITY, f64::min);
    let top = points().map(|(_, [.., highest])| *highest).chain(options.line).fold(f64::MIN, f64::max);
    let margin = ((top - bottom) * 0.05).max(0.01);

    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let below_title = area.margin(8, 0, 0, 0).titled(&options.title, ("sans-serif", 20))?;
        let chart_area = draw_legend(&below_title, curves.keys())?;
        let mut chart = ChartBuilder::on(&chart_area)
            .margin(MARGIN)
            .x_label_area_size(44)
            .y_label_area_size(Y_LABELS)
            .build_cartesian_2d(0.0..steps_max / 1e6, bottom - margin..top + margin)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_desc("environment steps, millions")
            .y_desc("mean return, greedy")
            .label_style(("sans-serif", 14))
            .draw()?;
        for (curve, colour) in curves.values().zip(COLOURS.iter().cycle()) {
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

/// Writes the tasks in their colours above the chart, where no curve is hidden by them, in as many lines as that takes;
/// returns the area that is left.
fn draw_legend<'a>(
    area: &Area<'a>,
    tasks: impl Iterator<Item = &'a String>,
) -> Result<Area<'a>, Box<dyn Error>> {
    const LEFT: i32 = MARGIN + Y_LABELS;
    const GAP: i32 = 20;
    const DASH: i32 = 18;
    const LINE: i32 = 20;
    let right = area.dim_in_pixel().0 as i32;
    let (mut x, mut y) = (LEFT, LINE / 2);
    for (task, colour) in tasks.zip(COLOURS.iter().cycle()) {
        let text = TextStyle::from(("sans-serif", 14).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
        let width = DASH + 6 + area.estimate_text_size(task, &text)?.0 as i32;
        if x > LEFT && x + width > right {
            (x, y) = (LEFT, y + LINE);
        }
        area.draw(&PathElement::new([(x, y), (x + DASH, y)], colour.stroke_width(2)))?;
        area.draw_text(task, &text, (x + DASH + 6, y))?;
        x += width + GAP;
    }
    Ok(area.split_vertically(y + LINE / 2).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_joined_where_all_were_evaluated() {
        let run = |points: &[(u64, f64)]| Evaluations::from([("a".into(), points.iter().copied().collect())]);
        let runs = [run(&[(0, 1.0), (10, 2.0), (20, 3.0)]), run(&[(0, 3.0), (10, 6.0)])];
        let expected: Curve = vec![(0.0, [1.0, 2.0, 3.0]), (10.0, [2.0, 4.0, 6.0])];
        assert_eq!(curves(&runs)["a"], expected);
    }

    #[test]
    fn the_legend_takes_as_many_lines_as_the_tasks_need() {
        let tasks =
            (0..12).map(|i| (format!("predator-prey-pro-{i:02}-2"), vec![(0.0, [1.0; 3]), (5.0, [2.0; 3])]));
        let options = PlotOptions { runs: Vec::new(), out: PathBuf::new(), title: "all".into(), line: None };
        let svg = draw(&tasks.clone().collect(), &options).unwrap();
        let place = |name: &str| {
            let text = &svg[..svg.find(name).unwrap()];
            let number = |key: &str| {
                let at = text.rfind(key).unwrap() + key.len();
                text[at..].split('"').next().unwrap().parse::<i32>().unwrap()
            };
            (number(" y=\""), number(" x=\""))
        };
        let places: Vec<_> = tasks.map(|(name, _)| place(&name)).collect();
        assert!(places.is_sorted_by(|a, b| a < b), "one after another: {places:?}");
        assert!(places.iter().all(|(_, x)| *x < 800), "within the picture: {places:?}");
        assert!(places.last().unwrap().0 > places[0].0, "several lines: {places:?}");
    }
}
