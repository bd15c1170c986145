//! A run that something is done to, again and again.

use super::{
    schedule::{Blow, Planned},
    summary,
};
use crate::{child, control, failure::Failure, last_words::last_words};
use rit_config::RunDir;
use rit_proto::v1::{ActorStatus, CheckpointRequest, PauseRequest, ResumeRequest, RunStatus, StatusRequest};
use rit_record::Summary;
use rustix::process::{Pid, kill_process};
use std::{
    fs::{self, File},
    io,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::Stdio,
    time::{Duration, Instant},
};
use tokio::process::{Child, Command};

/// From one look at the run to the next.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// A successor that does not come within this time does not come; a run that stands for so long is stuck.
const PATIENCE: Duration = Duration::from_secs(60);

/// Attempts to meet a checkpoint while it is written.
const CHECKPOINTS_TRIED: usize = 50;

/// A blow and what came of it.
#[derive(Clone, Copy, Debug)]
pub struct Dealt {
    /// What was done.
    pub blow: Blow,
    /// Seconds until all was well again: the learner answers and counts the victim's successor.
    pub recovery_s: f64,
}

/// Whether what a `rit train` says is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Output {
    /// A file beside the run's directory.
    Log,
    /// It is not: the other end of its pipes is closed.
    Closed,
}

/// What is waited for.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Wait {
    /// A moment of the run, however far off, as long as it goes on.
    Progress,
    /// The successor of what was killed.
    Successor,
}

/// A `rit train` under way.
#[derive(Debug)]
pub struct Run {
    root: PathBuf,
    train: Child,
    /// Until when a `rit train --resume` that is refused is tried again: what was killed may not be gone yet.
    resuming_until: Option<(Instant, Output)>,
    /// Copies of the run that go on beside it.
    copies: Vec<Self>,
    ledger_checks: u64,
}

impl Run {
    /// Starts a run in a new directory.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn start(experiment: &str, settings: &[String], root: &Path) -> Result<Self, Failure> {
        let mut arguments = vec![experiment.to_owned(), "--run-dir".to_owned(), root.display().to_string()];
        arguments.extend(settings.iter().flat_map(|setting| ["--set".to_owned(), setting.clone()]));
        Ok(Self::of(root, train(&arguments, root, Output::Log)?))
    }

    fn of(root: &Path, train: Child) -> Self {
        let root = root.to_owned();
        Self { root, train, resuming_until: None, copies: Vec::new(), ledger_checks: 0 }
    }

    /// Looks at the ledger, each of which found it sound.
    pub fn ledger_checks(&self) -> u64 {
        self.ledger_checks
    }

    /// Waits for the end, and for that of the copies; returns the summaries, the copies' last.
    ///
    /// # Errors
    /// When a run fails.
    pub async fn finish(mut self) -> Result<Vec<Summary>, Failure> {
        let mut summaries = Vec::new();
        summaries.push(self.end().await?);
        for mut copy in std::mem::take(&mut self.copies) {
            summaries.push(copy.end().await?);
        }
        Ok(summaries)
    }

    async fn end(&mut self) -> Result<Summary, Failure> {
        let status = self.train.wait().await.map_err(Failure::runtime)?;
        if !status.success() {
            return Err(self.failed());
        }
        summary(&RunDir::open(&self.root)?.0)
    }

    /// Does what is planned.
    ///
    /// # Errors
    /// When the run fails or ends too early, when it does not recover, or when the ledger does not add up.
    pub async fn under_fire(
        &mut self,
        schedule: &[Planned],
        say: &dyn Fn(&str),
    ) -> Result<Vec<Dealt>, Failure> {
        let mut done = Vec::with_capacity(schedule.len());
        for &planned in schedule {
            let status =
                self.wait_for(Wait::Progress, |status| status.env_steps as f64 >= planned.at).await?;
            let (blow, begun) = (planned.blow, Instant::now());
            let waited = self.deal(planned, &status).await?;
            let recovery_s = (begun.elapsed() - waited).as_secs_f64();
            say(&format!(
                "{:>8} steps: {}, well again after {recovery_s:.2} s",
                status.env_steps,
                blow.words()
            ));
            done.push(Dealt { blow, recovery_s });
        }
        Ok(done)
    }

    /// Deals a blow and waits until all is well again. Returns how long it was waited for its moment.
    async fn deal(&mut self, planned: Planned, status: &RunStatus) -> Result<Duration, Failure> {
        let (learner, actors, blow) = (status.pid, status.actors.len(), planned.blow);
        let begun = Instant::now();
        let mut waited = Duration::ZERO;
        match blow {
            Blow::ActorKilled
            | Blow::ActorTold
            | Blow::ActorInterrupted
            | Blow::ActorHungUp
            | Blow::ActorStopped => {
                let Some(actor) = status.actors.get(planned.which % actors.max(1)) else { return Ok(waited) };
                let (name, pid) = (actor.name.clone(), actor.pid);
                send(pid, blow)?;
                let there = |actor: &ActorStatus| actor.name == name && actor.pid != pid;
                self.wait_for(Wait::Successor, |status| status.actors.iter().any(there)).await?;
                return Ok(waited);
            }
            Blow::LearnerKilled | Blow::LearnerHungUp | Blow::LearnerStopped | Blow::LearnerTold => {
                send(learner, blow)?;
            }
            Blow::LearnerKilledAtCheckpoint => {
                self.meet_a_checkpoint().await?;
                waited = begun.elapsed();
                send(learner, blow)?;
            }
            Blow::TrainTold | Blow::TrainHungUp | Blow::OutputClosed => {
                send(self.train.id().unwrap_or_default(), blow)?;
                let output = if blow == Blow::OutputClosed { Output::Closed } else { Output::Log };
                self.resume(output).await?;
            }
            Blow::Everything => {
                // The supervisor first, else it would begin to put things right.
                self.train.start_kill().map_err(Failure::runtime)?;
                for pid in std::iter::once(learner).chain(status.actors.iter().map(|actor| actor.pid)) {
                    send(pid, blow)?;
                }
                self.resume(Output::Log).await?;
            }
            Blow::SecondLearner => {
                self.second_is_refused(&["learner", "--run-dir"]).await?;
                self.second_is_refused(&["train", "--json", "--resume"]).await?;
                let same = |status: &RunStatus| status.pid == learner;
                self.wait_for(Wait::Successor, same).await?;
                return Ok(waited);
            }
            Blow::Copied => {
                self.copy().await?;
                return Ok(waited);
            }
        }
        self.wait_for(Wait::Successor, |status| status.pid != learner && status.actors.len() >= actors)
            .await?;
        Ok(waited)
    }

    /// Waits for the supervisor's end and starts another.
    async fn resume(&mut self, output: Output) -> Result<(), Failure> {
        let ended = tokio::time::timeout(PATIENCE, self.train.wait()).await;
        let stays = |_| Failure::runtime_message("rit train was told to end and does not");
        ended.map_err(stays)?.map_err(Failure::runtime)?;
        self.train = resumed(&self.root, output)?;
        self.resuming_until = Some((Instant::now() + PATIENCE, output));
        Ok(())
    }

    /// Another process for the same run does nothing to it.
    async fn second_is_refused(&self, command: &[&str]) -> Result<(), Failure> {
        let second = Command::from(child::this_program())
            .args(command)
            .arg(&self.root)
            .stdin(Stdio::null())
            .kill_on_drop(true)
            .output();
        let second = second.await.map_err(Failure::runtime)?;
        if second.status.code() == Some(2) {
            return Ok(());
        }
        let words = String::from_utf8_lossy(&second.stderr).into_owned();
        let command = command.join(" ");
        Err(Failure::runtime_message(format!(
            "a second {command} was not refused: {} {words}",
            second.status
        )))
    }

    /// Copies the run while it rests at a checkpoint, and resumes the copy beside it.
    async fn copy(&mut self) -> Result<(), Failure> {
        let (run_dir, _) = RunDir::open(&self.root)?;
        let mut control = control::connect(&run_dir).await?;
        control.pause(PauseRequest {}).await?;
        control.checkpoint(CheckpointRequest {}).await?;
        let name = self.root.file_name().unwrap_or_default().to_string_lossy();
        let root = self.root.with_file_name(format!("{name}-copy-{}", self.copies.len() + 1));
        copy_folder(&self.root, &root).map_err(Failure::runtime)?;
        control.resume(ResumeRequest {}).await?;
        let copy = Self::of(&root, resumed(&root, Output::Log)?);
        self.copies.push(copy);
        Ok(())
    }

    /// Asks for checkpoints until one is seen half written.
    async fn meet_a_checkpoint(&self) -> Result<(), Failure> {
        let (run_dir, _) = RunDir::open(&self.root)?;
        let checkpoints = run_dir.checkpoints();
        let mut control = control::connect(&run_dir).await?;
        for _ in 0..CHECKPOINTS_TRIED {
            let mut writing = std::pin::pin!(control.checkpoint(CheckpointRequest {}));
            loop {
                if is_partial(&checkpoints) {
                    return Ok(());
                }
                tokio::select! {
                    biased;
                    _ = &mut writing => break,
                    () = tokio::task::yield_now() => {}
                }
            }
        }
        // It is written faster than one can look: then it is killed right after one.
        Ok(())
    }

    /// Looks at the run until it is as wanted.
    async fn wait_for(
        &mut self,
        what: Wait,
        wanted: impl Fn(&RunStatus) -> bool,
    ) -> Result<RunStatus, Failure> {
        let (mut since, mut env_steps) = (Instant::now(), 0);
        let mut control = None;
        loop {
            if self.train.try_wait().map_err(Failure::runtime)?.is_some() {
                // What was killed holds the run until it is gone.
                match self.resuming_until {
                    Some((until, output)) if Instant::now() < until => {
                        self.train = resumed(&self.root, output)?;
                    }
                    _ => return Err(self.failed()),
                }
            }
            if control.is_none() {
                control = match RunDir::open(&self.root) {
                    Ok((run_dir, _)) => control::connect(&run_dir).await.ok(),
                    // It is being made.
                    Err(_) => None,
                };
            }
            if let Some(connected) = &mut control {
                match connected.status(StatusRequest {}).await {
                    Ok(status) => {
                        let status = status.into_inner();
                        self.check_ledger(&status)?;
                        self.resuming_until = None;
                        if wanted(&status) {
                            return Ok(status);
                        }
                        if what == Wait::Progress && status.env_steps > env_steps {
                            (since, env_steps) = (Instant::now(), status.env_steps);
                        }
                    }
                    Err(_) => control = None,
                }
            }
            if since.elapsed() > PATIENCE {
                return Err(Failure::runtime_message(match what {
                    Wait::Progress => "the run stands still",
                    Wait::Successor => "what was killed does not come back",
                }));
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    fn check_ledger(&mut self, status: &RunStatus) -> Result<(), Failure> {
        let Some(ledger) = &status.ledger else { return Ok(()) };
        let rejected: u64 = ledger.rejected.values().sum();
        if ledger.handed_out != ledger.inserted + ledger.outstanding + rejected {
            return Err(Failure::runtime_message(format!("the ledger does not add up: {ledger:?}")));
        }
        self.ledger_checks += 1;
        Ok(())
    }

    fn failed(&self) -> Failure {
        let last = last_words(&log(&self.root), 0);
        let root = self.root.display();
        Failure::runtime_message(format!("the run in {root} ended by itself: {last}"))
    }
}

/// Starts `rit train`.
fn train(arguments: &[String], root: &Path, output: Output) -> Result<Child, Failure> {
    let (stdout, stderr): (Stdio, Stdio) = match output {
        Output::Log => {
            let log = File::options().create(true).append(true).open(log(root)).map_err(Failure::runtime)?;
            (Stdio::null(), log.into())
        }
        Output::Closed => {
            let (_, stdout) = io::pipe().map_err(Failure::runtime)?;
            let (_, stderr) = io::pipe().map_err(Failure::runtime)?;
            (stdout.into(), stderr.into())
        }
    };
    Command::from(child::this_program())
        .arg("train")
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(stdout)
        .stderr(stderr)
        .kill_on_drop(true)
        .spawn()
        .map_err(Failure::runtime)
}

fn resumed(root: &Path, output: Output) -> Result<Child, Failure> {
    train(&["--resume".to_owned(), root.display().to_string()], root, output)
}

/// Files and folders; what is neither, such as a socket, is left out.
fn copy_folder(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir(to)?;
    fs::set_permissions(to, fs::metadata(from)?.permissions())?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let (kind, to) = (entry.file_type()?, to.join(entry.file_name()));
        if kind.is_dir() {
            copy_folder(&entry.path(), &to)?;
        } else if kind.is_symlink() {
            symlink(fs::read_link(entry.path())?, &to)?;
        } else if kind.is_file() {
            fs::copy(entry.path(), &to)?;
        }
    }
    Ok(())
}

fn log(root: &Path) -> PathBuf {
    root.with_extension("log")
}

fn is_partial(checkpoints: &Path) -> bool {
    let names = fs::read_dir(checkpoints).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.into_iter().any(|name| name.to_string_lossy().contains("partial"))
}

fn send(pid: u32, blow: Blow) -> Result<(), Failure> {
    let Some(signal) = blow.signal() else { return Ok(()) };
    let Some(pid) = i32::try_from(pid).ok().and_then(Pid::from_raw) else {
        return Err(Failure::runtime_message(format!("{pid} is no process")));
    };
    match kill_process(pid, signal) {
        // Gone by itself in the meantime.
        Ok(()) | Err(rustix::io::Errno::SRCH) => Ok(()),
        Err(error) => Err(Failure::runtime_message(format!("cannot kill process {pid:?}: {error}"))),
    }
}
