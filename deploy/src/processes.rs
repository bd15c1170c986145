//! `rit learner` and `rit actor`: one process each.

use crate::{
    build,
    cli::{ActorOptions, LearnerOptions},
    experiments,
    failure::Failure,
    logging::LogOptions,
    shutdown, train,
};
use rit_actor::Learner;
use rit_config::{OwnedRunDir, RunDir};
use std::{
    process::ExitCode,
    sync::atomic::{AtomicBool, Ordering},
};
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
    let requested = shutdown::requested(options.supervised);
    // A learner waits for a request to end from the moment on that its run goes.
    let begun = AtomicBool::new(false);
    let shutdown = async {
        begun.store(true, Ordering::Relaxed);
        requested.await;
    };
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
        Err(failure) if options.supervised => failure,
        Err(failure) => for_people(failure, begun.load(Ordering::Relaxed)),
    };
    if matches!(failed, Failure::Input(_)) && !options.supervised {
        train::undo(owned);
    }
    Err(failed)
}

/// What a failure of a learner without a supervisor means: before its run has begun, that what was given does not fit what
/// is there; later the run itself has failed, and what it has in its directory stays.
fn for_people(failure: Failure, begun: bool) -> Failure {
    match failure {
        Failure::Unavailable(error) | Failure::Input(error) if begun => Failure::Runtime(error),
        Failure::Unavailable(error) => Failure::Input(error),
        failure => failure,
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_fails_before_a_run_has_begun_is_wrong_input() {
        let kinds = || {
            let error = || anyhow::anyhow!("/dev/shm is full");
            [Failure::Unavailable(error()), Failure::Input(error()), Failure::Runtime(error())]
        };
        let [unavailable, input, runtime] = kinds().map(|failure| for_people(failure, false));
        assert!(matches!(unavailable, Failure::Input(_)) && matches!(input, Failure::Input(_)));
        assert!(matches!(runtime, Failure::Runtime(_)));
        for failure in kinds() {
            assert!(matches!(for_people(failure, true), Failure::Runtime(_)));
        }
    }
}
