//! Options of the commands that look at several runs: sweeps, lists, curves, reports, pages; and at what one has learned.

use super::values::{finite, label, pair, web_listen, within};
use clap::{Args, Subcommand, ValueEnum};
use rit_config::{WebListen, count};
use std::path::PathBuf;

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
  [[also]]                                 # further cells: every combination of these, once with every seed
  \"algorithm.name\" = [\"rit\"]
  \"algorithm.random_permutation\" = [false]

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
    /// Run nothing: list the runs, how each stands, and what they will take by what finished ones took, and by records that
    /// lie in the file's folder. Needs no --dir
    #[arg(long)]
    pub dry_run: bool,
    /// Write an array job for Slurm in place of running: each index runs one cell
    #[arg(long, value_name = "OUT.sbatch", conflicts_with_all = ["dry_run", "kubernetes", "cell"])]
    pub slurm: Option<PathBuf>,
    /// Write an Indexed Job for Kubernetes in place of running
    #[arg(long, value_name = "OUT.yaml", conflicts_with_all = ["dry_run", "cell"])]
    pub kubernetes: Option<PathBuf>,
    /// Try cells again that have diverged, whose runs would end the same way unless the program has changed
    #[arg(long)]
    pub retry: bool,
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
pub struct RunsOptions {
    /// Folder whose runs are listed, those in folders of it too
    #[arg(value_name = "DIR", default_value = "runs")]
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
    /// Write the report even if something else lies in that folder: beside it, but index.html, marl-eval.json, runs.csv,
    /// figures/ and tables/ there are replaced
    #[arg(long)]
    pub force: bool,
    /// Write the page and the tables alone, without runs.csv, marl-eval.json and figures/: what version control may hold
    #[arg(long)]
    pub without_data: bool,
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
The page is served to this machine only, to those who know the token in its address; `ssh -L 8080:127.0.0.1:8080 HOST` leads \
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
