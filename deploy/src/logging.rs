//! Logs: human on a terminal, JSON by flag; every process names itself.

use crate::failure::Failure;
use clap::{Args, ValueEnum};
use std::io::{self, IsTerminal as _};
use tracing_subscriber::{EnvFilter, fmt};

/// What the command line says of logs.
#[derive(Args, Clone, Debug)]
pub struct LogOptions {
    /// What is logged: error, warn, info, debug, trace, or a filter such as rit_learner=debug
    #[arg(long, global = true, env = "RIT_LOG", default_value = "info", value_name = "FILTER")]
    pub log: String,
    /// How it is logged
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Human, value_name = "FORMAT")]
    pub log_format: LogFormat,
}

/// How logs look.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    Human,
    /// One object a line.
    Json,
}

impl LogOptions {
    /// The same options for a child process.
    pub fn arguments(&self) -> [String; 4] {
        let format = match self.log_format {
            LogFormat::Human => "human",
            LogFormat::Json => "json",
        };
        ["--log".into(), self.log.clone(), "--log-format".into(), format.into()]
    }

    /// Begins to log to standard error. The span returned names the process in every line.
    ///
    /// # Errors
    /// When the filter means nothing.
    pub fn start(&self, process: &str) -> Result<tracing::Span, Failure> {
        let filter = EnvFilter::try_new(&self.log);
        let filter =
            filter.map_err(|error| Failure::input_message(format!("--log {}: {error}", self.log)))?;
        let builder =
            fmt().with_env_filter(filter).with_writer(io::stderr).with_ansi(io::stderr().is_terminal());
        match self.log_format {
            LogFormat::Human => builder.with_target(false).init(),
            LogFormat::Json => builder.json().with_current_span(true).init(),
        }
        Ok(tracing::info_span!("process", name = process, pid = std::process::id()))
    }
}
