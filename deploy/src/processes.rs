//! `rit learner` and `rit actor`: one process each.

use crate::{
    build,
    cli::{ActorOptions, LearnerOptions},
    experiments,
    failure::Failure,
    logging::LogOptions,
    shutdown,
};
use rit_actor::Learner;
use rit_config::{OwnedRunDir, RunDir};
use std::process::ExitCode;
use tracing::Instrument as _;

/// `rit learner`.
pub async fn learner(options: LearnerOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let (span, set_log) = logs.start("learner")?;
    let (owned, config) = match &options.new {
        Some(experiment) => {
            let mut settings = options.settings.clone();
            settings.extend(experiments::algorithm(options.algorithm.as_deref()));
            let config = experiments::load(experiment, &settings)?.config;
            (OwnedRunDir::create(&options.run_dir, &config)?, config)
        }
        None => OwnedRunDir::open(&options.run_dir, options.supervised)?,
    };
    owned.notices().iter().for_each(|notice| tracing::warn!("{notice}"));
    let shutdown = shutdown::requested(options.supervised);
    let run_dir = owned.run_dir().clone();
    let ended = match rit_worlds::check(&config).map_err(Failure::input) {
        Ok(notice) => {
            notice.iter().for_each(|notice| tracing::warn!("{notice}"));
            let running =
                rit_learner::run(run_dir, config, build::this(), set_log, shutdown).instrument(span);
            running.await.map_err(Failure::from)
        }
        Err(failure) => Err(failure),
    };
    let failed = match ended {
        Ok(summary) => {
            let (digest, env_steps) = (summary.weights_digest, summary.progress.env_steps);
            tracing::info!(digest, env_steps, ended = %summary.ended, "the run is over");
            return Ok(ExitCode::from(summary.ended.exit_code()));
        }
        // For people, what they gave it does not fit what is there.
        Err(Failure::Unavailable(error)) if !options.supervised => Failure::Input(error),
        Err(failure) => failure,
    };
    if matches!(failed, Failure::Input(_)) && !options.supervised {
        // The same command will do for the next attempt.
        owned.undo()?;
    }
    Err(failed)
}

/// `rit actor`.
pub async fn actor(options: ActorOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let (span, _) = logs.start(&options.name)?;
    let learner = match (options.address, options.run_dir) {
        (Some(address), _) => Learner::At(address, options.credentials.read()?),
        (None, Some(run_dir)) => Learner::Here(RunDir::open(&run_dir)?.0),
        (None, None) => {
            return Err(Failure::input_message("which learner? give --run-dir DIR or --address ADDRESS"));
        }
    };
    let shutdown = shutdown::requested(options.supervised);
    let options =
        rit_actor::ActorOptions { name: options.name, slot: options.slot, supervised: options.supervised };
    rit_actor::run(learner, options, shutdown).instrument(span).await?;
    Ok(ExitCode::SUCCESS)
}
