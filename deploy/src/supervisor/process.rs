//! The child processes of `rit train`: this program, executed again.

use super::{Exit, Place};
use crate::{
    child,
    last_words::{last_traceback, last_words},
    logging::LogOptions,
};
use rit_config::OwnedRunDir;
use std::{collections::BTreeMap, fs, io, path::PathBuf, process::ExitStatus};
use tokio::{
    process::{Child, ChildStdin},
    sync::oneshot,
    task::JoinSet,
};

/// The processes there are, by their places.
#[derive(Debug)]
pub struct Processes<'a> {
    owned: &'a OwnedRunDir,
    logs: PathBuf,
    log_options: &'a LogOptions,
    handles: BTreeMap<Place, Handle>,
    /// Length of each log when its process started: what lies before is of former ones.
    log_begins_at: BTreeMap<Place, u64>,
    /// Each waits for the end of one.
    ends: JoinSet<(Place, io::Result<ExitStatus>)>,
}

/// What can be done to a process.
#[derive(Debug)]
struct Handle {
    /// The process's standard input: it shuts down gracefully when this is closed, however that comes about. Waiting for a
    /// child closes the input it still holds, so it is held here.
    lifeline: Option<ChildStdin>,
    kill: Option<oneshot::Sender<()>>,
}

impl<'a> Processes<'a> {
    /// None yet; those of this run.
    pub fn new(owned: &'a OwnedRunDir, log_options: &'a LogOptions) -> Self {
        Self {
            owned,
            logs: owned.run_dir().logs(),
            log_options,
            handles: BTreeMap::new(),
            log_begins_at: BTreeMap::new(),
            ends: JoinSet::new(),
        }
    }

    /// Starts a process. Returns its number.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn start(&mut self, place: Place) -> io::Result<Option<u32>> {
        let log = self.log(place);
        self.log_begins_at.insert(place, fs::metadata(&log).map_or(0, |metadata| metadata.len()));
        let mut command = child::this_program();
        match place {
            Place::Learner => command.arg("learner"),
            Place::Actor(slot) => {
                command.args(["actor", "--name", &place.to_string(), "--slot", &slot.to_string()])
            }
        };
        command
            .arg("--run-dir")
            .arg(self.owned.run_dir().root())
            .arg("--supervised")
            .args(self.log_options.arguments());
        // An actor writes nothing to the run directory.
        let lock = self.owned.lock().filter(|_| place == Place::Learner);
        let mut child = child::spawn(command, &log, lock)?;
        let (kill, killed) = oneshot::channel();
        self.handles.insert(place, Handle { lifeline: child.stdin.take(), kill: Some(kill) });
        let pid = child.id();
        self.ends.spawn(async move { (place, end_of(child, killed).await) });
        Ok(pid)
    }

    /// Asks a process to shut down gracefully.
    pub fn ask_to_end(&mut self, place: Place) {
        if let Some(handle) = self.handles.get_mut(&place) {
            handle.lifeline = None;
        }
    }

    /// Kills a process.
    pub fn kill(&mut self, place: Place) {
        if let Some(kill) = self.handles.get_mut(&place).and_then(|handle| handle.kill.take()) {
            // Ended in the meantime is as good.
            let _ = kill.send(());
        }
    }

    /// The next process to end, and how. Never comes while there is none. What is dropped is not lost.
    pub async fn next_end(&mut self) -> (Place, Exit) {
        loop {
            match self.ends.join_next().await {
                Some(Ok((place, status))) => {
                    self.handles.remove(&place);
                    return (place, exit(status));
                }
                // These tasks are not aborted, and they do not panic.
                Some(Err(error)) => tracing::error!(%error, "a process is not waited for any more"),
                None => std::future::pending().await,
            }
        }
    }

    /// Why a process ended, if its log tells.
    pub fn last_words(&self, place: Place) -> String {
        last_words(&self.log(place), self.log_begins_at.get(&place).copied().unwrap_or(0))
    }

    /// Where in an environment's code a process's last error was raised, if its log tells.
    pub fn last_traceback(&self, place: Place) -> Option<String> {
        last_traceback(&self.log(place), self.log_begins_at.get(&place).copied().unwrap_or(0))
    }

    fn log(&self, place: Place) -> PathBuf {
        self.logs.join(format!("{place}.log"))
    }
}

async fn end_of(mut child: Child, killed: oneshot::Receiver<()>) -> io::Result<ExitStatus> {
    tokio::select! {
        status = child.wait() => return status,
        Ok(()) = killed => {}
    }
    // Ended in the meantime is as good.
    let _ = child.start_kill();
    child.wait().await
}

fn exit(status: io::Result<ExitStatus>) -> Exit {
    use std::os::unix::process::ExitStatusExt as _;
    match status {
        Ok(status) => match (status.code(), status.signal()) {
            (Some(code), _) => Exit::Code(code),
            (None, signal) => Exit::Signal(signal.unwrap_or_default()),
        },
        // A child that cannot be waited for is as good as dead.
        Err(error) => Exit::NotStarted(error.to_string()),
    }
}
