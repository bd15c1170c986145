//! Over tasks: normalised scores, their aggregates, profiles, probabilities of improvement and curves.

use crate::{
    Figure, Options, ReportError, Styles,
    chart::{self, Chart, Line, Row, Rows},
    comparison::{Group, Method},
    measure::{Measure, signed},
    table::Table,
};
use rit_env::Split;
use rit_episode::{Rng, RunSeed, Stream};
use rit_record::Record;
use rit_statistics::{self as statistics, Estimate, SEEDS_MIN, Scores, Spans};

/// Replications where a whole curve is estimated, as in rliable.
const CURVE_REPLICATIONS: usize = 2000;
/// Thresholds of a performance profile.
const THRESHOLDS: usize = 101;
/// Most points of a curve whose intervals are estimated.
const POINTS_MAX: usize = 60;

/// What stands below a table of methods with so many runs each, where some are few.
fn few(runs: impl IntoIterator<Item = usize>) -> &'static str {
    match runs.into_iter().min() {
        Some(1) => {
            " † fewer than 5 seeds: the interval is not reliable, and figures show the runs instead; a single run has no \
             interval."
        }
        Some(runs) if runs < SEEDS_MIN => {
            " † fewer than 5 seeds: the interval is not reliable, and figures show the runs instead."
        }
        _ => "",
    }
}

/// Scores of methods on the same tasks, from 0 to 1.
#[derive(Debug)]
pub struct Scored {
    /// Part of files' names.
    id: String,
    title: String,
    /// What 0 and 1 mean.
    scale: String,
    /// Each method's scores, `[run][task]`.
    methods: Vec<(String, Vec<Vec<f64>>)>,
    /// By environment steps: the same for each method.
    curve: Vec<(u64, Vec<Scores>)>,
}

/// The scores of a group on the tasks of a split; none where there is none.
pub fn scored(group: &Group, split: Split) -> Option<Scored> {
    let (tasks, measure) = (group.tasks(split), group.measure);
    let of_run = |run: &Record| {
        tasks.iter().map(|task| measure.absolute(run, split, task)).collect::<Option<Vec<f64>>>()
    };
    let rows = |method: &Method| method.runs.iter().map(of_run).collect::<Option<Vec<_>>>();
    let rows: Vec<Vec<Vec<f64>>> = group.methods.iter().map(rows).collect::<Option<_>>()?;
    let ends: Vec<Scores> = rows.iter().map(|rows| Scores::new(rows)).collect::<Option<_>>()?;
    let curve = curve(group, split);
    let spans = Spans::of(ends.iter().chain(curve.iter().flat_map(|(_, scores)| scores)));
    let scale = |scores: &Scores| match measure {
        Measure::Return => spans.normalise(scores),
        // It lies between 0 and 1 as it is.
        Measure::WinRate => scores.clone(),
    };
    let rows_of = |scores: &Scores| {
        (0..scores.runs()).map(|run| scores.tasks().map(|task| task[run]).collect()).collect()
    };
    let methods = group.methods.iter().zip(&ends);
    let words = match split {
        Split::Training => "training tasks",
        Split::Testing => "unseen tasks",
    };
    Some(Scored {
        id: format!("{}-{}", group.id, if split == Split::Training { "training" } else { "unseen" }),
        title: format!("{}, {} {words}", group.title, tasks.len()),
        scale: match measure {
            Measure::Return => {
                "Returns are normalised task by task: 0 is the lowest mean that any evaluation of any \
                                run in this report had on the task, 1 the highest."
                    .to_owned()
            }
            Measure::WinRate => "Win rates are scores as they are.".to_owned(),
        },
        methods: methods.map(|(method, scores)| (method.label.clone(), rows_of(&scale(scores)))).collect(),
        curve: curve
            .iter()
            .map(|(env_steps, scores)| (*env_steps, scores.iter().map(scale).collect()))
            .collect(),
    })
}

/// The scores at the steps at which every run of every method was evaluated.
fn curve(group: &Group, split: Split) -> Vec<(u64, Vec<Scores>)> {
    let curves: Vec<_> = group.methods.iter().map(|method| group.curves(method, split)).collect();
    let mut all = curves.iter().flatten();
    let Some(first) = all.next() else { return Vec::new() };
    let rest: Vec<_> = all.collect();
    let common = first.keys().filter(|step| rest.iter().all(|curve| curve.contains_key(step)));
    let at = |step: &u64| {
        let of_method = |curves: &Vec<std::collections::BTreeMap<u64, Vec<f64>>>| {
            Scores::new(&curves.iter().map(|curve| curve[step].clone()).collect::<Vec<_>>())
        };
        Some((*step, curves.iter().map(of_method).collect::<Option<Vec<_>>>()?))
    };
    common.filter_map(at).collect()
}

/// Scores over several groups at once, of the methods that are in all of them; none of fewer than two groups or methods,
/// which would compare nothing. Where a method has more seeds in one group than in another, the first ones count.
pub fn joined(all: &[Scored]) -> Option<Scored> {
    let (first, rest) = all.split_first().filter(|(_, rest)| !rest.is_empty())?;
    let rows_in = |scored: &'_ Scored, label: &str| {
        scored.methods.iter().find(|(name, _)| name == label).map(|(_, rows)| rows.clone())
    };
    let method = |(label, rows): &(String, Vec<Vec<f64>>)| {
        let others: Vec<_> = rest.iter().map(|scored| rows_in(scored, label)).collect::<Option<_>>()?;
        let runs = others.iter().map(Vec::len).fold(rows.len(), usize::min);
        let row = |run: usize| {
            let others = others.iter().flat_map(|rows| rows[run].iter().copied());
            rows[run].iter().copied().chain(others).collect()
        };
        Some((label.clone(), (0..runs).map(row).collect::<Vec<_>>()))
    };
    let methods: Vec<_> = first.methods.iter().filter_map(method).collect();
    let kind = first.id.rsplit('-').next().unwrap_or_default();
    let mut scales: Vec<&str> = Vec::new();
    for scored in all {
        if !scales.contains(&scored.scale.as_str()) {
            scales.push(&scored.scale);
        }
    }
    (methods.len() > 1).then(|| Scored {
        id: format!("all-{kind}"),
        title: format!("All {} task sets with these methods, {kind} tasks", all.len()),
        scale: scales.join(" "),
        methods,
        curve: Vec::new(),
    })
}

impl Scored {
    fn scores(&self) -> impl Iterator<Item = (&String, Scores)> {
        self.methods.iter().filter_map(|(label, rows)| Some((label, Scores::new(rows)?)))
    }

    fn rng(&self, options: &Options, label: &str, what: u64) -> Rng {
        RunSeed(options.seed).derive(&format!("{} {label}", self.id), what).stream(Stream::Resampling, 0)
    }

    /// Interquartile mean, median, mean and optimality gap.
    ///
    /// # Errors
    /// When the figure cannot be drawn.
    pub fn aggregates(&self, options: &Options, styles: &Styles) -> Result<(Table, Figure), ReportError> {
        let names = ["IQM", "median", "mean", "optimality gap"];
        let mut table = Table {
            id: format!("aggregates-{}", self.id),
            title: format!("Aggregates over tasks: {}", self.title),
            head: ["method"].into_iter().chain(names).chain(["seeds"]).map(str::to_owned).collect(),
            rows: Vec::new(),
            note: format!(
                "{} In brackets: 95 % intervals of the stratified bootstrap, {} replications, seed {}.",
                self.scale, options.replications, options.seed
            ),
            ..Table::default()
        };
        let mut charts = names.map(|name| Rows {
            title: name.to_owned(),
            rows: Vec::new(),
            line: None,
            shown: Vec::new(),
        });
        for (label, scores) in self.scores() {
            let mut rng = self.rng(options, label, 0);
            let found = statistics::aggregates(&scores, options.replications, &mut rng);
            let found = [found.iqm, found.median, found.mean, found.optimality_gap];
            let reliable = scores.runs() >= SEEDS_MIN;
            let cells = found.iter().map(|estimate| cell(estimate, scores.runs()));
            let seeds = scores.runs().to_string();
            table.rows.push([label.clone()].into_iter().chain(cells).chain([seeds]).collect());
            let each: Vec<Scores> = runs_alone(&scores);
            let of_run = |at: usize| {
                let value = |run: &Scores| match at {
                    0 => statistics::interquartile_mean(&mut run.all().to_vec()),
                    1 => run.median(),
                    2 => run.mean(),
                    _ => run.optimality_gap(),
                };
                each.iter().map(value).collect()
            };
            for (at, (chart, estimate)) in charts.iter_mut().zip(&found).enumerate() {
                chart.rows.push(Row {
                    key: styles.key(label),
                    value: estimate.value,
                    interval: reliable.then_some((estimate.interval.low, estimate.interval.high)),
                    runs: if reliable { Vec::new() } else { of_run(at) },
                });
            }
        }
        table.note += few(self.methods.iter().map(|(_, runs)| runs.len()));
        let figure = Figure {
            id: table.id.clone(),
            title: table.title.clone(),
            caption: "Higher is better, but for the optimality gap. Bars: 95 % intervals; dots: single runs, where there \
                      are fewer than 5 seeds."
                .to_owned(),
            svg: chart::rows(&charts)?,
        };
        Ok((table, figure))
    }

    /// Which share of scores lies above each threshold.
    ///
    /// # Errors
    /// When the figure cannot be drawn.
    pub fn profile(&self, options: &Options, styles: &Styles) -> Result<Figure, ReportError> {
        let thresholds: Vec<f64> = (0..THRESHOLDS).map(|at| at as f64 / (THRESHOLDS - 1) as f64).collect();
        let lines = self.scores().map(|(label, scores)| {
            let mut rng = self.rng(options, label, 1);
            let found = statistics::profile(&scores, &thresholds, CURVE_REPLICATIONS, &mut rng);
            let points: Vec<_> = thresholds.iter().copied().zip(found).collect();
            estimated(styles, label, &points, scores.runs())
        });
        let chart = Chart {
            x: "score τ".to_owned(),
            y: "share of runs and tasks above τ".to_owned(),
            y_limits: Some([0.0, 1.0]),
            lines: lines.collect(),
            ..Chart::default()
        };
        Ok(Figure {
            id: format!("performance-profile-{}", self.id),
            title: format!("Performance profiles: {}", self.title),
            caption: format!(
                "A curve above another everywhere is better. Bands: 95 % intervals of the stratified bootstrap, \
                 {CURVE_REPLICATIONS} replications, where there are 5 seeds or more."
            ),
            svg: chart::curves(&[chart])?,
        })
    }

    /// How probably one method's run is better than another's.
    ///
    /// # Errors
    /// When a pair names no method, or the figure cannot be drawn.
    pub fn improvement(
        &self,
        options: &Options,
        styles: &Styles,
    ) -> Result<Option<(Table, Figure)>, ReportError> {
        let scores: Vec<(&String, Scores)> = self.scores().collect();
        let pairs = pairs(&scores, options);
        if pairs.is_empty() {
            return Ok(None);
        }
        let mut table = Table {
            id: format!("probability-of-improvement-{}", self.id),
            title: format!("Probability of improvement: {}", self.title),
            head: ["X", "Y", "P(X > Y)"].map(str::to_owned).to_vec(),
            rows: Vec::new(),
            note: format!(
                "How probably a run of X scores higher than one of Y on a task picked at random; a draw counts half. In \
                 brackets: 95 % intervals of the stratified bootstrap, {CURVE_REPLICATIONS} replications."
            ),
            ..Table::default()
        };
        let (mut rows, mut fewest) = (Vec::new(), Vec::new());
        for (x, y) in pairs {
            let mut rng = self.rng(options, &format!("{} {}", x.0, y.0), 2);
            let found = statistics::improvement_estimate(&x.1, &y.1, CURVE_REPLICATIONS, &mut rng);
            let runs = x.1.runs().min(y.1.runs());
            table.rows.push(vec![x.0.clone(), y.0.clone(), cell(&found, runs)]);
            let mut key = styles.key(y.0);
            key.label = format!("{} > {}", x.0, y.0);
            let interval = (runs >= SEEDS_MIN).then_some((found.interval.low, found.interval.high));
            fewest.push(runs);
            rows.push(Row { key, value: found.value, interval, runs: Vec::new() });
        }
        table.note += few(fewest);
        let chart = Rows { title: "P(X > Y)".to_owned(), rows, line: Some(0.5), shown: vec![0.0, 1.0] };
        let figure = Figure {
            id: table.id.clone(),
            title: table.title.clone(),
            caption: "Right of the dashed line X is better more often than not.".to_owned(),
            svg: chart::rows(&[chart])?,
        };
        Ok(Some((table, figure)))
    }

    /// The interquartile mean over environment steps; none where too little was measured.
    ///
    /// # Errors
    /// When the figure cannot be drawn.
    pub fn sample_efficiency(
        &self,
        options: &Options,
        styles: &Styles,
    ) -> Result<Option<Figure>, ReportError> {
        if self.curve.len() < 2 {
            return Ok(None);
        }
        let every = self.curve.len().div_ceil(POINTS_MAX);
        let last = self.curve.len() - 1;
        let points: Vec<_> = self
            .curve
            .iter()
            .enumerate()
            .filter(|(at, _)| (last - at).is_multiple_of(every))
            .map(|(_, it)| it)
            .collect();
        let lines = self.methods.iter().enumerate().map(|(method, (label, rows))| {
            let mut rng = self.rng(options, label, 3);
            let point = |(step, scores): &&(u64, Vec<Scores>)| {
                (*step as f64, statistics::iqm(&scores[method], CURVE_REPLICATIONS, &mut rng))
            };
            let points: Vec<_> = points.iter().map(point).collect();
            estimated(styles, label, &points, rows.len())
        });
        let chart = Chart {
            x: "environment steps".to_owned(),
            y: "IQM of scores".to_owned(),
            lines: lines.collect(),
            ..Chart::default()
        };
        Ok(Some(Figure {
            id: format!("sample-efficiency-{}", self.id),
            title: format!("Sample efficiency: {}", self.title),
            caption: format!(
                "The interquartile mean of scores over tasks and runs, after so many environment steps. Bands: 95 % \
                 intervals of the stratified bootstrap, {CURVE_REPLICATIONS} replications, where there are 5 seeds or more."
            ),
            svg: chart::curves(&[chart])?,
        }))
    }
}

type Named<'a> = (&'a String, Scores);

/// The pairs asked for that are there; of none asked for, the first method against each other.
fn pairs<'a, 'b>(scores: &'b [Named<'a>], options: &Options) -> Vec<(&'b Named<'a>, &'b Named<'a>)> {
    if options.pairs.is_empty() {
        let Some((first, rest)) = scores.split_first() else { return Vec::new() };
        return rest.iter().map(|other| (first, other)).collect();
    }
    let named = |name: &String| scores.iter().find(|(label, _)| *label == name);
    options.pairs.iter().filter_map(|(x, y)| Some((named(x)?, named(y)?))).collect()
}

/// Each run as if there were no other.
fn runs_alone(scores: &Scores) -> Vec<Scores> {
    let of_run = |run: usize| Scores::new(&[scores.tasks().map(|task| task[run]).collect()]);
    (0..scores.runs()).filter_map(of_run).collect()
}

fn estimated(styles: &Styles, label: &str, points: &[(f64, Estimate)], runs: usize) -> Line {
    let band = points.iter().map(|(x, it)| (*x, it.interval.low, it.interval.high));
    Line {
        key: styles.key(label),
        band: if runs >= SEEDS_MIN { band.collect() } else { Vec::new() },
        points: points.iter().map(|(x, it)| (*x, it.value)).collect(),
        runs: Vec::new(),
    }
}

/// A value and its interval; resampling a single run gives none.
fn cell(Estimate { value, interval }: &Estimate, runs: usize) -> String {
    let [value, low, high] = [*value, interval.low, interval.high].map(|number| signed(number, 3));
    match runs {
        1 => value,
        runs if runs < SEEDS_MIN => format!("{value} [{low}, {high}]†"),
        _ => format!("{value} [{low}, {high}]"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_run_has_no_interval_and_few_have_one_that_is_marked() {
        let estimate = Estimate { value: 0.5, interval: rit_statistics::Interval { low: -0.25, high: 0.75 } };
        let cells = [1, 4, 5].map(|runs| cell(&estimate, runs));
        assert_eq!(cells, ["0.500", "0.500 [−0.250, 0.750]†", "0.500 [−0.250, 0.750]"]);
        assert!(few([5, 1]).ends_with("a single run has no interval.") && few([5, 4]).contains('†'));
        assert_eq!(few([5, 7]), "");
    }

    #[test]
    fn scores_over_groups_are_of_methods_that_all_have_and_each_scale_is_said_once() {
        let scored = |id: &str, scale: &str, methods: &[(&str, f64)]| Scored {
            id: format!("{id}-training"),
            title: String::new(),
            scale: scale.to_owned(),
            methods: methods.iter().map(|(name, score)| ((*name).to_owned(), vec![vec![*score]])).collect(),
            curve: Vec::new(),
        };
        let wins = scored("a", "Wins.", &[("rit", 0.25), ("mat", 0.5), ("roma", 0.0)]);
        let returns = scored("b", "Returns.", &[("rit", 0.75), ("mat", 1.0)]);
        let more = scored("c", "Returns.", &[("mat", 0.0), ("rit", 0.5)]);
        let joined = joined(&[wins, returns, more]).unwrap();
        assert_eq!((joined.scale.as_str(), joined.id.as_str()), ("Wins. Returns.", "all-training"));
        let expected = [("rit", [0.25, 0.75, 0.5]), ("mat", [0.5, 1.0, 0.0])];
        let expected = expected.map(|(name, scores)| (name.to_owned(), vec![scores.to_vec()]));
        assert_eq!(joined.methods, expected);
        let alone = |id: &str| scored(id, "", &[("rit", 1.0)]);
        assert!(super::joined(&[alone("a"), alone("b")]).is_none(), "one method is no comparison");
    }
}
