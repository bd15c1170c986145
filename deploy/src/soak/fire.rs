//! A run whose processes are killed.

use crate::{child, control, failure::Failure, last_words::last_words};
use rand::RngExt as _;
use rit_config::RunDir;
use rit_episode::Rng;
use rit_proto::v1::{CheckpointRequest, RunStatus, StatusRequest};
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use serde_json::Value;
use std::{
    fs::{self, File},
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

/// The supervisor gives up a process that dies five times within a minute; so often each may be killed before
/// everything is, which starts a new supervisor.
const KILLS_PER_SUPERVISOR: usize = 3;

/// What is killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Victim {
    /// One actor, by SIGKILL.
    Actor,
    /// One actor, by SIGSTOP: it is noticed by its silence.
    StoppedActor,
    /// The learner.
    Learner,
    /// The learner, while it writes a checkpoint.
    LearnerAtCheckpoint,
    /// All processes at once, as when the machine loses power; the run is resumed.
    Everything,
}

impl Victim {
    /// For people.
    pub fn words(self) -> &'static str {
        match self {
            Self::Actor => "an actor",
            Self::StoppedActor => "an actor, stopped and not killed",
            Self::Learner => "the learner",
            Self::LearnerAtCheckpoint => "the learner, at a checkpoint",
            Self::Everything => "everything; the run is resumed",
        }
    }

    fn draw(rng: &mut Rng) -> Self {
        match rng.random_range(0..20) {
            0..8 => Self::Actor,
            8..9 => Self::StoppedActor,
            9..14 => Self::Learner,
            14..17 => Self::LearnerAtCheckpoint,
            _ => Self::Everything,
        }
    }
}

/// A kill and what came of it.
#[derive(Clone, Copy, Debug)]
pub struct Kill {
    /// What was killed.
    pub victim: Victim,
    /// Seconds until the learner answered and counted the victim's successor.
    pub restart_s: f64,
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
    /// Kills since this supervisor started.
    killed: usize,
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
        Ok(Self { root: root.to_owned(), train: train(&arguments, root)?, killed: 0, ledger_checks: 0 })
    }

    /// Looks at the ledger, each of which found it sound.
    pub fn ledger_checks(&self) -> u64 {
        self.ledger_checks
    }

    /// Waits for the end; returns the summary.
    ///
    /// # Errors
    /// When the run fails.
    pub async fn finish(mut self) -> Result<Value, Failure> {
        let status = self.train.wait().await.map_err(Failure::runtime)?;
        if !status.success() {
            return Err(self.failed());
        }
        let text = fs::read(self.root.join("summary.json")).map_err(Failure::runtime)?;
        serde_json::from_slice(&text).map_err(Failure::runtime)
    }

    /// Kills so many times, at random moments spread over the whole run.
    ///
    /// # Errors
    /// When the run fails or ends too early, when a successor does not come, or when the ledger does not add up.
    pub async fn under_fire(
        &mut self,
        kills: usize,
        env_steps: u64,
        rng: &mut Rng,
        say: &dyn Fn(&str),
    ) -> Result<Vec<Kill>, Failure> {
        let mut done = Vec::with_capacity(kills);
        for index in 0..kills {
            // The last tenth is left in peace, else a kill might come after the end.
            let moment = (index as f64 + rng.random::<f64>()) / kills as f64 * 0.9 * env_steps as f64;
            let status = self.wait_for(Wait::Progress, |status| status.env_steps as f64 >= moment).await?;
            let drawn = Victim::draw(rng);
            let victim = if self.killed < KILLS_PER_SUPERVISOR { drawn } else { Victim::Everything };
            let actor = rng.random_range(0..status.actors.len().max(1));
            let kill = self.kill(victim, &status, actor).await?;
            let words = victim.words();
            say(&format!(
                "{:>8} steps: {words} killed, back after {:.2} s",
                status.env_steps, kill.restart_s
            ));
            done.push(kill);
        }
        Ok(done)
    }

    async fn kill(&mut self, victim: Victim, status: &RunStatus, actor: usize) -> Result<Kill, Failure> {
        self.killed += 1;
        let (learner, actors) = (status.pid, status.actors.len());
        let mut begun = Instant::now();
        match victim {
            Victim::Actor | Victim::StoppedActor => {
                let (name, pid) = (status.actors[actor].name.clone(), status.actors[actor].pid);
                signal(pid, if victim == Victim::Actor { Signal::KILL } else { Signal::STOP })?;
                self.wait_for(Wait::Successor, |status| {
                    status.actors.iter().any(|actor| actor.name == name && actor.pid != pid)
                })
                .await?;
            }
            Victim::Learner | Victim::LearnerAtCheckpoint => {
                if victim == Victim::LearnerAtCheckpoint {
                    self.meet_a_checkpoint().await?;
                    begun = Instant::now();
                }
                signal(learner, Signal::KILL)?;
                self.wait_for(Wait::Successor, |status| {
                    status.pid != learner && status.actors.len() >= actors
                })
                .await?;
            }
            Victim::Everything => {
                // The supervisor first, else it would begin to put things right.
                self.train.start_kill().map_err(Failure::runtime)?;
                for pid in std::iter::once(learner).chain(status.actors.iter().map(|actor| actor.pid)) {
                    signal(pid, Signal::KILL)?;
                }
                self.train.wait().await.map_err(Failure::runtime)?;
                self.train = train(&["--resume".to_owned(), self.root.display().to_string()], &self.root)?;
                self.killed = 0;
                self.wait_for(Wait::Successor, |status| {
                    status.pid != learner && status.actors.len() >= actors
                })
                .await?;
            }
        }
        Ok(Kill { victim, restart_s: begun.elapsed().as_secs_f64() })
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
                return Err(self.failed());
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

/// Starts `rit train`; what it says goes to a file beside the run's directory.
fn train(arguments: &[String], root: &Path) -> Result<Child, Failure> {
    let log = File::options().create(true).append(true).open(log(root)).map_err(Failure::runtime)?;
    Command::from(child::this_program())
        .args(["train", "--json"])
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log)
        .kill_on_drop(true)
        .spawn()
        .map_err(Failure::runtime)
}

fn log(root: &Path) -> PathBuf {
    root.with_extension("log")
}

fn is_partial(checkpoints: &Path) -> bool {
    let names = fs::read_dir(checkpoints).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.into_iter().any(|name| name.to_string_lossy().contains("partial"))
}

fn signal(pid: u32, signal: Signal) -> Result<(), Failure> {
    let Some(pid) = i32::try_from(pid).ok().and_then(Pid::from_raw) else {
        return Err(Failure::runtime_message(format!("{pid} is no process")));
    };
    match kill_process(pid, signal) {
        // Gone by itself in the meantime.
        Ok(()) | Err(rustix::io::Errno::SRCH) => Ok(()),
        Err(error) => Err(Failure::runtime_message(format!("cannot kill process {pid:?}: {error}"))),
    }
}
