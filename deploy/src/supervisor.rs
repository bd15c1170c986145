//! Child processes of `rit train`: started by executing this program again, watched, restarted, ended.

use crate::{failure::Failure, logging::LogOptions};
use std::{
    fs::{self, OpenOptions},
    io,
    path::{Path, PathBuf},
    process::{ExitStatus, Stdio},
    time::{Duration, Instant},
};
use tokio::process::{Child, ChildStdin, Command};

/// An actor that dies this often within [`RESTART_WINDOW`] is given up, and the run with it.
const RESTARTS_MAX: usize = 5;

/// See [`RESTARTS_MAX`].
const RESTART_WINDOW: Duration = Duration::from_secs(60);

/// How long children may take to end once asked, before they are killed.
const END_TIMEOUT: Duration = Duration::from_secs(10);

/// A child process. Its standard input is a lifeline: it ends in order when this process does, however that
/// comes about.
#[derive(Debug)]
pub struct Process {
    name: String,
    command: Vec<String>,
    log: PathBuf,
    child: Child,
    /// Waiting for a child closes the input it still holds, so the lifeline is held here.
    lifeline: Option<ChildStdin>,
    starts: Vec<Instant>,
}

impl Process {
    /// Starts `rit` with these arguments; its standard error goes to `{logs}/{name}.log`.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn start(
        name: &str,
        mut command: Vec<String>,
        logs: &Path,
        log_options: &LogOptions,
    ) -> Result<Self, Failure> {
        command.push("--supervised".into());
        command.extend(log_options.arguments());
        let log = logs.join(format!("{name}.log"));
        let mut child = spawn(&command, &log).map_err(|error| cannot_start(name, &error))?;
        let lifeline = child.stdin.take();
        Ok(Self { name: name.to_owned(), command, log, child, lifeline, starts: vec![Instant::now()] })
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its process, while it lives.
    pub fn id(&self) -> Option<u32> {
        self.child.id()
    }

    /// Asks it to end in order; [`Process::wait`] sees its end.
    pub fn ask_to_end(&mut self) {
        self.lifeline = None;
    }

    /// Whether it was asked to end.
    pub fn is_ending(&self) -> bool {
        self.lifeline.is_none()
    }

    /// Kills it; [`Process::wait`] sees its end.
    pub fn start_kill(&mut self) {
        // Dead already is as good.
        let _ = self.child.start_kill();
    }

    /// Waits for its end.
    pub async fn wait(&mut self) -> io::Result<ExitStatus> {
        self.child.wait().await
    }

    /// Whether it may be started again.
    ///
    /// # Errors
    /// When it has died too often of late.
    pub fn may_restart(&mut self) -> Result<(), Failure> {
        self.starts.retain(|start| start.elapsed() < RESTART_WINDOW);
        if self.starts.len() >= RESTARTS_MAX {
            let (name, seconds) = (&self.name, RESTART_WINDOW.as_secs());
            return Err(Failure::runtime_message(format!(
                "{name} died {RESTARTS_MAX} times within {seconds} s and is given up: {}",
                self.last_words()
            )));
        }
        Ok(())
    }

    /// Starts it again.
    ///
    /// # Errors
    /// When it may not be, or the system refuses.
    pub fn restart(&mut self) -> Result<(), Failure> {
        self.may_restart()?;
        self.starts.push(Instant::now());
        self.child = spawn(&self.command, &self.log).map_err(|error| cannot_start(&self.name, &error))?;
        self.lifeline = self.child.stdin.take();
        Ok(())
    }

    /// Where it logs.
    pub fn log(&self) -> &Path {
        &self.log
    }

    /// The last line of its log.
    pub fn last_words(&self) -> String {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        let last = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("it said nothing");
        last.trim_start_matches("error: ").to_owned()
    }

    /// Closes the lifeline and waits; kills what does not end in time.
    pub async fn end(&mut self) {
        self.lifeline = None;
        if tokio::time::timeout(END_TIMEOUT, self.child.wait()).await.is_err() {
            tracing::warn!(name = self.name, "does not end and is killed");
            // Ended in the meantime is as good.
            let _ = self.child.kill().await;
        }
    }
}

fn spawn(command: &[String], log: &Path) -> io::Result<Child> {
    let log = OpenOptions::new().create(true).append(true).open(log)?;
    Command::new(std::env::current_exe()?)
        .args(command)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(log)
        // A terminal's Ctrl-C reaches this process alone, which then ends the others in order.
        .process_group(0)
        .kill_on_drop(true)
        .spawn()
}

fn cannot_start(name: &str, error: &io::Error) -> Failure {
    Failure::runtime_message(format!("cannot start {name}: {error}"))
}

/// How a process ended, in words.
pub fn in_words(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt as _;
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with exit code {code}"),
        (None, Some(signal)) => format!("was ended by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}
