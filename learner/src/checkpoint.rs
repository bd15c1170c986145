//! Checkpoints: all that training needs to go on as if it had never stopped.
//!
//! A checkpoint is a folder `checkpoints/step-…`:
//!
//! | file | what it holds |
//! |---|---|
//! | `weights.safetensors` | the weights, under the specification's names |
//! | `best.safetensors` | those of the best evaluation so far, where `checkpoints.keep_best` asks for them |
//! | `state.safetensors` | the learner's state under its names (target network, optimiser moments, …), and the acting weights that open batches are rolled with |
//! | `checkpoint.json` | progress, the terms of open batches, positions in other files |
//! | `SHA256SUMS` | of the files above; `sha256sum --check SHA256SUMS` |
//!
//! Replay lies beside them in `replay/`, written as it grows (see [`crate::replay_log`]). Random streams need no
//! place: they follow from the seed and the progress. A folder is written beside its place, made durable and
//! then renamed there, so it is whole or not there, and no folder is ever replaced. `checkpoints/latest` is a link to
//! the newest; `checkpoints.json`, beside the folder of them all, says that there are some.

mod folders;
mod manifest;
mod newest;
mod origin;
mod written;

pub use manifest::{Manifest, SnapshotMark};
pub use newest::{Loaded, Which, load_newest, weights};
pub use origin::{FORMAT_VERSION, Origin, OtherOrigin};

use crate::{
    replay_log::{ReplayLogError, remedy},
    weights::Snapshot,
};
use folders::PARTIAL;
use rit_algo::{
    Learner, Model,
    learner::{NamedState, Numbers},
};
use rit_config::{Algorithm, RunDir};
use rit_policy::{
    TaskNames, WeightsFileError,
    place::{LATEST, WEIGHTS},
    weights_file,
};
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use sha2::{Digest as _, Sha256};
use std::{
    fs::{self, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::symlink,
    path::{Path, PathBuf},
};

/// The best weights' file inside a checkpoint.
const BEST: &str = "best.safetensors";
const STATE: &str = "state.safetensors";
const MANIFEST: &str = "checkpoint.json";
const SUMS: &str = "SHA256SUMS";
/// No file of a checkpoint is longer: whatever lies in its place is not read to its end.
const FILE_BYTES_MAX: u64 = 1 << 36;

/// All that training needs to go on, but for replay.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingState {
    /// All parameters.
    pub params: Vec<f32>,
    /// Those of the best policy, which the manifest tells of.
    pub best: Option<Vec<f32>>,
    /// The rest of the learner: see [`Learner::state`].
    pub learner: Vec<NamedState<'static>>,
    /// The acting weights that the terms name.
    pub snapshots: Vec<Snapshot>,
    /// The rest.
    pub manifest: Manifest,
}

/// Why a checkpoint cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The system refused.
    #[error("{path}: {error}{}", remedy(error))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The weights.
    #[error(transparent)]
    Weights(#[from] WeightsFileError),
    /// Replay.
    #[error(transparent)]
    Replay(#[from] ReplayLogError),
    /// Tensors that cannot be written or read.
    #[error("{path} is no whole safetensors file ({error}); it was truncated or altered")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: SafeTensorError,
    },
    /// A file that is not what was written.
    #[error("{path} was altered: its SHA-256 is not the one in {SUMS}")]
    Altered {
        /// The file.
        path: PathBuf,
    },
    /// Sizes or contents that make no state.
    #[error("{path}: {what}")]
    Inconsistent {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        what: String,
    },
    /// Another run's, or one that was trained otherwise.
    #[error("{folder}: {what}")]
    Other {
        /// The checkpoint.
        folder: PathBuf,
        /// What differs.
        what: OtherOrigin,
    },
    /// A renamed one.
    #[error("{folder} holds the checkpoint at {env_steps} steps and is called otherwise; it is left out")]
    Misnamed {
        /// The checkpoint.
        folder: PathBuf,
        /// What its manifest says.
        env_steps: u64,
    },
    /// Checkpoints there are, and none can be used.
    #[error("no checkpoint in {folder} can be used; the newest: {newest}")]
    NoneUsable {
        /// The folder of all checkpoints.
        folder: PathBuf,
        /// What is wrong with the newest.
        newest: Box<CheckpointError>,
    },
    /// Checkpoints there were.
    #[error(
        "{folder} holds no checkpoint, and this run has written some (the newest: {newest}); put them back, or begin a \
         new run in another directory"
    )]
    Gone {
        /// The folder of all checkpoints.
        folder: PathBuf,
        /// The newest one's folder.
        newest: String,
    },
    /// No best policy is kept.
    #[error(
        "{folder} keeps no best policy: checkpoints.keep_best was not set when it was written; --checkpoint latest plays \
         the newest"
    )]
    NoBest {
        /// The newest checkpoint.
        folder: PathBuf,
    },
    /// There is no such checkpoint.
    #[error("{folder} holds no checkpoint at {env_steps} steps; there are: {}", there.join(", "))]
    NoStep {
        /// The folder of all checkpoints.
        folder: PathBuf,
        /// What was asked for.
        env_steps: u64,
        /// Those there are.
        there: Vec<String>,
    },
    /// Fewer steps are wanted than there are.
    #[error(
        "training.t_max = {t_max}, and {env_steps} steps are done already; set it higher (--steps), or leave it as it was"
    )]
    StepsDone {
        /// The steps wanted.
        t_max: u64,
        /// The steps done.
        env_steps: u64,
    },
    /// The configuration cannot be written down.
    #[error(transparent)]
    Config(#[from] rit_config::ConfigError),
}

/// What the newest checkpoint says of itself, if there is one that can be read at all.
pub fn newest_manifest(run_dir: &RunDir) -> Option<Manifest> {
    folders::list_named_right(&run_dir.checkpoints()).ok()?.pop().map(|(_, manifest)| manifest)
}

/// Writes a checkpoint, points `latest` to it and removes all but the newest `keep`. Returns its folder, relative
/// to the run directory. Replay up to it must be durable already.
///
/// # Errors
/// When the disk refuses; the checkpoints before are left as they were.
pub fn save(
    run_dir: &RunDir,
    model: &Model,
    names: &TaskNames,
    state: &TrainingState,
    keep: usize,
) -> Result<PathBuf, CheckpointError> {
    let all = run_dir.checkpoints();
    fs::create_dir_all(&all).map_err(io(&all))?;
    folders::remove_partial(&all)?;
    let name = folders::free_name(&all, state.manifest.progress.env_steps)?;
    let (folder, partial) = (all.join(&name), all.join(format!("{name}.{PARTIAL}")));
    fs::create_dir(&partial).map_err(io(&partial))?;
    let written = write_folder(&partial, model, names, state);
    if written.is_err() {
        // What could not be written whole takes no space. If that fails too, the next attempt removes it.
        let _ = fs::remove_dir_all(&partial);
    }
    written?;
    fs::rename(&partial, &folder).map_err(io(&folder))?;
    // A link cannot be replaced in place; a new one can be renamed over it.
    let (link, new_link) = (all.join(LATEST), all.join(format!("{LATEST}.{PARTIAL}")));
    let _ = fs::remove_file(&new_link);
    symlink(&name, &new_link).and_then(|()| fs::rename(&new_link, &link)).map_err(io(&link))?;
    sync(&all)?;
    written::remember(run_dir, &state.manifest.origin, &name)?;
    // This one is whole and remembered: older ones that cannot be removed do not make it a failure.
    if let Some(folder) = folders::named(&all, &name)
        && let Err(error) = folders::forget_old(&all, &folder, keep)
    {
        tracing::warn!(%error, "old checkpoints stay until the next one");
    }
    Ok(Path::new("checkpoints").join(name))
}

fn write_folder(
    folder: &Path,
    model: &Model,
    names: &TaskNames,
    state: &TrainingState,
) -> Result<(), CheckpointError> {
    let format = |name: &str| {
        let path = folder.join(name);
        move |error| CheckpointError::Format { path, error }
    };
    let manifest = serde_json::to_vec_pretty(&state.manifest);
    let manifest = manifest.map_err(|error| io(&folder.join(MANIFEST))(error.into()))?;
    let mut files = vec![
        (WEIGHTS, weights_file::encode(model, names, &state.params).map_err(format(WEIGHTS))?),
        (STATE, encode_state(state).map_err(format(STATE))?),
        (MANIFEST, manifest),
    ];
    if let Some(best) = &state.best {
        files.push((BEST, weights_file::encode(model, names, best).map_err(format(BEST))?));
    }
    let mut sums = String::new();
    for (name, bytes) in &files {
        sums += &format!("{}  {name}\n", sha256(bytes));
        write(&folder.join(name), bytes)?;
    }
    write(&folder.join(SUMS), sums.as_bytes())?;
    sync(folder)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let mut options = OpenOptions::new();
    let opened = rit_config::open_regular(path, options.write(true).create(true).truncate(true));
    let written = opened.and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()
    });
    written.map_err(io(path))
}

/// Writes a small file anew: it is the old one or the new one at every moment, and the new one is on disk after this.
/// Unlike those of [`rit_config::write_whole`], it can be read by everyone who can read the rest of a checkpoint, and a folder
/// that cannot be synced is an error.
fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let partial = path.with_extension(PARTIAL);
    write(&partial, bytes)?;
    fs::rename(&partial, path).map_err(io(path))?;
    path.parent().map_or(Ok(()), sync)
}

fn sync(folder: &Path) -> Result<(), CheckpointError> {
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(io(folder))
}

fn io(path: &Path) -> impl FnOnce(io::Error) -> CheckpointError {
    let path = path.to_owned();
    move |error| CheckpointError::Io { path, error }
}

/// A file of a checkpoint, if it is the one in the list of sums.
fn read_checked(folder: &Path, name: &str) -> Result<Vec<u8>, CheckpointError> {
    let read = |name: &str| {
        let path = folder.join(name);
        rit_config::read_regular(&path, FILE_BYTES_MAX).map_err(io(&path))
    };
    let (sums, bytes) = (read(SUMS)?, read(name)?);
    let line = format!("{}  {name}", sha256(&bytes));
    if String::from_utf8_lossy(&sums).lines().any(|known| known == line) {
        Ok(bytes)
    } else {
        Err(CheckpointError::Altered { path: folder.join(name) })
    }
}

/// What a checkpoint says of itself.
fn load_manifest(folder: &Path) -> Result<Manifest, CheckpointError> {
    serde_json::from_slice(&read_checked(folder, MANIFEST)?).map_err(|error| CheckpointError::Inconsistent {
        path: folder.join(MANIFEST),
        what: error.to_string(),
    })
}

/// Reads one checkpoint's folder.
fn load(
    folder: &Path,
    learner: &dyn Learner,
    tasks: usize,
    algorithm: &Algorithm,
) -> Result<TrainingState, CheckpointError> {
    let inconsistent =
        |name: &str, what: String| CheckpointError::Inconsistent { path: folder.join(name), what };
    let manifest = load_manifest(folder)?;
    manifest.check(tasks, algorithm).map_err(|what| inconsistent(MANIFEST, what))?;
    let weights = |name: &str, digest: &String| {
        read_checked(folder, name)?;
        let params = weights_file::load(&folder.join(name), learner.layout())?;
        if weights_file::digest(&params) != *digest {
            return Err(inconsistent(name, format!("its weights are not those that {MANIFEST} names")));
        }
        Ok(params)
    };
    let params = weights(WEIGHTS, &manifest.weights_digest)?;
    let best = manifest.best.as_ref().map(|best| weights(BEST, &best.weights_digest)).transpose()?;
    let bytes = read_checked(folder, STATE)?;
    let format = |error| CheckpointError::Format { path: folder.join(STATE), error };
    let tensors = SafeTensors::deserialize(&bytes).map_err(format)?;
    let tensor = |name: &str, kind: Dtype, len: usize| {
        let tensor = tensors.tensor(name).map_err(format)?;
        if (tensor.dtype(), tensor.shape()) == (kind, &[len]) {
            return Ok(tensor.data().to_vec());
        }
        let (found, shape) = (tensor.dtype(), tensor.shape());
        Err(inconsistent(STATE, format!("{name} is {shape:?} {found:?}, not [{len}] {kind:?}")))
    };
    let mut state = Vec::new();
    for NamedState { name, numbers } in learner.state() {
        let bytes = tensor(name, dtype(&numbers), numbers.len())?;
        let numbers = match numbers {
            Numbers::F32(_) => Numbers::F32(numbers_of(&bytes, f32::from_le_bytes).into()),
            Numbers::F64(_) => Numbers::F64(numbers_of(&bytes, f64::from_le_bytes).into()),
            Numbers::U64(_) => Numbers::U64(numbers_of(&bytes, u64::from_le_bytes).into()),
        };
        state.push(NamedState { name, numbers });
    }
    let mut snapshots = Vec::new();
    for SnapshotMark { version, env_steps } in &manifest.snapshots {
        let params = tensor(&snapshot_name(*version), Dtype::F32, learner.acting().len())?;
        snapshots.push(Snapshot { version: *version, env_steps: *env_steps, params: params.into() });
    }
    Ok(TrainingState { params, best, learner: state, snapshots, manifest })
}

/// Little-endian numbers.
fn numbers_of<T, const SIZE: usize>(bytes: &[u8], from: fn([u8; SIZE]) -> T) -> Vec<T> {
    bytes.as_chunks().0.iter().map(|&bytes| from(bytes)).collect()
}

fn dtype(numbers: &Numbers<'_>) -> Dtype {
    match numbers {
        Numbers::F32(_) => Dtype::F32,
        Numbers::F64(_) => Dtype::F64,
        Numbers::U64(_) => Dtype::U64,
    }
}

fn snapshot_name(version: u64) -> String {
    format!("acting.{version}")
}

fn encode_state(state: &TrainingState) -> Result<Vec<u8>, SafeTensorError> {
    let mut tensors = Vec::new();
    for NamedState { name, numbers } in &state.learner {
        let bytes: Vec<u8> = match numbers {
            Numbers::F32(numbers) => numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Numbers::F64(numbers) => numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Numbers::U64(numbers) => numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
        };
        tensors.push(((*name).to_owned(), dtype(numbers), numbers.len(), bytes));
    }
    for Snapshot { version, params, .. } in &state.snapshots {
        tensors.push((snapshot_name(*version), Dtype::F32, params.len() / 4, params.to_vec()));
    }
    let views = tensors.iter().map(|(name, kind, len, bytes)| {
        TensorView::new(*kind, vec![*len], bytes).map(|view| (name.as_str(), view))
    });
    safetensors::serialize(views.collect::<Result<Vec<_>, _>>()?, None)
}

/// Episode numbers that the oldest checkpoint kept needs of replay: all from here on.
///
/// # Errors
/// When the folder cannot be read.
pub fn replay_needed_from(run_dir: &RunDir, replay_episodes: usize) -> Result<u64, CheckpointError> {
    let kept = folders::list_named_right(&run_dir.checkpoints())?;
    let oldest = kept.first().map_or(0, |(_, manifest)| manifest.progress.episodes);
    Ok(oldest.saturating_sub(replay_episodes as u64))
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests;
