//! `rit evaluate`: greedy episodes with a run's newest checkpoint or a script, in this process.

use crate::{cli::EvaluateOptions, failure::Failure, player::Player, report};
use rit_learner::evaluation::{Evaluator, TaskResult, by_task};
use std::process::ExitCode;

/// `rit evaluate`.
#[allow(clippy::print_stdout, reason = "what the command is for")]
pub fn run(options: &EvaluateOptions) -> Result<ExitCode, Failure> {
    let mut player = Player::new(&options.play)?;
    let config = &player.config;
    let evaluator = Evaluator::new(config);
    let tasks = evaluator.tasks(&options.tasks)?;
    if tasks.is_empty() {
        let (task_set, names) = (config.environment.task_set, options.tasks.join(","));
        return Err(Failure::input_message(format!("{task_set} has no tasks {names}")));
    }
    let episodes = options.episodes.map_or(config.evaluation.episodes, |episodes| episodes as usize);
    let seed = player.seed(options.seed);
    let results = evaluator.evaluate(player.policy.as_mut(), &tasks, episodes, seed)?;
    if options.json {
        let output = serde_json::json!({
            "policy": player.name,
            "weights_digest": player.weights_digest,
            "tasks": by_task(&results),
        });
        println!("{output:#}");
    } else {
        let mut lines: Vec<_> = results.iter().map(TaskResult::to_message).collect();
        lines.extend(report::mean(&lines));
        print!("{}", report::table(&lines));
        if let Some(digest) = &player.weights_digest {
            println!("weights digest {digest}");
        }
    }
    Ok(ExitCode::SUCCESS)
}
