//! Logs: human on a terminal, JSON by flag; every process names itself. A log that cannot be written ends nothing.

use crate::failure::Failure;
use clap::{Args, ValueEnum};
use rit_config::open_regular;
use rit_learner::run_handle::SetLog;
use std::{
    fs::OpenOptions,
    io::{self, IsTerminal as _},
    path::Path,
    sync::{Arc, Mutex},
};
use tracing_subscriber::{EnvFilter, fmt, fmt::writer::BoxMakeWriter, reload};

/// What a level may be called.
const LEVELS: [&str; 6] = ["error", "warn", "info", "debug", "trace", "off"];

/// The parts of this program that log.
const PARTS: [&str; 12] = [
    "rit",
    "rit_actor",
    "rit_algo",
    "rit_config",
    "rit_env",
    "rit_episode",
    "rit_foreign",
    "rit_ipc",
    "rit_learner",
    "rit_nn",
    "rit_proto",
    "rit_starcraft",
];

/// What the command line says of logs.
#[derive(Args, Clone, Debug)]
pub struct LogOptions {
    /// What is logged: error, warn, info, debug, trace, off, or a filter such as rit_learner=debug
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

    /// Whether the filter means something.
    ///
    /// # Errors
    /// When it does not.
    pub fn check(&self) -> Result<(), Failure> {
        self.filter().map(drop)
    }

    fn filter(&self) -> Result<EnvFilter, Failure> {
        filter(&self.log).map_err(|error| Failure::input_message(format!("--log {error}")))
    }

    /// Begins to log to standard error. The span returned names the process in every line; the function changes what
    /// is logged.
    ///
    /// # Errors
    /// When the filter means nothing.
    pub fn start(&self, process: &str) -> Result<(tracing::Span, SetLog), Failure> {
        self.start_on(BoxMakeWriter::new(io::stderr), io::stderr().is_terminal(), process)
    }

    /// Begins to log to a file, at its end; where that cannot be had, nowhere.
    ///
    /// # Errors
    /// When the filter means nothing.
    pub fn start_in(&self, path: &Path, process: &str) -> Result<tracing::Span, Failure> {
        let writer = match open_regular(path, OpenOptions::new().create(true).append(true)) {
            Ok(file) => BoxMakeWriter::new(Mutex::new(file)),
            Err(_) => BoxMakeWriter::new(io::sink),
        };
        Ok(self.start_on(writer, false, process)?.0)
    }

    fn start_on(
        &self,
        writer: BoxMakeWriter,
        ansi: bool,
        process: &str,
    ) -> Result<(tracing::Span, SetLog), Failure> {
        let builder = fmt()
            .with_env_filter(self.filter()?)
            .with_writer(writer)
            .with_ansi(ansi)
            // It would be told by a macro that panics where it cannot write either.
            .log_internal_errors(false);
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
    Arc::new(move |text| handle.reload(filter(text)?).map_err(|error| error.to_string()))
}

/// The filter that is meant. Its library takes any word for the name of some part, and then logs nothing.
fn filter(text: &str) -> Result<EnvFilter, String> {
    let levels = LEVELS.join(", ");
    // Spans have fields with commas and equals signs of their own.
    for directive in text.split(',').filter(|_| !text.contains('[')) {
        let (target, level) = directive.split_once('=').unwrap_or(("", directive));
        if !LEVELS.iter().any(|known| level.eq_ignore_ascii_case(known)) {
            return Err(format!(
                "{text:?}: {level:?} is no level; write one of {levels}, or a filter such as rit_learner=debug"
            ));
        }
        let part = target.split("::").next().unwrap_or_default();
        if part.starts_with("rit") && !PARTS.contains(&part) {
            let parts = PARTS.join(", ");
            return Err(format!("{text:?}: {part:?} is no part of this program; those are {parts}"));
        }
    }
    EnvFilter::try_new(text).map_err(|error| format!("{text:?}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{fs, path::PathBuf};

    #[test]
    fn every_crate_that_logs_can_be_named_in_a_filter() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let mut folders: Vec<PathBuf> =
            ["actor", "deploy", "learner", "proto"].map(|name| root.join(name)).into();
        folders.extend(fs::read_dir(root.join("common")).unwrap().map(|entry| entry.unwrap().path()));
        let mut logging = Vec::new();
        for manifest in folders.iter().filter_map(|folder| fs::read_to_string(folder.join("Cargo.toml")).ok())
        {
            if manifest.lines().any(|line| line.starts_with("tracing.") || line.starts_with("tracing =")) {
                let name = manifest.lines().find_map(|line| line.strip_prefix("name = ")).unwrap();
                logging.push(name.trim_matches('"').replace('-', "_"));
            }
        }
        assert!(logging.len() >= 7, "{logging:?}");
        for name in logging {
            assert!(filter(&format!("{name}=debug")).is_ok(), "{name} logs, and PARTS lacks it");
        }
    }

    #[test]
    fn a_filter_means_something_or_is_refused_with_what_there_is() {
        for text in
            ["info", "DEBUG", "off", "rit_learner=debug", "warn,rit::train=trace,h2=off", "[span{a=1}]=info"]
        {
            assert!(filter(text).is_ok(), "{text}");
        }
        for (text, message) in [
            (
                "debgu",
                "\"debgu\" is no level; write one of error, warn, info, debug, trace, off, or a filter",
            ),
            ("", "\"\" is no level"),
            ("rit_learner", "\"rit_learner\" is no level"),
            ("rit_learner=loud", "\"loud\" is no level"),
            ("info,rit_lerner=debug", "\"rit_lerner\" is no part of this program; those are rit, rit_actor"),
            ("[span=", "\"[span=\": "),
        ] {
            let error = filter(text).unwrap_err();
            assert!(error.contains(message) && !error.contains('\n'), "{text}: {error}");
        }
    }
}
