//! Which checkpoint training goes on from.

use super::{
    BEST, CheckpointError, MANIFEST, Manifest, Origin, OtherOrigin, TrainingState, folders, load,
    load_manifest, written,
};
use crate::replay_log;
use rit_algo::Learner;
use rit_config::{Config, RunDir};
use rit_episode::{Episode, wire::Expected};
use rit_policy::place::{LATEST, WEIGHTS};
use std::path::{Path, PathBuf};

/// A checkpoint that training goes on from.
#[derive(Debug)]
pub struct Loaded {
    /// Its folder.
    pub folder: PathBuf,
    /// All but replay.
    pub state: TrainingState,
    /// Replay, oldest first.
    pub replay: Vec<Episode>,
    /// Warnings: newer checkpoints that could not be used, settings that have changed.
    pub warnings: Vec<String>,
}

/// The newest checkpoint that is whole, with replay's last episodes; `None` for a run that has never
/// written one. Newer ones that are damaged are set aside, so that they do not count any more.
///
/// # Errors
/// When there are checkpoints and none can be used, when there were and they are gone, when one is of another run or
/// was trained otherwise, or when it has more steps than the run shall make. Then nothing has been changed.
pub fn load_newest(
    run_dir: &RunDir,
    learner: &dyn Learner,
    expected: &Expected,
    config: &Config,
) -> Result<Option<Loaded>, CheckpointError> {
    let all = run_dir.checkpoints();
    let origin = Origin::of(run_dir, config)?;
    let (mut misnamed, mut damaged) = (Vec::new(), Vec::<(PathBuf, CheckpointError)>::new());
    let mut candidates = Vec::new();
    for folder in folders::list(&all)?.into_iter().rev() {
        match load_manifest(&folder.path) {
            Ok(manifest) => {
                let changed = check_origin(&origin, &folder.path, &manifest)?;
                let env_steps = manifest.progress.env_steps;
                if env_steps == folder.env_steps {
                    candidates.push((folder.path, Ok(changed)));
                } else {
                    misnamed.push(CheckpointError::Misnamed { folder: folder.path, env_steps });
                }
            }
            Err(error) => candidates.push((folder.path, Err(error))),
        }
    }
    for (folder, manifest) in candidates {
        let loaded = manifest
            .and_then(|changed| Ok((changed, load_whole(&folder, run_dir, learner, expected, config)?)));
        match loaded {
            Ok((changed, (state, replay))) => {
                check_steps(&state.manifest, config)?;
                let mut warnings: Vec<String> = misnamed.iter().map(ToString::to_string).collect();
                warnings.extend(changed);
                let env_steps = state.manifest.progress.env_steps;
                warnings.extend(damaged.iter().map(|(path, error)| set_aside(path, error, env_steps)));
                return Ok(Some(Loaded { folder, state, replay, warnings }));
            }
            Err(error) => damaged.push((folder, error)),
        }
    }
    if let Some(newest) = damaged.into_iter().map(|(_, error)| error).chain(misnamed).next() {
        return Err(CheckpointError::NoneUsable { folder: all, newest: Box::new(newest) });
    }
    match written::newest(run_dir) {
        Some(newest) => Err(CheckpointError::Gone { folder: all, newest }),
        None => Ok(None),
    }
}

/// Which of a run's weights are wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Which {
    /// Those of the newest checkpoint.
    #[default]
    Latest,
    /// The best that it keeps.
    Best,
    /// Those of the checkpoint at so many environment steps.
    Step(u64),
}

/// The file of the weights, for a reader that wants them alone; `None` for a run that has never written a checkpoint.
///
/// # Errors
/// When there was one and it is gone, when it is of another run or build, or when these weights are not kept.
pub fn weights(run_dir: &RunDir, config: &Config, which: Which) -> Result<Option<PathBuf>, CheckpointError> {
    let all = run_dir.checkpoints();
    let folder = match which {
        Which::Step(env_steps) => at_step(&all, env_steps)?,
        Which::Latest | Which::Best => all.join(LATEST),
    };
    if !folder.join(MANIFEST).exists() {
        return match written::newest(run_dir) {
            Some(newest) => Err(CheckpointError::Gone { folder: all, newest }),
            None => Ok(None),
        };
    }
    let manifest = load_manifest(&folder)?;
    match Origin::of(run_dir, config)?.may_go_on_from(&manifest.origin) {
        // Settings that another training would follow from do not change what these weights do.
        Ok(_) | Err(OtherOrigin::Setting { .. }) => {}
        Err(what) => return Err(CheckpointError::Other { folder, what }),
    }
    match (which, manifest.best) {
        (Which::Best, None) => Err(CheckpointError::NoBest { folder }),
        (Which::Best, Some(_)) => Ok(Some(folder.join(BEST))),
        _ => Ok(Some(folder.join(WEIGHTS))),
    }
}

/// The newest folder at this step.
fn at_step(all: &Path, env_steps: u64) -> Result<PathBuf, CheckpointError> {
    let folders = folders::list(all)?;
    let found = folders.iter().rfind(|folder| folder.env_steps == env_steps);
    found.map(|folder| folder.path.clone()).ok_or_else(|| {
        let mut there: Vec<String> =
            folders.iter().map(|folder| format!("step-{}", folder.env_steps)).collect();
        there.dedup();
        CheckpointError::NoStep { folder: all.to_owned(), env_steps, there }
    })
}

/// The settings that have changed since, in words.
fn check_origin(origin: &Origin, folder: &Path, manifest: &Manifest) -> Result<Vec<String>, CheckpointError> {
    let other = |what: OtherOrigin| CheckpointError::Other { folder: folder.to_owned(), what };
    origin.may_go_on_from(&manifest.origin).map_err(other)
}

/// A run that its last batch has brought beyond `t_max` is over. One that was there before wants fewer steps than it
/// has.
fn check_steps(manifest: &Manifest, config: &Config) -> Result<(), CheckpointError> {
    let (t_max, before) = (config.training.t_max, manifest.env_steps_before);
    if before > 0 && t_max <= before {
        return Err(CheckpointError::StepsDone { t_max, env_steps: manifest.progress.env_steps });
    }
    Ok(())
}

fn load_whole(
    folder: &Path,
    run_dir: &RunDir,
    learner: &dyn Learner,
    expected: &Expected,
    config: &Config,
) -> Result<(TrainingState, Vec<Episode>), CheckpointError> {
    let state = load(folder, learner, expected.tasks.len(), &config.algorithm)?;
    let end = state.manifest.progress.episodes;
    let numbers = end.saturating_sub(config.replay_episodes() as u64)..end;
    let replay = replay_log::read(&run_dir.replay(), expected, numbers)?;
    Ok((state, replay))
}

/// Takes a damaged checkpoint out of the count; what is said of it.
fn set_aside(folder: &Path, error: &CheckpointError, used: u64) -> String {
    let place = folders::set_aside(folder);
    let place = place.map_or_else(String::new, |place| format!("; it lies in {} now", place.display()));
    format!("a checkpoint is damaged, the one at {used} steps is used: {error}{place}")
}
