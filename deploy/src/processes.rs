//! `rit learner` and `rit actor`: one process each.

use crate::{
    cli::{ActorOptions, LearnerOptions},
    experiments,
    failure::Failure,
    logging::LogOptions,
    shutdown,
};
use rit_actor::Learner;
use rit_config::RunDir;
use std::process::ExitCode;
use tracing::Instrument as _;

/// `rit learner`.
pub async fn learner(options: LearnerOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let (span, set_log) = logs.start("learner")?;
    if let Some(experiment) = &options.new {
        let mut settings = options.settings.clone();
        settings.extend(experiments::algorithm(options.algorithm.as_deref()));
        let experiment = experiments::load(experiment, &settings)?;
        RunDir::create(&options.run_dir, &experiment.config)?;
    }
    let (run_dir, config) = RunDir::open(&options.run_dir)?;
    let shutdown = shutdown::requested(options.supervised);
    let ended = rit_learner::run(run_dir, config, set_log, shutdown).instrument(span).await;
    let summary = ended.map_err(|error| match Failure::from(error) {
        // For people, what they gave it does not fit what is there.
        Failure::Unavailable(error) if !options.supervised => Failure::Input(error),
        failure => failure,
    })?;
    tracing::info!(
        digest = summary.weights_digest,
        env_steps = summary.progress.env_steps,
        "the run is over"
    );
    Ok(ExitCode::SUCCESS)
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
