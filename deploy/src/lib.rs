//! The `rit` program: one program, many processes. `rit train` starts `rit learner` and several `rit actor` by
//! executing itself; the same sub-commands are what a service unit or a cluster starts.
//!
//! A program of your own is the same with task sets of your own: it has every command, and its learner and actors are itself.
//! `deploy/examples/corridor` is a whole one.
//!
//! ```no_run
//! use rit::{Environment, OwnTaskSet, Program};
//!
//! fn make(task: &str) -> Option<Box<dyn Environment>> {
//!     # let _ = task;
//!     None // the world of the task of this name
//! }
//!
//! fn main() -> std::process::ExitCode {
//!     Program::new()
//!         .task_set(OwnTaskSet {
//!             name: "corridor",
//!             training: &["corridor-3", "corridor-4"],
//!             testing: &["corridor-6"],
//!             feature_names: &["place", "goal"],
//!             action_names: &["stay", "left", "right"],
//!             make,
//!         })
//!         .main()
//! }
//! ```

mod beginning;
mod bench;
mod build;
mod certificates;
mod child;
mod cli;
mod comparison;
mod control;
mod ctl;
mod evaluate;
mod experiments;
mod export;
mod failure;
mod finished;
mod last_words;
mod logging;
mod new_file;
mod output;
mod player;
mod plot;
mod processes;
mod progress;
mod python_worlds;
mod render;
mod report;
mod representations;
mod runs;
mod serve;
mod shapley;
mod shutdown;
mod soak;
mod starcraft;
mod supervisor;
mod sweep;
mod traceback;
mod train;
mod usage;
mod warnings;
mod watch;

use cli::{Cli, Command, EnvCommand};
use failure::Failure;
use rit_config::{program_name, set_program_name};
use std::{env, path::Path, process::ExitCode};

pub use rand;
pub use rit_env::{
    BodyKind, Environment, EnvironmentError, FailureKind, Make, OwnTaskSet, OwnTaskSetError, Scene,
    SceneBody, Spec, Step, conformance,
};
pub use rit_episode::{Action, End, Observation, Rng};

/// The program, and what it has beside what comes with it.
#[derive(Debug, Default)]
#[must_use = "main runs it"]
pub struct Program {
    name: Option<String>,
    task_sets: Vec<OwnTaskSet>,
}

impl Program {
    /// What comes with it and nothing else.
    pub fn new() -> Self {
        Self::default()
    }

    /// What its help and its messages call it, in place of the name that its file has.
    pub fn name(mut self, name: &str) -> Self {
        self.name = Some(name.to_owned());
        self
    }

    /// Adds a set of tasks: `train NAME` trains on it, and `environment.task_set = "NAME"` in an experiment's file.
    pub fn task_set(mut self, set: OwnTaskSet) -> Self {
        self.task_sets.push(set);
        self
    }

    /// Does what the command line says. The program's `main` is to do nothing else: its learner and actors are processes that
    /// begin there too.
    pub fn main(self) -> ExitCode {
        let file = env::args_os().next().unwrap_or_default();
        let file = Path::new(&file).file_name().unwrap_or_default().to_string_lossy();
        set_program_name(self.name.as_deref().unwrap_or(&file));
        child::take_name();
        for set in &self.task_sets {
            if let Err(error) = rit_env::register(set) {
                return Failure::input(error).report();
            }
        }
        command()
    }
}

/// Does what the command line says.
fn command() -> ExitCode {
    let cli = match cli::parse(starcraft::translate_game_options(env::args_os())) {
        Ok(cli) => cli,
        Err(error) => return usage::report(&error),
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let result = match runtime {
        Ok(runtime) => {
            let result = runtime.block_on(run(cli));
            // A rollout or an evaluation that is no longer wanted is not waited for here either.
            runtime.shutdown_background();
            result
        }
        Err(error) => Err(Failure::runtime(error)),
    };
    match result {
        Ok(code) => code,
        Err(failure) => failure.report(),
    }
}

async fn run(cli: Cli) -> Result<ExitCode, Failure> {
    let logs = cli.logs;
    logs.check()?;
    match cli.command {
        Command::Train(options) => train::run(options, logs).await,
        Command::Learner(options) => processes::learner(options, logs).await,
        Command::Actor(options) => processes::actor(options, logs).await,
        Command::Sweep(options) => sweep::run(options, logs).await,
        Command::Evaluate(options) => evaluate::run(&options),
        Command::Render(options) => render::run(&options),
        Command::Export(options) => export::run(&options),
        Command::Ctl(options) => ctl::run(options).await,
        Command::Watch(options) => watch::run(&options).await,
        Command::Soak(options) => soak::run(options).await,
        Command::Bench(options) => bench::run(&options),
        Command::Plot(options) => plot::run(&options),
        Command::Report(options) => comparison::run(&options),
        Command::Serve(options) => serve::run(options).await,
        Command::Shapley(options) => shapley::run(&options),
        Command::Certificates(options) => certificates::run(&options),
        Command::Env { command: EnvCommand::Check(options) } => python_worlds::check(&options),
        Command::Runs(options) => runs::run(&options),
        Command::StarcraftEndpoint(options) => starcraft::endpoint(options, logs).await,
        Command::StarcraftCheck(options) => starcraft::check(&options),
        Command::StarcraftGame(options) => Err(starcraft::game(&options)),
        Command::Experiments => experiments::print(),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut cli::command(), program_name(), &mut script);
            output::print(&String::from_utf8_lossy(&script))?;
            Ok(ExitCode::SUCCESS)
        }
    }
}
