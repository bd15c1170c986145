//! The end of a run that failed before its learner could say so.

use crate::checkpoint;
use rit_config::RunDir;
use rit_record::{Ended, Summary};
use std::io;

/// Writes that a run has failed, with the figures of the checkpoint that it can be gone on from; unless its learner has
/// written so itself. Where that did not know why, the reason is added.
///
/// # Errors
/// When the disk refuses.
pub fn write_failed(run_dir: &RunDir, reason: &str) -> io::Result<()> {
    let reason = Some(reason.to_owned());
    let summary = match Summary::read(run_dir).ok().flatten() {
        Some(Summary { ended: Ended::Failed, reason: Some(_), .. }) => return Ok(()),
        Some(unexplained @ Summary { ended: Ended::Failed, .. }) => Summary { reason, ..unexplained },
        _ => {
            let newest = checkpoint::newest_manifest(run_dir);
            Summary {
                ended: Ended::Failed,
                reason,
                progress: newest.as_ref().map(|manifest| manifest.progress).unwrap_or_default(),
                wall_s: newest.as_ref().map_or(0.0, |manifest| manifest.wall_s),
                cpu_s: newest.as_ref().map(|manifest| manifest.cpu_s),
                weights_digest: newest.map(|manifest| manifest.weights_digest),
                ..Summary::default()
            }
        }
    };
    summary.write(run_dir)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_config::OwnedRunDir;
    use rit_record::Progress;

    #[test]
    fn a_failure_gets_the_first_reason_that_is_known() {
        let config = rit_config::resolve("environment.task_set = 'matrix-game'", "test", &[]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let made = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
        let run_dir = made.run_dir();
        let failed = |reason: &str| {
            write_failed(run_dir, reason).unwrap();
            Summary::read(run_dir).unwrap().unwrap()
        };
        // The trainer ends without its receiver, and does not know why that has gone.
        let progress = Progress { env_steps: 40, episodes: 20, updates: 10 };
        let unexplained = Summary { ended: Ended::Failed, progress, cpu_s: Some(2.0), ..Summary::default() };
        unexplained.write(run_dir).unwrap();
        let explained = Summary { reason: Some("no shared memory".into()), ..unexplained.clone() };
        assert_eq!(failed("no shared memory"), explained, "its figures are kept");
        assert_eq!(failed("the learner ended"), explained, "the first reason is kept");
        // An end that was not the last word.
        Summary { ended: Ended::Finished, ..unexplained }.write(run_dir).unwrap();
        let over = failed("the write thread panicked");
        assert_eq!((over.ended, over.reason.as_deref()), (Ended::Failed, Some("the write thread panicked")));
    }
}
