//! How training ends: the last checkpoint, the last evaluation and the summary, insisted on while a disk is full.

use super::{News, TrainError, Trainer, Work};
use crate::{
    evaluation::by_task,
    replay_log::remedy,
    summary::{Ended, SUMMARY_FORMAT, Summary},
};
use rit_config::{Config, write_whole};
use rit_policy::{TaskNames, weights_file};
use std::{
    collections::BTreeMap,
    fs,
    path::Path,
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};
use tokio::sync::oneshot;

/// From one attempt at a run's last files to the next.
const RETRY_EVERY: Duration = Duration::from_secs(1);

impl Trainer {
    /// The last checkpoint, the last evaluation and the summary.
    pub(super) fn finish(
        &mut self,
        ended: Ended,
        work: &mpsc::Receiver<Work>,
    ) -> Result<Summary, TrainError> {
        let (done, written) = oneshot::channel();
        self.checkpoint(Some(done));
        let evaluation = by_task(&self.greedy(self.config.evaluation.episodes)?);
        let mut first = Some(written);
        let checkpointed = self.insist("the last checkpoint", work, |trainer| {
            let written = first.take().unwrap_or_else(|| {
                let (done, written) = oneshot::channel();
                trainer.checkpoint(Some(done));
                written
            });
            let written = written.blocking_recv().map_err(|_| "the writer has gone".to_owned())?;
            written.map(drop)
        });
        if let Err(error) = checkpointed {
            return Err(TrainError::Checkpoint(self.rescue(error)));
        }
        let mut summary = Summary { evaluation, ..self.summary(ended) };
        self.insist("summary.json", work, |trainer| {
            summary.warnings.clone_from(&trainer.warnings);
            summary.write(&trainer.run_dir).map_err(|error| format!("{error}{}", remedy(&error)))
        })
        .map_err(TrainError::Summary)?;
        Ok(summary)
    }

    pub(super) fn summary(&self, ended: Ended) -> Summary {
        Summary {
            format_version: SUMMARY_FORMAT,
            ended,
            reason: None,
            progress: self.standing.progress,
            wall_s: self.metrics.wall_s(),
            weights_digest: Some(weights_file::digest(self.learner.params())),
            evaluation: BTreeMap::new(),
            warnings: self.warnings.clone(),
        }
    }

    /// Tries until it is done, for as long as `checkpoints.last_retry_ms` says: a disk that is full now may not be later.
    /// Says so once. A second wish to stop is one not to wait.
    fn insist(
        &mut self,
        what: &str,
        work: &mpsc::Receiver<Work>,
        mut attempt: impl FnMut(&mut Self) -> Result<(), String>,
    ) -> Result<(), String> {
        let begun = Instant::now();
        let mut refused = false;
        loop {
            let error = match attempt(self) {
                Ok(()) if refused => {
                    self.warn(format!("{what} is written now"));
                    return Ok(());
                }
                Ok(()) => return Ok(()),
                Err(error) => error,
            };
            let limit = Duration::from_millis(self.config.checkpoints.last_retry_ms);
            // A directory that was removed does not come back, as room on a disk does.
            if begun.elapsed() >= limit || !self.run_dir.root().is_dir() {
                return Err(error);
            }
            if !std::mem::replace(&mut refused, true) {
                self.warn(format!(
                    "{what} is not written: {error}; trying again for {} s, then the weights go to \
                     checkpoints.rescue_dir, if that is set (`rit ctl set` can do so now)",
                    limit.as_secs()
                ));
            }
            match work.recv_timeout(RETRY_EVERY) {
                Ok(Work::Set(config)) => self.config = Config::clone(&config),
                Ok(Work::Stop(_)) => return Err(error),
                // Whoever wants more of a run that is over is told so by its end.
                Ok(Work::Batch(_) | Work::Checkpoint(_)) | Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => thread::sleep(RETRY_EVERY),
            }
        }
    }

    fn warn(&mut self, what: String) {
        self.warnings.push(what.clone());
        (self.news)(News::Warning(what));
    }

    /// Writes the weights to `checkpoints.rescue_dir`, if there is one; returns the error with what came of it.
    fn rescue(&self, error: String) -> String {
        let folder = &self.config.checkpoints.rescue_dir;
        if folder.is_empty() {
            return error;
        }
        let run = self.run_dir.root().file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = format!("{run}-step-{:012}.safetensors", self.standing.progress.env_steps);
        let path = Path::new(folder).join(name);
        let weights =
            weights_file::encode(self.learner.model(), &TaskNames::of(&self.config), self.learner.params());
        let written = weights.map_err(|error| error.to_string()).and_then(|bytes| {
            fs::create_dir_all(folder)
                .and_then(|()| write_whole(&path, &bytes))
                .map_err(|error| format!("{error}{}", remedy(&error)))
        });
        match written {
            Ok(()) => format!("{error}; the last weights are in {}", path.display()),
            Err(rescue) => format!("{error}; nor are the last weights in {}: {rescue}", path.display()),
        }
    }
}
