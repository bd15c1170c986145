//! Tables of results: the paper's III to V with ours beside them, task by task, the gap to unseen tasks, and how runs vary.

use crate::{
    comparison::{Group, Method},
    measure::{Measure, signed},
    paper::{self, PaperTable, TABLES},
    table::Table,
};
use rit_env::Split;
use rit_statistics::{generalisation_gap, mean, percentile, standard_error, t_interval};

/// The percentiles that say how runs vary.
const PERCENTILES: [f64; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

/// The paper's tables for which there is a run.
pub fn of_the_paper(groups: &[Group]) -> Vec<Table> {
    TABLES.iter().filter_map(|table| beside_ours(table, groups)).collect()
}

fn beside_ours(table: &PaperTable, groups: &[Group]) -> Option<Table> {
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
        note: "Mean ± standard error over seeds of the mean over unseen tasks (paper: five seeds); in parentheses our \
               number of seeds. ▲ or ▼: ours is higher or lower by more than both errors together; of a single seed there \
               is no error and no mark."
            .to_owned(), ..Table::default() })
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
        interval_cell(group.measure, &group.scores_of_task(method, *split, task))
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
        note: "Mean over seeds of greedy episodes at the end of training, with its 95 % interval of Student's t; in \
               parentheses the number of seeds. † fewer than 5 seeds: the interval is not reliable."
            .to_owned(), ..Table::default() }
}

/// Mean and interval.
fn interval_cell(measure: Measure, values: &[f64]) -> String {
    let text = measure.number(mean(values));
    let number = |value: f64| measure.number(value);
    match t_interval(values) {
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
        let [seen, unseen, gap] = [0, 1, 2].map(|at| {
            let values = all.iter().map(|it| [it.0, it.1, it.2][at]).collect::<Vec<_>>();
            interval_cell(measure, &values)
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
        note: "Mean over seeds with its 95 % interval of Student's t († fewer than 5 seeds: not reliable). Returns of \
               unseen tasks are sums over other numbers of agents, so a gap of returns is to be compared between methods \
               and not with 0; a gap of win rates is what it says."
            .to_owned(), ..Table::default() })
}

/// How the runs of a method vary.
pub fn variation(groups: &[Group]) -> Table {
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
            group.methods.iter().map(move |method| row(group, method, split)).collect::<Vec<_>>()
        })
    });
    let percentiles = PERCENTILES.map(|share| format!("{} %", signed(100.0 * share, 0)));
    let head = ["method", "tasks"].map(str::to_owned).into_iter().chain(percentiles);
    Table {
        id: "run-to-run".to_owned(),
        title: "How runs vary: percentiles over seeds".to_owned(),
        head: head.chain(["75 % − 25 %".to_owned(), "seeds".to_owned()]).collect(),
        rows: rows.collect(),
        note: "Of each run's mean over tasks at the end of training; between two runs percentiles lie on a straight line."
            .to_owned(), ..Table::default() }
}
