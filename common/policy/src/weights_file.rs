//! Weights on disk: safetensors under the specification's parameter names, with a [`Description`] of the model in its
//! metadata; `deploy/docs/weights.md` has the format. The digest of its numbers shows what was altered.

use crate::{Description, DescriptionError, TaskNames, place};
use rit_algo::Model;
use rit_config::read_regular;
use rit_nn::Layout;
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use sha2::{Digest as _, Sha256};
use std::{
    collections::HashMap,
    io,
    path::{Path, PathBuf},
    sync::Arc,
};

/// The key of the description in the file's metadata: JSON, so that the same weights make the same bytes.
pub const DESCRIPTION: &str = "rit";
/// The key of the digest in files of builds that wrote no description.
const DIGEST: &str = "digest";
/// No weights file is longer.
const FILE_BYTES_MAX: u64 = 1 << 36;

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
    /// A file of an older build.
    #[error(
        "{path} does not say what model it holds: an older build wrote it; this build's `rit train --resume` of its run \
         writes checkpoints that do"
    )]
    NoDescription {
        /// The file.
        path: PathBuf,
    },
    /// A description that makes no sense.
    #[error("{path}: {error}")]
    Description {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: DescriptionError,
    },
    /// A description that is none.
    #[error("{path}: its description is none: {reason}")]
    DescriptionText {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// No file is meant by what was given.
    #[error(transparent)]
    Place(#[from] place::PlaceError),
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

/// Weights, and the model they are of.
#[derive(Clone, Debug)]
pub struct Weights {
    /// What the file says of itself.
    pub description: Description,
    /// The model that it describes.
    pub model: Arc<Model>,
    /// All parameters, in the layout's order.
    pub params: Vec<f32>,
}

impl Weights {
    /// Reads the weights of a run's newest checkpoint, of one of its checkpoints (`RUN@STEPS`), or of a file: see
    /// [`place::weights_path`].
    ///
    /// # Errors
    /// When no weights are there, or they are not whole, altered, or do not say what model they are of.
    pub fn load(given: &Path) -> Result<Self, WeightsFileError> {
        let path = place::weights_path(given)?;
        let bytes = read(&path)?;
        let description = match read_metadata(&path, &bytes)?.remove(DESCRIPTION) {
            Some(text) => parse(&path, &text)?,
            None => return Err(WeightsFileError::NoDescription { path }),
        };
        let described = |error| WeightsFileError::Description { path: path.clone(), error };
        let config = description.model().map_err(described)?;
        let model = Model::new(config).map_err(|error| described(error.into()))?;
        let params = decode(&path, &bytes, model.layout())?;
        Ok(Self { description, model: Arc::new(model), params })
    }
}

/// The file's bytes: the same weights make the same bytes.
///
/// # Errors
/// Never for a model of our own making.
pub fn encode(model: &Model, names: &TaskNames, params: &[f32]) -> Result<Vec<u8>, SafeTensorError> {
    let description = Description::new(model.config(), names, digest(params));
    let text = description.to_json()?;
    let bytes = to_bytes(params);
    let mut tensors = Vec::new();
    for param in model.layout().params() {
        let data = &bytes[4 * param.range.start..4 * param.range.end];
        let view = TensorView::new(Dtype::F32, param.shape.clone(), data)?;
        tensors.push((param.name.as_str(), view));
    }
    // One key alone: a map of several would be written in any order.
    let metadata = HashMap::from([(DESCRIPTION.to_owned(), text)]);
    safetensors::serialize(tensors, Some(metadata))
}

/// Reads weights of a model of this layout.
///
/// # Errors
/// When the file is not there, not whole, altered, or of another model.
pub fn load(path: &Path, layout: &Layout) -> Result<Vec<f32>, WeightsFileError> {
    decode(path, &read(path)?, layout)
}

fn read(path: &Path) -> Result<Vec<u8>, WeightsFileError> {
    read_regular(path, FILE_BYTES_MAX).map_err(|error| WeightsFileError::Io { path: path.to_owned(), error })
}

fn read_metadata(path: &Path, bytes: &[u8]) -> Result<HashMap<String, String>, WeightsFileError> {
    let format = |error| WeightsFileError::Format { path: path.to_owned(), error };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
    Ok(header.metadata().clone().unwrap_or_default())
}

fn parse(path: &Path, text: &str) -> Result<Description, WeightsFileError> {
    serde_json::from_str(text).map_err(|error| WeightsFileError::DescriptionText {
        path: path.to_owned(),
        reason: error.to_string(),
    })
}

fn decode(path: &Path, bytes: &[u8], layout: &Layout) -> Result<Vec<f32>, WeightsFileError> {
    let format = |error| WeightsFileError::Format { path: path.to_owned(), error };
    let tensors = SafeTensors::deserialize(bytes).map_err(format)?;
    let other = |difference| WeightsFileError::OtherModel { path: path.to_owned(), difference };
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
    let mut metadata = read_metadata(path, bytes)?;
    let carried = match metadata.remove(DESCRIPTION) {
        Some(text) => Some(parse(path, &text)?.digest),
        None => metadata.remove(DIGEST),
    };
    if carried.is_some_and(|carried| carried != digest(&params)) {
        return Err(WeightsFileError::Altered { path: path.to_owned() });
    }
    Ok(params)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_episode::{RunSeed, Stream};
    use std::fs;

    fn model(settings: &[&str]) -> (Model, TaskNames, Vec<f32>) {
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        let config =
            rit_config::resolve("environment.task_set = \"matrix-game\"", "test", &settings).unwrap();
        let model = Model::new(config.model()).unwrap();
        let params = model.initial(&mut RunSeed(1).stream(Stream::Weights, 0));
        (model, TaskNames::of(&config), params)
    }

    #[test]
    fn weights_come_back_and_make_the_same_bytes() {
        let (model, names, params) = model(&[]);
        let file = tempfile::NamedTempFile::new().unwrap();
        let bytes = encode(&model, &names, &params).unwrap();
        fs::write(file.path(), &bytes).unwrap();
        assert_eq!(load(file.path(), model.layout()).unwrap(), params);
        let weights = Weights::load(file.path()).unwrap();
        assert_eq!((weights.model.layout(), &weights.params), (model.layout(), &params));
        assert_eq!(weights.description.names(), names);
        assert_eq!(encode(&weights.model, &names, &params).unwrap(), bytes);
    }

    #[test]
    fn files_of_older_builds_are_read_where_the_model_is_known() {
        let (model, _, params) = model(&[]);
        let bytes = to_bytes(&params);
        let views = model.layout().params().iter().map(|param| {
            let data = &bytes[4 * param.range.start..4 * param.range.end];
            (param.name.as_str(), TensorView::new(Dtype::F32, param.shape.clone(), data).unwrap())
        });
        let file = tempfile::NamedTempFile::new().unwrap();
        let with = |carried: String| {
            let metadata = HashMap::from([(DIGEST.to_owned(), carried)]);
            fs::write(file.path(), safetensors::serialize(views.clone(), Some(metadata)).unwrap()).unwrap();
        };
        with(digest(&params));
        assert_eq!(load(file.path(), model.layout()).unwrap(), params);
        let silent = Weights::load(file.path()).unwrap_err().to_string();
        assert!(silent.contains("does not say what model it holds: an older build wrote it"), "{silent}");
        with(digest(&[0.0]));
        assert!(load(file.path(), model.layout()).unwrap_err().to_string().contains("was altered"));
    }

    #[test]
    fn what_is_not_these_weights_is_refused_and_named() {
        let (this, names, params) = model(&[]);
        let layout = this.layout();
        let file = tempfile::NamedTempFile::new().unwrap();
        let good = encode(&this, &names, &params).unwrap();
        let error = |bytes: &[u8], layout: &Layout| {
            fs::write(file.path(), bytes).unwrap();
            load(file.path(), layout).unwrap_err().to_string()
        };

        let (other, ..) = model(&["network.hidden_dim=32"]);
        let message = error(&good, other.layout());
        assert!(message.contains("utility.embed.weight is [64, 6] F32, not [32, 6] F32"), "{message}");
        let (sum, ..) = model(&["algorithm.mixing=sum"]);
        assert!(error(&good, sum.layout()).contains("there is mixer."));
        let (no_z, ..) = model(&["algorithm.task_representations=false"]);
        assert!(error(&good, no_z.layout()).contains("utility.head_hidden.weight is [64, 160]"));

        for length in [0, 4, 8, 100, good.len() / 2, good.len() - 1] {
            assert!(error(&good[..length], layout).contains("no whole safetensors file"), "{length}");
        }
        let mut altered = good.clone();
        *altered.last_mut().unwrap() ^= 1;
        assert!(error(&altered, layout).contains("was altered"));
        let nowhere = load(Path::new("/no/such/file"), layout).unwrap_err().to_string();
        assert!(nowhere.contains("No such file"));
        assert!(load(Path::new("/dev/zero"), layout).unwrap_err().to_string().contains("no regular file"));
    }

    #[test]
    fn a_description_of_another_model_is_refused_and_named() {
        let (model, names, params) = model(&[]);
        let good = String::from_utf8_lossy(&encode(&model, &names, &params).unwrap()).into_owned();
        let described = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len(), "lengths in the header stay true");
            assert!(good.contains(from), "{from}");
            let bytes = encode(&model, &names, &params).unwrap();
            let at = bytes.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
            let mut changed = bytes.clone();
            changed[at..at + from.len()].copy_from_slice(to.as_bytes());
            let file = tempfile::NamedTempFile::new().unwrap();
            fs::write(file.path(), changed).unwrap();
            Weights::load(file.path()).unwrap_err().to_string()
        };
        let other = described(r#"\"hidden_dim\":64"#, r#"\"hidden_dim\":32"#);
        assert!(other.contains("utility.embed.weight is [64, 6] F32, not [32, 6] F32"), "{other}");
        assert!(described(r#"\"beside\""#, r#"\"tokens\""#).contains("rit has no encoder \"tokens\""));
        assert!(
            described("format_version", "formal_version").contains("its description is none: missing field")
        );
    }
}
