//! Real processes of the `rit` binary, and the files that they leave.
#![allow(dead_code, reason = "each test binary uses its part")]

use rustix::process::{Pid, Signal, kill_process, test_kill_process};
use serde_json::Value;
use std::{
    fs::{self, Permissions},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    sync::LazyLock,
    time::{Duration, Instant},
};
use tempfile::TempDir;
use tokio::{
    runtime::Runtime,
    signal::unix::{SignalKind, signal},
};

/// Far beyond what any step of a test takes on a slow machine: reached only when something hangs.
const DEADLINE: Duration = Duration::from_secs(120);

/// Signals that these tests were started with ignored, as by `nohup` or in the background of a script: what they start
/// would ignore them too. A process that catches a signal hands its default action down.
static CAUGHT: LazyLock<Runtime> = LazyLock::new(|| {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
    let inside = runtime.enter();
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap();
    let ignored = u64::from_str_radix(ignored.trim(), 16).unwrap();
    for kind in [SignalKind::hangup(), SignalKind::quit()] {
        // Signals are counted from 1.
        if ignored >> (kind.as_raw_value() - 1) & 1 == 1 {
            drop(signal(kind).unwrap());
        }
    }
    drop(inside);
    runtime
});

/// `rit` with these arguments.
pub fn rit(arguments: &[&str]) -> Command {
    LazyLock::force(&CAUGHT);
    let mut command = Command::new(env!("CARGO_BIN_EXE_rit"));
    command.args(arguments).stdin(Stdio::null());
    command
}

/// What became of `rit` with these arguments.
pub fn output(arguments: &[&str]) -> Output {
    rit(arguments).output().unwrap()
}

/// Runs `rit` and checks exit code 2 and the one line it prints.
#[track_caller]
pub fn refused(arguments: &[&str], message: &[&str]) {
    let output = output(arguments);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
    // Before it, only what `rit train` says of the run it makes.
    let errors: Vec<_> = stderr.lines().filter(|line| !line.contains("run directory /")).collect();
    assert!(errors.len() == 1 && errors[0].starts_with("error: "), "{stderr}");
    for part in message {
        assert!(stderr.contains(part), "{part:?} in {stderr}");
    }
}

/// A run directory in a folder of its own.
pub struct RunFolder {
    folder: TempDir,
}

impl RunFolder {
    pub fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    /// The run directory, not made yet.
    pub fn run_dir(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// A file of mode 600 with a token.
    pub fn secret(&self, name: &str) -> PathBuf {
        let path = self.path().join(name);
        fs::write(&path, format!("{name}-0123456789abcdef\n")).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
        path
    }

    /// Where the learner of this run listens for other hosts, once it does.
    pub fn remote_address(&self) -> String {
        let begun = Instant::now();
        loop {
            if let Ok(address) = fs::read_to_string(self.run_dir().join("remote_address")) {
                return address.trim().to_owned();
            }
            assert!(begun.elapsed() < DEADLINE, "no learner listens");
            std::thread::yield_now();
        }
    }

    /// Trains to the end and returns the summary.
    pub fn train(&self, arguments: &[&str]) -> Value {
        self.start(arguments).finish()
    }

    /// Starts to train; what is not the summary is kept quiet.
    pub fn start(&self, arguments: &[&str]) -> Train {
        self.start_as(rit(&[]), &[&["--json"], arguments].concat())
    }

    /// Starts to train by a command that executes `rit`, and says what happens on standard error.
    pub fn start_as(&self, mut command: Command, arguments: &[&str]) -> Train {
        let run_dir = self.run_dir();
        command.args(["train", "--run-dir", run_dir.to_str().unwrap()]);
        let child = command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Train { child: Some(child), run_dir }
    }
}

/// A `rit train` under way; killed with its children when dropped.
pub struct Train {
    child: Option<Child>,
    run_dir: PathBuf,
}

impl Train {
    /// `rit ctl` for this run.
    pub fn ctl(&self, arguments: &[&str]) -> Output {
        let run = self.run_dir.to_str().unwrap();
        output(&[&["ctl", "--json", "--run", run], arguments].concat())
    }

    /// Asks for the status until it is as wanted.
    pub fn wait_for(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let begun = Instant::now();
        loop {
            let answer = self.ctl(&["status"]);
            if answer.status.success() {
                let status: Value = serde_json::from_slice(&answer.stdout).unwrap();
                // Of a run that goes on from its end, until its learner answers.
                if status["state"] != "over" && wanted(&status) {
                    return status;
                }
            }
            if self.child.as_mut().unwrap().try_wait().unwrap().is_some() || begun.elapsed() > DEADLINE {
                let _ = self.child.as_mut().unwrap().kill();
                let output = self.child.take().unwrap().wait_with_output().unwrap();
                panic!("waiting for {what}: {:?} {}", output.status, String::from_utf8_lossy(&output.stderr));
            }
        }
    }

    /// A learner's process other than this one, from its first moment on, before it says anything.
    pub fn wait_for_learner_process(&mut self, other_than: u32) -> u32 {
        let begun = Instant::now();
        let run_dir = self.run_dir.to_str().unwrap();
        let is_learner = |pid: u32| {
            let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let words: Vec<&str> = line.split('\0').collect();
            words.get(1) == Some(&"learner") && words.contains(&run_dir)
        };
        loop {
            let entries = fs::read_dir("/proc").unwrap();
            let mut pids = entries.filter_map(|entry| entry.unwrap().file_name().to_str()?.parse().ok());
            if let Some(pid) = pids.find(|&pid| pid != other_than && is_learner(pid)) {
                return pid;
            }
            assert!(begun.elapsed() < DEADLINE, "no learner is started");
        }
    }

    /// Sends a signal to `rit train` itself.
    pub fn signal(&self, signal: Signal) {
        kill(self.child.as_ref().unwrap().id(), signal);
    }

    /// Trains on from where the run of this folder stands.
    pub fn resume(folder: &RunFolder, arguments: &[&str]) -> Self {
        Self::resume_in(&folder.run_dir(), arguments)
    }

    /// Trains on from where the run in this directory stands.
    pub fn resume_in(run_dir: &Path, arguments: &[&str]) -> Self {
        let mut command = rit(&["train", "--json", "--resume", run_dir.to_str().unwrap()]);
        let child = command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Self { child: Some(child), run_dir: run_dir.to_owned() }
    }

    /// The process of `rit train` itself.
    pub fn pid(&self) -> u32 {
        self.child.as_ref().unwrap().id()
    }

    /// Waits for the end.
    pub fn wait(mut self) -> Output {
        self.child.take().unwrap().wait_with_output().unwrap()
    }

    /// Waits for the end, which must be a good one; returns the summary.
    pub fn finish(self) -> Value {
        self.end_with(0)
    }

    /// Waits for the end of a run that was asked to stop; returns the summary.
    pub fn finish_stopped(self) -> Value {
        let summary = self.end_with(3);
        assert_eq!(summary["ended"], "stopped");
        summary
    }

    /// Waits for the end, with this exit code; returns the summary.
    pub fn end_with(self, code: i32) -> Value {
        let output = self.wait();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        serde_json::from_slice(&output.stdout).unwrap()
    }
}

impl Drop for Train {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Sends a signal to a process.
pub fn kill(pid: u32, signal: Signal) {
    kill_process(Pid::from_raw(pid as i32).unwrap(), signal).unwrap();
}

/// Waits until a process is gone.
pub fn wait_until_gone(pid: u32) {
    let begun = Instant::now();
    while test_kill_process(Pid::from_raw(pid as i32).unwrap()).is_ok() {
        assert!(begun.elapsed() < DEADLINE, "process {pid} stays");
        std::thread::yield_now();
    }
}

/// The process of the actor of this name, if it is there.
pub fn actor_pid(status: &Value, name: &str) -> Option<u32> {
    let actors = status["actors"].as_array().unwrap();
    actors.iter().find(|actor| actor["name"] == name).map(|actor| actor["pid"].as_u64().unwrap() as u32)
}

/// The process of the learner.
pub fn learner_pid(status: &Value) -> u32 {
    status["pid"].as_u64().unwrap() as u32
}

/// The processes of a run, as its status names them: the learner first.
pub fn pids(status: &Value) -> Vec<u32> {
    let actors = status["actors"].as_array().unwrap().iter().map(|actor| &actor["pid"]);
    std::iter::once(&status["pid"]).chain(actors).map(|pid| pid.as_u64().unwrap() as u32).collect()
}

/// What the run has left in shared memory: nothing, if all is well.
pub fn shared_memory_of(run_dir: &Path) -> Vec<PathBuf> {
    let (run_dir, _) = rit_config::RunDir::open(run_dir).unwrap();
    match fs::read_to_string(run_dir.shared_memory()) {
        Ok(place) => rit_ipc::RunSpace::new(Path::new(place.trim_end())).unwrap().leftovers().unwrap(),
        // No life of the run has left a place.
        Err(_) => Vec::new(),
    }
}

/// The objects of a file of one JSON object a line.
pub fn json_lines(path: &Path) -> Vec<Value> {
    fs::read_to_string(path).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The lines of a run's metrics after the first, which says whose they are.
pub fn metrics_lines(run_dir: &Path) -> Vec<Value> {
    let mut lines = json_lines(&run_dir.join("metrics.jsonl"));
    let run_id = fs::read_to_string(run_dir.join("run_id")).unwrap();
    let header = lines.remove(0);
    let whose = [&header["kind"], &header["format_version"], &header["run_id"]];
    assert_eq!(whose, [&Value::from("run"), &Value::from(1), &Value::from(run_id.trim())]);
    lines
}
