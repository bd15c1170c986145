//! `rit train`: a learner and its actors on this host, from beginning to end.

use crate::{
    cli::{ConfigOptions, TrainOptions},
    experiments::{self, Experiment},
    failure::{Failure, INTERRUPTED},
    logging::LogOptions,
    progress::Progress,
    report,
    supervisor::{Outcome, watch_over},
};
use rit_config::{Config, RunDir};
use rit_ipc::RunSpace;
use rit_proto::v1::TaskResult;
use std::{fs, path::Path, process::ExitCode};

/// `rit train`.
pub async fn run(options: TrainOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let (run_dir, config, name) = prepare(&options.config)?;
    let mut progress = Progress::new(config.training.t_max, options.json);
    let root = run_dir.root().display();
    progress.say(&format!("{name}: learner and {} actors, run directory {root}", config.actors.count));

    let outcome = watch_over(&run_dir, &logs, &mut progress, config.actors.count as u32).await;
    progress.finish();
    remove_shared_memory(&run_dir);
    match outcome {
        Outcome::Finished => print_summary(&run_dir, options.json).map(|()| ExitCode::SUCCESS),
        Outcome::Interrupted => {
            print_summary(&run_dir, options.json)?;
            Ok(ExitCode::from(INTERRUPTED))
        }
        Outcome::Failed { input: true, message } => {
            if !run_dir.metrics().exists() {
                // It never began: the same directory will do for the next attempt.
                fs::remove_dir_all(run_dir.root()).map_err(Failure::runtime)?;
            }
            Err(Failure::input_message(message))
        }
        Outcome::Failed { input: false, message } => Err(Failure::runtime_message(message)),
    }
}

/// A new run's directory, or that of a run to go on with; its configuration and what it is called.
fn prepare(options: &ConfigOptions) -> Result<(RunDir, Config, String), Failure> {
    let settings = experiments::settings(options);
    let (run_dir, config, name) = match (&options.resume, &options.experiment) {
        (Some(root), _) => {
            let (run_dir, config) = RunDir::resume(root, &experiments::parse_settings(&settings)?)?;
            let name = format!("going on with {}", config.environment.task_set);
            (run_dir, config, name)
        }
        (None, Some(experiment)) => {
            let Experiment { name, config } = experiments::load(experiment, &settings)?;
            let name =
                options.algorithm.as_ref().map_or(name.clone(), |algorithm| format!("{name}-{algorithm}"));
            refuse_no_actors(&config)?;
            let run_dir = match &options.run_dir {
                Some(root) => RunDir::create(root, &config)?,
                None => RunDir::create_fresh(Path::new("runs"), &name, &config)?,
            };
            (run_dir, config, name)
        }
        (None, None) => return Err(Failure::input_message("which experiment? `rit experiments` lists them")),
    };
    refuse_no_actors(&config)?;
    Ok((run_dir, config, name))
}

fn refuse_no_actors(config: &Config) -> Result<(), Failure> {
    if config.actors.count > 0 || config.actors.remote > 0 {
        return Ok(());
    }
    Err(Failure::input_message(
        "actors.count = 0: `rit train` needs at least one actor; set actors.remote for actors on other hosts",
    ))
}

/// Whatever became of the children, nothing of the run stays in shared memory.
pub fn remove_shared_memory(run_dir: &RunDir) {
    match RunSpace::new(&run_dir.shared_memory_root()).map(|space| space.remove()) {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(%error, "something of the run is still in shared memory"),
        Err(error) => tracing::warn!(%error, "something of the run is still in shared memory"),
    }
}

/// Prints what `summary.json` says.
#[allow(clippy::print_stdout, reason = "what the command is for")]
pub fn print_summary(run_dir: &RunDir, json: bool) -> Result<(), Failure> {
    let path = run_dir.summary();
    let text = fs::read_to_string(&path).map_err(Failure::runtime)?;
    if json {
        println!("{}", text.trim_end());
        return Ok(());
    }
    let summary: serde_json::Value = serde_json::from_str(&text).map_err(Failure::runtime)?;
    let number = |key: &str| summary[key].as_u64().unwrap_or_default();
    let results: Vec<TaskResult> =
        summary["evaluation"].as_object().into_iter().flatten().map(task_result).collect();
    println!(
        "{} environment steps, {} episodes, {} updates in {}",
        report::grouped(number("env_steps")),
        report::grouped(number("episodes")),
        report::grouped(number("updates")),
        report::duration(summary["wall_s"].as_f64().unwrap_or_default())
    );
    print!("{}", report::table(&results));
    println!("weights digest {}", summary["weights_digest"].as_str().unwrap_or_default());
    println!("run directory  {}", run_dir.root().display());
    Ok(())
}

fn task_result((task, result): (&String, &serde_json::Value)) -> TaskResult {
    TaskResult {
        task: task.clone(),
        episodes: result["episodes"].as_u64().unwrap_or_default(),
        mean_return: result["mean_return"].as_f64().unwrap_or_default(),
        win_rate: result["win_rate"].as_f64(),
        ..TaskResult::default()
    }
}
