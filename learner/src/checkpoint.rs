//! Weights on disk: safetensors under the specification's parameter names.
//!
//! A checkpoint is a folder, written beside its place, made durable and then renamed there, so it is whole or
//! not there. `checkpoints/latest` is a link to the newest.

use rit_algo::Rit;
use rit_config::RunDir;
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::{
    collections::HashMap,
    fs::{self, File},
    io::{self, Write as _},
    os::unix::fs::symlink,
    path::{Path, PathBuf},
};

/// The weights' file inside a checkpoint.
pub const WEIGHTS: &str = "weights.safetensors";
/// The progress' file inside a checkpoint.
const PROGRESS: &str = "progress.json";
/// The link to the newest checkpoint.
pub const LATEST: &str = "latest";
/// The key of the weights' digest in the file's metadata.
const DIGEST: &str = "digest";

/// How far training had come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Environment steps collected.
    pub env_steps: u64,
    /// Episodes collected.
    pub episodes: u64,
    /// Updates made.
    pub updates: u64,
}

/// Why a checkpoint cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The system refused.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// Not a whole safetensors file.
    #[error(
        "{path} is no whole safetensors file ({error}); it was truncated or altered: use another checkpoint"
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: SafeTensorError,
    },
    /// Weights of another model.
    #[error(
        "{path} holds weights of another model: {difference}; use the configuration they were trained with"
    )]
    OtherModel {
        /// The file.
        path: PathBuf,
        /// The first difference.
        difference: String,
    },
    /// Numbers that are not those that were written.
    #[error("{path} was altered: its weights have not the digest it carries; use another checkpoint")]
    Altered {
        /// The file.
        path: PathBuf,
    },
}

/// SHA-256 of the weights as little-endian f32 in the layout's order, in hexadecimal.
pub fn digest(params: &[f32]) -> String {
    let mut hasher = Sha256::new();
    for part in params.chunks(4096) {
        hasher.update(to_bytes(part));
    }
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn to_bytes(params: &[f32]) -> Vec<u8> {
    params.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Writes a checkpoint and points `latest` to it. Returns its folder, relative to the run directory.
///
/// # Errors
/// When the disk refuses; the checkpoints before are left as they were.
pub fn save(
    run_dir: &RunDir,
    rit: &Rit,
    params: &[f32],
    progress: Progress,
) -> Result<PathBuf, CheckpointError> {
    let name = format!("step-{:012}", progress.env_steps);
    let folder = run_dir.checkpoints().join(&name);
    let partial = run_dir.checkpoints().join(format!("{name}.partial"));
    let io = |path: &Path| {
        let path = path.to_owned();
        move |error| CheckpointError::Io { path, error }
    };
    if partial.exists() {
        fs::remove_dir_all(&partial).map_err(io(&partial))?;
    }
    fs::create_dir(&partial).map_err(io(&partial))?;
    let write = |name: &str, bytes: &[u8]| {
        let path = partial.join(name);
        let written = File::create(&path).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()
        });
        written.map_err(io(&path))
    };
    write(WEIGHTS, &encode(rit, params, &partial.join(WEIGHTS))?)?;
    let text = serde_json::to_vec_pretty(&progress);
    write(PROGRESS, &text.map_err(|error| io(&partial.join(PROGRESS))(error.into()))?)?;
    sync_folder(&partial).map_err(io(&partial))?;
    if folder.exists() {
        // The same step once more, by request: the same content under the same name.
        fs::remove_dir_all(&folder).map_err(io(&folder))?;
    }
    fs::rename(&partial, &folder).map_err(io(&folder))?;
    // A link cannot be replaced in place; a new one can be renamed over it.
    let (link, new_link) = (run_dir.checkpoints().join(LATEST), run_dir.checkpoints().join("latest.partial"));
    let _ = fs::remove_file(&new_link);
    symlink(&name, &new_link).and_then(|()| fs::rename(&new_link, &link)).map_err(io(&link))?;
    sync_folder(&run_dir.checkpoints()).map_err(io(&run_dir.checkpoints()))?;
    Ok(Path::new("checkpoints").join(name))
}

fn sync_folder(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

fn encode(rit: &Rit, params: &[f32], path: &Path) -> Result<Vec<u8>, CheckpointError> {
    let bytes = to_bytes(params);
    let format = |error| CheckpointError::Format { path: path.to_owned(), error };
    let mut tensors = Vec::new();
    for param in rit.layout.params() {
        let data = &bytes[4 * param.range.start..4 * param.range.end];
        let view = TensorView::new(Dtype::F32, param.shape.clone(), data).map_err(format)?;
        tensors.push((param.name.as_str(), view));
    }
    // One key alone: a map of several would be written in any order.
    let metadata = HashMap::from([(DIGEST.to_owned(), digest(params))]);
    safetensors::serialize(tensors, Some(metadata)).map_err(format)
}

/// Reads weights for this model.
///
/// # Errors
/// When the file is not there, not whole, altered, or of another model.
pub fn load_weights(path: &Path, rit: &Rit) -> Result<Vec<f32>, CheckpointError> {
    let path = path.to_owned();
    let bytes = fs::read(&path).map_err(|error| CheckpointError::Io { path: path.clone(), error })?;
    let format = |error| CheckpointError::Format { path: path.clone(), error };
    let tensors = SafeTensors::deserialize(&bytes).map_err(format)?;
    let other = |difference| CheckpointError::OtherModel { path: path.clone(), difference };
    let mut params = Vec::with_capacity(rit.layout.len());
    for param in rit.layout.params() {
        let Ok(tensor) = tensors.tensor(&param.name) else {
            return Err(other(format!("there is no {}", param.name)));
        };
        if tensor.dtype() != Dtype::F32 || tensor.shape() != param.shape {
            let (found, expected) = (tensor.shape(), &param.shape);
            return Err(other(format!(
                "{} is {found:?} {:?}, not {expected:?} F32",
                param.name,
                tensor.dtype()
            )));
        }
        params.extend(tensor.data().as_chunks::<4>().0.iter().map(|&word| f32::from_le_bytes(word)));
    }
    if let Some(name) =
        tensors.names().iter().find(|name| !rit.layout.params().iter().any(|p| p.name == **name))
    {
        return Err(other(format!("there is {name} too")));
    }
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(format)?;
    let carried = header.metadata().as_ref().and_then(|metadata| metadata.get(DIGEST));
    if carried.is_some_and(|carried| *carried != digest(&params)) {
        return Err(CheckpointError::Altered { path });
    }
    Ok(params)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_episode::{RunSeed, Stream};

    fn run(settings: &[&str]) -> (tempfile::TempDir, RunDir, Rit, Vec<f32>) {
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        let config =
            rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &settings).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let run_dir = RunDir::create(&folder.path().join("run"), &config).unwrap();
        let rit = Rit::new(config.rit()).unwrap();
        let params = rit.layout.initial(&mut RunSeed(1).stream(Stream::Weights, 0));
        (folder, run_dir, rit, params)
    }

    #[test]
    fn weights_come_back_and_latest_is_the_newest() {
        let (_folder, run_dir, rit, mut params) = run(&[]);
        let progress = |env_steps| Progress { env_steps, episodes: 3, updates: 2 };
        let first = save(&run_dir, &rit, &params, progress(50)).unwrap();
        assert_eq!(first, Path::new("checkpoints/step-000000000050"));
        params[17] += 1.0;
        save(&run_dir, &rit, &params, progress(100)).unwrap();
        save(&run_dir, &rit, &params, progress(100)).unwrap();
        let latest = run_dir.checkpoints().join(LATEST);
        assert_eq!(load_weights(&latest.join(WEIGHTS), &rit).unwrap(), params);
        assert_ne!(load_weights(&run_dir.root().join(first).join(WEIGHTS), &rit).unwrap(), params);
        let partial = fs::read_dir(run_dir.checkpoints()).unwrap();
        assert!(partial.flatten().all(|entry| !entry.file_name().to_string_lossy().contains("partial")));
    }

    #[test]
    fn the_same_weights_make_the_same_bytes() {
        let (_folder, run_dir, rit, params) = run(&[]);
        let bytes = |env_steps| {
            let progress = Progress { env_steps, ..Progress::default() };
            let folder = save(&run_dir, &rit, &params, progress).unwrap();
            fs::read(run_dir.root().join(folder).join(WEIGHTS)).unwrap()
        };
        assert_eq!(bytes(1), bytes(2));
    }

    #[test]
    fn what_is_not_these_weights_is_refused_and_named() {
        let (_folder, run_dir, rit, params) = run(&[]);
        save(&run_dir, &rit, &params, Progress::default()).unwrap();
        let path = run_dir.checkpoints().join(LATEST).join(WEIGHTS);
        let good = fs::read(&path).unwrap();
        let error = |rit: &Rit| load_weights(&path, rit).unwrap_err().to_string();

        let (.., other, _) = run(&["network.hidden_dim=32"]);
        assert!(
            error(&other).contains("utility.embed.weight is [64, 6] F32, not [32, 6] F32"),
            "{}",
            error(&other)
        );
        let (.., sum, _) = run(&["algorithm.mixing=sum"]);
        assert!(error(&sum).contains("there is mixer."));
        let (.., no_z, _) = run(&["algorithm.task_representations=false"]);
        assert!(error(&no_z).contains("utility.head_hidden.weight is [64, 160]"));

        for length in [0, 4, 8, 100, good.len() / 2, good.len() - 1] {
            fs::write(&path, &good[..length]).unwrap();
            assert!(error(&rit).contains("no whole safetensors file"), "{length}");
        }
        let mut altered = good.clone();
        *altered.last_mut().unwrap() ^= 1;
        fs::write(&path, altered).unwrap();
        assert!(error(&rit).contains("was altered"));
        fs::remove_file(&path).unwrap();
        assert!(error(&rit).contains("No such file"));
    }
}
