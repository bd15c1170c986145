//! `rit export`: a policy or its episodes, in formats that others load.

mod episodes;

use crate::{
    cli::ExportOptions,
    failure::Failure,
    new_file, output,
    player::{Player, weights_path},
    report,
};
use episodes::Recorded;
use rit_learner::evaluation::Evaluator;
use rit_onnx::OPSET;
use rit_policy::Weights;
use serde_json::json;
use std::{fs, path::Path, process::ExitCode};

/// Episodes that are rolled side by side, at most.
const SIDE_BY_SIDE: usize = 32;

/// `rit export`.
pub fn run(options: &ExportOptions) -> Result<ExitCode, Failure> {
    match (&options.onnx, options.episodes, &options.out) {
        (Some(folder), _, _) => onnx(options, folder)?,
        (None, Some(count), Some(out)) => write_episodes(options, count.into(), out)?,
        // The command line is held to one of them.
        _ => return Err(Failure::input_message("give --onnx DIR, or --episodes N with --out FILE")),
    }
    Ok(ExitCode::SUCCESS)
}

fn onnx(options: &ExportOptions, folder: &Path) -> Result<(), Failure> {
    let Some(run) = &options.play.run else {
        return Err(Failure::input_message("give --run DIR, whose policy is exported"));
    };
    let files = ["encoder.onnx", "head.onnx"].map(|name| folder.join(name));
    files.iter().try_for_each(|file| new_file::check(file, options.force))?;
    let (_, path) = weights_path(run, options.play.checkpoint.unwrap_or_default())?;
    let weights = Weights::load(&path)?;
    let graphs = rit_onnx::graphs(&weights).map_err(Failure::input)?;
    fs::create_dir_all(folder).map_err(|error| new_file::failure("--onnx", folder, &error))?;
    for (file, bytes) in files.iter().zip([graphs.encoder, graphs.head]) {
        new_file::write("--onnx", file, &bytes, options.force)?;
    }
    let [encoder, head] = files.map(|file| file.display().to_string());
    let digest = &weights.description.digest;
    output::print(&if options.json {
        let answer = json!({ "files": [encoder, head], "opset": OPSET, "weights_digest": digest });
        format!("{answer:#}\n")
    } else {
        format!("{encoder}\n{head}\nopset {OPSET}, weights digest {digest}\n")
    })?;
    Ok(())
}

fn write_episodes(options: &ExportOptions, count: u64, out: &Path) -> Result<(), Failure> {
    if out.extension().is_none_or(|ending| ending != "safetensors") {
        return Err(Failure::input_message(format!("--out {} must end in .safetensors", out.display())));
    }
    new_file::check(out, options.force)?;
    let mut player = Player::new(&options.play)?;
    let worlds = rit_worlds::factory(&player.config);
    let at_once = worlds.worlds_max().clamp(1, SIDE_BY_SIDE);
    let evaluator = Evaluator::with_factory(&player.config, worlds);
    let tasks = evaluator.tasks(&options.tasks)?;
    let seed = player.seed(options.seed);
    let (mut all, mut said) = (Vec::new(), Vec::new());
    for task in tasks {
        let mut recorded = Recorded::new(task);
        for begin in (0..count).step_by(at_once) {
            let numbers = begin..(begin + at_once as u64).min(count);
            let rolled = evaluator.watch(player.policy.as_mut(), task, numbers, seed, |_, _| {})?;
            rolled.iter().for_each(|episode| recorded.push(episode));
        }
        said.push((task.to_string(), recorded.steps(), recorded.mean_return()));
        all.push(recorded);
    }
    let bytes = episodes::encode(&all, &player, seed).map_err(Failure::runtime)?;
    new_file::write("--out", out, &bytes, options.force)?;
    output::print(&if options.json {
        let task = |(task, steps, mean_return): &(String, usize, f64)| json!({ "task": task, "episodes": count, "steps": steps, "mean_return": mean_return });
        let tasks: Vec<_> = said.iter().map(task).collect();
        format!("{:#}\n", json!({ "file": out.display().to_string(), "tasks": tasks }))
    } else {
        let line = |(task, steps, mean_return): &(String, usize, f64)| {
            let steps = report::grouped(*steps as u64);
            format!("{task}: {count} episodes, {steps} steps, mean return {mean_return:.2}\n")
        };
        let lines: String = said.iter().map(line).collect();
        format!("{lines}{} ({} bytes)\n", out.display(), report::grouped(bytes.len() as u64))
    })?;
    Ok(())
}
