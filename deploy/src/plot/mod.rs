//! `rit plot`: learning curves of runs, as SVG.

mod curves;
mod draw;
mod runs;

use crate::{cli::PlotOptions, failure::Failure, new_file, output};
use std::process::ExitCode;

/// `rit plot`.
///
/// # Errors
/// When a run has no evaluations, runs do not go together, or the file is there or cannot be written.
pub fn run(options: &PlotOptions) -> Result<ExitCode, Failure> {
    if options.out.extension().is_none_or(|ending| ending != "svg") {
        return Err(Failure::input_message(format!(
            "--out {}: a plot's name ends in .svg",
            options.out.display()
        )));
    }
    new_file::check(&options.out, options.force)?;
    let mut runs = Vec::new();
    for path in &options.runs {
        let run = runs::read(path, options.metric)?;
        if run.broken_lines > 0 {
            // It is drawn without them, whether or not anybody is told.
            let lines = run.broken_lines;
            let _ = output::say(&format!("{}: {lines} lines cannot be read and are left out", run.name));
        }
        runs.push(run);
    }
    runs::refuse_twice(&runs)?;
    let series =
        if options.compare { curves::by_kind(&runs, &options.labels)? } else { curves::by_task(&runs)? };
    let text = draw::draw(&series, options).map_err(|error| Failure::runtime_message(error.to_string()))?;
    new_file::write(&options.out, text.as_bytes(), options.force)?;
    Ok(ExitCode::SUCCESS)
}
