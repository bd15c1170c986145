//! The threads of a learner: they begin and end together.

use super::{LearnerError, new_receiver};
use crate::{
    coordinator::{Event, Input},
    receive::{Fence, receive},
    summary,
    trainer::{TrainError, Trainer, Work},
    write_queue::WriteQueueReader,
    writer::Writer,
};
use rit_config::RunDir;
use rit_episode::wire::Expected;
use rit_ipc::{EpisodeReceiver, Limits};
use rit_record::Summary;
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
};
use tokio::sync::{mpsc as async_mpsc, oneshot};

/// What the threads work with, before they do.
pub(super) struct Workers {
    pub(super) receiver: EpisodeReceiver,
    pub(super) limits: Limits,
    pub(super) expected: Arc<Expected>,
    pub(super) fences: mpsc::Receiver<Fence>,
    pub(super) writer: Writer,
    pub(super) to_write: WriteQueueReader,
    pub(super) trainer: Trainer,
    pub(super) work: mpsc::Receiver<Work>,
}

impl Workers {
    /// Begins the work.
    ///
    /// # Errors
    /// When the summary of an earlier end cannot be removed, or a thread cannot be started.
    pub(super) fn spawn(
        self,
        run_dir: &RunDir,
        events: &async_mpsc::Sender<Event>,
    ) -> Result<Threads, LearnerError> {
        // The run continues: a summary of an earlier end is no longer true. Removed before the trainer starts, which writes
        // the next one at once where nothing is left to train.
        Summary::remove(run_dir)
            .map_err(|error| LearnerError::Io { what: run_dir.summary().display().to_string(), error })?;
        let Self { receiver, limits, expected, fences, writer, to_write, trainer, work } = self;
        let stop = Arc::new(AtomicBool::new(false));
        let receiving = {
            let (stop, run_dir, to_coordinator) = (Arc::clone(&stop), run_dir.clone(), events.clone());
            Thread::spawn("receive", events, move || {
                let renew = || new_receiver(&run_dir, limits);
                receive(receiver, renew, &expected, &to_coordinator, &fences, &stop)
            })?
        };
        let writing = Thread::spawn("write", events, move || writer.run(&to_write))?;
        let training = Thread::spawn("train", events, move || trainer.run(&work))?;
        Ok(Threads { stop, receiving, writing, training })
    }
}

/// The threads at work.
pub(super) struct Threads {
    /// Ends receiving; writing ends with training, and training when it is told or the coordinator has gone.
    stop: Arc<AtomicBool>,
    pub(super) receiving: Thread<Result<(), LearnerError>>,
    pub(super) writing: Thread<()>,
    pub(super) training: Thread<Result<Summary, TrainError>>,
}

impl Threads {
    /// Tells the receiving thread to end: no frame is wanted any more.
    pub(super) fn stop_receiving(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Waits for their ends; returns how the run ended.
    ///
    /// # Errors
    /// When one of them failed. Then the summary says so.
    pub(super) async fn end(self, run_dir: &RunDir) -> Result<Summary, LearnerError> {
        let received = self.receiving.end().await.flatten();
        let trained = self.training.end().await.and_then(|trained| Ok(trained?));
        let written = self.writing.end().await;
        let ended = both(both(received, trained), written).map(|(((), summary), ())| summary);
        if let Err(error) = &ended
            && let Err(error) = summary::write_failed(run_dir, &error.to_string())
        {
            tracing::error!(%error, "summary.json was not written");
        }
        ended
    }
}

/// Both results, or what failed. A failure in one thread ends the others, which may then fail too: that is logged.
fn both<T, U>(
    first: Result<T, LearnerError>,
    second: Result<U, LearnerError>,
) -> Result<(T, U), LearnerError> {
    match (first, second) {
        (Ok(first), Ok(second)) => Ok((first, second)),
        (Err(first), Err(second)) => {
            tracing::error!(error = %second, "another thread of the learner failed too");
            Err(first)
        }
        (Err(error), Ok(_)) | (Ok(_), Err(error)) => Err(error),
    }
}

/// A thread at work, and the way to its result.
pub(super) struct Thread<T> {
    name: &'static str,
    result: oneshot::Receiver<T>,
}

impl<T: Send + 'static> Thread<T> {
    /// Starts a named thread. The coordinator is told when its work has ended, also by a panic: a run goes on with all of
    /// its threads or not at all.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn spawn(
        name: &'static str,
        events: &async_mpsc::Sender<Event>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<Self, LearnerError> {
        let (done, result) = oneshot::channel();
        let events = events.clone();
        let started = thread::Builder::new().name(name.to_owned()).spawn(move || {
            let _over = SaysOver(events);
            // The learner may have ended early.
            let _ = done.send(work());
        });
        started.map_err(|error| LearnerError::Io { what: format!("the {name} thread"), error })?;
        Ok(Self { name, result })
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// When it panicked.
    pub(super) async fn end(self) -> Result<T, LearnerError> {
        self.result.await.map_err(|_| LearnerError::Panicked(self.name))
    }

    /// Whether its result is there.
    #[cfg(test)]
    pub(super) fn has_ended(&self) -> bool {
        !self.result.is_empty()
    }
}

/// Tells the coordinator that nothing more can happen, when it is dropped at the end of its thread or while that unwinds.
struct SaysOver(async_mpsc::Sender<Event>);

impl Drop for SaysOver {
    fn drop(&mut self) {
        // At the end of a run the coordinator may have gone.
        let _ = self.0.blocking_send(Input::Over.into());
    }
}
