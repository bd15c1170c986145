//! Learning curves: the paper's figures 2 to 5, zero-shot curves, and returns by the size of teams.

use crate::{
    Figure, ReportError, Styles,
    chart::{self, Chart, Line},
    comparison::{Group, Method},
    measure::Measure,
    paper::{FIGURES, PaperFigure},
};
use rit_env::{Split, TaskSet};
use rit_statistics::{Interval, mean, median, standard_deviation, standard_error, t_interval};
use std::collections::BTreeMap;

/// What is drawn of several runs: a line and a band.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drawn {
    /// The mean and its 95 % interval: all that is no figure of the paper.
    MeanAndInterval,
    /// Mean and standard deviation ("we ... plot the mean/std in all figures", section VI-G).
    MeanAndDeviation,
    /// Median and standard error (caption of figure 3).
    MedianAndError,
}

impl Drawn {
    fn centre(self, values: &[f64]) -> f64 {
        match self {
            Self::MeanAndInterval | Self::MeanAndDeviation => mean(values),
            Self::MedianAndError => median(values),
        }
    }

    /// None of fewer than two values.
    fn band(self, values: &[f64]) -> Option<Interval> {
        let about = |reach: Option<f64>| {
            let (centre, reach) = (self.centre(values), reach?);
            Some(Interval { low: centre - reach, high: centre + reach })
        };
        match self {
            Self::MeanAndInterval => t_interval(values),
            Self::MeanAndDeviation => about(standard_deviation(values)),
            Self::MedianAndError => about(standard_error(values)),
        }
    }

    /// `measures` are those of the charts below which it stands.
    fn caption(self, measures: impl IntoIterator<Item = Measure>) -> String {
        let (line, band) = match self {
            Self::MeanAndInterval => ("mean", "95 % intervals of Student's t over seeds"),
            Self::MeanAndDeviation => {
                ("mean", "one standard deviation over seeds to either side, as in the paper")
            }
            Self::MedianAndError => {
                ("median", "one standard error over seeds to either side, as in the paper")
            }
        };
        format!(
            "Lines: {line} over seeds of the mean over tasks, greedy episodes. Bands: {band}; thin lines: single runs, where \
             there are fewer than 5 seeds.{}",
            Measure::ends("Bands", measures)
        )
    }
}

/// The paper's figures 2 to 5 as far as there are runs for them, then the groups that none of them shows.
///
/// # Errors
/// When one cannot be drawn.
pub fn learning_curves(groups: &[Group], styles: &Styles) -> Result<Vec<Figure>, ReportError> {
    let mut figures = Vec::new();
    for figure in &FIGURES {
        let shown = shown(figure, groups);
        let charts: Vec<Chart> = shown
            .iter()
            .map(|(group, methods)| chart(group, methods, Split::Training, figure.drawn, styles))
            .collect();
        if charts.is_empty() {
            continue;
        }
        let there = shown.iter().map(|(group, _)| group.task_set.as_str()).collect::<Vec<_>>();
        let missing: Vec<&str> =
            figure.task_sets.iter().copied().filter(|task_set| !there.contains(task_set)).collect();
        let missing = match (figure.single_task, missing.join(", ")) {
            (false, missing) if !missing.is_empty() => format!(" No finished runs yet: {missing}."),
            _ => String::new(),
        };
        figures.push(Figure {
            id: format!("figure-{}", figure.number),
            title: format!("Figure {} of the paper: {}", figure.number, figure.title),
            caption: format!(
                "{}{missing}",
                figure.drawn.caption(shown.iter().map(|(group, _)| group.measure))
            ),
            svg: chart::curves(&charts)?,
        });
    }
    let covered = |group: &Group| {
        FIGURES.iter().any(|figure| shown(figure, groups).iter().any(|(it, _)| it.id == group.id))
    };
    for group in groups {
        let (id, title, methods) = if covered(group) {
            (
                format!("curves-{}-other-settings", group.id),
                "Learning curves with other settings",
                variants(group),
            )
        } else {
            (format!("curves-{}", group.id), "Learning curves", group.methods.iter().collect())
        };
        if methods.is_empty() {
            continue;
        }
        figures.push(Figure {
            id,
            title: format!("{title}: {}", group.title),
            caption: Drawn::MeanAndInterval.caption([group.measure]),
            svg: chart::curves(&[chart(group, &methods, Split::Training, Drawn::MeanAndInterval, styles)])?,
        });
    }
    Ok(figures)
}

/// The groups and methods of a figure that are there; an ablation needs two methods to show anything.
fn shown<'a>(figure: &PaperFigure, groups: &'a [Group]) -> Vec<(&'a Group, Vec<&'a Method>)> {
    let fits = |group: &&Group| {
        figure.task_sets.contains(&group.task_set.as_str())
            && figure.single_task == (group.training.len() == 1)
    };
    let place = |group: &Group| figure.task_sets.iter().position(|it| *it == group.task_set);
    let mut shown: Vec<_> = groups
        .iter()
        .filter(fits)
        .map(|group| {
            let named = |method: &&Method| figure.methods.contains(&method.label.as_str());
            let all = figure.methods.is_empty();
            let methods = if all { plain(group) } else { group.methods.iter().filter(named).collect() };
            (group, methods)
        })
        .filter(|(_, methods)| methods.len() >= if figure.methods.is_empty() { 1 } else { 2 })
        .collect();
    shown.sort_by_key(|(group, _)| place(group));
    shown
}

/// Methods with the settings that come with the task set; all where there are none such.
fn plain(group: &Group) -> Vec<&Method> {
    let plain: Vec<&Method> = group.methods.iter().filter(|method| !method.is_variant()).collect();
    if plain.is_empty() { group.methods.iter().collect() } else { plain }
}

/// Methods with other settings, which would crowd the paper's figures, beside the first of the others.
fn variants(group: &Group) -> Vec<&Method> {
    let (variants, plain): (Vec<&Method>, Vec<&Method>) =
        group.methods.iter().partition(|method| method.is_variant());
    match plain.first() {
        Some(first) if !variants.is_empty() => [&[*first][..], &variants].concat(),
        _ => Vec::new(),
    }
}

/// Curves on tasks that were never trained on, where they were evaluated on schedule.
///
/// # Errors
/// When it cannot be drawn.
pub fn zero_shot_curves(groups: &[Group], styles: &Styles) -> Result<Option<Figure>, ReportError> {
    let (measures, charts): (Vec<Measure>, Vec<Chart>) = groups
        .iter()
        .map(|group| {
            let methods: Vec<_> = group.methods.iter().collect();
            (group.measure, chart(group, &methods, Split::Testing, Drawn::MeanAndInterval, styles))
        })
        .filter(|(_, chart)| chart.lines.iter().any(|line| line.points.len() > 1))
        .unzip();
    if charts.is_empty() {
        return Ok(None);
    }
    Ok(Some(Figure {
        id: "zero-shot-curves".to_owned(),
        title: "Zero-shot curves: tasks that were never trained on".to_owned(),
        caption: Drawn::MeanAndInterval.caption(measures),
        svg: chart::curves(&charts)?,
    }))
}

/// What methods come to by the number of agents, over training and testing tasks.
///
/// # Errors
/// When it cannot be drawn.
pub fn team_sizes(groups: &[Group], styles: &Styles) -> Result<Option<Figure>, ReportError> {
    let of_group = |group: &Group| Some((group.measure, team_size_chart(group, styles)?));
    let (measures, charts): (Vec<Measure>, Vec<Chart>) = groups.iter().filter_map(of_group).unzip();
    if charts.is_empty() {
        return Ok(None);
    }
    Ok(Some(Figure {
        id: "team-size".to_owned(),
        title: "What methods come to by the number of agents".to_owned(),
        caption: format!(
            "Tasks with as many agents count the same, seen or not. Bands: 95 % intervals of Student's t over seeds; thin \
             lines: single runs, where there are fewer than 5 seeds.{} Returns of other team sizes are sums over other \
             numbers of agents and landmarks: slopes are to be compared, not heights.",
            Measure::ends("Bands", measures)
        ),
        svg: chart::curves(&charts)?,
    }))
}

/// Number of agents of a task.
pub fn team_size(task_set: &str, task: &str) -> Option<usize> {
    Some(task_set.parse::<TaskSet>().ok()?.task(task).ok()?.spec().n_agents)
}

fn team_size_chart(group: &Group, styles: &Styles) -> Option<Chart> {
    let mut sizes: BTreeMap<usize, Vec<(Split, &String)>> = BTreeMap::new();
    for split in [Split::Training, Split::Testing] {
        for task in group.tasks(split) {
            sizes.entry(team_size(&group.task_set, task)?).or_default().push((split, task));
        }
    }
    if sizes.len() < 2 {
        return None;
    }
    let line = |method: &Method| {
        let of_size = |(size, tasks): (&usize, &Vec<(Split, &String)>)| {
            let of_run = |run| {
                let values =
                    tasks.iter().filter_map(|(split, task)| group.measure.at_the_end(run, *split, task));
                mean(&values.collect::<Vec<_>>())
            };
            (*size as f64, method.runs.iter().map(of_run).collect())
        };
        let points = sizes.iter().map(of_size).collect::<Vec<_>>();
        line(method, &points, Drawn::MeanAndInterval, group.measure, styles)
    };
    let seen = |size: &&usize| sizes[size].iter().any(|(split, _)| *split == Split::Training);
    let seen: Vec<String> = sizes.keys().filter(seen).map(ToString::to_string).collect();
    Some(Chart {
        title: group.title.clone(),
        x: format!("agents (trained on: {})", seen.join(", ")),
        y: group.measure.words().to_owned(),
        y_shown: group.measure.range().map_or_else(Vec::new, |range| range.to_vec()),
        lines: group.methods.iter().map(line).collect(),
        ..Chart::default()
    })
}

/// One group's curves, of these methods.
pub fn chart(group: &Group, methods: &[&Method], split: Split, drawn: Drawn, styles: &Styles) -> Chart {
    let of_method = |method: &&Method| {
        let curve = group.curve(method, split);
        let points: Vec<_> = curve.into_iter().map(|(step, values)| (step as f64, values)).collect();
        line(method, &points, drawn, group.measure, styles)
    };
    let over = match group.tasks(split).len() {
        1 => String::new(),
        tasks => format!(", mean of {tasks} tasks"),
    };
    Chart {
        title: group.title.clone(),
        x: "environment steps".to_owned(),
        y: format!("{}{over}", group.measure.words()),
        y_shown: group.measure.range().map_or_else(Vec::new, |range| range.to_vec()),
        lines: methods.iter().map(of_method).collect(),
        ..Chart::default()
    }
}

/// A line of several runs, with its band or, where there are too few for one, the runs themselves.
fn line(
    method: &Method,
    points: &[(f64, Vec<f64>)],
    drawn: Drawn,
    measure: Measure,
    styles: &Styles,
) -> Line {
    let reliable = method.is_reliable();
    let ends = |(x, values): &(f64, Vec<f64>)| {
        drawn.band(values).map(|it| measure.possible(it)).map(|it| (*x, it.low, it.high))
    };
    let run = |at: usize| points.iter().map(move |(x, values)| (*x, values[at])).collect();
    Line {
        key: styles.key(&method.label),
        band: if reliable { points.iter().filter_map(ends).collect() } else { Vec::new() },
        runs: match method.runs.len() {
            runs if reliable || runs < 2 => Vec::new(),
            runs => (0..runs).map(run).collect(),
        },
        points: points.iter().map(|(x, values)| (*x, drawn.centre(values))).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_and_bands_are_what_the_caption_says() {
        // Mean 3, deviation √7, error √(7/3); median 2; t(2) for 95 % is 4.3027.
        let values = [6.0, 1.0, 2.0];
        let drawn = |drawn: Drawn| {
            let band = drawn.band(&values).unwrap();
            [drawn.centre(&values), band.low, band.high].map(|it| (it * 1000.0).round() / 1000.0)
        };
        assert_eq!(drawn(Drawn::MeanAndDeviation), [3.0, 0.354, 5.646]);
        assert_eq!(drawn(Drawn::MedianAndError), [2.0, 0.472, 3.528]);
        assert_eq!(drawn(Drawn::MeanAndInterval), [3.0, -3.572, 9.572]);
        assert!(Drawn::MedianAndError.caption([]).starts_with("Lines: median over seeds"));
        assert!(Drawn::MeanAndDeviation.band(&[1.0]).is_none());
    }

    /// Five win rates, mean 0.9, deviation √(0.2/4) = 0.2236, error 0.1, t(4) = 2.7764: 0.9 ± 0.2776.
    #[test]
    fn no_band_of_win_rates_reaches_beyond_what_a_win_rate_can_be() {
        let values = [1.0, 1.0, 1.0, 1.0, 0.5];
        let method = Method { label: "a".to_owned(), runs: vec![rit_record::Record::default(); 5] };
        let band = |drawn, measure| {
            let line = line(&method, &[(7.0, values.to_vec())], drawn, measure, &Styles::default());
            let (x, low, high) = line.band[0];
            [x, low, high].map(|it| (it * 1000.0).round() / 1000.0)
        };
        assert_eq!(band(Drawn::MeanAndInterval, Measure::Return), [7.0, 0.622, 1.178]);
        assert_eq!(band(Drawn::MeanAndInterval, Measure::WinRate), [7.0, 0.622, 1.0]);
        assert_eq!(band(Drawn::MeanAndDeviation, Measure::WinRate), [7.0, 0.676, 1.0]);
        let caption = Drawn::MeanAndInterval.caption([Measure::Return, Measure::WinRate]);
        assert!(caption.ends_with("Bands of win rates end at 0 and 1, beyond which no win rate lies."));
        assert!(!Drawn::MeanAndInterval.caption([Measure::Return]).contains("win rate"));
    }
}
