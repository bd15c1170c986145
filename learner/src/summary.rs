//! The end of a run that failed before its learner could say so.

use crate::checkpoint;
use rit_config::RunDir;
use rit_record::{Ended, Summary};
use std::io;

/// Writes that a run has failed, with the figures of the checkpoint that it can be gone on from; unless its learner has
/// said so itself.
///
/// # Errors
/// When the disk refuses.
pub fn write_failed(run_dir: &RunDir, reason: &str) -> io::Result<()> {
    if Summary::read(run_dir).ok().flatten().is_some_and(|summary| summary.ended == Ended::Failed) {
        return Ok(());
    }
    let newest = checkpoint::newest_manifest(run_dir);
    let summary = Summary {
        ended: Ended::Failed,
        reason: Some(reason.to_owned()),
        progress: newest.as_ref().map(|manifest| manifest.progress).unwrap_or_default(),
        wall_s: newest.as_ref().map_or(0.0, |manifest| manifest.wall_s),
        cpu_s: newest.as_ref().map(|manifest| manifest.cpu_s),
        weights_digest: newest.map(|manifest| manifest.weights_digest),
        ..Summary::default()
    };
    summary.write(run_dir)
}
