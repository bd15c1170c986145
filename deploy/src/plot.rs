//! `rit plot`: learning curves of runs, finished or not, as SVG.

use crate::{
    cli::{PlotMetric, PlotOptions},
    experiments::plain_settings,
    failure::Failure,
    new_file, output,
    report::counted,
};
use rit_env::Split;
use rit_report::{
    Group, Measure, Options, Styles,
    chart::{self, Chart},
    figures::{self, Drawn},
    groups, read,
};
use std::process::ExitCode;

/// `rit plot`.
///
/// # Errors
/// When a run has no evaluations, runs do not go together, or the file is there or cannot be written.
pub fn run(options: &PlotOptions) -> Result<ExitCode, Failure> {
    if options.out.extension().is_none_or(|ending| ending != "svg") {
        return Err(Failure::input_message(format!(
            "--out {}: a plot's name ends in .svg",
            options.out.display()
        )));
    }
    new_file::check(&options.out, options.force)?;
    let input = read(&options.runs)?;
    for run in &input.runs {
        if run.evaluations.is_empty() {
            return Err(Failure::input_message(format!("{run}: it holds no evaluation yet")));
        }
        if run.broken_lines > 0 {
            // It is drawn without them, whether or not the warning can be printed.
            let are = if run.broken_lines == 1 { "is" } else { "are" };
            let lines = counted(run.broken_lines as u64, "torn line");
            let _ = output::say(&format!("{run}: {lines} {are} left out"));
        }
    }
    let by = input.keys_by(&options.by);
    let measure = options.metric.map(Measure::from);
    let groups = groups(input.runs, &Options { measure, by, plain: plain_settings, ..Options::default() })?;
    let styles = Styles::of(&groups);
    let charts: Vec<Chart> = if options.tasks {
        groups.iter().flat_map(|group| by_task(group, &styles)).collect()
    } else {
        let chart = |group: &Group| {
            let methods: Vec<_> = group.methods.iter().collect();
            figures::chart(group, &methods, Split::Training, Drawn::MeanAndInterval, &styles)
        };
        groups.iter().map(chart).collect()
    };
    let charts: Vec<Chart> = charts.into_iter().map(|chart| with_options(chart, options)).collect();
    new_file::write("--out", &options.out, chart::curves(&charts)?.as_bytes(), options.force)?;
    Ok(ExitCode::SUCCESS)
}

/// A chart of each task.
fn by_task(group: &Group, styles: &Styles) -> Vec<Chart> {
    let of_task = |task: &String| {
        let alone = Group { training: vec![task.clone()], title: task.clone(), ..group.clone() };
        let methods: Vec<_> = alone.methods.iter().collect();
        figures::chart(&alone, &methods, Split::Training, Drawn::MeanAndInterval, styles)
    };
    group.training.iter().map(of_task).collect()
}

fn with_options(mut chart: Chart, options: &PlotOptions) -> Chart {
    if let Some(title) = &options.title {
        chart.title =
            if chart.title.is_empty() { title.clone() } else { format!("{title}: {}", chart.title) };
    }
    chart.marked = options.line;
    chart
}

impl From<PlotMetric> for Measure {
    fn from(metric: PlotMetric) -> Self {
        match metric {
            PlotMetric::MeanReturn => Self::Return,
            PlotMetric::WinRate => Self::WinRate,
        }
    }
}
