//! What can be typed.

mod comparison;
mod ctl;
mod export;
mod program;
mod starcraft;
mod values;

use crate::logging::LogOptions;
use clap::{Args, Parser, Subcommand, ValueEnum};
use rit_config::{count, program_name};
use rit_learner::{checkpoint::Which, run_handle::EPISODES_MAX};
use rit_proto::transport::{Address, CredentialFiles, Credentials, CredentialsError};
use std::{ffi::OsString, fmt, path::PathBuf};
use values::{host, positive, which, within};

pub use comparison::{
    PlotMetric, PlotOptions, ReportOptions, RunsOptions, ServeOptions, ShapleyOptions, SweepCommand,
    SweepOptions,
};
pub use ctl::{CtlCommand, CtlOptions};
pub use export::ExportOptions;
pub use program::{command, parse};
pub use starcraft::{EndpointOptions, GameOptions, StarCraftCheckOptions};

/// Multi-task multi-agent reinforcement learning with interaction and task representations.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, args_override_self = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
    #[command(flatten)]
    pub logs: LogOptions,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Start a learner and its actors, and watch over them until training is done
    Train(TrainOptions),
    /// Start a learner alone; actors join it
    Learner(LearnerOptions),
    /// Start one actor; it joins the learner of a run directory, or of an address
    Actor(ActorOptions),
    /// Run what a file compares: every combination of its axes with every seed, here or as jobs of a cluster
    Sweep(SweepOptions),
    /// Roll greedy episodes with a run's newest checkpoint, or with a script
    Evaluate(EvaluateOptions),
    /// Draw episodes of a run's newest checkpoint, or of a script
    Render(RenderOptions),
    /// Write a run's policy as ONNX, or episodes of a policy as a data set, for others to load
    Export(ExportOptions),
    /// Ask something of a running learner
    Ctl(CtlOptions),
    /// Watch a run in the terminal; q or Ctrl-C ends the view, not the run
    Watch(WatchOptions),
    /// Kill a run's processes at random moments, and compare its end with an undisturbed run's; or simulate that
    Soak(SoakOptions),
    /// Measure a part beside the machine's limit
    Bench(BenchOptions),
    /// Draw learning curves of runs: a line for each method, with its interval over seeds
    Plot(PlotOptions),
    /// Make the experimental section of a paper from finished runs: one page, figures, tables, data
    Report(ReportOptions),
    /// Show a folder of runs or a sweep in this machine's browser: table, curves, episodes
    Serve(ServeOptions),
    /// Hold a run's utilities to the Shapley values that they are said to approximate
    Shapley(ShapleyOptions),
    /// Make an authority, and certificates for a learner and for those who call it over TCP
    Certificates(CertificatesOptions),
    /// Environments of your own
    Env {
        #[command(subcommand)]
        command: EnvCommand,
    },
    /// List runs: what each is, how it stands, and what it has reached
    Runs(RunsOptions),
    /// Speak StarCraft II's protocol over the combat simulator: for clients of the game where it is not installed
    StarcraftEndpoint(EndpointOptions),
    /// Check that real StarCraft II can be played here, and play one battle in it
    StarcraftCheck(StarCraftCheckOptions),
    /// Become a game that ends with its parent
    #[command(name = rit_worlds::starcraft::process::WRAPPER, hide = true)]
    StarcraftGame(GameOptions),
    /// List the task sets' experiments and the algorithms that come with the program
    Experiments,
    /// Print completions for a shell, such as `rit completions bash > /etc/bash_completion.d/rit`
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
}

/// What makes a run's configuration.
#[derive(Args, Debug)]
pub struct ConfigOptions {
    /// Name of an experiment (see `rit experiments`) or path of a TOML file
    #[arg(required_unless_present = "resume", conflicts_with = "resume")]
    pub experiment: Option<String>,
    /// Go on with the run of this directory from its newest checkpoint; keys that do not change the result may be
    /// set anew, such as --steps or --actors
    #[arg(long, value_name = "DIR", conflicts_with_all = ["run_dir", "seed"])]
    pub resume: Option<PathBuf>,
    /// Begin with another run's weights: its newest checkpoint's, those of a checkpoint (RUN@STEPS), or a weights
    /// file. Features, actions and sizes of the networks must be the same; teams, tasks, rewards and settings need not
    #[arg(long, value_name = "RUN[@STEPS]", conflicts_with = "resume")]
    pub from: Option<PathBuf>,
    /// The algorithm, in place of the experiment's; `rit experiments` lists them
    #[arg(long, value_name = "NAME")]
    pub algorithm: Option<String>,
    /// The run's seed: the same seed gives the same weights
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count)]
    pub seed: Option<u64>,
    /// Actor processes
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count)]
    pub actors: Option<u64>,
    /// Environment steps to collect, `training.t_max`: 1000000, 1_000_000, 1e6 or 1M
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = count)]
    pub steps: Option<u64>,
    /// End at the first evaluation where every training task has reached this, such as win_rate=1.0
    #[arg(long, value_name = "METRIC=VALUE")]
    pub until: Option<String>,
    /// Set any key, such as algorithm.gamma=0.95; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    /// Directory of the new run; without it a fresh one under runs/
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
}

/// How a script tells how a run ended.
const EXIT_CODES: &str = "\
Exit codes: 0 finished (all steps are done, or --until is reached), 1 failed, 2 something given was wrong and nothing was \
overwritten, 3 stopped by `rit ctl stop` or the page, 130 interrupted (Ctrl-C, SIGTERM, or SIGHUP where it is not ignored). summary.json in the run directory says the same, as \
\"ended\".";

#[derive(Args, Debug)]
#[command(args_override_self = true, after_help = EXIT_CODES)]
pub struct TrainOptions {
    #[command(flatten)]
    pub config: ConfigOptions,
    /// Print the summary as JSON, and no progress
    #[arg(long)]
    pub json: bool,
    /// Shut down gracefully when standard input ends: the process that started this one has gone
    #[arg(long, hide = true)]
    pub supervised: bool,
}

/// The options of `rit train` with these arguments.
///
/// # Errors
/// When they are none, which is a fault of the program.
pub fn train(arguments: &[String], json: bool) -> Result<TrainOptions, clap::Error> {
    let json = json.then(|| "--json".to_owned());
    let program = program_name().to_owned();
    let arguments = [program].into_iter().chain(arguments.iter().cloned()).chain(json);
    let cli = parse(arguments.map(OsString::from))?;
    match cli.command {
        Command::Train(options) => Ok(options),
        _ => Err(clap::Error::new(clap::error::ErrorKind::InvalidSubcommand)),
    }
}

#[derive(Args, Debug)]
#[command(after_help = EXIT_CODES)]
pub struct LearnerOptions {
    /// Run directory that `rit train` or `rit learner --new` has made
    #[arg(long, value_name = "DIR")]
    pub run_dir: PathBuf,
    /// Make the run directory first, for this experiment or TOML file
    #[arg(long, value_name = "EXPERIMENT")]
    pub new: Option<String>,
    /// The algorithm of a new run, in place of the experiment's
    #[arg(long, value_name = "NAME", requires = "new")]
    pub algorithm: Option<String>,
    /// Set any key of a new run; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "new")]
    pub settings: Vec<String>,
    /// Stop when standard input ends: the process that started this one has gone
    #[arg(long, hide = true)]
    pub supervised: bool,
}

#[derive(Args, Debug)]
pub struct ActorOptions {
    /// Run directory of a learner on this host; episodes travel through shared memory
    #[arg(long, value_name = "DIR", required_unless_present = "address")]
    pub run_dir: Option<PathBuf>,
    /// Address of a learner on any host, such as tcp:10.0.0.1:50051; episodes travel over gRPC
    #[arg(long, value_name = "ADDRESS", conflicts_with = "run_dir")]
    pub address: Option<Address>,
    #[command(flatten)]
    pub credentials: CredentialOptions,
    /// Name of this actor, unique in its run
    #[arg(long, default_value = "actor-0")]
    pub name: String,
    /// Slot that `rit train` fills with this actor: its identity, which it takes over from the actor that held it before
    #[arg(long, value_name = "N", hide = true)]
    pub slot: Option<u32>,
    /// Stop when standard input ends: the process that started this one has gone
    #[arg(long, hide = true)]
    pub supervised: bool,
}

/// What a caller shows a learner that is reached by its address.
#[derive(Args, Debug)]
pub struct CredentialOptions {
    /// File of mode 600 with the token that the learner demands, its learner.token_file
    #[arg(long, value_name = "FILE", requires = "address")]
    pub token_file: Option<PathBuf>,
    /// Authority of the learner's certificate; without it there is no TLS
    #[arg(long, value_name = "FILE", requires = "address")]
    pub tls_ca: Option<PathBuf>,
    /// This caller's certificate, of the learner's learner.tls.client_ca
    #[arg(long, value_name = "FILE", requires = "address")]
    pub tls_certificate: Option<PathBuf>,
    /// Its key, a file of mode 600
    #[arg(long, value_name = "FILE", requires = "address")]
    pub tls_key: Option<PathBuf>,
}

impl CredentialOptions {
    /// What the files hold.
    ///
    /// # Errors
    /// When one cannot be used.
    pub fn read(self) -> Result<Credentials, CredentialsError> {
        let Self { token_file, tls_ca, tls_certificate, tls_key } = self;
        Credentials::read(&CredentialFiles {
            token: token_file,
            ca: tls_ca,
            certificate: tls_certificate,
            key: tls_key,
        })
    }
}

#[derive(Args, Debug)]
pub struct CertificatesOptions {
    /// Folder to make them in
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Names and IP addresses by which callers reach the learner
    #[arg(long = "host", value_name = "NAME", required = true, num_args = 1.., value_parser = host)]
    pub hosts: Vec<String>,
    /// Days that they are valid for
    #[arg(long, value_name = "N", default_value_t = 365, value_parser = within::<u32>(1, 3650))]
    pub days: u32,
}

#[derive(Debug, Subcommand)]
pub enum EnvCommand {
    /// Check that environments keep the interface's rules: plays random episodes, each twice, and says what is wrong
    Check(EnvCheckOptions),
}

#[derive(Args, Debug)]
pub struct EnvCheckOptions {
    /// Name of an experiment or path of a TOML file, whose tasks are checked
    #[arg(required_unless_present = "python")]
    pub experiment: Option<String>,
    /// A Python function in place of the experiment's: MODULE:FUNCTION
    #[arg(long, value_name = "MODULE:FUNCTION", requires = "tasks")]
    pub python: Option<String>,
    /// Names of tasks, in place of the experiment's training tasks
    #[arg(long, value_delimiter = ',')]
    pub tasks: Vec<String>,
    /// Episodes of each task
    #[arg(long, default_value_t = 10, value_parser = within::<u32>(1, EPISODES_MAX.into()))]
    pub episodes: u32,
    /// Set any key; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Who plays, and what.
#[derive(Args, Debug)]
pub struct PlayOptions {
    /// checkpoint: a run's newest weights. script:NAME: random, still, nearest-assignment or chase; in combat nearest, focus or
    /// kite
    #[arg(long, default_value = "checkpoint")]
    pub policy: String,
    /// Run directory
    #[arg(long, value_name = "DIR")]
    pub run: Option<PathBuf>,
    /// Which weights of the run: latest; best, where checkpoints.keep_best keeps them; or step-N, those of the checkpoint at N
    /// environment steps
    #[arg(long, value_name = "WHICH", value_parser = which)]
    pub checkpoint: Option<Which>,
    /// Whose tasks a script plays, without a run: name of an experiment or path of a TOML file
    #[arg(long, value_name = "EXPERIMENT")]
    pub experiment: Option<String>,
    /// Where combat is played, in place of environment.backend: embedded or starcraft
    #[arg(long, value_name = "NAME")]
    pub backend: Option<String>,
}

#[derive(Args, Debug)]
pub struct EvaluateOptions {
    #[command(flatten)]
    pub play: PlayOptions,
    /// training, testing, or names of tasks
    #[arg(long, value_delimiter = ',', default_value = "training")]
    pub tasks: Vec<String>,
    /// Episodes of each task; without it the run's own number: evaluation.episodes of a training task,
    /// evaluation.testing_episodes of a testing task
    #[arg(long, value_parser = within::<u32>(1, EPISODES_MAX.into()))]
    pub episodes: Option<u32>,
    /// Seed of the evaluation; without it one that follows from the run's
    #[arg(long, allow_negative_numbers = true, value_parser = count)]
    pub seed: Option<u64>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

#[derive(Args, Debug)]
#[command(after_help = "\
The file's ending says what is drawn: .gif, every step of the episodes; .png, a row of moments for each episode; \
.svg, each episode's whole course. Numbers are places in the decision order, arrows what the agents have just done, \
bars the reward of each step.
Episodes are those that `rit evaluate` measures with the same seed.")]
pub struct RenderOptions {
    #[command(flatten)]
    pub play: PlayOptions,
    /// Name of the task
    #[arg(long)]
    pub task: String,
    /// Episodes to draw
    #[arg(long, default_value_t = 1, value_parser = within::<u8>(1, 20))]
    pub episodes: u8,
    /// Seed of the episodes; without it one that follows from the run's
    #[arg(long, allow_negative_numbers = true, value_parser = count)]
    pub seed: Option<u64>,
    /// File to write, ending in .gif, .png or .svg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Write over the file if it is there
    #[arg(long)]
    pub force: bool,
}

#[derive(Args, Debug)]
pub struct SoakOptions {
    /// Name of an experiment or path of a TOML file
    #[arg(default_value = "matrix-game")]
    pub experiment: String,
    /// The algorithm, in place of the experiment's
    #[arg(long, value_name = "NAME")]
    pub algorithm: Option<String>,
    /// Blows, spread over the run: kills by SIGKILL, TERM, INT, HUP and STOP, second learners, copies that are resumed
    #[arg(long, default_value_t = 10, value_parser = within::<usize>(1, 100_000))]
    pub kills: usize,
    /// Seed of both runs, and of what is done when: the same seed does the same
    #[arg(long, default_value_t = 1, value_parser = count)]
    pub seed: u64,
    /// Actor processes
    #[arg(long, default_value_t = 2, value_parser = within::<u32>(1, 64))]
    pub actors: u32,
    /// Environment steps of each run; without it the experiment's own number
    #[arg(long, allow_negative_numbers = true, value_parser = count)]
    pub steps: Option<u64>,
    /// Set any key of both runs; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    /// Drive the supervisor, the coordinator and the ledger alone through random scenarios, without processes: joins,
    /// deaths, hangs, restarts, pauses, settings, slow and lost messages, late frames, full disks. Scenario i has the
    /// seed --seed + i
    #[arg(long, conflicts_with_all = ["experiment", "kills", "actors", "steps", "settings", "dir"])]
    pub simulated: bool,
    /// Scenarios
    #[arg(long, value_name = "N", default_value_t = 10_000, requires = "simulated", value_parser = clap::value_parser!(u64).range(1..=1_000_000_000_000))]
    pub runs: u64,
    /// Folder for both runs and their logs, to be made
    #[arg(long, value_name = "DIR", default_value = "runs/soak")]
    pub dir: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

#[derive(Args, Debug)]
pub struct WatchOptions {
    /// Run directory
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
}

#[derive(Args, Debug)]
pub struct BenchOptions {
    /// What to measure
    #[arg(value_enum)]
    pub kind: BenchKind,
    /// Experiment whose sizes and tasks are used
    #[arg(long, default_value = "cooperative-navigation", conflicts_with = "run")]
    pub experiment: String,
    /// The algorithm, in place of the experiment's; for the learner, `all` measures every one of them
    #[arg(long, value_name = "NAME", conflicts_with = "run")]
    pub algorithm: Option<String>,
    /// Run whose configuration and newest weights are used instead of fresh ones, for learner and rollout
    #[arg(long, value_name = "DIR")]
    pub run: Option<PathBuf>,
    /// Set any key of it; may be given again and again
    #[arg(long = "set", value_name = "KEY=VALUE", conflicts_with = "run")]
    pub settings: Vec<String>,
    /// How long to measure
    #[arg(long, default_value_t = 5.0, value_parser = positive)]
    pub seconds: f64,
    /// Payload of a frame, for ipc
    #[arg(long, default_value_t = 64, value_parser = within::<usize>(1, 16384))]
    pub payload_kib: usize,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BenchKind {
    /// One update of the networks, batch and replay as in training
    Learner,
    /// Rolling episodes with the acting networks, as an actor does
    Rollout,
    /// The environments alone
    Env,
    /// Frames through shared memory
    Ipc,
    /// Costs as agents, entities and actors grow
    Scale,
}

impl fmt::Display for BenchKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Learner => "learner",
            Self::Rollout => "rollout",
            Self::Env => "env",
            Self::Ipc => "ipc",
            Self::Scale => "scale",
        })
    }
}
