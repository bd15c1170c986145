//! `rit train`: a learner and its actors on this host, from beginning to end.

use crate::{
    beginning::Beginning,
    cli::{ConfigOptions, TrainOptions},
    experiments::{self, Experiment},
    failure::Failure,
    finished::Finished,
    logging::LogOptions,
    output::{self, Reader},
    progress::Progress,
    python_worlds, report,
    supervisor::{Outcome, watch_over},
};
use rit_config::{Config, OwnedRunDir, RunDir};
use rit_learner::{life, summary};
use rit_record::{Ended, Summary};
use std::{num::NonZero, path::Path, process::ExitCode};
use tracing::Instrument as _;

/// `rit train`.
pub async fn run(options: TrainOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let Prepared { owned, config, said } = prepare(&options.config)?;
    let started = refuse_no_actors(&config)
        .and_then(|()| rit_worlds::check(&config).map_err(Failure::input))
        .and_then(|notice| {
            // For people's eyes alone.
            notice.iter().for_each(|notice| drop(output::say(notice)));
            logs.start_in(&owned.run_dir().logs().join("train.log"), "train")
        });
    let span = match started {
        Ok(span) => span,
        Err(failure) => {
            undo(owned);
            return Err(failure);
        }
    };
    supervise(owned, &config, &said, &logs, &options).instrument(span).await
}

async fn supervise(
    owned: OwnedRunDir,
    config: &Config,
    said: &[String],
    logs: &LogOptions,
    &TrainOptions { json, supervised, .. }: &TrainOptions,
) -> Result<ExitCode, Failure> {
    let run_dir = owned.run_dir();
    let mut progress = Progress::new(config.training.t_max, json);
    said.iter().chain(owned.notices()).for_each(|words| progress.say(words));
    if let Some(words) = too_many_actors(config.actors.count) {
        progress.say(&words);
    }

    let (outcome, begun) =
        watch_over(&owned, logs, &mut progress, config.actors.count as u32, supervised).await;
    progress.finish();
    // Whatever became of the children, nothing of the run stays in shared memory.
    life::remove_dead(run_dir);
    match outcome {
        // What lies there of an earlier end is not this one's.
        Outcome::Interrupted if !begun => Ok(ExitCode::from(Ended::Interrupted.exit_code())),
        Outcome::Finished | Outcome::Interrupted => {
            print_summary(run_dir, json)?;
            let ended = Summary::read(run_dir).map_err(Failure::runtime)?.map(|summary| summary.ended);
            Ok(ExitCode::from(ended.unwrap_or(Ended::Failed).exit_code()))
        }
        // A run that has begun has failed, whatever the reason: its summary and the exit code say the same.
        Outcome::Failed { message, .. } if begun => {
            if let Err(error) = summary::write_failed(run_dir, &message) {
                tracing::warn!(%error, "summary.json was not written");
            }
            Err(Failure::runtime_message(message))
        }
        Outcome::Failed { input: true, message } => {
            undo(owned);
            Err(Failure::input_message(message))
        }
        Outcome::Failed { input: false, message } => Err(Failure::runtime_message(message)),
    }
}

/// Takes back what was made of a run that has not begun, so that the same command will do for the next attempt. Where that
/// fails it is said here: the error to report is the one before.
pub fn undo(owned: OwnedRunDir) {
    if let Err(error) = owned.undo() {
        // The run's log may be what was just taken away.
        let _ = output::say(&format!("warning: what was made of the run is still there: {error}"));
    }
}

/// A run that is about to begin or to go on.
struct Prepared {
    owned: OwnedRunDir,
    config: Config,
    /// What a person is told of it first.
    said: Vec<String>,
}

/// A new run's directory, or that of a run to go on with.
fn prepare(options: &ConfigOptions) -> Result<Prepared, Failure> {
    let settings = experiments::settings(options);
    let (owned, config, name, beginning) = match (&options.resume, &options.experiment) {
        (Some(root), _) => {
            let (owned, config) = OwnedRunDir::resume(root, &experiments::parse_settings(&settings)?)?;
            let name = format!("going on with {}", config.environment.task_set);
            (owned, config, name, None)
        }
        (None, Some(experiment)) => {
            let Experiment { name, mut config } = experiments::load(experiment, &settings)?;
            let name =
                options.algorithm.as_ref().map_or(name.clone(), |algorithm| format!("{name}-{algorithm}"));
            refuse_no_actors(&config)?;
            let from = options.from.as_ref();
            let beginning = from.map(|from| Beginning::from(from, &mut config)).transpose()?;
            let owned = match &options.run_dir {
                Some(root) => OwnedRunDir::create(root, &config)?,
                None => OwnedRunDir::create_fresh(Path::new("runs"), &name, &config)?,
            };
            (owned, config, name, beginning)
        }
        (None, None) => return Err(Failure::input_message("which experiment? `rit experiments` lists them")),
    };
    let root = owned.run_dir().root().display();
    let actors = report::counted(config.actors.count as u64, "actor");
    let mut said = vec![format!("{name}: learner and {actors}, run directory {root}")];
    said.extend(python_worlds::not_reproducible(&config));
    if let Some(beginning) = beginning {
        if let Err(failure) = beginning.write(owned.run_dir()) {
            undo(owned);
            return Err(failure);
        }
        said.push(beginning.words().to_owned());
    }
    Ok(Prepared { owned, config, said })
}

/// What to say of more actors than the machine has work for.
fn too_many_actors(count: usize) -> Option<String> {
    // Two for a processor still make up for each other's waiting.
    let processors = std::thread::available_parallelism().map_or(1, NonZero::get);
    (count > 2 * processors).then(|| {
        format!(
            "{count} actors share {processors} processors with the learner: they will mostly wait for each other, and \
             {processors} would do (--actors {processors})"
        )
    })
}

fn refuse_no_actors(config: &Config) -> Result<(), Failure> {
    if config.actors.count > 0 || config.actors.remote > 0 {
        return Ok(());
    }
    Err(Failure::input_message(
        "actors.count = 0: `rit train` needs at least one actor; set actors.remote for actors on other hosts",
    ))
}

/// Prints what the run came to. Where that cannot be written the run has come to its end all the same, and the exit
/// code is that of the run.
fn print_summary(run_dir: &RunDir, json: bool) -> Result<(), Failure> {
    let finished = Finished::read(run_dir)?;
    let why = match output::print(&if json { finished.json() } else { finished.text() }) {
        Ok(Reader::There) => return Ok(()),
        Ok(Reader::Gone) => "standard output has no reader any more".to_owned(),
        Err(failure) => {
            let _ = output::say(&format!("{failure}; the run is whole, and its summary in summary.json"));
            failure.to_string()
        }
    };
    tracing::warn!(why, "the summary is in summary.json alone");
    Ok(())
}
