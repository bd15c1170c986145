//! What the tests share: a run of their own, frames that can be told apart, child processes.

#![allow(dead_code, clippy::unwrap_used, clippy::panic, clippy::print_stderr)]

use rit_episode::wire::{Frame, Header};
use rit_ipc::{EpisodeReceiver, EpisodeSender, Limits, ReceivedFrame, RunSpace};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{ChildStderr, Command, Stdio};
use std::time::Duration;

/// Long enough for anything here, short enough to see that a test hangs.
pub const PATIENCE: Duration = Duration::from_secs(30);

pub const PAYLOAD_LEN: usize = 4096;

pub fn never() -> bool {
    false
}

/// A run in a directory of its own, which has to be gone without a trace when the test ends.
pub struct Run {
    pub space: RunSpace,
    parent: tempfile::TempDir,
}

impl Run {
    pub fn new() -> Self {
        let parent = tempfile::Builder::new().prefix("rit-").tempdir().unwrap();
        let space = RunSpace::new(&parent.path().join("run")).unwrap();
        assert!(space.leftovers().unwrap().is_empty());
        Self { space, parent }
    }

    pub fn receiver(&self, limits: Limits) -> EpisodeReceiver {
        EpisodeReceiver::create(&self.space, limits).unwrap()
    }

    pub fn sender(&self) -> EpisodeSender {
        EpisodeSender::open(&self.space, PAYLOAD_LEN, PATIENCE).unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.space.remove().unwrap();
        assert_eq!(self.space.leftovers().unwrap(), Vec::<std::path::PathBuf>::new());
    }
}

/// Limits of small frames.
pub fn limits(max_senders: usize, frames_per_sender: usize) -> Limits {
    Limits { payload_len: PAYLOAD_LEN, max_senders, frames_per_sender }
}

/// A frame whose every byte says which it is.
pub fn frame_of(actor: u32, episode: u64, payload_len: usize) -> Frame {
    let header = Header { actor, episode, payload_len: payload_len as u64, ..bytemuck::Zeroable::zeroed() };
    let mut frame = Frame { header, payload: vec![0; payload_len] };
    for (i, word) in frame.payload.chunks_mut(8).enumerate() {
        word.copy_from_slice(&mark(actor, episode, i).to_le_bytes()[..word.len()]);
    }
    frame
}

pub fn frame(actor: u32, episode: u64) -> Frame {
    frame_of(actor, episode, PAYLOAD_LEN)
}

/// Which frame it is, after a look at every byte.
pub fn identify(frame: &ReceivedFrame) -> (u32, u64) {
    let Header { actor, episode, payload_len, .. } = *frame.header();
    assert_eq!(frame.payload().len() as u64, payload_len);
    for (i, word) in frame.payload().chunks(8).enumerate() {
        assert_eq!(word, &mark(actor, episode, i).to_le_bytes()[..word.len()], "a torn frame");
    }
    (actor, episode)
}

/// Payloads are alike after so many episodes: more than frames of one sender lie in shared memory at a time.
pub const PATTERNS: u64 = 16;

fn mark(actor: u32, episode: u64, word: usize) -> u64 {
    ((u64::from(actor) << 56) ^ ((episode % PATTERNS) << 40) ^ word as u64)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
}

/// The next frame, waited for.
pub fn next(receiver: &mut EpisodeReceiver) -> ReceivedFrame {
    let began = std::time::Instant::now();
    loop {
        if let Some(frame) = receiver.receive().unwrap() {
            return frame;
        }
        assert!(began.elapsed() < PATIENCE, "no frame came");
        receiver.wait(PATIENCE).unwrap();
    }
}

/// Everything that has come, identified.
pub fn drain(receiver: &mut EpisodeReceiver) -> Vec<(u32, u64)> {
    std::iter::from_fn(|| receiver.receive().unwrap()).map(|frame| identify(&frame)).collect()
}

/// A test of this binary in a process of its own. The two talk in lines: the child over standard error.
pub struct Child {
    process: std::process::Child,
    lines: std::io::Lines<BufReader<ChildStderr>>,
}

const CHILD: &str = "RIT_IPC_CHILD_OF";

/// In a child: the run of its parent. Elsewhere nothing, and the test has nothing to do.
pub fn parents_run() -> Option<RunSpace> {
    let directory = std::env::var_os(CHILD)?;
    Some(RunSpace::new(Path::new(&directory)).unwrap())
}

/// In a child: says something to the parent.
pub fn tell(line: &str) {
    eprintln!("{line}");
}

/// In a child: waits for a line of the parent.
pub fn hear() -> String {
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).unwrap();
    line.trim().to_owned()
}

impl Child {
    pub fn start(run: &Run, test: &str) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        Self::start_with(run, test, &mut command)
    }

    /// Appends what makes it a child to a command that ends in this binary.
    pub fn start_with(run: &Run, test: &str, command: &mut Command) -> Self {
        let mut process = command
            .args(["--exact", test, "--nocapture"])
            .env(CHILD, run.space.directory())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(process.stderr.take().unwrap()).lines();
        Self { process, lines }
    }

    /// Waits until the child says this.
    pub fn expect(&mut self, expected: &str) {
        let mut said = Vec::new();
        for line in &mut self.lines {
            let line = line.unwrap();
            if line == expected {
                return;
            }
            said.push(line);
        }
        panic!("the child ended without {expected:?}, it said {said:#?}");
    }

    pub fn say(&mut self, line: &str) {
        writeln!(self.process.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// SIGKILL.
    pub fn kill(mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }

    /// Waits for its own end.
    pub fn finish(mut self) {
        let status = self.process.wait().unwrap();
        let said: Vec<_> = self.lines.map_while(Result::ok).collect();
        assert!(status.success(), "the child failed, it said {said:#?}");
    }
}
