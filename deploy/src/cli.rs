//! What can be typed.

mod starcraft;

use crate::logging::LogOptions;
use clap::{Args, Parser, Subcommand, ValueEnum};
use rit_config::{WHOLE_MAX, WebListen, count};
use rit_learner::{checkpoint::Which, run_handle::EPISODES_MAX};
use rit_proto::transport::{Address, CredentialFiles, Credentials, CredentialsError};
use std::{fmt, net::IpAddr, path::PathBuf};

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
    /// Ask something of a running learner
    Ctl(CtlOptions),
    /// Watch a run in the terminal; q or Ctrl-C ends the view, not the run
    Watch(WatchOptions),
    /// Kill a run's processes at random moments, and hold its end to that of an undisturbed run; or simulate that
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
    /// End in order when standard input ends: whoever started this process has gone
    #[arg(long, hide = true)]
    pub supervised: bool,
}

/// The options of `rit train` with these arguments.
///
/// # Errors
/// When they are none, which is a fault of the program.
pub fn train(arguments: &[String], json: bool) -> Result<TrainOptions, clap::Error> {
    let json = json.then(|| "--json".to_owned());
    let cli =
        Cli::try_parse_from(["rit".to_owned()].into_iter().chain(arguments.iter().cloned()).chain(json))?;
    match cli.command {
        Command::Train(options) => Ok(options),
        _ => Err(clap::Error::new(clap::error::ErrorKind::InvalidSubcommand)),
    }
}

/// How the file of a sweep looks.
const SWEEP_FILE: &str = "\
The file:
  experiment = \"matrix-game\"               # a name of `rit experiments`, or a .toml file
  seeds = [1, 2, 3]
  [axes]                                   # every combination is a cell, once with every seed
  \"algorithm.name\" = [\"rit\", \"vdn-attn\"]  # any key; or \"experiment\" = [..] in place of the one above
  [set]                                    # what all cells set
  \"training.t_max\" = 4000
  [[exclude]]                              # cells that are left out
  \"algorithm.name\" = \"vdn-attn\"
  seed = 3
  [[override]]                             # what some cells set beyond that
  where = { \"algorithm.name\" = \"rit\" }
  set = { \"algorithm.lr\" = 0.001 }

Each run lies in DIR/runs/NAME. Started again, the same command leaves out what is finished and goes on with the rest.
Exit codes: 0 all cells are finished, 1 some are not, 2 something given was wrong, 130 interrupted.";

#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true, after_help = SWEEP_FILE)]
pub struct SweepOptions {
    #[command(subcommand)]
    pub command: Option<SweepCommand>,
    /// File that says what is compared
    #[arg(value_name = "FILE.toml")]
    pub file: Option<PathBuf>,
    /// Folder of the sweep: new, empty, or of the same sweep
    #[arg(long, value_name = "DIR")]
    pub dir: Option<PathBuf>,
    /// Runs side by side, which share the processors; without it one for every two processors. On a cluster: at most so
    /// many at once
    #[arg(long, value_name = "N", value_parser = within::<usize>(1, 256))]
    pub jobs: Option<usize>,
    /// Run nothing: list the runs, how each stands, and what they will take by what finished ones took
    #[arg(long)]
    pub dry_run: bool,
    /// Write an array job for Slurm in place of running: each index runs one cell
    #[arg(long, value_name = "OUT.sbatch", conflicts_with_all = ["dry_run", "kubernetes", "cell"])]
    pub slurm: Option<PathBuf>,
    /// Write an Indexed Job for Kubernetes in place of running
    #[arg(long, value_name = "OUT.yaml", conflicts_with_all = ["dry_run", "cell"])]
    pub kubernetes: Option<PathBuf>,
    /// Queue of Kueue that the job waits in
    #[arg(long, value_name = "NAME", requires = "kubernetes", value_parser = label)]
    pub queue: Option<String>,
    /// Write over the file of --slurm or --kubernetes
    #[arg(long)]
    pub force: bool,
    /// Run this cell alone, from 0, in this process: what a job of a cluster does
    #[arg(long, value_name = "INDEX", conflicts_with_all = ["dry_run", "jobs"])]
    pub cell: Option<usize>,
    /// Print JSON, and no progress
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Subcommand)]
pub enum SweepCommand {
    /// How the cells of a sweep stand
    Status {
        /// Folder of the sweep
        #[arg(value_name = "DIR")]
        dir: PathBuf,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Keep what finished cells came to as small records, which version control can hold: NAME.jsonl and NAME.json
    Collect {
        /// Folder of the sweep
        #[arg(value_name = "DIR")]
        dir: PathBuf,
        /// Folder for the records; those that it has already stay as they are
        #[arg(long, value_name = "FOLDER")]
        out: PathBuf,
    },
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
    /// Stop when standard input ends: whoever started this process has gone
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
    /// Slot that `rit train` fills with this actor: its identity, which it takes over from whoever held it before
    #[arg(long, value_name = "N", hide = true)]
    pub slot: Option<u32>,
    /// Stop when standard input ends: whoever started this process has gone
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
    /// Hold environments to what they promise: random episodes, each again, and what is wrong in words
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

#[derive(Args, Debug)]
pub struct RunsOptions {
    /// Folder whose runs are listed, those in folders of it too
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dir: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Who plays, and what.
#[derive(Args, Debug)]
pub struct PlayOptions {
    /// checkpoint: a run's newest weights. script:NAME: random, still, nearest-assignment or chase
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
#[command(after_help = "\
Runs that differ in their seed alone are drawn together: a line for the mean of each method over seeds and tasks, with its \
95 % interval; fewer than 5 seeds are drawn one by one. Each task set has a chart of its own. Other differences are \
refused, unless --by names the keys.")]
pub struct PlotOptions {
    /// Run directories, folders of them, sweeps, or files like their metrics.jsonl
    #[arg(required = true)]
    pub runs: Vec<PathBuf>,
    /// File to write, ending in .svg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Write over the file if it is there
    #[arg(long)]
    pub force: bool,
    /// What is drawn; without it win rates where tasks can be won, returns elsewhere
    #[arg(long, value_enum)]
    pub metric: Option<PlotMetric>,
    /// A key whose values are methods of their own, such as algorithm.gamma; may be given again and again
    #[arg(long, value_name = "KEY")]
    pub by: Vec<String>,
    /// Draw a chart of each task in place of their mean
    #[arg(long)]
    pub tasks: bool,
    /// Heading
    #[arg(long)]
    pub title: Option<String>,
    /// Draw a dashed line at this value, for comparison
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true, value_parser = finite)]
    pub line: Option<f64>,
}

#[derive(Args, Debug)]
#[command(after_help = "\
OUT/index.html is one page that needs nothing else; OUT/tables/*.md, OUT/figures/*.svg and OUT/runs.csv hold the same, \
OUT/marl-eval.json is what the marl-eval and rliable packages read. Only finished runs count; what is missing of a sweep is \
said. Runs of one method that differ in more than the seed are refused, unless --by names the keys.")]
pub struct ReportOptions {
    /// Sweeps, run directories, folders of them, or of committed records
    #[arg(required = true, value_name = "DIR")]
    pub runs: Vec<PathBuf>,
    /// Folder for the report: new, empty, or of an earlier report, which it replaces
    #[arg(long, value_name = "OUT")]
    pub out: PathBuf,
    /// Write the report even if something else lies in that folder, beside it
    #[arg(long)]
    pub force: bool,
    /// What is compared; without it win rates where tasks can be won, returns elsewhere
    #[arg(long, value_enum)]
    pub metric: Option<PlotMetric>,
    /// A key whose values are methods of their own, such as algorithm.gamma; may be given again and again. A sweep's axes
    /// are such keys
    #[arg(long, value_name = "KEY")]
    pub by: Vec<String>,
    /// Two methods X,Y whose probability of improvement is said; may be given again and again. Without it the first method
    /// against every other
    #[arg(long = "pair", value_name = "X,Y", value_parser = pair)]
    pub pairs: Vec<(String, String)>,
    /// Replications of the bootstrap
    #[arg(long, value_name = "N", default_value_t = 50_000, value_parser = within::<usize>(100, 10_000_000))]
    pub replications: usize,
    /// Seed of the bootstrap and of the map of task representations
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = count)]
    pub seed: u64,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

#[derive(Args, Debug)]
#[command(after_help = "\
The page is served to this machine only, to whoever knows the token in its address; `ssh -L 8080:127.0.0.1:8080 HOST` leads \
to it from another machine. Ctrl-C ends it.")]
pub struct ServeOptions {
    /// Folder of runs, a sweep, or a run directory
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// Loopback address; with port 0 a free one
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:0", value_parser = web_listen)]
    pub listen: WebListen,
    /// A key whose values are methods of their own, such as algorithm.gamma; may be given again and again
    #[arg(long, value_name = "KEY")]
    pub by: Vec<String>,
}

#[derive(Args, Debug)]
#[command(after_help = "\
A coalition's value at a step is that of the joint action in which its members do what they did and all others take the \
first action that is available to them: Q_total of it (the learned game), or the return from there on as the episode goes \
on greedily (the environment's own game). Utilities are those of the actions taken, in the episode's decision order (M = 1) \
or averaged over M orders (equation 10).")]
pub struct ShapleyOptions {
    /// Run directory
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Name of a task of at most 6 agents
    #[arg(long, value_name = "NAME")]
    pub task: String,
    /// Greedy episodes
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = within::<u32>(1, 1000))]
    pub episodes: u32,
    /// Steps of each episode from which every coalition's continuation is rolled
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = within::<u16>(0, 1000))]
    pub rolled_steps: u16,
    /// Seed of the episodes and orders; without it one that follows from the run's
    #[arg(long, value_name = "N", value_parser = count)]
    pub seed: Option<u64>,
    /// Figure to write, ending in .svg
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Write over the figure if it is there
    #[arg(long)]
    pub force: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// What of an evaluation is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PlotMetric {
    /// Mean of undiscounted returns.
    #[value(name = "return", alias = "mean_return")]
    MeanReturn,
    /// Share of episodes won.
    #[value(name = "win_rate", alias = "win-rate")]
    WinRate,
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

fn web_listen(text: &str) -> Result<WebListen, String> {
    WebListen::try_from(text.to_owned())
}

/// Two names with a comma between them.
fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once(',').map(|(x, y)| (x.trim(), y.trim())) {
        Some((x, y)) if !x.is_empty() && !y.is_empty() => Ok((x.to_owned(), y.to_owned())),
        _ => Err("write two methods, such as rit,qmix-attn".to_owned()),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    let seconds = finite(text)?;
    if (0.0..=3600.0).contains(&seconds) && seconds > 0.0 {
        Ok(seconds)
    } else {
        Err("it must lie above 0 and up to 3600".into())
    }
}

fn finite(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| "write a number, such as -12.5".to_owned())
}

/// Reads a count in this range.
fn within<T: TryFrom<u64>>(min: u64, max: u64) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| {
        let out_of_range = || format!("it is out of range {min}..={}", max.min(WHOLE_MAX));
        let number = match count(text) {
            Err(rit_config::CountError::TooLarge) => return Err(out_of_range()),
            number => number.map_err(|error| error.to_string())?,
        };
        if !(min..=max).contains(&number) {
            return Err(out_of_range());
        }
        T::try_from(number).map_err(|_| out_of_range())
    }
}

/// Which of a run's weights.
fn which(text: &str) -> Result<Which, String> {
    match text {
        "latest" => Ok(Which::Latest),
        "best" => Ok(Which::Best),
        _ => text
            .strip_prefix("step-")
            .and_then(|step| count(step).ok())
            .map(Which::Step)
            .ok_or_else(|| "write latest, best or step-N, such as step-100000".to_owned()),
    }
}

/// A name as labels of Kubernetes may be.
fn label(text: &str) -> Result<String, String> {
    let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '.';
    let ends = [text.chars().next(), text.chars().last()];
    if text.len() <= 63
        && text.chars().all(is_plain)
        && ends.iter().flatten().all(char::is_ascii_alphanumeric)
        && !text.is_empty()
    {
        Ok(text.to_owned())
    } else {
        Err("write a queue's name, of small letters, digits, '-' and '.'".to_owned())
    }
}

/// A name or address that a certificate can be for: what a DNS name may be, or an IP address.
fn host(text: &str) -> Result<String, String> {
    let is_label = |label: &str| {
        let inner = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        (1..=63).contains(&label.len())
            && label.chars().all(inner)
            && !label.starts_with('-')
            && !label.ends_with('-')
    };
    let name = text.strip_prefix("*.").unwrap_or(text);
    if text.parse::<IpAddr>().is_ok() || (name.len() <= 253 && name.split('.').all(is_label)) {
        Ok(text.to_owned())
    } else {
        Err("write a host's name or IP address, such as learner.example.org or 10.0.0.1".to_owned())
    }
}

#[derive(Args, Debug)]
pub struct CtlOptions {
    /// Run directory of a learner on this host
    #[arg(long, value_name = "DIR", global = true)]
    pub run: Option<PathBuf>,
    /// Address of a learner on any host, such as tcp:10.0.0.1:50051; give it before the command
    #[arg(long, value_name = "ADDRESS", conflicts_with = "run")]
    pub address: Option<Address>,
    #[command(flatten)]
    pub credentials: CredentialOptions,
    /// Print JSON
    #[arg(long, global = true)]
    pub json: bool,
    #[command(subcommand)]
    pub command: CtlCommand,
}

#[derive(Debug, Subcommand)]
pub enum CtlCommand {
    /// How the run stands
    Status,
    /// Hand out no further episode
    Pause,
    /// Hand out episodes again
    Resume,
    /// Roll greedy episodes with the present weights, while training goes on
    Evaluate {
        /// training, testing, or names of tasks
        #[arg(long, value_delimiter = ',', default_value = "training")]
        tasks: Vec<String>,
        /// Episodes of each task; without it the run's own number
        #[arg(long, value_parser = within::<u32>(1, EPISODES_MAX.into()))]
        episodes: Option<u32>,
        /// Seed of the evaluation; without it one that follows from the run's
        #[arg(long, allow_negative_numbers = true, value_parser = count)]
        seed: Option<u64>,
    },
    /// Write a checkpoint now
    Checkpoint,
    /// Print what has been measured, one line each; with --json one object each
    Metrics {
        /// Go on with what is measured from now on, until the run is over
        #[arg(long)]
        follow: bool,
        /// Begin with the first line at or behind so many environment steps
        #[arg(long, value_name = "STEPS", default_value_t = 0, value_parser = count)]
        from: u64,
    },
    /// Print the address of the run's web page; it carries the run's token
    Web,
    /// Change settings while the run goes on: algorithm.epsilon_finish, evaluation.every_env_steps, evaluation.episodes,
    /// evaluation.testing_every_env_steps, evaluation.testing_episodes,
    /// checkpoints.every_env_steps, actors.count, actors.heartbeat_timeout_ms, learner.metrics_every_env_steps, and what
    /// the learner logs, such as log=debug
    Set {
        /// What to set
        #[arg(required = true, value_name = "KEY=VALUE")]
        settings: Vec<String>,
    },
    /// End the run: checkpoint, summary, farewell
    Stop {
        /// Let the episodes under way arrive first, and train on every batch they complete
        #[arg(long)]
        drain: bool,
    },
}
