//! The numbers themselves: marl-eval's JSON, and a flat CSV.

use crate::{
    ReportError,
    comparison::{Group, Method},
    measure::Measure,
};
use rit_env::Split;
use rit_record::{EachEpisode, Evaluation, Occasion, Record, TaskResult};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// marl-eval's format: environment, task, algorithm, run, step, metrics; every algorithm has the same runs and steps. Runs
/// beyond the fewest that a method has, and steps that a run lacks, are left out.
pub fn marl_eval(groups: &[Group]) -> Value {
    let mut environments = Map::new();
    for group in groups {
        for (split, name) in
            [(Split::Training, group.id.clone()), (Split::Testing, format!("{}-unseen", group.id))]
        {
            environments.extend(environment(group, split).map(|tasks| (name, tasks)));
        }
    }
    Value::Object(environments)
}

fn environment(group: &Group, split: Split) -> Option<Value> {
    let tasks = group.tasks(split);
    let runs: Vec<(&Method, &[Record])> =
        group.methods.iter().map(|method| (method, &method.runs[..group.seeds_min()])).collect();
    let all = || runs.iter().flat_map(|(_, runs)| runs.iter());
    let curves: Vec<BTreeMap<u64, &Evaluation>> =
        all().map(|run| run.curve(split).into_iter().collect()).collect();
    let is_common = |step: &u64| {
        let has_all = |it: &&Evaluation| tasks.iter().all(|task| it.tasks.contains_key(task));
        curves.iter().all(|curve| curve.get(step).is_some_and(&has_all))
    };
    let steps: Vec<u64> = curves.first()?.keys().copied().filter(is_common).collect();
    // Their tools read curves: without one there is nothing for them.
    if steps.is_empty() || tasks.is_empty() {
        return None;
    }
    let with_episodes = all().all(|run| {
        let evaluations = run.evaluations.iter().filter(|it| it.split == split);
        evaluations.flat_map(|it| it.tasks.values()).all(|result| result.each.is_some())
    });
    let mut by_task = Map::new();
    for task in tasks {
        let mut algorithms = Map::new();
        for (method, runs) in &runs {
            let of_run = |(at, run): (usize, &Record)| {
                (format!("run_{}", at + 1), run_json(run, split, task, &steps, with_episodes))
            };
            algorithms.insert(method.label.to_lowercase(), runs.iter().enumerate().map(of_run).collect());
        }
        by_task.insert(task.to_lowercase(), Value::Object(algorithms));
    }
    Some(Value::Object(by_task))
}

fn run_json(run: &Record, split: Split, task: &str, steps: &[u64], with_episodes: bool) -> Value {
    let curve: BTreeMap<u64, &Evaluation> = run.curve(split).into_iter().collect();
    let mut json = Map::new();
    for (at, step) in steps.iter().enumerate() {
        let mut point = Map::new();
        point.insert("step_count".to_owned(), json!(step));
        if let Some(result) = curve.get(step).and_then(|it| it.tasks.get(task)) {
            point.extend(metrics(result, with_episodes));
        }
        // Their tools take steps in the order of the file, which is that of the names.
        json.insert(format!("step_{at:05}"), Value::Object(point));
    }
    let occasions = [Occasion::Best, Occasion::Final, Occasion::Scheduled].into_iter();
    let absolute = occasions
        .filter_map(|occasion| {
            run.evaluations
                .iter()
                .rfind(|it| (it.occasion, it.split) == (occasion, split) && it.tasks.contains_key(task))
        })
        .find_map(|evaluation| evaluation.tasks.get(task));
    let absolute: Map<String, Value> =
        absolute.map(|it| metrics(it, with_episodes)).into_iter().flatten().collect();
    json.insert("absolute_metrics".to_owned(), Value::Object(absolute));
    Value::Object(json)
}

/// `return` and `win_rate` are means over episodes; with each episode, `episode_return` and `episode_won` are those.
fn metrics(result: &TaskResult, with_episodes: bool) -> Vec<(String, Value)> {
    let mut metrics = vec![("return".to_owned(), json!([result.mean_return]))];
    metrics.extend(result.win_rate.map(|rate| ("win_rate".to_owned(), json!([rate]))));
    if let Some(EachEpisode { returns, wins, .. }) = result.each.as_ref().filter(|_| with_episodes) {
        metrics.push(("episode_return".to_owned(), json!(returns)));
        if !wins.is_empty() {
            let won: Vec<u8> = wins.iter().map(|&won| u8::from(won)).collect();
            metrics.push(("episode_won".to_owned(), json!(won)));
        }
    }
    metrics
}

/// Every evaluation of every run and task, a line each.
///
/// # Errors
/// When the library refuses.
pub fn flat(groups: &[Group]) -> Result<Vec<u8>, ReportError> {
    let wrong = |error: &dyn std::fmt::Display| ReportError::Write(format!("runs.csv: {error}"));
    let mut lines = csv::Writer::from_writer(Vec::new());
    let head = [
        "group",
        "task_set",
        "method",
        "seed",
        "run",
        "occasion",
        "split",
        "task",
        "agents",
        "env_steps",
        "env_steps_due",
        "updates",
        "episodes",
        "mean_return",
        "std_return",
        "win_rate",
        "wall_s",
        "run_cpu_s",
        "run_wall_s",
        "parameters",
        "version",
        "commit",
        "weights_digest",
    ];
    lines.write_record(head).map_err(|error| wrong(&error))?;
    for group in groups {
        for method in &group.methods {
            for run in &method.runs {
                for line in run_lines(group, method, run) {
                    lines.write_record(line).map_err(|error| wrong(&error))?;
                }
            }
        }
    }
    lines.into_inner().map_err(|error| wrong(&error))
}

fn run_lines(group: &Group, method: &Method, run: &Record) -> Vec<Vec<String>> {
    let text = |value: Option<String>| value.unwrap_or_default();
    let number =
        |value: Option<f64>| text(value.filter(|value| value.is_finite()).map(|value| value.to_string()));
    let due: BTreeMap<(u64, bool), u64> = [Split::Training, Split::Testing]
        .into_iter()
        .flat_map(|split| {
            run.curve(split)
                .into_iter()
                .map(move |(due, it)| ((it.progress.env_steps, split == Split::Testing), due))
        })
        .collect();
    let line = |evaluation: &Evaluation, task: &String, result: &TaskResult| {
        let is_testing = evaluation.split == Split::Testing;
        let scheduled = evaluation.occasion == Occasion::Scheduled;
        let due = due.get(&(evaluation.progress.env_steps, is_testing)).filter(|_| scheduled);
        let occasion = match evaluation.occasion {
            Occasion::Scheduled => "scheduled",
            Occasion::Final => "final",
            Occasion::Best => "best",
        };
        vec![
            group.id.clone(),
            group.task_set.clone(),
            method.label.clone(),
            text(run.seed.map(|seed| seed.to_string())),
            run.name.clone(),
            occasion.to_owned(),
            if is_testing { "testing" } else { "training" }.to_owned(),
            task.clone(),
            text(crate::figures::team_size(&group.task_set, task).map(|size| size.to_string())),
            evaluation.progress.env_steps.to_string(),
            text(due.map(ToString::to_string)),
            evaluation.progress.updates.to_string(),
            result.episodes.to_string(),
            number(Measure::Return.of(result)),
            number(result.std_return()),
            number(result.win_rate),
            number(Some(evaluation.wall_s)),
            number(run.cpu_s),
            number(run.wall_s),
            text(run.parameters.map(|count| count.to_string())),
            text(run.build.as_ref().map(|build| build.version.clone())),
            text(run.build.as_ref().and_then(|build| build.commit.clone())),
            text(run.weights_digest.clone()),
        ]
    };
    let evaluations = run.evaluations.iter();
    evaluations
        .flat_map(|evaluation| {
            evaluation.tasks.iter().map(move |(task, result)| line(evaluation, task, result))
        })
        .collect()
}
