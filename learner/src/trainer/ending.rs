//! How training ends: the last checkpoint, the last evaluation and the summary, insisted on while a disk is full.

use super::{News, TrainError, Trainer, Work};
use crate::replay_log::remedy;
use rit_config::{Config, write_whole};
use rit_env::Split;
use rit_policy::{TaskNames, weights_file};
use rit_record::{Best, Ended, Evaluation, Host, Line, Occasion, Summary, TaskResult};
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

/// Why a checkpoint has no answer.
const WRITER_GONE: &str =
    "the write thread panicked; this is a fault of the program, its message is in the log";

impl Trainer {
    /// The last checkpoint, the last evaluation and the summary.
    pub(super) fn finish(
        &mut self,
        ended: Ended,
        work: &mpsc::Receiver<Work>,
    ) -> Result<Summary, TrainError> {
        let (done, written) = oneshot::channel();
        self.checkpoint(Some(done));
        let [evaluation, testing] = self.last_evaluation()?;
        let best = self.absolute_metric()?;
        let mut first = Some(written);
        let checkpointed = self.insist("the last checkpoint", work, |trainer| {
            let written = first.take().unwrap_or_else(|| {
                let (done, written) = oneshot::channel();
                trainer.checkpoint(Some(done));
                written
            });
            let written = written.blocking_recv().map_err(|_| WRITER_GONE.to_owned())?;
            written.map(drop)
        });
        if let Err(error) = checkpointed {
            return Err(TrainError::Checkpoint(self.rescue(error)));
        }
        let mut summary = Summary { evaluation, testing, best, ..self.summary(ended) };
        self.insist("summary.json", work, |trainer| {
            summary.warnings.clone_from(&trainer.warnings);
            let written = trainer.metrics.flush().and_then(|()| summary.write(&trainer.run_dir));
            written.map_err(|error| format!("{error}{}", remedy(&error)))
        })
        .map_err(TrainError::Summary)?;
        Ok(summary)
    }

    pub(super) fn summary(&self, ended: Ended) -> Summary {
        Summary {
            ended,
            reason: None,
            progress: self.standing.progress,
            wall_s: self.metrics.wall_s(),
            cpu_s: Some(self.cpu_s()),
            build: Some(self.made.build.clone()),
            host: Some(Host::this()),
            weights_digest: Some(weights_file::digest(self.learner.params())),
            warnings: self.warnings.clone(),
            ..Summary::default()
        }
    }

    /// The last weights on the training tasks, and on the testing tasks if those are evaluated at all: means. Its lines lie
    /// after the last checkpoint, so a run that is gone on with forgets them.
    fn last_evaluation(&mut self) -> Result<[BTreeMap<String, TaskResult>; 2], TrainError> {
        let progress = self.standing.progress;
        let episodes = self.config.evaluation.episodes as u64;
        let same = |(at, results): &(_, Vec<TaskResult>)| {
            *at == progress && results.iter().all(|result| result.episodes == episodes)
        };
        let training = match self.evaluated.take().filter(same) {
            Some((_, results)) => results,
            None => self.greedy(Split::Training)?,
        };
        let has_testing = self.config.evaluation.testing_every_env_steps > 0;
        let testing = if has_testing { self.greedy(Split::Testing)? } else { Vec::new() };
        for (split, results) in [(Split::Training, &training), (Split::Testing, &testing)] {
            if !results.is_empty() {
                self.record_evaluation(Occasion::Final, split, results)?;
            }
        }
        Ok([by_task(&training), by_task(&testing)])
    }

    /// The best policy, where it is kept; if that is asked for with the absolute metric: ten times as many episodes of all
    /// tasks, and others than those that it was chosen by, which it may have had luck with.
    fn absolute_metric(&mut self) -> Result<Option<Best>, TrainError> {
        let Some((best, params)) = self.best.clone() else { return Ok(None) };
        let evaluation = self.config.evaluation.clone();
        if !evaluation.absolute_metric {
            return Ok(Some(best));
        }
        let (acting, seed) = (self.learner.acting(), self.config.seed.derive("absolute metric", 0));
        let mut of_split = |split: Split, episodes: usize| {
            let results = self.roll(&params[acting.clone()], split, Some(10 * episodes), seed)?;
            if !results.is_empty() {
                let (progress, wall_s) = (best.progress, self.metrics.wall_s());
                let evaluation = Evaluation::new(progress, wall_s, Occasion::Best, split, &results);
                self.measured(&Line::Evaluation(evaluation))?;
            }
            Ok::<_, TrainError>(by_task(&results))
        };
        let training = of_split(Split::Training, evaluation.episodes)?;
        let testing = of_split(Split::Testing, evaluation.testing_episodes)?;
        Ok(Some(Best { evaluation: training, testing, ..best }))
    }

    /// Repeats an attempt until it succeeds or `checkpoints.last_retry_ms` is over: a full disk may have room later.
    /// Reports the failure once. A second request to stop ends the waiting.
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
            // A directory that was removed does not come back, as room on a disk does; nor does a writer.
            let may_pass = self.run_dir.root().is_dir() && !self.writer.is_closed();
            if begun.elapsed() >= limit || !may_pass {
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
                // Callers that want more of a run that is over are told so by its end.
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
        let weights = weights_file::encode(&self.model, &TaskNames::of(&self.config), self.learner.params());
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

/// Means by task, as summaries have them.
fn by_task(results: &[TaskResult]) -> BTreeMap<String, TaskResult> {
    results.iter().map(|result| (result.task.clone(), result.means())).collect()
}
