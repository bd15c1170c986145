//! Runs the cells of a sweep on this machine, several side by side.

use super::{
    plan::{self, Plan},
    screen::Screen,
    standing::{self, Standing, State},
};
use crate::{child, control, report, shutdown};
use rit_config::RunDir;
use rit_proto::v1::StatusRequest;
use rit_record::{Cell, CellState, Ended, Sweep};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    collections::{BTreeMap, VecDeque},
    fs, io,
    num::NonZero,
    path::Path,
    process::ExitStatus,
    time::Duration,
};
use tokio::task::JoinSet;

/// From one look at the cells that run to the next.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// How long a run's learner may take to say how it stands.
const ASK_TIMEOUT: Duration = Duration::from_millis(500);

/// What came of the cells that were not finished when the sweep began.
#[derive(Debug, Default)]
pub struct Outcome {
    pub finished: usize,
    /// Cells, with the reason.
    pub failed: Vec<(String, String)>,
    /// Cells that were stopped, or that another process trains.
    pub left: Vec<(String, String)>,
    pub interrupted: bool,
}

/// A machine's processors, shared out among so many jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    pub jobs: usize,
    /// Threads of each learner, and actors beside it.
    pub threads: usize,
}

impl Share {
    /// Of this machine; without a number of jobs as many as leave two threads for each.
    pub fn of_this_machine(jobs: Option<usize>) -> Self {
        let processors = std::thread::available_parallelism().map_or(1, NonZero::get);
        Self::of(processors, jobs)
    }

    fn of(processors: usize, jobs: Option<usize>) -> Self {
        let jobs = jobs.unwrap_or((processors / 2).max(1));
        Self { jobs, threads: (processors / jobs).max(1) }
    }

    /// Settings of a cell that no result follows from, but for those that the sweep sets itself.
    pub fn settings(self, cell: &Cell) -> Vec<String> {
        let own = [("learner.threads", self.threads.min(256)), ("actors.count", self.threads.min(16))];
        let free = own.into_iter().filter(|(key, _)| !cell.settings.contains_key(*key));
        free.map(|(key, value)| format!("{key}={value}")).collect()
    }
}

/// The arguments of `rit train` that begin a cell's run or go on with it.
pub fn train_arguments(dir: &Path, cell: &Cell, share: Share) -> Vec<String> {
    let root = Sweep::run_dir(dir, cell).display().to_string();
    let mut arguments = vec!["train".to_owned()];
    let mut settings = share.settings(cell);
    if Sweep::state(dir, cell) == CellState::Waiting {
        remove_beginning(&Sweep::run_dir(dir, cell));
        arguments.extend([cell.experiment.clone(), "--run-dir".into(), root]);
        settings.extend(plan::arguments(cell));
    } else {
        arguments.extend(["--resume".into(), root]);
    }
    arguments.extend(settings.into_iter().flat_map(|setting| ["--set".to_owned(), setting]));
    arguments
}

/// Removes what a run consists of that was killed in its first moment, before it was one.
fn remove_beginning(root: &Path) {
    if root.join("config.toml").exists() {
        return;
    }
    // What cannot be removed is not a run's beginning; the run that finds it there says so.
    for name in ["run_id", "token", "place", "lock", "config.partial", "place.partial"] {
        let _ = fs::remove_file(root.join(name));
    }
    for folder in [root.join("logs"), root.join("checkpoints"), root.to_owned()] {
        let _ = fs::remove_dir(folder);
    }
}

/// Runs all cells that are not finished.
pub async fn run_all(dir: &Path, plan: &Plan, share: Share, retry: bool, quiet: bool) -> Outcome {
    let standings = standing::of_all(dir, plan);
    let is_open = |at: &usize| match standings[*at].state {
        State::Finished => false,
        State::Diverged => retry,
        _ => true,
    };
    let open: VecDeque<usize> = (0..standings.len()).filter(is_open).collect();
    let diverged = standings.iter().filter(|it| !retry && it.state == State::Diverged);
    let diverged = diverged.map(|it| {
        let why = it.reason.clone().unwrap_or_default();
        (it.cell.clone(), format!("left alone, since it would end the same way (--retry tries again): {why}"))
    });
    let outcome = Outcome { failed: diverged.collect(), ..Outcome::default() };
    let mut jobs = Jobs {
        dir,
        plan,
        share,
        waiting: open,
        standings,
        children: JoinSet::new(),
        running: BTreeMap::new(),
        outcome,
        screen: Screen::new(quiet),
    };
    jobs.screen.say(&standing::in_words(&jobs.standings));
    let mut requests = shutdown::Requests::new(false);
    let mut looks = tokio::time::interval(LOOK_EVERY);
    loop {
        jobs.start_next();
        if jobs.running.is_empty() {
            break;
        }
        tokio::select! {
            Some(ended) = jobs.children.join_next() => {
                if let Ok((at, status)) = ended {
                    jobs.ended(at, status);
                }
            }
            _ = looks.tick(), if !quiet => jobs.look().await,
            () = requests.next() => jobs.interrupt(),
        }
    }
    jobs.screen.finish();
    jobs.outcome
}

/// The cells that run, and those that wait for their turn.
struct Jobs<'a> {
    dir: &'a Path,
    plan: &'a Plan,
    share: Share,
    /// Cells, by their place in the sweep; here and below.
    waiting: VecDeque<usize>,
    /// Each ends with its cell.
    children: JoinSet<(usize, io::Result<ExitStatus>)>,
    /// With their processes.
    running: BTreeMap<usize, Option<u32>>,
    /// How every cell stands, as far as was looked.
    standings: Vec<Standing>,
    outcome: Outcome,
    screen: Screen,
}

impl Jobs<'_> {
    fn start_next(&mut self) {
        while !self.outcome.interrupted && self.running.len() < self.share.jobs {
            let Some(at) = self.waiting.pop_front() else { return };
            let cell = &self.plan.sweep.cells[at];
            let root = Sweep::run_dir(self.dir, cell);
            if RunDir::open(&root).is_ok_and(|(run_dir, _)| run_dir.is_in_use()) {
                let why = "another process trains it".to_owned();
                self.screen.say(&format!("{}: {why}; it is left to that", cell.name));
                self.outcome.left.push((cell.name.clone(), why));
                continue;
            }
            let resumed = Sweep::state(self.dir, cell) != CellState::Waiting;
            match self.start(at) {
                Ok(()) => {
                    let how = if resumed { "goes on" } else { "begins" };
                    self.screen.say(&format!("{}: {how}", cell.name));
                }
                // Its log or its folder may be what is wrong: the other cells have their own.
                Err(error) => {
                    let why = format!("its process could not be started: {error}");
                    self.screen.say(&format!("{}: failed: {why}", cell.name));
                    self.outcome.failed.push((cell.name.clone(), why));
                }
            }
        }
    }

    fn start(&mut self, at: usize) -> io::Result<()> {
        let cell = &self.plan.sweep.cells[at];
        let mut command = child::this_program();
        command.args(train_arguments(self.dir, cell, self.share)).args(["--json", "--supervised"]);
        let mut child = child::spawn(command, &Sweep::log(self.dir, cell), None)?;
        self.running.insert(at, child.id());
        self.children.spawn(async move {
            // Held open: its end tells the run that this process has gone.
            let stdin = child.stdin.take();
            let status = child.wait().await;
            drop(stdin);
            (at, status)
        });
        Ok(())
    }

    /// What became of a cell's process.
    fn ended(&mut self, at: usize, status: io::Result<ExitStatus>) {
        self.running.remove(&at);
        let cell = &self.plan.sweep.cells[at];
        let name = &cell.name;
        self.standings[at] = standing::of_cell(self.dir, cell, &self.plan.configs[at]);
        let words = match Sweep::state(self.dir, cell) {
            CellState::Ended(ended) if ended.is_whole() => {
                self.outcome.finished += 1;
                format!("finished, {}", self.standings[at].result())
            }
            CellState::Ended(Ended::Interrupted) if self.outcome.interrupted => {
                "interrupted; the next `rit sweep` goes on with it".to_owned()
            }
            CellState::Ended(ended @ (Ended::Stopped | Ended::Interrupted)) => {
                self.outcome.left.push((name.clone(), ended.word().to_owned()));
                format!("{}; the next `rit sweep` goes on with it", ended.word())
            }
            _ if self.outcome.interrupted => "ended before it began".to_owned(),
            _ => {
                let why = Sweep::last_words(self.dir, cell).unwrap_or_else(|| match status {
                    Ok(status) => status.to_string(),
                    Err(error) => error.to_string(),
                });
                let why = why.trim_start_matches(Sweep::ERROR).to_owned();
                self.outcome.failed.push((name.clone(), why.clone()));
                format!("failed: {why}")
            }
        };
        self.screen.say(&format!("{name}: {}", report::printable_sentence(&words)));
    }

    /// Shows how the cells that run stand, a line each.
    async fn look(&mut self) {
        let mut rows = Vec::with_capacity(self.running.len());
        for &at in self.running.keys() {
            let cell = &self.plan.sweep.cells[at];
            self.standings[at] = standing::of_cell(self.dir, cell, &self.plan.configs[at]);
            let asked = tokio::time::timeout(ASK_TIMEOUT, status(&Sweep::run_dir(self.dir, cell))).await;
            let words = asked.ok().flatten().unwrap_or_else(|| "…".to_owned());
            rows.push(format!("{}: {words}", cell.name));
        }
        standing::estimate(self.plan, &[], &mut self.standings);
        self.screen.show(standing::in_words(&self.standings), rows);
    }

    /// Asks every run to shut down gracefully; a second and a third time mean to each what they mean to `rit train`.
    fn interrupt(&mut self) {
        let again = std::mem::replace(&mut self.outcome.interrupted, true);
        self.screen.say(if again {
            "interrupted again: the runs are told so; a second interrupt ends the retries of their last files, a third kills \
             their processes"
        } else {
            "interrupted: the runs write their checkpoints and end"
        });
        for pid in self.running.values() {
            let pid = pid.and_then(|pid| Pid::from_raw(pid as i32));
            // One that has just ended needs no telling.
            let _ = pid.map(|pid| kill_process(pid, Signal::TERM));
        }
    }
}

async fn status(root: &Path) -> Option<String> {
    let (run_dir, _) = RunDir::open(root).ok()?;
    let mut control = control::connect(&run_dir).await.ok()?;
    let status = control.status(StatusRequest {}).await.ok()?.into_inner();
    Some(report::status_line(&status))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processors_are_shared_out() {
        let share = |processors, jobs| {
            let Share { jobs, threads } = Share::of(processors, jobs);
            (jobs, threads)
        };
        assert_eq!(share(2, None), (1, 2));
        assert_eq!((share(1, None), share(64, None)), ((1, 1), (32, 2)));
        assert_eq!((share(8, Some(3)), share(2, Some(5))), ((3, 2), (5, 1)));
    }

    #[test]
    fn what_the_sweep_sets_itself_is_left_alone() {
        let mut cell = Cell { name: "a".into(), experiment: "b".into(), seed: 1, settings: BTreeMap::new() };
        let share = Share { jobs: 1, threads: 4 };
        assert_eq!(share.settings(&cell), ["learner.threads=4", "actors.count=4"]);
        cell.settings.insert("actors.count".into(), "1".into());
        assert_eq!(share.settings(&cell), ["learner.threads=4"]);
    }
}
