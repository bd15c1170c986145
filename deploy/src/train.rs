//! `rit train`: a learner and its actors on this host, from beginning to end.

use crate::{
    cli::{ConfigOptions, TrainOptions},
    control,
    experiments::{self, Experiment},
    failure::{Failure, INTERRUPTED},
    logging::LogOptions,
    progress::Progress,
    report, shutdown,
    supervisor::{Process, in_words},
    warnings::Warnings,
};
use rit_config::{Config, RunDir};
use rit_ipc::RunSpace;
use rit_proto::{
    transport::Client,
    v1::{RunStatus, StatusRequest, StopRequest, TaskResult, control_client::ControlClient},
};
use std::{
    fs,
    path::Path,
    process::{ExitCode, ExitStatus},
    time::Duration,
};

/// How long a learner may take to listen.
const START_TIMEOUT: Duration = Duration::from_secs(30);

/// From one look for the learner's address to the next.
const START_POLL: Duration = Duration::from_millis(10);

/// From one look at the run's status to the next.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// `rit train`.
pub async fn run(options: TrainOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    let (run_dir, config, name) = prepare(&options.config)?;
    let progress = Progress::new(config.training.t_max, options.json);
    let root = run_dir.root().display();
    progress.say(&format!("{name}: learner and {} actors, run directory {root}", config.actors.count));

    let mut run = Run {
        run_dir: &run_dir,
        logs: &logs,
        progress,
        warnings: Warnings::default(),
        actors: Vec::new(),
        web_url: None,
    };
    let ended = run.watch(&config).await;
    run.end_actors().await;
    run.progress.finish();
    remove_shared_memory(&run_dir);
    if matches!(ended, Err(Failure::Input(_))) && !run_dir.metrics().exists() {
        // It never began: the same directory will do for the next attempt.
        fs::remove_dir_all(run_dir.root()).map_err(Failure::runtime)?;
    }
    match ended? {
        Ended::Finished => print_summary(&run_dir, options.json).map(|()| ExitCode::SUCCESS),
        Ended::Interrupted => {
            print_summary(&run_dir, options.json)?;
            Ok(ExitCode::from(INTERRUPTED))
        }
    }
}

/// A new run's directory, or that of a run to go on with; its configuration and what it is called.
fn prepare(options: &ConfigOptions) -> Result<(RunDir, Config, String), Failure> {
    let settings = experiments::settings(options);
    let (run_dir, config, name) = match (&options.resume, &options.experiment) {
        (Some(root), _) => {
            let (run_dir, config) = RunDir::resume(root, &experiments::parse_settings(&settings)?)?;
            let name = format!("going on with {}", config.environment.task_set);
            (run_dir, config, name)
        }
        (None, Some(experiment)) => {
            let Experiment { name, config } = experiments::load(experiment, &settings)?;
            refuse_no_actors(&config)?;
            let run_dir = match &options.run_dir {
                Some(root) => RunDir::create(root, &config)?,
                None => RunDir::create_fresh(Path::new("runs"), &name, &config)?,
            };
            (run_dir, config, name)
        }
        (None, None) => return Err(Failure::input_message("which experiment? `rit experiments` lists them")),
    };
    refuse_no_actors(&config)?;
    Ok((run_dir, config, name))
}

fn refuse_no_actors(config: &Config) -> Result<(), Failure> {
    if config.actors.count > 0 || config.actors.remote > 0 {
        return Ok(());
    }
    Err(Failure::input_message(
        "actors.count = 0: `rit train` needs at least one actor; set actors.remote for actors on other hosts",
    ))
}

/// How a run came to its end in order.
enum Ended {
    Finished,
    Interrupted,
}

/// A run under way.
struct Run<'a> {
    run_dir: &'a RunDir,
    logs: &'a LogOptions,
    progress: Progress,
    warnings: Warnings,
    actors: Vec<Process>,
    /// The web page's address, once it was said.
    web_url: Option<String>,
}

impl Run<'_> {
    async fn watch(&mut self, config: &Config) -> Result<Ended, Failure> {
        // What a learner that was killed with everything else has left behind.
        let _ = fs::remove_file(self.run_dir.address());
        let mut learner = self.start("learner", &["learner"])?;
        let mut control = self.control(&mut learner).await?;
        self.start_actors(config.actors.count)?;
        let mut ticks = tokio::time::interval(STATUS_EVERY);
        let interrupted = shutdown::requested(false);
        tokio::pin!(interrupted);
        let mut stopping = false;
        loop {
            tokio::select! {
                status = learner.wait() => {
                    let status = status.map_err(Failure::runtime)?;
                    if status.success() {
                        return Ok(if stopping { Ended::Interrupted } else { Ended::Finished });
                    }
                    // What it said itself would be no better a second time; what ended it from outside may be.
                    if stopping || status.code().is_some() {
                        return Err(died(&learner, status));
                    }
                    control = self.restart_learner(&mut learner, status, config).await?;
                }
                (index, status) = any_actor(&mut self.actors) => {
                    self.actor_ended(index, status, &mut learner, stopping).await?;
                }
                _ = ticks.tick() => {
                    // A learner that is ending or has just died does not answer; its end is seen above.
                    if let Ok(status) = ask(&mut control).await {
                        self.kill_hung_actors(&status);
                        if !stopping {
                            self.adjust_actors(status.actors_wanted as usize)?;
                        }
                        for warning in self.warnings.new_of(&status) {
                            self.progress.say(&format!("warning: {warning}"));
                        }
                        self.progress.update(&status);
                    }
                }
                () = &mut interrupted, if !stopping => {
                    stopping = true;
                    self.progress.say("interrupted: ending the run in order");
                    let _ = control.stop(StopRequest::default()).await;
                }
            }
        }
    }

    fn start_actors(&mut self, count: usize) -> Result<(), Failure> {
        for index in self.actors.len()..count {
            let name = format!("actor-{index}");
            let actor = self.start(&name, &["actor", "--name", &name])?;
            self.actors.push(actor);
        }
        Ok(())
    }

    /// Starts actors or lets some go, as `rit ctl set actors.count` wants it.
    fn adjust_actors(&mut self, wanted: usize) -> Result<(), Failure> {
        let before = self.actors.len();
        self.start_actors(wanted)?;
        if self.actors.len() > before {
            self.progress.say(&format!("{wanted} actors are wanted: started {}", wanted - before));
        }
        for actor in self.actors.iter_mut().skip(wanted).filter(|actor| !actor.is_ending()) {
            self.progress.say(&format!("{wanted} actors are wanted: {} leaves", actor.name()));
            actor.ask_to_end();
        }
        Ok(())
    }

    async fn end_actors(&mut self) {
        for actor in &mut self.actors {
            actor.end().await;
        }
        self.actors.clear();
    }

    /// Starts the learner again, which goes on from its newest checkpoint. Actors find it by themselves; only if
    /// it cannot begin beside them is everything started anew.
    async fn restart_learner(
        &mut self,
        learner: &mut Process,
        status: ExitStatus,
        config: &Config,
    ) -> Result<ControlClient<Client>, Failure> {
        self.start_again(learner, status)?;
        loop {
            match self.control(learner).await {
                Ok(control) => {
                    self.start_actors(config.actors.count)?;
                    return Ok(control);
                }
                Err(error) => {
                    learner.may_restart()?;
                    self.progress.say(&format!("{error}; the actors are started anew too"));
                    self.end_actors().await;
                    learner.end().await;
                    remove_shared_memory(self.run_dir);
                }
            }
            learner.restart()?;
        }
    }

    /// Starts a learner again that something from outside has ended.
    fn start_again(&mut self, learner: &mut Process, status: ExitStatus) -> Result<(), Failure> {
        self.progress.say(&format!("the learner {} and is restarted", in_words(status)));
        // Else the dead one's address would be taken for the new one's.
        let _ = fs::remove_file(self.run_dir.address());
        learner.restart()
    }

    /// A hung actor is of no use; when it is dead it is restarted like any other.
    fn kill_hung_actors(&mut self, status: &RunStatus) {
        // The process of one on another host has a number that may be anybody's here.
        for hung in status.actors.iter().filter(|actor| actor.hung && !actor.remote) {
            if let Some(actor) = self.actors.iter_mut().find(|actor| actor.id() == Some(hung.pid)) {
                self.progress
                    .say(&format!("{} has hung for {:.0} s and is killed", hung.name, hung.silent_s));
                actor.start_kill();
            }
        }
    }

    fn start(&self, name: &str, command: &[&str]) -> Result<Process, Failure> {
        let mut command: Vec<String> = command.iter().map(|&word| word.to_owned()).collect();
        command.extend(["--run-dir".to_owned(), self.run_dir.root().display().to_string()]);
        Process::start(name, command, &self.run_dir.logs(), self.logs)
    }

    /// Waits until the learner answers. One that is killed before it does is started again: connecting to it fails
    /// then, and its end is known a moment later.
    async fn control(&mut self, learner: &mut Process) -> Result<ControlClient<Client>, Failure> {
        loop {
            let mut unheard = None;
            let answering = async {
                loop {
                    if self.run_dir.address().exists() {
                        match control::connect(self.run_dir).await {
                            Ok(control) => return control,
                            Err(failure) => unheard = Some(failure),
                        }
                    }
                    tokio::time::sleep(START_POLL).await;
                }
            };
            tokio::select! {
                control = answering => {
                    self.say_web_url();
                    return Ok(control);
                }
                status = learner.wait() => {
                    let status = status.map_err(Failure::runtime)?;
                    if status.code().is_some() {
                        return Err(died(learner, status));
                    }
                    self.start_again(learner, status)?;
                }
                () = tokio::time::sleep(START_TIMEOUT) => {
                    learner.end().await;
                    let why = unheard.map_or_else(|| learner.last_words(), |failure| failure.to_string());
                    return Err(Failure::runtime_message(format!(
                        "the learner does not answer after {} s: {why} (log: {})",
                        START_TIMEOUT.as_secs(),
                        learner.log().display()
                    )));
                }
            }
        }
    }

    /// Says where the web page is, when it is there first and when it moves.
    fn say_web_url(&mut self) {
        let url = self.run_dir.web_url();
        if let Some(url) = url.as_ref().filter(|_| url != self.web_url) {
            // What is no terminal may be a log that others read: the token stays out of it.
            let (page, _) = url.split_once("?token=").unwrap_or((url, ""));
            let root = self.run_dir.root().display();
            self.progress.say(&if self.progress.is_plain() {
                format!("web page: {page} (`rit ctl --run {root} web` says the address that lets you in)")
            } else {
                format!("web page: {url}")
            });
        }
        self.web_url = url;
    }

    async fn actor_ended(
        &mut self,
        index: usize,
        status: ExitStatus,
        learner: &mut Process,
        stopping: bool,
    ) -> Result<(), Failure> {
        if stopping || status.success() || self.actors[index].is_ending() {
            // The learner has said farewell: the run is ending, or fewer actors are wanted.
            self.actors.remove(index);
            return Ok(());
        }
        let actor = &mut self.actors[index];
        let words = in_words(status);
        // Exit code 2 is bad input, which is no better a second time.
        let restarted = if status.code() == Some(2) {
            Err(Failure::input_message(format!("{}: {}", actor.name(), actor.last_words())))
        } else {
            actor.restart()
        };
        match restarted {
            Ok(()) => self.progress.say(&format!("{} {words} and was restarted", self.actors[index].name())),
            Err(failure) => {
                self.actors.remove(index);
                learner.end().await;
                return Err(failure);
            }
        }
        Ok(())
    }
}

/// The next actor to end.
async fn any_actor(actors: &mut [Process]) -> (usize, ExitStatus) {
    if actors.is_empty() {
        return std::future::pending().await;
    }
    let mut waits: Vec<_> = actors.iter_mut().map(|actor| Box::pin(actor.wait())).collect();
    std::future::poll_fn(|context| {
        for (index, wait) in waits.iter_mut().enumerate() {
            if let std::task::Poll::Ready(status) = wait.as_mut().poll(context) {
                // A child that cannot be waited for is as good as dead.
                return std::task::Poll::Ready((index, status.unwrap_or_default()));
            }
        }
        std::task::Poll::Pending
    })
    .await
}

async fn ask(control: &mut ControlClient<Client>) -> Result<RunStatus, tonic::Status> {
    control.status(StatusRequest {}).await.map(tonic::Response::into_inner)
}

fn died(learner: &Process, status: ExitStatus) -> Failure {
    let (words, last) = (in_words(status), learner.last_words());
    if status.code() == Some(2) {
        Failure::input_message(last)
    } else {
        Failure::runtime_message(format!("the learner {words}: {last} (log: {})", learner.log().display()))
    }
}

/// Whatever became of the children, nothing of the run stays in shared memory.
fn remove_shared_memory(run_dir: &RunDir) {
    match RunSpace::new(&run_dir.shared_memory_root()).map(|space| space.remove()) {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(%error, "something of the run is still in shared memory"),
        Err(error) => tracing::warn!(%error, "something of the run is still in shared memory"),
    }
}

/// Prints what `summary.json` says.
#[allow(clippy::print_stdout, reason = "what the command is for")]
pub fn print_summary(run_dir: &RunDir, json: bool) -> Result<(), Failure> {
    let path = run_dir.summary();
    let text = fs::read_to_string(&path).map_err(Failure::runtime)?;
    if json {
        println!("{}", text.trim_end());
        return Ok(());
    }
    let summary: serde_json::Value = serde_json::from_str(&text).map_err(Failure::runtime)?;
    let number = |key: &str| summary[key].as_u64().unwrap_or_default();
    let results: Vec<TaskResult> =
        summary["evaluation"].as_object().into_iter().flatten().map(task_result).collect();
    println!(
        "{} environment steps, {} episodes, {} updates in {}",
        report::grouped(number("env_steps")),
        report::grouped(number("episodes")),
        report::grouped(number("updates")),
        report::duration(summary["wall_s"].as_f64().unwrap_or_default())
    );
    print!("{}", report::table(&results));
    println!("weights digest {}", summary["weights_digest"].as_str().unwrap_or_default());
    println!("run directory  {}", run_dir.root().display());
    Ok(())
}

fn task_result((task, result): (&String, &serde_json::Value)) -> TaskResult {
    TaskResult {
        task: task.clone(),
        episodes: result["episodes"].as_u64().unwrap_or_default(),
        mean_return: result["mean_return"].as_f64().unwrap_or_default(),
        win_rate: result["win_rate"].as_f64(),
        ..TaskResult::default()
    }
}
