//! Options of `rit ctl`.

use super::{CredentialOptions, values::within};
use clap::{Args, Subcommand};
use rit_config::{all_keys, count, is_live};
use rit_learner::run_handle::EPISODES_MAX;
use rit_proto::transport::Address;
use std::path::PathBuf;

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
        /// Begin with the first line at or after so many environment steps
        #[arg(long, value_name = "STEPS", default_value_t = 0, value_parser = count)]
        from: u64,
    },
    /// Print the address of the run's web page; it carries the run's token
    Web,
    /// Change settings while the run goes on
    #[command(about = set_about())]
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

fn set_about() -> String {
    let live: Vec<String> = all_keys().into_iter().filter(|key| is_live(key)).collect();
    format!(
        "Change settings while the run goes on: {}, and what the learner logs, such as log=debug",
        live.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_help_of_set_names_every_key_that_a_running_learner_can_change() {
        let about = set_about();
        for key in
            ["algorithm.epsilon_finish", "checkpoints.rescue_dir", "learner.stall_timeout_ms", "actors.count"]
        {
            assert!(about.contains(key), "{about}");
        }
        assert!(!about.contains("algorithm.gamma") && about.ends_with("such as log=debug"), "{about}");
    }
}
