//! The table of everything that is not the algorithm: settings, builds, machines, what runs took, how they were evaluated.

use crate::{comparison::Group, table::Table};
use rit_env::Split;
use rit_record::{Occasion, Record};
use std::collections::{BTreeMap, BTreeSet};

/// Settings that say where a run is and not what it is.
const LEFT_OUT: [&str; 3] = ["learner.tls.", "learner.token_file", "learner.listen"];

/// What was run.
pub fn runs(groups: &[Group]) -> Table {
    let row = |group: &Group, label: &str, run: &Record| {
        let or_dash =
            |text: Option<String>| text.filter(|text| !text.is_empty()).unwrap_or_else(|| "–".to_owned());
        let seconds = |seconds: Option<f64>| or_dash(seconds.map(|seconds| grouped(seconds.round() as u64)));
        let build = run.build.as_ref();
        let commit = build.and_then(|build| build.commit.clone()).unwrap_or_default();
        let commit: String = commit.chars().take(12).collect();
        let version = build.map(|build| format!("{} {commit}", build.version).trim().to_owned());
        let machine = run.host.as_ref().map(|host| format!("{} ({} cores)", host.cpu, host.cores));
        let digest = run.weights_digest.as_ref().map(|digest| digest.chars().take(12).collect());
        vec![
            format!("{}: {label}", group.title),
            or_dash(run.seed.map(|seed| seed.to_string())),
            grouped(run.progress.env_steps),
            grouped(run.progress.episodes),
            grouped(run.progress.updates),
            or_dash(run.parameters.map(grouped)),
            seconds(run.cpu_s),
            seconds(run.wall_s),
            or_dash(version),
            or_dash(machine),
            or_dash(digest),
        ]
    };
    let methods = groups.iter().flat_map(|group| group.methods.iter().map(move |method| (group, method)));
    let runs = methods.flat_map(|(group, method)| method.runs.iter().map(move |run| (group, method, run)));
    let rows = runs.map(|(group, method, run)| row(group, &method.label, run));
    let head = [
        "run",
        "seed",
        "env. steps",
        "episodes",
        "updates",
        "parameters",
        "CPU s",
        "wall s",
        "build",
        "machine",
        "weights",
    ];
    Table {
        id: "runs".to_owned(),
        title: "Runs".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: rows.collect(),
        note: "CPU s: processor time of all processes of a run, evaluations included; wall s: how long learners ran. \
               Weights: the beginning of the SHA-256 of the final weights. – : the record does not say."
            .to_owned(), ..Table::default() }
}

/// What all runs have in common, and what sets methods apart.
pub fn settings(groups: &[Group]) -> Vec<Table> {
    let all: Vec<(String, &Record)> = groups
        .iter()
        .flat_map(|group| {
            group.methods.iter().map(move |it| (format!("{}: {}", group.title, it.label), &it.runs[0]))
        })
        .filter(|(_, run)| !run.settings.is_empty())
        .collect();
    if all.is_empty() {
        return Vec::new();
    }
    let is_shown = |key: &&String| *key != "seed" && !LEFT_OUT.iter().any(|out| key.starts_with(out));
    let keys: BTreeSet<&String> =
        all.iter().flat_map(|(_, run)| run.settings.keys()).filter(is_shown).collect();
    let values = |key: &str| -> BTreeSet<Option<&String>> {
        all.iter().map(|(_, run)| run.settings.get(key)).collect()
    };
    let (shared, other): (Vec<_>, Vec<_>) = keys.into_iter().partition(|key| values(key).len() == 1);
    let shared = Table {
        id: "settings-shared".to_owned(),
        title: "Settings that all runs share".to_owned(),
        head: ["key", "value"].map(str::to_owned).to_vec(),
        rows: shared.into_iter().map(|key| vec![key.clone(), all[0].1.settings[key].clone()]).collect(),
        note: String::new(),
        ..Table::default()
    };
    let row = |key: &String| {
        let mut holders: BTreeMap<String, Vec<&str>> = BTreeMap::new();
        for (name, run) in &all {
            let value = run.settings.get(key).cloned().unwrap_or_else(|| "(has no such key)".to_owned());
            holders.entry(value).or_default().push(name);
        }
        // The value that most have needs no list of names.
        let most = holders.values().map(Vec::len).max().unwrap_or(0);
        let mut said_most = false;
        let words = holders.iter().map(|(value, names)| {
            if names.len() == most && names.len() > 3 && !said_most {
                said_most = true;
                format!("{value}: the others")
            } else {
                format!("{value}: {}", names.join(", "))
            }
        });
        vec![key.clone(), words.collect::<Vec<_>>().join("; ")]
    };
    let other = Table {
        id: "settings-other".to_owned(),
        title: "Settings that differ".to_owned(),
        head: ["key", "value: where"].map(str::to_owned).to_vec(),
        rows: other.into_iter().map(row).collect(),
        note: String::new(),
        ..Table::default()
    };
    if other.rows.is_empty() { vec![shared] } else { vec![other, shared] }
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
        let or_dash = |text: String| if text.is_empty() { "–".to_owned() } else { text };
        vec![
            group.title.clone(),
            steps,
            or_dash(interval.unwrap_or_default()),
            or_dash(group.training.join(", ")),
            or_dash(episodes(Split::Training)),
            or_dash(group.testing.join(", ")),
            or_dash(episodes(Split::Testing)),
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
