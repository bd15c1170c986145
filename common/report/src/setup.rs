//! The table of everything that is not the algorithm: settings, builds, machines, what runs took, how they were evaluated.

use crate::{
    comparison::{Group, Method},
    paper,
    table::Table,
};
use rit_env::Split;
use rit_record::{Occasion, Record};
use std::collections::{BTreeMap, BTreeSet};

/// Settings that say where a run is and not what it is, and those that every name says.
const LEFT_OUT: [&str; 5] =
    ["learner.tls", "learner.token_file", "learner.listen", "algorithm.name", "environment.task_set"];

/// What each method is, and how many seeds of it there are on each task set.
pub fn methods(groups: &[Group]) -> Table {
    let mut labels: Vec<&Method> = Vec::new();
    for method in groups.iter().flat_map(|group| &group.methods) {
        if !labels.iter().any(|other| other.label == method.label) {
            labels.push(method);
        }
    }
    labels.sort_by_key(|method| (paper::method_place(&method.label), method.label.clone()));
    let row = |method: &&Method| {
        let name = method.runs[0].method();
        let facts = rit_algo::Method::ALL.map(rit_algo::Method::facts);
        let words =
            facts.into_iter().find(|facts| Some(facts.name) == name).map_or("–", |facts| facts.summary);
        let seeds = groups.iter().map(|group| {
            let found = group.methods.iter().find(|other| other.label == method.label);
            found.map_or_else(|| "–".to_owned(), |found| found.runs.len().to_string())
        });
        [method.label.clone(), words.to_owned()].into_iter().chain(seeds).collect()
    };
    let titles = groups.iter().map(|group| group.title.clone());
    Table {
        id: "methods".to_owned(),
        title: "Methods, and seeds of each by task set".to_owned(),
        head: ["method", "what it is"].map(str::to_owned).into_iter().chain(titles).collect(),
        rows: labels.iter().map(row).collect(),
        note: "A method's plain name stands for the settings that come with the task set; what else was set follows the name. \
               – : no finished run."
            .to_owned(),
        ..Table::default()
    }
}

/// What was run; then what trained it and where, each pair of build and machine once.
pub fn runs(groups: &[Group]) -> [Table; 2] {
    let mut makers: Vec<[String; 2]> = Vec::new();
    let mut rows = Vec::new();
    for (group, method) in groups.iter().flat_map(|group| group.methods.iter().map(move |it| (group, it))) {
        for run in &method.runs {
            let maker = maker(run);
            let at = makers.iter().position(|other| *other == maker).unwrap_or_else(|| {
                makers.push(maker);
                makers.len() - 1
            });
            rows.push(run_row(&format!("{}: {}", group.title, method.label), run, at + 1));
        }
    }
    let head = [
        "run",
        "seed",
        "env. steps",
        "episodes",
        "updates",
        "parameters",
        "CPU s",
        "wall s",
        "made by",
        "weights",
    ];
    let runs = Table {
        id: "runs".to_owned(),
        title: "Runs".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows,
        note: "CPU s: processor time of all processes of a run, evaluations included; wall s: how long learners ran. Made by: \
               the number of build and machine in the table below. Weights: the beginning of the SHA-256 of the final \
               weights. – : the record does not say."
            .to_owned(),
        ..Table::default()
    };
    let made_by = |(at, [build, machine]): (usize, [String; 2])| vec![format!("{}", at + 1), build, machine];
    let builds = Table {
        id: "builds".to_owned(),
        title: "Builds and machines".to_owned(),
        head: ["made by", "version and commit", "machine"].map(str::to_owned).to_vec(),
        rows: makers.into_iter().enumerate().map(made_by).collect(),
        ..Table::default()
    };
    [runs, builds]
}

/// The text, or a dash for none.
fn or_dash(text: Option<String>) -> String {
    text.filter(|text| !text.is_empty()).unwrap_or_else(|| "–".to_owned())
}

/// Build and machine of a run.
fn maker(run: &Record) -> [String; 2] {
    let build = run.build.as_ref();
    let commit = build.and_then(|build| build.commit.clone()).unwrap_or_default();
    let commit: String = commit.chars().take(12).collect();
    let version = build.map(|build| format!("{} {commit}", build.version).trim().to_owned());
    let cores = |cores: usize| format!("{cores} core{}", if cores == 1 { "" } else { "s" });
    let machine = run.host.as_ref().map(|host| format!("{}, {}", host.cpu, cores(host.cores)));
    [or_dash(version), or_dash(machine)]
}

fn run_row(name: &str, run: &Record, maker: usize) -> Vec<String> {
    let seconds = |seconds: Option<f64>| or_dash(seconds.map(|seconds| grouped(seconds.round() as u64)));
    let digest = run.weights_digest.as_ref().map(|digest| digest.chars().take(12).collect());
    vec![
        name.to_owned(),
        or_dash(run.seed.map(|seed| seed.to_string())),
        grouped(run.progress.env_steps),
        grouped(run.progress.episodes),
        grouped(run.progress.updates),
        or_dash(run.parameters.map(grouped)),
        seconds(run.cpu_s),
        seconds(run.wall_s),
        maker.to_string(),
        or_dash(digest),
    ]
}

/// One method on one task set, and its settings as this build has them.
struct Cell<'a> {
    group: &'a Group,
    method: &'a Method,
    settings: BTreeMap<String, String>,
}

/// What all runs have in common, and what sets methods apart.
pub fn settings(groups: &[Group]) -> Vec<Table> {
    let all: Vec<Cell> = groups
        .iter()
        .flat_map(|group| group.methods.iter().map(move |method| (group, method)))
        .map(|(group, method)| {
            let settings = rit_config::completed(method.runs[0].settings.clone());
            Cell { group, method, settings }
        })
        .filter(|cell| !cell.method.runs[0].settings.is_empty())
        .collect();
    if all.is_empty() {
        return Vec::new();
    }
    let is_shown = |key: &&String| *key != "seed" && !LEFT_OUT.iter().any(|out| key.starts_with(out));
    let keys: BTreeSet<&String> = all.iter().flat_map(|cell| cell.settings.keys()).filter(is_shown).collect();
    let values =
        |key: &str| -> BTreeSet<&String> { all.iter().filter_map(|cell| cell.settings.get(key)).collect() };
    let in_all =
        |key: &&String| values(key).len() == 1 && all.iter().all(|cell| cell.settings.contains_key(*key));
    let (shared, other): (Vec<_>, Vec<_>) = keys.into_iter().partition(in_all);
    let shared = Table {
        id: "settings-shared".to_owned(),
        title: "Settings that all runs share".to_owned(),
        head: ["key", "value"].map(str::to_owned).to_vec(),
        rows: shared.into_iter().map(|key| vec![key.clone(), shown(&all[0].settings[key])]).collect(),
        ..Table::default()
    };
    let other = Table {
        id: "settings-other".to_owned(),
        title: "Settings that differ".to_owned(),
        head: ["key", "value: where"].map(str::to_owned).to_vec(),
        rows: other.into_iter().map(|key| vec![key.clone(), holders(key, &all)]).collect(),
        note: "A task set's name alone: all methods there that have the key. Methods without a key are not named."
            .to_owned(),
        ..Table::default()
    };
    if other.rows.is_empty() { vec![shared] } else { vec![other, shared] }
}

fn shown(value: &str) -> String {
    if value.is_empty() { "(empty)".to_owned() } else { value.to_owned() }
}

/// Each value of a key, and who has it, in as few words as say it.
fn holders(key: &str, all: &[Cell]) -> String {
    let mut of_value: BTreeMap<&str, Vec<&Cell>> = BTreeMap::new();
    let having: Vec<&Cell> = all.iter().filter(|cell| cell.settings.contains_key(key)).collect();
    for cell in &having {
        of_value.entry(&cell.settings[key]).or_default().push(cell);
    }
    if of_value.len() == 1 {
        // A key that some methods have and others do not.
        return of_value.into_keys().map(shown).collect();
    }
    let in_group = |cells: &[&Cell], id: &str| cells.iter().filter(|cell| cell.group.id == id).count();
    let named = |cells: &[&Cell]| {
        let mut names: Vec<String> = Vec::new();
        for cell in cells {
            let Group { id, title, .. } = cell.group;
            let is_whole = in_group(cells, id) == in_group(&having, id);
            let name = if is_whole { title.clone() } else { format!("{title}: {}", cell.method.label) };
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    };
    let named: Vec<(&str, Vec<String>)> =
        of_value.into_iter().map(|(value, cells)| (value, named(&cells))).collect();
    // The value with most names needs none of them.
    let most = named.iter().map(|(_, names)| names.len()).max().unwrap_or(0);
    let longest = named.iter().position(|(_, names)| names.len() == most && most > 3);
    let words = named.iter().enumerate().map(|(at, (value, names))| {
        let value = shown(value);
        if Some(at) == longest {
            format!("{value}: the others")
        } else {
            format!("{value}: {}", names.join(", "))
        }
    });
    words.collect::<Vec<_>>().join("; ")
}

/// How runs were evaluated.
pub fn protocol(groups: &[Group]) -> Table {
    let row = |group: &Group| {
        let runs = || group.methods.iter().flat_map(|method| &method.runs);
        let episodes = |split: Split| {
            let of_split = runs().flat_map(|run| run.evaluations.iter().filter(move |it| it.split == split));
            let counts: BTreeSet<u64> =
                of_split.flat_map(|it| it.tasks.values().map(|result| result.episodes)).collect();
            counts.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
        };
        let interval = runs().next().and_then(|run| run.kind.get("evaluation.every_env_steps").cloned());
        let best = runs().filter(|run| run.latest(Occasion::Best, Split::Training).is_some()).count();
        let steps: BTreeSet<u64> = runs().map(|run| run.progress.env_steps).collect();
        let steps = match (steps.first(), steps.last()) {
            (Some(low), Some(high)) if low != high => format!("{} to {}", grouped(*low), grouped(*high)),
            (Some(low), _) => grouped(*low),
            _ => "–".to_owned(),
        };
        let number = |text: String| text.parse().map_or(text, grouped);
        vec![
            group.title.clone(),
            steps,
            or_dash(interval.map(number)),
            or_dash(Some(group.training.join(", "))),
            or_dash(Some(episodes(Split::Training))),
            or_dash(Some(group.testing.join(", "))),
            or_dash(Some(episodes(Split::Testing))),
            format!("{best} of {}", runs().count()),
        ]
    };
    let head = [
        "task set",
        "env. steps",
        "evaluated every",
        "training tasks",
        "episodes a task",
        "unseen tasks",
        "episodes a task",
        "with the best policy",
    ];
    Table {
        id: "protocol".to_owned(),
        title: "How runs were evaluated".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: groups.iter().map(row).collect(),
        note: "Greedy episodes; a run's result is the evaluation of its final weights. Aggregates over tasks take the best \
               policy over ten times as many episodes (the absolute metric) of runs that have it, the final weights of others."
            .to_owned(), ..Table::default() }
}

/// A number in groups of three digits.
pub fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}
