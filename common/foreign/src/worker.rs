//! One worker: a process that holds several environments. It has a process group of its own, which ends with it, and a mark in
//! its environment, by which a process that it leaves behind ends what environments have started elsewhere.

use crate::protocol::{
    Answer, Failed, HEADER_BYTES, Header, Hello, PROTOCOL_VERSION, ProtocolError, Request, answer, header,
    request,
};
use rit_config::Environment;
use rit_env::{EnvironmentError, FailureKind};
use rustix::process::{Pid, Signal, kill_process_group};
use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    env,
    io::{self, ErrorKind, Read as _, Write as _},
    os::{
        fd::OwnedFd,
        unix::{net::UnixStream, process::CommandExt as _},
    },
    path::{Path, PathBuf},
    process::{self, Child, Command, Stdio},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

/// What the first question, which no environment answers, is about.
const NO_ENVIRONMENT: u16 = u16::MAX;

/// How long a worker may take until it answers for the first time: it imports what environments need.
const START_TIMEOUT: Duration = Duration::from_secs(120);

/// Bytes that are read at a time.
const CHUNK: usize = 1 << 16;

/// How workers are started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Launch {
    /// `MODULE:FUNCTION`.
    pub make: String,
    /// The interpreter; empty: the active virtual environment's, or the one beside this program, or `python3`.
    pub interpreter: String,
    /// How long one step, or one reset, may take.
    pub timeout: Duration,
    /// Environments that share a worker, at most.
    pub environments_per_worker: usize,
    /// Memory that a worker may take; 0: all.
    pub memory_mb: u64,
}

impl Launch {
    /// As a configuration says.
    pub fn of(environment: &Environment) -> Self {
        Self {
            make: environment.python.clone(),
            interpreter: environment.interpreter.clone(),
            timeout: Duration::from_millis(environment.timeout_ms),
            environments_per_worker: environment.environments_per_worker,
            memory_mb: environment.worker_memory_mb,
        }
    }

    /// The interpreter that workers are started with.
    pub fn interpreter(&self) -> PathBuf {
        if !self.interpreter.is_empty() {
            return PathBuf::from(&self.interpreter);
        }
        if let Some(active) = env::var_os("VIRTUAL_ENV") {
            return Path::new(&active).join("bin/python");
        }
        let beside = env::current_exe().ok().and_then(|program| Some(program.parent()?.join("python")));
        beside.filter(|python| python.exists()).unwrap_or_else(|| "python3".into())
    }
}

/// A frame's kind and body.
pub(crate) type Frame = (u16, Vec<u8>);

/// A worker's process, and what it has said.
#[derive(Debug)]
pub(crate) struct Worker {
    child: Child,
    stream: UnixStream,
    interpreter: PathBuf,
    timeout: Duration,
    /// Whether it has said welcome.
    greeted: bool,
    /// Read, and no whole frame yet.
    unread: Vec<u8>,
    /// Answers about other environments than the one that was waited for.
    early: BTreeMap<u16, VecDeque<Frame>>,
    /// Environments in it.
    environments: BTreeSet<u16>,
    /// The next one's number: none is used twice.
    next: u16,
    /// Why it can be used no more.
    broken: Option<EnvironmentError>,
}

impl Worker {
    /// Starts a worker and says hello; it is not waited for.
    pub(crate) fn start(launch: &Launch) -> Result<Self, EnvironmentError> {
        let interpreter = launch.interpreter();
        let failed = |error: io::Error| {
            let interpreter = interpreter.display();
            let detail = format!("{interpreter} cannot be started: {error}; set environment.interpreter");
            EnvironmentError::new(FailureKind::Died, detail)
        };
        let (stream, theirs) = UnixStream::pair().map_err(failed)?;
        stream.set_read_timeout(Some(START_TIMEOUT)).map_err(failed)?;
        stream.set_write_timeout(Some(launch.timeout)).map_err(failed)?;
        let (requests, answers) = (theirs.try_clone().map_err(failed)?, theirs);
        let child = Command::new(&interpreter)
            .args(["-m", "rit.worker", &launch.make])
            .env("RIT_WORKER_MEMORY_MB", launch.memory_mb.to_string())
            .env("RIT_WORKER_MARK", mark())
            .stdin(Stdio::from(OwnedFd::from(requests)))
            .stdout(Stdio::from(OwnedFd::from(answers)))
            .process_group(0)
            .spawn()
            .map_err(failed)?;
        let mut worker = Self {
            child,
            stream,
            timeout: launch.timeout,
            interpreter,
            greeted: false,
            unread: Vec::new(),
            early: BTreeMap::new(),
            environments: BTreeSet::new(),
            next: 0,
            broken: None,
        };
        let hello = serde_json::to_vec(&Hello { protocol: PROTOCOL_VERSION }).unwrap_or_default();
        worker.send(Request::Hello, NO_ENVIRONMENT, &hello)?;
        Ok(worker)
    }

    /// Whether another environment may be made in it.
    pub(crate) fn has_room(&self, environments_per_worker: usize) -> bool {
        self.broken.is_none()
            && self.environments.len() < environments_per_worker
            && self.next < NO_ENVIRONMENT
    }

    /// A number for another environment.
    pub(crate) fn take_place(&mut self) -> u16 {
        let environment = self.next;
        self.next += 1;
        self.environments.insert(environment);
        environment
    }

    /// Forgets an environment. What it may still say is not listened to.
    pub(crate) fn give_up(&mut self, environment: u16) {
        self.environments.remove(&environment);
        self.early.remove(&environment);
        if self.broken.is_none() {
            // A worker that has gone needs to forget nothing.
            let _ = self.send(Request::Close, environment, &[]);
        }
    }

    /// Asks for something; the answer is not waited for.
    pub(crate) fn send(
        &mut self,
        kind: Request,
        environment: u16,
        body: &[u8],
    ) -> Result<(), EnvironmentError> {
        self.usable()?;
        match self.stream.write_all(&request(kind, environment, body)) {
            Ok(()) => Ok(()),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// The next answer about an environment.
    pub(crate) fn receive(&mut self, environment: u16) -> Result<Frame, EnvironmentError> {
        if let Some(frame) = self.early.get_mut(&environment).and_then(VecDeque::pop_front) {
            return Ok(frame);
        }
        loop {
            let (about, frame) = self.next_frame()?;
            if about == NO_ENVIRONMENT && !self.greeted {
                self.greet(&frame)?;
            } else if about == environment {
                return Ok(frame);
            } else if self.environments.contains(&about) {
                self.early.entry(about).or_default().push_back(frame);
            }
        }
    }

    /// Ends the process, and whatever is in its group; says how it ended.
    fn kill(&mut self) -> String {
        if let Some(group) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process_group(group, Signal::KILL);
        }
        self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string())
    }

    fn usable(&self) -> Result<(), EnvironmentError> {
        self.broken.clone().map_or(Ok(()), Err)
    }

    fn greet(&mut self, (kind, body): &Frame) -> Result<(), EnvironmentError> {
        match answer(*kind, body) {
            Ok(Answer::Welcome) => {
                self.greeted = true;
                if let Err(error) = self.stream.set_read_timeout(Some(self.timeout)) {
                    return Err(self.failed(&error));
                }
                Ok(())
            }
            Ok(Answer::Failed(failed)) => {
                let error = self.raised(*failed);
                Err(self.break_with(error))
            }
            Ok(_) => Err(self.misspoke(&"it did not say welcome")),
            Err(error) => Err(self.misspoke(&error)),
        }
    }

    /// An error of the environment's own, in a line; its traceback goes to the log, once.
    pub(crate) fn raised(&mut self, failed: Failed) -> EnvironmentError {
        let Failed { error, place, traceback } = failed;
        let mut logged = LOGGED.lock().unwrap_or_else(PoisonError::into_inner);
        if logged.len() < LOGGED_MAX && logged.insert(format!("{error} {place}")) {
            tracing::error!("an environment raised an error\n{traceback}");
        }
        let at = if place.is_empty() { String::new() } else { format!(" ({place})") };
        EnvironmentError {
            // Of a fault that the worker has found itself there is but a line, which the error says.
            traceback: Some(traceback).filter(|traceback| traceback.trim_end().lines().count() > 1),
            ..EnvironmentError::new(FailureKind::Raised, format!("{error}{at}"))
        }
    }

    /// What it said cannot be understood, so nothing else that it says can be either.
    pub(crate) fn misspoke(&mut self, error: &dyn std::fmt::Display) -> EnvironmentError {
        let detail = format!("the worker's answer means nothing: {error}");
        self.break_with(EnvironmentError::new(FailureKind::BadAnswer, detail))
    }

    fn next_frame(&mut self) -> Result<(u16, Frame), EnvironmentError> {
        self.usable()?;
        let begun = Instant::now();
        let timeout = if self.greeted { self.timeout } else { START_TIMEOUT };
        loop {
            match self.whole_frame() {
                Ok(Some(frame)) => return Ok(frame),
                Ok(None) => {}
                Err(error) => return Err(self.misspoke(&error)),
            }
            if begun.elapsed() > timeout {
                return Err(self.failed(&ErrorKind::TimedOut.into()));
            }
            let at = self.unread.len();
            self.unread.resize(at + CHUNK, 0);
            let read = self.stream.read(&mut self.unread[at..]);
            self.unread.truncate(at + *read.as_ref().unwrap_or(&0));
            match read {
                Ok(0) => return Err(self.failed(&ErrorKind::UnexpectedEof.into())),
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(self.failed(&error)),
            }
        }
    }

    fn whole_frame(&mut self) -> Result<Option<(u16, Frame)>, ProtocolError> {
        let Some((beginning, rest)) = self.unread.split_first_chunk::<HEADER_BYTES>() else {
            return Ok(None);
        };
        let Header { len, kind, environment } = header(*beginning)?;
        if rest.len() < len {
            return Ok(None);
        }
        let body = rest[..len].to_vec();
        self.unread.drain(..HEADER_BYTES + len);
        Ok(Some((environment, (kind, body))))
    }

    /// The connection failed, or nothing came in time: the process is ended.
    fn failed(&mut self, error: &io::Error) -> EnvironmentError {
        let timed_out = matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut);
        let status = self.kill();
        let interpreter = self.interpreter.display();
        let (kind, detail) = match (timed_out, self.greeted) {
            (true, true) => {
                let ms = self.timeout.as_millis();
                (FailureKind::TimedOut, format!("it did not answer within environment.timeout_ms = {ms}"))
            }
            (true, false) => {
                let seconds = START_TIMEOUT.as_secs();
                (FailureKind::TimedOut, format!("{interpreter} did not come up within {seconds} s"))
            }
            (false, true) => (FailureKind::Died, format!("its process ended by itself ({status})")),
            (false, false) => (
                FailureKind::Died,
                format!(
                    "{interpreter} -m rit.worker ended ({status}); is the package rit-marl installed there? What it said is \
                     above, or in the actor's log"
                ),
            ),
        };
        self.break_with(EnvironmentError::new(kind, detail))
    }

    fn break_with(&mut self, error: EnvironmentError) -> EnvironmentError {
        self.kill();
        // Those that share it learn what happened to it.
        let detail =
            format!("its worker was ended, since another environment in it failed: {}", error.detail);
        self.broken = Some(EnvironmentError::new(FailureKind::Died, detail));
        error
    }
}

/// What no other worker on this host is marked with, nor was.
fn mark() -> String {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("{}-{}-{}", process::id(), since.as_nanos(), COUNT.fetch_add(1, Ordering::Relaxed))
}

/// Errors whose traceback was logged; one that comes again and again is logged once.
static LOGGED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
/// How many different ones are remembered.
const LOGGED_MAX: usize = 1000;

impl Drop for Worker {
    fn drop(&mut self) {
        self.kill();
    }
}
