//! Tables of results: the paper's III to V with ours beside them, task by task, the gap to unseen tasks, and how runs vary.

use crate::{
    comparison::{Group, Method, Options, Settings, of_presets},
    measure::{Measure, signed},
    paper::{self, PaperTable, TABLES},
    table::Table,
};
use rit_env::Split;
use rit_record::Record;
use rit_statistics::{generalisation_gap, mean, percentile, standard_error, t_interval};
use std::collections::BTreeSet;

/// The percentiles that say how runs vary.
const PERCENTILES: [f64; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

/// The paper's tables for which there is a run.
pub fn of_the_paper(groups: &[Group], options: &Options) -> Vec<Table> {
    TABLES.iter().filter_map(|table| beside_ours(table, groups, options)).collect()
}

fn beside_ours(table: &PaperTable, groups: &[Group], options: &Options) -> Option<Table> {
    let group_of = |task_set: &str| {
        groups
            .iter()
            .find(|group| group.task_set == task_set && !group.testing.is_empty() && group.training.len() > 1)
    };
    let columns: Vec<_> =
        table.columns.iter().map(|(task_set, rows)| (*task_set, *rows, group_of(task_set))).collect();
    let ours = |group: Option<&Group>, label: &str| {
        let group = group?;
        let method = group.methods.iter().find(|method| method.label == label)?;
        let scores = group.scores(method, Split::Testing);
        (!scores.is_empty()).then_some((group.measure, scores))
    };
    let is_there = |label: &&str| columns.iter().any(|(_, _, group)| ours(*group, label).is_some());
    if !table.methods.iter().any(is_there) {
        return None;
    }
    let head = |&(task_set, ..): &(&str, _, _)| {
        let title = paper::title(task_set);
        [format!("{title}: paper"), format!("{title}: ours")]
    };
    let row = |label: &&'static str| {
        let cells = columns.iter().flat_map(|(task_set, rows, group)| {
            let theirs = rows.iter().find(|row| row.0 == *label).map(|row| (row.1, row.2));
            let measure = Measure::of_task_set(task_set);
            let paper = theirs.map_or_else(
                || "–".to_owned(),
                |(mean, error)| format!("{} ± {}", measure.number(mean), measure.number(error)),
            );
            // What another measure than the paper's came to stands beside nothing.
            let ours = ours(*group, label).filter(|(used, _)| *used == measure);
            [paper, ours.map_or_else(|| "–".to_owned(), |(_, scores)| our_cell(measure, &scores, theirs))]
        });
        [(*label).to_owned()].into_iter().chain(cells).collect()
    };
    let number = ["III", "IV", "V"].iter().position(|it| *it == table.number).unwrap_or(0) + 3;
    Some(Table {
        id: format!("table-{number}"),
        title: format!("Table {} of the paper: {}", table.number, table.title),
        head: ["method".to_owned()].into_iter().chain(columns.iter().flat_map(head)).collect(),
        rows: table.methods.iter().map(row).collect(),
        note: format!(
            "Mean ± standard error over seeds of the mean over unseen tasks (paper: five seeds); in parentheses our number of \
             seeds. ▲ or ▼: ours is higher or lower by more than both errors together; of a single seed there is no error and \
             no mark. Variants, whose names say what was set, stand in the tables by task below.{}",
            departures(&columns.iter().filter_map(|(_, _, group)| *group).collect::<Vec<_>>(), options)
        ),
        ..Table::default()
    })
}

/// Where our runs are not what the paper's were, as far as that is known: a plain method's settings that are not those of the
/// paper's tables, and games that are played elsewhere.
fn departures(groups: &[&Group], options: &Options) -> String {
    let mut words = String::new();
    for group in groups {
        let of = |settings: fn(&str, &str) -> Option<Settings>| {
            settings(&group.task_set, "rit").unwrap_or_default()
        };
        let (plain, presets) = (of(options.plain), of(of_presets));
        // Runs of every length go by their method's plain name.
        let runs = group.methods.iter().flat_map(|method| &method.runs);
        let lengths = runs.filter_map(|run| run.settings.get_key_value("training.t_max"));
        let differing: BTreeSet<String> = plain
            .iter()
            .chain(lengths)
            .filter_map(|(key, value)| {
                Some((key, value, presets.get(key).filter(|preset| *preset != value)?))
            })
            .map(|(key, value, preset)| format!("{key} = {value} in place of {preset}"))
            .collect();
        if !differing.is_empty() {
            let differing = Vec::from_iter(differing).join(", ");
            words += &format!(" {}, ours: {differing}.", group.title);
        }
    }
    let in_game = |run: &Record| run.settings.get("environment.backend").is_some_and(|it| it == "starcraft");
    let elsewhere = |group: &&&Group| {
        paper::is_combat(&group.task_set)
            && group.methods.iter().flat_map(|method| &method.runs).any(|run| !in_game(run))
    };
    if groups.iter().any(|group| elsewhere(&group)) {
        words += " Our battles were played in a simulator and the paper's in StarCraft II: their win rates are not comparable.";
    }
    words
}

fn our_cell(measure: Measure, scores: &[f64], paper: Option<(f64, f64)>) -> String {
    let (ours, error) = (mean(scores), standard_error(scores));
    let mark = match (paper, error) {
        (Some((theirs, their_error)), Some(error)) if (ours - theirs).abs() > error + their_error => {
            if ours > theirs { " ▲" } else { " ▼" }
        }
        _ => "",
    };
    let error = error.map_or_else(String::new, |error| format!(" ± {}", measure.number(error)));
    format!("{}{error} ({}){mark}", measure.number(ours), scores.len())
}

/// Each task of a group: mean and interval over seeds.
pub fn by_task(group: &Group) -> Table {
    let tasks = |split: Split| group.tasks(split).iter().map(move |task| (split, task));
    let tasks: Vec<_> = tasks(Split::Training).chain(tasks(Split::Testing)).collect();
    let name = |(split, task): &(Split, &String)| {
        format!("{task}{}", if *split == Split::Testing { " (unseen)" } else { "" })
    };
    let cell = |method: &Method, (split, task): &(Split, &String)| {
        let values = group.scores_of_task(method, *split, task);
        interval_cell(group.measure, group.measure.range(), &values)
    };
    let method_name = |method: &Method| format!("{} ({})", method.label, method.runs.len());
    // What there is less of lies side by side.
    let (head, rows): (Vec<String>, Vec<Vec<String>>) = if tasks.len() <= group.methods.len().max(8) {
        let row = |method: &Method| {
            [method_name(method)].into_iter().chain(tasks.iter().map(|task| cell(method, task))).collect()
        };
        (
            ["method".to_owned()].into_iter().chain(tasks.iter().map(name)).collect(),
            group.methods.iter().map(row).collect(),
        )
    } else {
        let row = |task: &(Split, &String)| {
            [name(task)].into_iter().chain(group.methods.iter().map(|method| cell(method, task))).collect()
        };
        (
            ["task".to_owned()].into_iter().chain(group.methods.iter().map(method_name)).collect(),
            tasks.iter().map(row).collect(),
        )
    };
    Table {
        id: format!("tasks-{}", group.id),
        title: format!("{}: {} by task", group.title, group.measure.words()),
        head,
        rows,
        note: format!(
            "Mean over seeds of greedy episodes at the end of training, with its 95 % interval of Student's t; in \
             parentheses the number of seeds. † fewer than 5 seeds: the interval is not reliable.{}",
            Measure::ends("Intervals", [group.measure])
        ),
        ..Table::default()
    }
}

/// Mean and interval, of values that lie in this range.
fn interval_cell(measure: Measure, range: Option<[f64; 2]>, values: &[f64]) -> String {
    let text = measure.number(mean(values));
    let number = |value: f64| measure.number(value);
    let interval = t_interval(values).map(|it| range.map_or(it, |range| it.within(range)));
    match interval {
        Some(it) if values.len() >= rit_statistics::SEEDS_MIN => {
            format!("{text} [{}, {}]", number(it.low), number(it.high))
        }
        Some(it) => format!("{text} [{}, {}]†", number(it.low), number(it.high)),
        None => text,
    }
}

/// What methods have on tasks that they were trained on above unseen ones; none where nothing unseen was evaluated.
pub fn gaps(groups: &[Group]) -> Option<Table> {
    let row = |group: &Group, method: &Method| {
        let (measure, both) = (group.measure, [Split::Training, Split::Testing]);
        let of_run = |run| {
            let means = both.map(|split| measure.over_tasks(run, split, group.tasks(split)));
            let [Some(seen), Some(unseen)] = means else { return None };
            Some((seen, unseen, generalisation_gap(&[seen], &[unseen])))
        };
        let all: Vec<(f64, f64, f64)> = method.runs.iter().filter_map(of_run).collect();
        // A difference of two values lies between the differences of their ends.
        let range = measure.range();
        let ranges = [range, range, range.map(|[low, high]| [low - high, high - low])];
        let [seen, unseen, gap] = [0, 1, 2].map(|at| {
            let values = all.iter().map(|it| [it.0, it.1, it.2][at]).collect::<Vec<_>>();
            interval_cell(measure, ranges[at], &values)
        });
        let head = format!("{}: {}", group.title, method.label);
        (!all.is_empty()).then(|| vec![head, seen, unseen, gap, all.len().to_string()])
    };
    let rows: Vec<_> = groups
        .iter()
        .filter(|group| !group.testing.is_empty())
        .flat_map(|group| group.methods.iter().filter_map(move |method| row(group, method)))
        .collect();
    (!rows.is_empty()).then(|| Table {
        id: "generalisation-gap".to_owned(),
        title: "Generalisation gap: training tasks minus unseen tasks".to_owned(),
        head: ["method", "training tasks", "unseen tasks", "gap", "seeds"].map(str::to_owned).to_vec(),
        rows,
        note: format!(
            "Mean over seeds with its 95 % interval of Student's t († fewer than 5 seeds: not reliable).{} Returns of unseen \
             tasks are sums over other numbers of agents, so a gap of returns is to be compared between methods and not with \
             0; a gap of win rates is what it says.",
            Measure::ends("Intervals", groups.iter().map(|group| group.measure))
        ),
        ..Table::default()
    })
}

/// How the runs of a method vary, where there are several.
pub fn variation(groups: &[Group]) -> Option<Table> {
    let row = |group: &Group, method: &Method, split: Split| {
        let scores = group.scores(method, split);
        let numbers = PERCENTILES.map(|share| group.measure.number(percentile(&scores, share)));
        let spread = percentile(&scores, 0.75) - percentile(&scores, 0.25);
        let tasks = if split == Split::Training { "training" } else { "unseen" };
        let head = format!("{}: {}", group.title, method.label);
        let cells = [tasks.to_owned()].into_iter().chain(numbers);
        [head]
            .into_iter()
            .chain(cells)
            .chain([group.measure.number(spread), scores.len().to_string()])
            .collect()
    };
    let splits = |group: &Group| {
        let testing = (!group.testing.is_empty()).then_some(Split::Testing);
        [Some(Split::Training), testing].into_iter().flatten().collect::<Vec<_>>()
    };
    let rows = groups.iter().flat_map(|group| {
        splits(group).into_iter().flat_map(move |split| {
            let several = group.methods.iter().filter(|method| method.runs.len() > 1);
            several.map(|method| row(group, method, split)).collect::<Vec<_>>()
        })
    });
    let rows: Vec<_> = rows.collect();
    let percentiles = PERCENTILES.map(|share| format!("{} %", signed(100.0 * share, 0)));
    let head = ["method", "tasks"].map(str::to_owned).into_iter().chain(percentiles);
    (!rows.is_empty()).then(|| Table {
        id: "run-to-run".to_owned(),
        title: "How runs vary: percentiles over seeds".to_owned(),
        head: head.chain(["75 % − 25 %".to_owned(), "seeds".to_owned()]).collect(),
        rows,
        note: "Of each run's mean over tasks at the end of training; between two runs percentiles lie on a straight line. \
               Methods with a single run are left out."
            .to_owned(),
        ..Table::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean 0.9, error 0.1, t(4) = 2.7764 (see `figures.rs`); of three, mean 0.8333, error 0.1667, t(2) = 4.3027.
    #[test]
    fn an_interval_of_win_rates_ends_at_0_and_1() {
        let values = [1.0, 0.5, 1.0, 1.0, 1.0];
        let cell = |values: &[f64]| interval_cell(Measure::WinRate, Measure::WinRate.range(), values);
        assert_eq!(cell(&values), "0.90 [0.62, 1.00]");
        assert_eq!(cell(&values[..3]), "0.83 [0.12, 1.00]†");
        assert_eq!(cell(&values[..1]), "1.00");
        assert_eq!(interval_cell(Measure::Return, Measure::Return.range(), &values), "0.9 [0.6, 1.2]");
        // A gap may be below nought.
        assert_eq!(
            interval_cell(Measure::WinRate, Some([-1.0, 1.0]), &[-0.5, 0.5, 0.0]),
            "0.00 [−1.00, 1.00]†"
        );
    }
}
