//! Who plays an evaluation or a picture, and what: `--policy`, `--run` and `--experiment`.

use crate::{cli::PlayOptions, experiments, failure::Failure, output};
use rit_algo::{Acting, Model};
use rit_config::{Backend, Config, RunDir, resolve};
use rit_env::Script;
use rit_episode::{Policy, RunSeed};
use rit_learner::{
    checkpoint::{self, Which},
    trainer::evaluation_seed,
};
use rit_policy::weights_file;
use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

/// The policy of a checkpoint, as it is typed.
const CHECKPOINT: &str = "checkpoint";
/// What the name of a script is typed after.
const SCRIPT: &str = "script:";

/// A policy and the configuration whose tasks it plays.
pub struct Player {
    /// The policy as it is typed.
    pub name: String,
    /// Says which tasks there are, and with which options they are played.
    pub config: Config,
    /// The policy itself.
    pub policy: Box<dyn Policy>,
    /// Digest of the weights, where it has any.
    pub weights_digest: Option<String>,
}

/// A run's configuration, and the file of these weights of it.
///
/// # Errors
/// When it has none.
pub fn weights_path(run: &Path, which: Which) -> Result<(Config, PathBuf), Failure> {
    let (run_dir, config) = RunDir::open(run)?;
    let Some(weights) = checkpoint::weights(&run_dir, &config, which).map_err(Failure::input)? else {
        let root = run_dir.root().display();
        return Err(Failure::input_message(format!(
            "{root} has no checkpoint yet; `rit ctl --run {root} checkpoint` writes one"
        )));
    };
    Ok((config, weights))
}

/// What a run has come to.
pub struct Trained {
    /// The run's configuration.
    pub config: Config,
    /// Its model.
    pub model: Arc<Model>,
    /// All parameters.
    pub params: Vec<f32>,
}

impl Trained {
    /// Reads these weights of the run.
    ///
    /// # Errors
    /// When it has none, or they are not as they were written.
    pub fn load(run: &Path, which: Which) -> Result<Self, Failure> {
        let (config, weights) = weights_path(run, which)?;
        let model = Arc::new(Model::new(config.model()).map_err(Failure::input)?);
        let params = weights_file::load(&weights, model.layout())?;
        Ok(Self { config, model, params })
    }

    /// The policy itself.
    pub fn policy(&self) -> Box<dyn Policy> {
        Box::new(Acting::new(&self.model, &self.params[self.model.acting()]))
    }
}

impl Player {
    /// What these options ask for.
    ///
    /// # Errors
    /// When something is missing or unknown, or options do not fit each other.
    pub fn new(options: &PlayOptions) -> Result<Self, Failure> {
        let player = Self::of_policy(options)?;
        if let Some(notice) = rit_worlds::check(&player.config).map_err(Failure::input)? {
            // For people's eyes alone.
            let _ = output::say(&notice);
        }
        Ok(player)
    }

    fn of_policy(options: &PlayOptions) -> Result<Self, Failure> {
        match options.policy.strip_prefix(SCRIPT) {
            Some(name) => Self::script(name.parse()?, options),
            None if options.policy == CHECKPOINT => Self::checkpoint(options),
            None => Err(Failure::input_message(format!(
                "unknown policy {:?}; write {CHECKPOINT} or {SCRIPT}NAME with one of {}",
                options.policy,
                Script::ALL.map(|script| script.to_string()).join(", ")
            ))),
        }
    }

    /// The seed that was asked for, or the one that follows from the configuration's: two policies meet the
    /// same episodes.
    pub fn seed(&self, asked: Option<u64>) -> RunSeed {
        asked.map_or_else(|| evaluation_seed(&self.config), RunSeed)
    }

    fn script(script: Script, options: &PlayOptions) -> Result<Self, Failure> {
        if options.checkpoint.is_some() {
            return Err(Failure::input_message("--checkpoint is for weights; a script has none"));
        }
        let config = match (&options.run, &options.experiment) {
            (Some(run), None) => RunDir::open(run)?.1,
            (None, Some(experiment)) => experiments::load(experiment, &[])?.config,
            (Some(_), Some(_)) => {
                return Err(Failure::input_message(
                    "both --run and --experiment say what is played; give one",
                ));
            }
            (None, None) => {
                return Err(Failure::input_message(format!(
                    "--policy {SCRIPT}{script} does not say what is played; give --experiment NAME or --run DIR"
                )));
            }
        };
        let config = with_backend(config, options)?;
        script.check(config.environment.task_set)?;
        Ok(Self { name: format!("{SCRIPT}{script}"), config, policy: Box::new(script), weights_digest: None })
    }

    fn checkpoint(options: &PlayOptions) -> Result<Self, Failure> {
        if options.experiment.is_some() {
            return Err(Failure::input_message(format!(
                "--experiment is for scripts, such as --policy {SCRIPT}random; a checkpoint comes with its --run DIR"
            )));
        }
        let Some(run) = &options.run else {
            return Err(Failure::input_message(format!(
                "give --run DIR, whose checkpoint plays, or a --policy {SCRIPT}NAME that needs none"
            )));
        };
        let trained = Trained::load(run, options.checkpoint.unwrap_or_default())?;
        let policy = trained.policy();
        let weights_digest = Some(weights_file::digest(&trained.params));
        let config = with_backend(trained.config, options)?;
        Ok(Self { name: CHECKPOINT.to_owned(), config, policy, weights_digest })
    }
}

/// The configuration, played where these options say.
fn with_backend(config: Config, options: &PlayOptions) -> Result<Config, Failure> {
    let mut config = config;
    config.environment.backend = match options.backend.as_deref() {
        None => return Ok(config),
        Some("embedded") => Backend::Embedded,
        Some("starcraft") => Backend::Starcraft,
        Some(other) => {
            return Err(Failure::input_message(format!(
                "--backend {other:?} is not one of: embedded, starcraft"
            )));
        }
    };
    // What goes with the one back end may not go with the other.
    Ok(resolve(&config.to_toml()?, "the configuration", &[])?)
}
