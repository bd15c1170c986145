//! Which weights file a person means.

use std::path::{Path, PathBuf};

/// The weights' file inside a checkpoint.
pub const WEIGHTS: &str = "weights.safetensors";
/// The link to a run's newest checkpoint.
pub const LATEST: &str = "latest";
/// The folder of a run's checkpoints.
const CHECKPOINTS: &str = "checkpoints";

/// Why no weights file is meant by what was given.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlaceError {
    /// Nothing is there.
    #[error(
        "{0}: there is no such file or folder; give a run directory, RUN@STEPS, a checkpoint or a weights file"
    )]
    Nothing(PathBuf),
    /// A folder that is neither a run's nor a checkpoint's.
    #[error("{0} holds no run and no checkpoint: neither {CHECKPOINTS}/ nor {WEIGHTS} is there")]
    NoRun(PathBuf),
    /// A run without a checkpoint.
    #[error("{0} has no checkpoint yet; `rit ctl --run {0} checkpoint` writes one")]
    NoCheckpoint(PathBuf),
    /// A run without this checkpoint.
    #[error("{run} has no checkpoint {wanted}; it has {}", if known.is_empty() { "none".to_owned() } else { known.join(", ") })]
    NoSuchCheckpoint {
        /// The run.
        run: PathBuf,
        /// What was asked for.
        wanted: String,
        /// Its checkpoints.
        known: Vec<String>,
    },
}

/// The weights file of a run directory's newest checkpoint, of a checkpoint's folder, or the file itself; `RUN@STEPS`, or
/// `RUN@` and a checkpoint's folder, is one of a run's checkpoints.
///
/// # Errors
/// When there is none.
pub fn weights_path(given: &Path) -> Result<PathBuf, PlaceError> {
    if given.is_dir() {
        let of_checkpoint = given.join(WEIGHTS);
        if of_checkpoint.exists() {
            return Ok(of_checkpoint);
        }
        let all = given.join(CHECKPOINTS);
        if !all.is_dir() {
            return Err(PlaceError::NoRun(given.to_owned()));
        }
        let newest = all.join(LATEST).join(WEIGHTS);
        return if newest.exists() { Ok(newest) } else { Err(PlaceError::NoCheckpoint(given.to_owned())) };
    }
    if given.exists() {
        return Ok(given.to_owned());
    }
    let nothing = || PlaceError::Nothing(given.to_owned());
    let (run, wanted) = given.to_str().and_then(|text| text.rsplit_once('@')).ok_or_else(nothing)?;
    let run = Path::new(run);
    if !run.is_dir() {
        return Err(nothing());
    }
    of_run(run, wanted)
}

fn of_run(run: &Path, wanted: &str) -> Result<PathBuf, PlaceError> {
    let all = run.join(CHECKPOINTS);
    let name = match wanted.parse::<u64>() {
        Ok(steps) => format!("step-{steps:012}"),
        Err(_) => wanted.to_owned(),
    };
    let entries = all.read_dir().into_iter().flatten().flatten();
    let mut known: Vec<String> = entries
        .filter(|entry| entry.path().join(WEIGHTS).exists())
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    known.sort();
    if known.contains(&name) {
        return Ok(all.join(name).join(WEIGHTS));
    }
    Err(PlaceError::NoSuchCheckpoint {
        run: run.to_owned(),
        wanted: wanted.chars().take(64).collect(),
        known,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{fs, os::unix::fs::symlink};

    #[test]
    fn what_is_given_leads_to_a_file_or_to_what_would() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let all = run.join(CHECKPOINTS);
        let refused = |given: &Path| weights_path(given).unwrap_err().to_string();
        assert!(refused(&run).ends_with("give a run directory, RUN@STEPS, a checkpoint or a weights file"));
        fs::create_dir_all(&all).unwrap();
        assert!(refused(&run).contains("has no checkpoint yet; `rit ctl --run "));
        assert!(refused(&all).contains("holds no run and no checkpoint"));
        for name in ["step-000000000400", "step-000000000800", "step-000000000800-2"] {
            fs::create_dir(all.join(name)).unwrap();
            fs::write(all.join(name).join(WEIGHTS), name).unwrap();
        }
        symlink("step-000000000800-2", all.join(LATEST)).unwrap();
        let found = |given: &Path| fs::read_to_string(weights_path(given).unwrap()).unwrap();
        let at = |checkpoint: &str| folder.path().join(format!("run@{checkpoint}"));
        assert_eq!(found(&run), "step-000000000800-2");
        assert_eq!(found(&at("latest")), "step-000000000800-2");
        assert_eq!(found(&at("800")), "step-000000000800");
        assert_eq!(found(&at("step-000000000400")), "step-000000000400");
        assert_eq!(found(&all.join("step-000000000400")), "step-000000000400");
        assert_eq!(found(&all.join("step-000000000400").join(WEIGHTS)), "step-000000000400");
        assert!(refused(&at("500")).ends_with(
            "run has no checkpoint 500; it has latest, step-000000000400, step-000000000800, step-000000000800-2"
        ));
        assert!(refused(&at("../..")).contains("has no checkpoint ../..;"));
    }
}
