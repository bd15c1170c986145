//! `rit bench`: rates, each beside the machine's limit measured in the same run.
//!
//! Time is CPU time (user and system, all threads of the process) unless a name says otherwise: on a shared
//! machine that is what can be compared.

mod env;
mod ipc;
mod learner;
mod rollout;

use crate::{
    cli::{BenchKind, BenchOptions},
    experiments,
    failure::Failure,
};
use rit_config::Config;
use rit_env::{
    Split,
    particle::Script,
    rollout::{Job, Rollout},
};
use rit_episode::{Episode, RunSeed};
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Map, Value};
use std::{process::ExitCode, time::Duration};

/// `rit bench`.
#[allow(clippy::print_stdout, reason = "what the command is for")]
pub fn run(options: &BenchOptions) -> Result<ExitCode, Failure> {
    let settings: Vec<String> = options.settings.clone();
    let config = experiments::load(&options.experiment, &settings)?.config;
    let duration = Duration::from_secs_f64(options.seconds);
    let mut report = match options.kind {
        BenchKind::Learner => learner::run(&config, duration)?,
        BenchKind::Rollout => rollout::run(&config, duration)?,
        BenchKind::Env => env::run(&config, duration),
        BenchKind::Ipc => ipc::run(options.payload_kib, duration)?,
    };
    report.insert("bench".into(), options.kind.to_string().into());
    if !matches!(options.kind, BenchKind::Ipc) {
        report.insert("experiment".into(), options.experiment.clone().into());
    }
    if options.json {
        println!("{:#}", Value::Object(report));
    } else {
        let width = report.keys().map(String::len).max().unwrap_or(0);
        for (key, value) in &report {
            match value {
                Value::Number(number) if number.is_f64() => {
                    println!("{key:width$}  {:.3}", number.as_f64().unwrap_or_default());
                }
                Value::String(text) => println!("{key:width$}  {text}"),
                value => println!("{key:width$}  {value}"),
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// What a benchmark prints, in this order.
type Report = Map<String, Value>;

/// CPU seconds of this process so far, user and system.
fn cpu_s() -> f64 {
    seconds(ClockId::ProcessCPUTime)
}

/// CPU seconds of this thread so far, user and system.
fn thread_cpu_s() -> f64 {
    seconds(ClockId::ThreadCPUTime)
}

fn seconds(clock: ClockId) -> f64 {
    let time = clock_gettime(clock);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Episodes of random actions of the experiment's training tasks.
fn random_episodes(config: &Config, count: u64) -> Vec<Episode> {
    let tasks = config.environment.task_set.tasks(Split::Training);
    let mut rollout = Rollout::new(tasks, config.environment_options(), RunSeed(1), true);
    let jobs: Vec<Job> =
        (0..count).map(|number| Job { number, weights_version: 0, epsilon: 1.0, task: None }).collect();
    jobs.chunks(64).flat_map(|jobs| rollout.roll(&mut Script::Random, jobs)).collect()
}
