//! Utilities beside Shapley values: what the paper claims (proposition 1) and does not check.

use crate::{
    Figure, ReportError, Section, Table,
    chart::{self, Chart, Key, Line, Scatter},
    comparison::{Group, Method},
    signed,
};
use rit_record::{Record, Shapley};

/// From this correlation within steps on, and up to this share of the values' mean size, utilities are said to approximate
/// Shapley values.
const CORRELATION_MIN: f64 = 0.9;
const ERROR_SHARE_MAX: f64 = 0.25;

/// Whose comparison it is.
struct Of<'a> {
    group: &'a Group,
    method: &'a Method,
    run: &'a Record,
    found: &'a Shapley,
}

impl Of<'_> {
    fn words(&self) -> String {
        let seed = self.run.seed.map_or_else(String::new, |seed| format!(", seed {seed}"));
        format!("{}: {}{seed}", self.group.title, self.method.label)
    }

    fn row(&self, cells: impl IntoIterator<Item = String>) -> Vec<String> {
        [self.words(), self.found.task.clone()].into_iter().chain(cells).collect()
    }
}

/// The part of a report on every comparison that was kept with a run.
///
/// # Errors
/// When a figure cannot be drawn.
pub fn section(groups: &[Group]) -> Result<Section, ReportError> {
    let all: Vec<Of> = groups
        .iter()
        .flat_map(|group| group.methods.iter().map(move |method| (group, method)))
        .flat_map(|(group, method)| method.runs.iter().map(move |run| (group, method, run)))
        .flat_map(|(group, method, run)| {
            run.shapley.iter().map(move |found| Of { group, method, run, found })
        })
        .collect();
    let mut section = Section::new("shapley", "Utilities and Shapley values");
    if all.is_empty() {
        return Ok(section);
    }
    section.text.push(verdict(&all));
    section.text.extend(all.iter().map(sentence));
    section.tables = vec![correlations(&all), estimates(&all), residuals(&all), symmetry(&all)];
    for (at, of) in all.iter().enumerate() {
        section.figures.push(Figure {
            id: format!("shapley-{}", at + 1),
            title: format!("Utilities against Shapley values. {}, {}", of.words(), of.found.task),
            caption: "One point for each agent and step (at most 500 of each game, spread evenly); on the dashed diagonal \
                      both are the same. Right: mean absolute error of equation 10's estimate with M decision orders."
                .to_owned(),
            svg: figure(of.found)?,
        });
    }
    Ok(section)
}

/// Utilities against the Shapley values of both games, and the error against M.
///
/// # Errors
/// When it cannot be drawn.
pub fn figure(found: &Shapley) -> Result<String, ReportError> {
    let key = |label: &str, style| Key { label: label.to_owned(), style };
    let scatter = |title: &str, places: &[[f64; 2]], style| Scatter {
        title: title.to_owned(),
        x: "Shapley value".to_owned(),
        y: "utility (M = 1)".to_owned(),
        key: key(title, style),
        places: places.to_vec(),
    };
    let scatters = [
        scatter("learned game", &found.points, 0),
        scatter("the environment's own game", &found.own_points, 3),
    ];
    let points = found.estimates.iter().map(|it| (it.orders as f64, it.mean_error)).collect();
    let error = Chart {
        title: "Equation 10 with M orders".to_owned(),
        x: "M".to_owned(),
        y: "mean |estimate − Shapley value|".to_owned(),
        y_shown: vec![0.0],
        lines: vec![Line { key: key(&found.method, 13), points, band: Vec::new(), runs: Vec::new() }],
        ..Chart::default()
    };
    chart::scatters(&scatters, &[error])
}

/// Whether utilities are close to Shapley values: with the most orders that were averaged over, or with one.
fn holds(found: &Shapley) -> bool {
    let within = found.within_steps_learned.is_some_and(|it| it >= CORRELATION_MIN);
    within && found.estimates.iter().any(|it| it.mean_error <= ERROR_SHARE_MAX * found.mean_shapley)
}

fn verdict(all: &[Of]) -> String {
    let held = all.iter().filter(|of| holds(of.found)).count();
    let (count, runs) = (all.len(), if all.len() == 1 { "comparison" } else { "comparisons" });
    let came_out = match held {
        0 => format!("In none of {count} {runs} do they"),
        _ if held == count => format!("In all of {count} {runs} they do"),
        _ => format!("They do in {held} of {count} {runs}"),
    };
    format!(
        "The paper says (proposition 1) that utilities approximate Shapley values. {came_out}: they are said to where their \
         correlation with exact Shapley values within a step is at least {CORRELATION_MIN} and their mean error at most {:.0} % \
         of the values' mean size.",
        100.0 * ERROR_SHARE_MAX
    )
}

/// What came of one comparison.
fn sentence(of: &Of) -> String {
    let found = of.found;
    let number = |value: Option<f64>| value.map_or_else(|| "no number".to_owned(), |it| signed(it, 2));
    let weights = match &of.run.weights_digest {
        Some(digest) if *digest == found.weights_digest => "the final weights".to_owned(),
        _ => format!("weights {}", found.weights_digest.get(..12).unwrap_or("of a checkpoint")),
    };
    let error = found.estimates.first().map_or(f64::NAN, |it| it.mean_error);
    format!(
        "{}, {} ({weights}, {} greedy episodes, {} steps): the correlation with the learned game's Shapley values is {} over \
         all steps and agents and {} within a step; with those of the environment's own game {} and {}. The mean error is {} \
         where a Shapley value's mean size is {}.",
        of.words(),
        found.task,
        found.episodes,
        found.steps,
        number(found.utilities_learned),
        number(found.within_steps_learned),
        number(found.utilities_own),
        number(found.within_steps_own),
        signed(error, 3),
        signed(found.mean_shapley, 3),
    )
}

fn table(id: &str, title: &str, head: &[&str], rows: Vec<Vec<String>>, note: &str) -> Table {
    let head = ["run", "task"].iter().chain(head).map(|it| (*it).to_owned()).collect();
    Table {
        id: id.to_owned(),
        title: title.to_owned(),
        head,
        rows,
        note: note.to_owned(),
        ..Table::default()
    }
}

fn correlations(all: &[Of]) -> Table {
    let number = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |it| signed(it, 2));
    let row = |of: &Of| {
        let found = of.found;
        let values = [
            found.utilities_learned,
            found.within_steps_learned,
            found.utilities_own,
            found.within_steps_own,
            found.learned_own,
        ];
        let counts = [found.agents, found.steps, found.rolled_steps].map(|count| count.to_string());
        of.row(counts.into_iter().chain(values.map(number)))
    };
    table(
        "shapley-correlations",
        "Correlation of utilities with exact Shapley values",
        &[
            "agents",
            "steps",
            "rolled",
            "learned game",
            "within a step",
            "environment's own",
            "within a step",
            "both games",
        ],
        all.iter().map(row).collect(),
        "Pearson's correlation over agents and steps; within a step: with each step's mean over agents taken off both sides, \
         which leaves which agent counts for more. The value of a coalition: its members do what they did, all others the \
         first action that is available to them; Q_total of that (the learned game), or the return from there on as the \
         episode goes on greedily (the environment's own, at the rolled steps). Both games: Shapley values of the one with \
         those of the other.",
    )
}

fn estimates(all: &[Of]) -> Table {
    let orders: std::collections::BTreeSet<usize> =
        all.iter().flat_map(|of| of.found.estimates.iter().map(|it| it.orders)).collect();
    let row = |of: &Of| {
        let of_orders = |orders: &usize| {
            let found = of.found.estimates.iter().find(|it| it.orders == *orders);
            found.map_or_else(
                || "–".to_owned(),
                |it| {
                    let correlation =
                        it.correlation.map_or_else(String::new, |it| format!(" ({})", signed(it, 2)));
                    format!("{}{correlation}", signed(it.mean_error, 3))
                },
            )
        };
        of.row([signed(of.found.mean_shapley, 3)].into_iter().chain(orders.iter().map(of_orders)))
    };
    let names: Vec<String> = orders.iter().map(|orders| format!("M = {orders}")).collect();
    let head: Vec<&str> = ["mean |φ|"].into_iter().chain(names.iter().map(String::as_str)).collect();
    table(
        "shapley-estimates",
        "Error of equation 10's estimate by the number of decision orders",
        &head,
        all.iter().map(row).collect(),
        "Mean absolute difference from the learned game's Shapley values φ; in parentheses the correlation with them.",
    )
}

fn residuals(all: &[Of]) -> Table {
    let row = |of: &Of| {
        of.found
            .efficiency
            .iter()
            .map(|it| {
                of.row([it.sum.clone(), it.of.clone(), signed(it.mean_error, 3), signed(it.mean_size, 3)])
            })
            .collect::<Vec<_>>()
    };
    table(
        "shapley-efficiency",
        "Efficiency (lemma 1): what sums over agents miss",
        &["sum of", "against", "mean error", "mean size"],
        all.iter().flat_map(row).collect(),
        "Over steps: mean absolute difference of the sum from what it is held against, and the mean absolute value of that.",
    )
}

fn symmetry(all: &[Of]) -> Table {
    let row = |of: &Of| {
        let it = &of.found.symmetry;
        let cells = if it.pairs == 0 {
            ["–"; 3].map(str::to_owned)
        } else {
            [it.shapley, it.utilities, it.averaged].map(|value| signed(value, 3))
        };
        of.row([it.pairs.to_string()].into_iter().chain(cells))
    };
    table(
        "shapley-symmetry",
        "Symmetric agents",
        &["pairs", "Shapley values", "utilities", "mean over orders"],
        all.iter().map(row).collect(),
        "Pairs of agents whose contributions to every coalition differ by at most 5 % of what the whole team's actions are \
         worth at the step; mean absolute difference between the two, which should be small.",
    )
}
