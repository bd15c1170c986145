//! `rit train`: a learner and its actors on this host, from beginning to end.

use crate::{
    cli::TrainOptions,
    experiments,
    failure::{Failure, INTERRUPTED},
    logging::LogOptions,
    progress::Progress,
    report, shutdown,
    supervisor::{Process, in_words},
};
use rit_config::{Config, RunDir};
use rit_ipc::RunSpace;
use rit_proto::{
    transport::{self, Client},
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
    let experiment = experiments::from_options(&options.config)?;
    let config = experiment.config;
    if config.actors.count == 0 {
        return Err(Failure::input_message("actors.count = 0: `rit train` needs at least one actor"));
    }
    let run_dir = match &options.config.run_dir {
        Some(root) => RunDir::create(root, &config)?,
        None => RunDir::create_fresh(Path::new("runs"), &experiment.name, &config)?,
    };
    let progress = Progress::new(config.training.t_max, options.json);
    let root = run_dir.root().display();
    progress.say(&format!(
        "{}: learner and {} actors, run directory {root}",
        experiment.name, config.actors.count
    ));

    let mut run = Run { run_dir: &run_dir, logs: &logs, progress, actors: Vec::new() };
    let ended = run.watch(&config).await;
    for actor in &mut run.actors {
        actor.end().await;
    }
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
    actors: Vec<Process>,
}

impl Run<'_> {
    async fn watch(&mut self, config: &Config) -> Result<Ended, Failure> {
        let mut learner = self.start("learner", &["learner"])?;
        let mut control = self.control(&mut learner).await?;
        for index in 0..config.actors.count {
            let name = format!("actor-{index}");
            let actor = self.start(&name, &["actor", "--name", &name])?;
            self.actors.push(actor);
        }
        let mut ticks = tokio::time::interval(STATUS_EVERY);
        let interrupted = shutdown::requested(false);
        tokio::pin!(interrupted);
        let mut stopping = false;
        loop {
            tokio::select! {
                status = learner.wait() => {
                    let status = status.map_err(Failure::runtime)?;
                    let ended = if stopping { Ended::Interrupted } else { Ended::Finished };
                    return if status.success() { Ok(ended) } else { Err(died(&learner, status)) };
                }
                (index, status) = any_actor(&mut self.actors) => {
                    self.actor_ended(index, status, &mut learner, stopping).await?;
                }
                _ = ticks.tick() => {
                    // A learner that is ending does not answer; its end is seen above.
                    if let Ok(status) = ask(&mut control).await {
                        self.progress.update(&status);
                    }
                }
                () = &mut interrupted, if !stopping => {
                    stopping = true;
                    self.progress.say("interrupted: ending the run in order");
                    let _ = control.stop(StopRequest {}).await;
                }
            }
        }
    }

    fn start(&self, name: &str, command: &[&str]) -> Result<Process, Failure> {
        let mut command: Vec<String> = command.iter().map(|&word| word.to_owned()).collect();
        command.extend(["--run-dir".to_owned(), self.run_dir.root().display().to_string()]);
        Process::start(name, command, &self.run_dir.logs(), self.logs)
    }

    /// Waits until the learner listens.
    async fn control(&self, learner: &mut Process) -> Result<ControlClient<Client>, Failure> {
        let listening = async {
            loop {
                if let Ok(address) = fs::read_to_string(self.run_dir.address()) {
                    return address;
                }
                tokio::time::sleep(START_POLL).await;
            }
        };
        let address = tokio::select! {
            address = listening => address.trim().parse().map_err(Failure::runtime)?,
            status = learner.wait() => return Err(died(learner, status.map_err(Failure::runtime)?)),
            () = tokio::time::sleep(START_TIMEOUT) => {
                learner.end().await;
                let seconds = START_TIMEOUT.as_secs();
                return Err(Failure::runtime_message(format!(
                    "the learner does not listen after {seconds} s: {} (log: {})",
                    learner.last_words(),
                    learner.log().display()
                )));
            }
        };
        Ok(ControlClient::new(transport::connect(&address, self.run_dir.token()).await?))
    }

    async fn actor_ended(
        &mut self,
        index: usize,
        status: ExitStatus,
        learner: &mut Process,
        stopping: bool,
    ) -> Result<(), Failure> {
        if stopping || status.success() {
            // The learner has said farewell: the run is ending.
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
fn print_summary(run_dir: &RunDir, json: bool) -> Result<(), Failure> {
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
    }
}
