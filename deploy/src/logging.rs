//! Logs: human on a terminal, JSON by flag; every process names itself.

use crate::failure::Failure;
use clap::{Args, ValueEnum};
use rit_learner::run_handle::SetLog;
use std::{
    io::{self, IsTerminal as _},
    sync::Arc,
};
use tracing_subscriber::{EnvFilter, fmt, reload};

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

    /// Begins to log to standard error. The span returned names the process in every line; the function changes what
    /// is logged.
    ///
    /// # Errors
    /// When the filter means nothing.
    pub fn start(&self, process: &str) -> Result<(tracing::Span, SetLog), Failure> {
        let filter = EnvFilter::try_new(&self.log);
        let filter =
            filter.map_err(|error| Failure::input_message(format!("--log {}: {error}", self.log)))?;
        let builder =
            fmt().with_env_filter(filter).with_writer(io::stderr).with_ansi(io::stderr().is_terminal());
        let set_log = match self.log_format {
            LogFormat::Human => {
                let builder = builder.with_target(false).with_filter_reloading();
                let set_log = set_log(builder.reload_handle());
                builder.init();
                set_log
            }
            LogFormat::Json => {
                let builder = builder.json().with_current_span(true).with_filter_reloading();
                let set_log = set_log(builder.reload_handle());
                builder.init();
                set_log
            }
        };
        Ok((tracing::info_span!("process", name = process, pid = std::process::id()), set_log))
    }
}

fn set_log<S: 'static>(handle: reload::Handle<EnvFilter, S>) -> SetLog {
    Arc::new(move |filter| {
        let filter = EnvFilter::try_new(filter).map_err(|error| error.to_string())?;
        handle.reload(filter).map_err(|error| error.to_string())
    })
}
