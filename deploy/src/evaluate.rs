//! `rit evaluate`: greedy episodes with a run's newest checkpoint or a script, in this process.

use crate::{cli::EvaluateOptions, failure::Failure, output, player::Player, report};
use rit_learner::evaluation::{Evaluator, TaskResult, by_task};
use std::process::ExitCode;

/// `rit evaluate`.
pub fn run(options: &EvaluateOptions) -> Result<ExitCode, Failure> {
    let mut player = Player::new(&options.play)?;
    let config = &player.config;
    let evaluator = Evaluator::new(config);
    let tasks = evaluator.tasks(&options.tasks)?;
    let episodes = options.episodes.map(|episodes| episodes as usize);
    let seed = player.seed(options.seed);
    let results = evaluator.evaluate_own(player.policy.as_mut(), &tasks, episodes, seed)?;
    if options.json {
        let answer = serde_json::json!({
            "policy": player.name,
            "weights_digest": player.weights_digest,
            "tasks": by_task(&results),
        });
        output::print(&format!("{answer:#}\n"))?;
    } else {
        let mut lines: Vec<_> = results.iter().map(TaskResult::to_message).collect();
        lines.extend(report::mean(&lines));
        let digest = player.weights_digest.map(|digest| format!("weights digest {digest}\n"));
        output::print(&(report::table(&lines) + &digest.unwrap_or_default()))?;
    }
    Ok(ExitCode::SUCCESS)
}
