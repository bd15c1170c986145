//! From runs to the lines that are drawn.

use super::runs::{Evaluations, Kind, Run};
use crate::failure::Failure;
use std::collections::{BTreeMap, BTreeSet};

/// Over runs, by environment steps: lowest, mean, highest.
pub type Curve = Vec<(f64, [f64; 3])>;

/// A line with its band.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    pub label: String,
    pub curve: Curve,
}

/// A line for each task, of runs of one kind.
///
/// # Errors
/// When they are of several kinds.
pub fn by_task(runs: &[Run]) -> Result<Vec<Series>, Failure> {
    let (first, rest) = runs.split_first().ok_or_else(|| Failure::input_message("no run is given"))?;
    if let Some(other) = rest.iter().find(|run| run.kind != first.kind) {
        let differing = differing(&[&first.kind, &other.kind]);
        let words = differing.iter().map(|key| {
            let value = |kind: &Kind| kind.get(key).cloned().unwrap_or_else(|| "unknown".to_owned());
            format!("{key} ({}, {})", value(&first.kind), value(&other.kind))
        });
        return Err(Failure::input_message(format!(
            "{} and {} are not runs of one experiment, they differ in {}; --compare draws a line for each kind of runs",
            first.name,
            other.name,
            words.collect::<Vec<_>>().join(", ")
        )));
    }
    let tasks: BTreeSet<&String> = runs.iter().flat_map(|run| run.evaluations.keys()).collect();
    let series = tasks.into_iter().map(|task| {
        let of_task: Vec<_> = runs.iter().filter_map(|run| run.evaluations.get(task)).collect();
        Series { label: task.clone(), curve: join(&of_task) }
    });
    Ok(series.collect())
}

/// A line for each kind of runs, of their mean over all tasks; called by these labels, or else by what the kinds differ
/// in.
///
/// # Errors
/// When kinds play different tasks, or there is another number of labels.
pub fn by_kind(runs: &[Run], labels: &[String]) -> Result<Vec<Series>, Failure> {
    let mut kinds: Vec<(&Kind, Vec<&Run>)> = Vec::new();
    for run in runs {
        match kinds.iter_mut().find(|(kind, _)| **kind == run.kind) {
            Some((_, of_kind)) => of_kind.push(run),
            None => kinds.push((&run.kind, vec![run])),
        }
    }
    let tasks = |run: &Run| run.evaluations.keys().cloned().collect::<Vec<_>>();
    if let Some(other) = runs.iter().find(|run| tasks(run) != tasks(&runs[0])) {
        return Err(Failure::input_message(format!(
            "{} and {} play different tasks ({}; {}): their means say nothing of one another",
            runs[0].name,
            other.name,
            tasks(&runs[0]).join(", "),
            tasks(other).join(", ")
        )));
    }
    let all: Vec<&Kind> = kinds.iter().map(|(kind, _)| *kind).collect();
    let differing = differing(&all);
    if !labels.is_empty() && labels.len() != kinds.len() {
        let (labels, kinds, differing) = (labels.len(), kinds.len(), differing.join(", "));
        return Err(Failure::input_message(format!(
            "{labels} labels for {kinds} kinds of runs; they differ in {differing}"
        )));
    }
    let series = kinds.iter().enumerate().map(|(at, (kind, runs))| {
        let means: Vec<_> = runs.iter().map(|run| mean_over_tasks(&run.evaluations)).collect();
        let label = labels.get(at).cloned().unwrap_or_else(|| label(kind, &differing, runs[0]));
        Series { label, curve: join(&means.iter().collect::<Vec<_>>()) }
    });
    Ok(series.collect())
}

/// Keys whose values are not the same in all kinds. Of a key that some algorithm has not, the algorithm tells enough.
fn differing(kinds: &[&Kind]) -> Vec<String> {
    let keys: BTreeSet<&String> = kinds.iter().flat_map(|kind| kind.keys()).collect();
    let differs = |key: &&String| kinds.iter().any(|kind| kind.get(*key) != kinds[0].get(*key));
    let differing: Vec<String> = keys.into_iter().filter(differs).cloned().collect();
    let (of_all, of_some): (Vec<_>, Vec<_>) =
        differing.into_iter().partition(|key| kinds.iter().all(|kind| kind.contains_key(key)));
    if of_all.is_empty() { of_some } else { of_all }
}

/// What sets a kind apart, in the last words of its keys: "rit-vdn, gamma 0.9".
fn label(kind: &Kind, differing: &[String], run: &Run) -> String {
    let word = |key: &String| {
        let name = key.rsplit('.').next().unwrap_or(key);
        let speaks_for_itself = ["folder", "name"].contains(&name);
        kind.get(key).map(|value| if speaks_for_itself { value.clone() } else { format!("{name} {value}") })
    };
    let words: Vec<_> = differing.iter().filter_map(word).collect();
    if words.is_empty() { run.name.clone() } else { words.join(", ") }
}

/// Where all tasks were evaluated, each counting the same.
fn mean_over_tasks(evaluations: &Evaluations) -> BTreeMap<u64, f64> {
    let curve = join(&evaluations.values().collect::<Vec<_>>());
    curve.into_iter().map(|(env_steps, [_, mean, _])| (env_steps as u64, mean)).collect()
}

/// What these have in common: points at which each was evaluated.
fn join(all: &[&BTreeMap<u64, f64>]) -> Curve {
    let Some((first, _)) = all.split_first() else { return Vec::new() };
    let point = |env_steps: &u64| {
        let values: Vec<f64> =
            all.iter().map(|points| points.get(env_steps).copied()).collect::<Option<_>>()?;
        let lowest = values.iter().copied().fold(f64::INFINITY, f64::min);
        let highest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        Some((*env_steps as f64, [lowest, mean, highest]))
    };
    first.keys().filter_map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::{
        super::runs::{read, refuse_twice},
        *,
    };
    use crate::cli::PlotMetric;
    use rit_config::{Config, OwnedRunDir, resolve, set};
    use std::{fs, path::Path};

    fn config(settings: &[&str]) -> Config {
        let settings: Vec<_> = settings.iter().map(|text| set(text).unwrap()).collect();
        resolve("environment.task_set = \"matrix-game\"", "test", &settings).unwrap()
    }

    /// Evaluations of one or two tasks: (environment steps, return).
    fn lines(points: &[(u64, f64)], tasks: &[&str]) -> String {
        let line = |(env_steps, value): &(u64, f64)| {
            let results = tasks.iter().enumerate().map(|(at, task)| {
                let value = value + 10.0 * at as f64;
                format!("\"{task}\":{{\"episodes\":2,\"mean_return\":{value},\"win_rate\":null}}")
            });
            let results = results.collect::<Vec<_>>().join(",");
            format!(
                "{{\"kind\":\"evaluation\",\"env_steps\":{env_steps},\"episodes\":1,\"updates\":1,\"tasks\":{{{results}}}}}\n"
            )
        };
        points.iter().map(line).collect()
    }

    fn run_dir(folder: &Path, name: &str, settings: &[&str], text: &str) -> Run {
        let run_dir = OwnedRunDir::create(&folder.join(name), &config(settings)).unwrap().run_dir().clone();
        fs::write(run_dir.metrics(), text).unwrap();
        let mut run = read(run_dir.root(), PlotMetric::MeanReturn).unwrap();
        run.name = name.to_owned();
        run
    }

    fn file(folder: &Path, name: &str, text: &str) -> Run {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
        let mut run = read(&path, PlotMetric::MeanReturn).unwrap();
        run.name = name.to_owned();
        run
    }

    fn message<T: std::fmt::Debug>(refused: Result<T, Failure>) -> String {
        refused.unwrap_err().to_string()
    }

    const EVERY: &str = "evaluation.every_env_steps=10";

    #[test]
    fn seeds_of_one_experiment_are_joined_where_all_were_evaluated() {
        let folder = tempfile::tempdir().unwrap();
        let a = run_dir(
            folder.path(),
            "a",
            &["seed=1", EVERY],
            &lines(&[(0, 1.0), (10, 2.0), (20, 3.0)], &["x", "y"]),
        );
        // An episode of this run ended early, and it has not come as far.
        let b = run_dir(
            folder.path(),
            "b",
            &["seed=2", EVERY, "actors.count=7"],
            &lines(&[(0, 3.0), (12, 6.0)], &["x", "y"]),
        );
        let runs = [a, b];
        refuse_twice(&runs).unwrap();
        let series = by_task(&runs).unwrap();
        assert_eq!(
            series[0],
            Series { label: "x".into(), curve: vec![(0.0, [1.0, 2.0, 3.0]), (10.0, [2.0, 4.0, 6.0])] }
        );
        assert_eq!(series[1].label, "y");
    }

    #[test]
    fn runs_of_different_kinds_are_refused_by_what_they_differ_in_or_compared() {
        let folder = tempfile::tempdir().unwrap();
        let points = lines(&[(0, 1.0), (10, 2.0)], &["x", "y"]);
        let a = run_dir(folder.path(), "a", &["seed=1", EVERY], &points);
        let others = [
            ("gamma", vec!["algorithm.gamma=0.9", EVERY], "algorithm.gamma (0.99, 0.9)"),
            ("vdn", vec!["algorithm.name=rit-vdn", EVERY], "algorithm.name (rit, rit-vdn);"),
            ("interval", vec!["evaluation.every_env_steps=5"], "evaluation.every_env_steps (10, 5)"),
        ];
        for (name, settings, difference) in others {
            let other = run_dir(
                folder.path(),
                name,
                &[&settings[..], &["seed=2"]].concat(),
                &lines(&[(0, 5.0), (10, 6.0)], &["x", "y"]),
            );
            let runs = [run_dir(folder.path(), &format!("a-{name}"), &["seed=1", EVERY], &points), other];
            let refused = message(by_task(&runs));
            assert!(refused.contains(difference) && refused.contains("--compare"), "{refused}");
            let series = by_kind(&runs, &[]).unwrap();
            assert_eq!(series.len(), 2);
            // The mean of tasks x and y, ten apart.
            assert_eq!(series[0].curve, [(0.0, [6.0; 3]), (10.0, [7.0; 3])]);
            assert_eq!(series[1].curve, [(0.0, [10.0; 3]), (10.0, [11.0; 3])]);
        }
        let gamma = run_dir(
            folder.path(),
            "gamma-3",
            &["algorithm.gamma=0.9", EVERY],
            &lines(&[(0, 5.0)], &["x", "y"]),
        );
        let runs = [a, gamma];
        let labels: Vec<_> = by_kind(&runs, &[]).unwrap().into_iter().map(|series| series.label).collect();
        assert_eq!(labels, ["gamma 0.99", "gamma 0.9"]);
        let named = by_kind(&runs, &["paper".into(), "nearer".into()]).unwrap();
        assert_eq!(named[1].label, "nearer");
        let refused = message(by_kind(&runs, &["paper".into()]));
        assert!(
            refused.starts_with("1 labels for 2 kinds of runs; they differ in algorithm.gamma"),
            "{refused}"
        );
    }

    #[test]
    fn files_without_a_configuration_are_told_apart_by_folder_tasks_and_interval() {
        let folder = tempfile::tempdir().unwrap();
        let points = [(0, 1.0), (10, 2.0), (20, 3.0)];
        let a = file(folder.path(), "one/seed-1.jsonl", &lines(&points, &["x"]));
        let same = file(folder.path(), "one/seed-2.jsonl", &lines(&[(0, 4.0), (10, 5.0), (20, 6.0)], &["x"]));
        assert!(by_task(&[a, same]).is_ok());
        let a = || file(folder.path(), "one/seed-1.jsonl", &lines(&points, &["x"]));
        for (name, text, difference) in [
            ("two/seed-2.jsonl", lines(&[(0, 4.0), (10, 5.0), (20, 7.0)], &["x"]), "folder (one, two)"),
            ("one/tasks.jsonl", lines(&[(0, 4.0), (10, 5.0), (20, 7.0)], &["z"]), "tasks (x, z)"),
            ("one/gap.jsonl", lines(&[(0, 4.0), (5, 5.0), (10, 7.0)], &["x"]), "every_env_steps (10, 5)"),
        ] {
            let refused = message(by_task(&[a(), file(folder.path(), name, &text)]));
            assert!(refused.contains(difference), "{refused}");
        }
        let other_tasks = file(folder.path(), "one/tasks.jsonl", &lines(&points, &["z"]));
        assert!(message(by_kind(&[a(), other_tasks], &[])).contains("play different tasks (x; z)"));
    }

    #[test]
    fn a_run_counts_once() {
        let folder = tempfile::tempdir().unwrap();
        let points = lines(&[(0, 1.0), (10, 2.0)], &["x"]);
        let a = run_dir(folder.path(), "a", &["seed=1", EVERY], &points);
        let again = read(&folder.path().join("a/metrics.jsonl"), PlotMetric::MeanReturn).unwrap();
        assert!(message(refuse_twice(&[a, again])).ends_with("are the same run, seed 1: give it once"));
        let (b, c) = (lines(&[(0, 1.0)], &["x"]), lines(&[(0, 1.5)], &["x"]));
        let twins = [
            run_dir(folder.path(), "b", &["seed=2", EVERY], &b),
            run_dir(folder.path(), "c", &["seed=2", EVERY], &c),
        ];
        assert!(message(refuse_twice(&twins)).starts_with("b and c are the same run"));
        let copies = [file(folder.path(), "d/1.jsonl", &points), file(folder.path(), "d/2.jsonl", &points)];
        assert!(message(refuse_twice(&copies)).starts_with("d/1.jsonl and d/2.jsonl are the same run"));
    }

    #[test]
    fn torn_lines_and_missing_measures_are_said() {
        let folder = tempfile::tempdir().unwrap();
        let text = lines(&[(0, 1.0), (10, 2.0)], &["x"]);
        let torn = file(folder.path(), "torn.jsonl", &format!("{}{{\"kind\":\"eval\n{}", &text, &text[..30]));
        assert_eq!((torn.broken_lines, torn.evaluations["x"].len()), (1, 2), "a torn last line is the end");
        let path = folder.path().join("torn.jsonl");
        assert!(message(read(&path, PlotMetric::WinRate)).ends_with("there is no win rate to draw"));
        fs::write(&path, "").unwrap();
        assert!(message(read(&path, PlotMetric::MeanReturn)).ends_with("it holds no evaluation yet"));
    }
}
