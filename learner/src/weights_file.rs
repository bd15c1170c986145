//! Weights on disk: safetensors under the specification's parameter names. The file carries the digest of its
//! numbers, so what was altered is noticed.

use rit_nn::Layout;
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use sha2::{Digest as _, Sha256};
use std::{
    collections::HashMap,
    fs, io,
    path::{Path, PathBuf},
};

/// The key of the weights' digest in the file's metadata.
const DIGEST: &str = "digest";

/// Why a weights file cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum WeightsFileError {
    /// The system refused.
    #[error("{path}: {error}")]
    Io {
        /// The file.
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

/// The file's bytes: the same weights make the same bytes.
///
/// # Errors
/// Never for a layout of our own making.
pub fn encode(layout: &Layout, params: &[f32]) -> Result<Vec<u8>, SafeTensorError> {
    let bytes = to_bytes(params);
    let mut tensors = Vec::new();
    for param in layout.params() {
        let data = &bytes[4 * param.range.start..4 * param.range.end];
        let view = TensorView::new(Dtype::F32, param.shape.clone(), data)?;
        tensors.push((param.name.as_str(), view));
    }
    // One key alone: a map of several would be written in any order.
    let metadata = HashMap::from([(DIGEST.to_owned(), digest(params))]);
    safetensors::serialize(tensors, Some(metadata))
}

/// Reads weights of a model of this layout.
///
/// # Errors
/// When the file is not there, not whole, altered, or of another model.
pub fn load(path: &Path, layout: &Layout) -> Result<Vec<f32>, WeightsFileError> {
    let path = path.to_owned();
    let bytes = fs::read(&path).map_err(|error| WeightsFileError::Io { path: path.clone(), error })?;
    let format = |error| WeightsFileError::Format { path: path.clone(), error };
    let tensors = SafeTensors::deserialize(&bytes).map_err(format)?;
    let other = |difference| WeightsFileError::OtherModel { path: path.clone(), difference };
    let mut params = Vec::with_capacity(layout.len());
    for param in layout.params() {
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
    if let Some(name) = tensors.names().iter().find(|name| !layout.params().iter().any(|p| p.name == **name))
    {
        return Err(other(format!("there is {name} too")));
    }
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(format)?;
    let carried = header.metadata().as_ref().and_then(|metadata| metadata.get(DIGEST));
    if carried.is_some_and(|carried| *carried != digest(&params)) {
        return Err(WeightsFileError::Altered { path });
    }
    Ok(params)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_algo::Model;
    use rit_episode::{RunSeed, Stream};

    fn model(settings: &[&str]) -> (Model, Vec<f32>) {
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        let config =
            rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &settings).unwrap();
        let model = Model::new(config.model()).unwrap();
        let params = model.initial(&mut RunSeed(1).stream(Stream::Weights, 0));
        (model, params)
    }

    #[test]
    fn weights_come_back_and_make_the_same_bytes() {
        let (model, params) = model(&[]);
        let layout = model.layout();
        let file = tempfile::NamedTempFile::new().unwrap();
        let bytes = encode(layout, &params).unwrap();
        fs::write(file.path(), &bytes).unwrap();
        assert_eq!(load(file.path(), layout).unwrap(), params);
        assert_eq!(encode(layout, &params).unwrap(), bytes);
    }

    #[test]
    fn what_is_not_these_weights_is_refused_and_named() {
        let (this, params) = model(&[]);
        let layout = this.layout();
        let file = tempfile::NamedTempFile::new().unwrap();
        let good = encode(layout, &params).unwrap();
        let error = |bytes: &[u8], layout: &Layout| {
            fs::write(file.path(), bytes).unwrap();
            load(file.path(), layout).unwrap_err().to_string()
        };

        let (other, _) = model(&["network.hidden_dim=32"]);
        let message = error(&good, other.layout());
        assert!(message.contains("utility.embed.weight is [64, 6] F32, not [32, 6] F32"), "{message}");
        let (sum, _) = model(&["algorithm.mixing=sum"]);
        assert!(error(&good, sum.layout()).contains("there is mixer."));
        let (no_z, _) = model(&["algorithm.task_representations=false"]);
        assert!(error(&good, no_z.layout()).contains("utility.head_hidden.weight is [64, 160]"));

        for length in [0, 4, 8, 100, good.len() / 2, good.len() - 1] {
            assert!(error(&good[..length], layout).contains("no whole safetensors file"), "{length}");
        }
        let mut altered = good.clone();
        *altered.last_mut().unwrap() ^= 1;
        assert!(error(&altered, layout).contains("was altered"));
        let nowhere = load(Path::new("/no/such/file"), layout).unwrap_err().to_string();
        assert!(nowhere.contains("No such file"));
    }
}
