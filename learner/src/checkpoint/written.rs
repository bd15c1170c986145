//! `checkpoints.json`: that the run has written checkpoints, and which was the newest. It lies beside their folder, so
//! that a run whose checkpoints are gone is no new run.

use super::{CheckpointError, LATEST, io, write_durably};
use crate::checkpoint::origin::Origin;
use rit_config::{RunDir, TEXT_BYTES_MAX, read_regular};
use rit_record::{Ended, Summary};
use serde::{Deserialize, Serialize};
use std::{fs, path::PathBuf};

#[derive(Serialize, Deserialize)]
struct Written {
    format_version: u32,
    run_id: String,
    /// The newest one's folder.
    newest: String,
}

fn path(run_dir: &RunDir) -> PathBuf {
    run_dir.root().join("checkpoints.json")
}

/// Remembers that a checkpoint lies in the folder of this name.
pub(super) fn remember(run_dir: &RunDir, origin: &Origin, newest: &str) -> Result<(), CheckpointError> {
    let Origin { format_version, run_id, .. } = origin;
    let written =
        Written { format_version: *format_version, run_id: run_id.clone(), newest: newest.to_owned() };
    let path = path(run_dir);
    let text = serde_json::to_vec_pretty(&written).map_err(|error| io(&path)(error.into()))?;
    write_durably(&path, &text)
}

/// The newest checkpoint that this run is known to have written, by its folder's name or by what tells of it; `None`
/// for a run that has never written one.
pub(super) fn newest(run_dir: &RunDir) -> Option<String> {
    let path = path(run_dir);
    if path.exists() {
        let written = read_regular(&path, TEXT_BYTES_MAX)
            .ok()
            .and_then(|text| serde_json::from_slice::<Written>(&text).ok());
        return Some(written.map_or_else(|| "checkpoints.json tells of it".into(), |written| written.newest));
    }
    // What tells of it where that file is gone.
    let latest = fs::read_link(run_dir.checkpoints().join(LATEST));
    latest.ok().map(|target| target.display().to_string()).or_else(|| {
        // A run that has ended gracefully wrote one; one that failed may never have come so far.
        let ended = Summary::read(run_dir).ok().flatten()?.ended;
        (ended != Ended::Failed).then(|| "summary.json tells of it".into())
    })
}
