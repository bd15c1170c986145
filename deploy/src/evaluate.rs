//! `rit evaluate`: greedy episodes with a run's newest checkpoint, in this process.

use crate::{cli::EvaluateOptions, failure::Failure, report};
use rit_algo::{Acting, Rit};
use rit_config::RunDir;
use rit_episode::RunSeed;
use rit_learner::{
    checkpoint::{LATEST, WEIGHTS},
    evaluation::{Evaluator, TaskResult, by_task},
    trainer::evaluation_seed,
    weights_file,
};
use std::{process::ExitCode, sync::Arc};

/// `rit evaluate`.
#[allow(clippy::print_stdout, reason = "what the command is for")]
pub fn run(options: &EvaluateOptions) -> Result<ExitCode, Failure> {
    let (run_dir, config) = RunDir::open(&options.run)?;
    let evaluator = Evaluator::new(&config);
    let tasks = evaluator.tasks(&options.tasks)?;
    if tasks.is_empty() {
        let (task_set, names) = (config.environment.task_set, options.tasks.join(","));
        return Err(Failure::input_message(format!("{task_set} has no tasks {names}")));
    }
    let path = run_dir.checkpoints().join(LATEST).join(WEIGHTS);
    if !path.exists() {
        let root = run_dir.root().display();
        return Err(Failure::input_message(format!(
            "{root} has no checkpoint yet; `rit ctl --run {root} checkpoint` writes one"
        )));
    }
    let rit = Arc::new(Rit::new(config.rit()).map_err(Failure::input)?);
    let params = weights_file::load(&path, &rit)?;
    let episodes = options.episodes.map_or(config.evaluation.episodes, |episodes| episodes as usize);
    let seed = options.seed.map_or_else(|| evaluation_seed(&config), RunSeed);
    let mut acting = Acting::new(Arc::clone(&rit), &params[rit.acting()]);
    let results = evaluator.evaluate(&mut acting, &tasks, episodes, seed);
    let weights_digest = weights_file::digest(&params);
    if options.json {
        let output = serde_json::json!({ "weights_digest": weights_digest, "tasks": by_task(&results) });
        println!("{output:#}");
    } else {
        print!("{}", report::table(&results.iter().map(TaskResult::to_message).collect::<Vec<_>>()));
        println!("weights digest {weights_digest}");
    }
    Ok(ExitCode::SUCCESS)
}
