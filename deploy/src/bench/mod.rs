//! `rit bench`: rates, each beside the machine's limit measured in the same run.
//!
//! Time is CPU time (user and system, all threads of the process) unless a name says otherwise: on a shared
//! machine that is what can be compared.

mod env;
mod ipc;
mod learner;
mod rollout;
mod scale;

use crate::{
    cli::{BenchKind, BenchOptions},
    experiments,
    failure::Failure,
    output,
    player::Trained,
};
use rit_algo::{Method, Model};
use rit_config::Config;
use rit_env::{
    Script, Task,
    rollout::{Job, Rollout},
};
use rit_episode::{Choice, Episode, RunSeed, Stream};
use rit_learner::checkpoint::Which;
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Map, Value};
use std::{process::ExitCode, sync::Arc, time::Duration};

/// `rit bench`.
pub fn run(options: &BenchOptions) -> Result<ExitCode, Failure> {
    let duration = Duration::from_secs_f64(options.seconds);
    let mut report = if options.algorithm.as_deref() == Some(ALL) {
        every_method(options, duration)?
    } else {
        one_method(options, duration)?
    };
    report.insert("bench".into(), options.kind.to_string().into());
    if let Some(run) = &options.run {
        report.insert("run".into(), run.display().to_string().into());
    } else if !matches!(options.kind, BenchKind::Ipc) {
        report.insert("experiment".into(), options.experiment.clone().into());
    }
    output::print(&if options.json { format!("{:#}\n", Value::Object(report)) } else { lines(&report) })?;
    Ok(ExitCode::SUCCESS)
}

fn one_method(options: &BenchOptions, duration: Duration) -> Result<Report, Failure> {
    let settings =
        options.settings.iter().cloned().chain(experiments::algorithm(options.algorithm.as_deref()));
    let settings: Vec<String> = settings.collect();
    let measured = Measured::new(options, &settings)?;
    let mut report = match options.kind {
        BenchKind::Learner => learner::run(&measured, duration)?,
        BenchKind::Rollout => rollout::run(&measured, duration)?,
        BenchKind::Env => env::run(&measured.config, duration)?,
        BenchKind::Ipc => return ipc::run(options.payload_kib, duration),
        BenchKind::Scale => scale::run(&measured, &options.experiment, &settings, duration)?,
    };
    report.insert("algorithm".into(), measured.model.method().name().into());
    Ok(report)
}

/// `--algorithm all`: one update, and rolling, of every method that there is.
fn every_method(options: &BenchOptions, duration: Duration) -> Result<Report, Failure> {
    if options.kind != BenchKind::Learner {
        let kind = options.kind;
        return Err(Failure::input_message(format!(
            "`rit bench {kind}` measures one algorithm; --algorithm {ALL} is for learner"
        )));
    }
    let mut rows = Vec::new();
    for method in Method::ALL {
        let settings = options.settings.iter().cloned().chain(experiments::algorithm(Some(method.name())));
        let report = learner::run(&Measured::new(options, &settings.collect::<Vec<_>>())?, duration)?;
        let mut row = Report::new();
        row.insert("algorithm".into(), method.name().into());
        for key in ["parameters", "update_cpu_ms", "update_wall_ms", "update_gflop", "gemm_share"] {
            row.insert(key.into(), report[key].clone());
        }
        rows.push(Value::Object(row));
    }
    Ok(Report::from_iter([("algorithms".into(), rows.into())]))
}

/// Every method, in `--algorithm`.
const ALL: &str = "all";

/// The report for people.
fn lines(report: &Report) -> String {
    let width = report.keys().map(String::len).max().unwrap_or(0);
    let line = |(key, value): (&String, &Value)| match value {
        Value::Number(number) if number.is_f64() => {
            format!("{key:width$}  {:.3}\n", number.as_f64().unwrap_or_default())
        }
        Value::String(text) => format!("{key:width$}  {text}\n"),
        Value::Array(rows) => format!("\n{key}\n{}\n", table(rows)),
        value => format!("{key:width$}  {value}\n"),
    };
    report.iter().map(line).collect()
}

/// Whose networks are measured.
struct Measured {
    config: Config,
    model: Arc<Model>,
    params: Vec<f32>,
}

impl Measured {
    /// An experiment's fresh networks, or those that a run has come to.
    fn new(options: &BenchOptions, settings: &[String]) -> Result<Self, Failure> {
        let Some(run) = &options.run else {
            let config = experiments::load(&options.experiment, settings)?.config;
            let model = Arc::new(Model::new(config.model()).map_err(Failure::input)?);
            let params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
            return Ok(Self { config, model, params });
        };
        if !matches!(options.kind, BenchKind::Learner | BenchKind::Rollout) {
            let kind = options.kind;
            return Err(Failure::input_message(format!(
                "`rit bench {kind}` has no use for a run's weights; --run is for learner and rollout"
            )));
        }
        let Trained { config, model, params } = Trained::load(run, Which::Latest)?;
        Ok(Self { config, model, params })
    }
}

/// Rows of one kind, a line each.
fn table(rows: &[Value]) -> String {
    let Some(first) = rows.first().and_then(Value::as_object) else { return String::new() };
    let cell = |value: &Value| match value {
        Value::Number(number) if number.is_f64() => format!("{:.2}", number.as_f64().unwrap_or_default()),
        Value::String(text) => text.clone(),
        value => value.to_string(),
    };
    let columns: Vec<Vec<String>> = first
        .keys()
        .map(|key| {
            let cells: Vec<String> =
                [key.clone()].into_iter().chain(rows.iter().map(|row| cell(&row[key]))).collect();
            let width = cells.iter().map(String::len).max().unwrap_or(0) + 2;
            cells.iter().map(|cell| format!("{cell:>width$}")).collect()
        })
        .collect();
    let line = |row: usize| columns.iter().map(|column| column[row].as_str()).collect::<String>();
    (0..=rows.len()).map(line).collect::<Vec<_>>().join("\n")
}

/// What a benchmark prints, in this order.
type Report = Map<String, Value>;

/// CPU seconds of this thread so far, user and system.
fn thread_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Episodes of random actions of these tasks.
fn random_episodes(config: &Config, tasks: &[Task], count: u64) -> Vec<Episode> {
    let mut rollout = Rollout::new(tasks.to_vec(), rit_worlds::factory(config), RunSeed(1), true);
    let jobs: Vec<Job> = (0..count)
        .map(|number| Job { number, weights_version: 0, choice: Choice::EpsilonGreedy(1.0), task: None })
        .collect();
    jobs.chunks(64).flat_map(|jobs| rollout.roll(&mut Script::Random, jobs)).flatten().collect()
}
