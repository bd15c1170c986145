//! The live line of `rit train`.

use crate::report;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rit_proto::v1::RunStatus;
use std::{
    io::{self, IsTerminal as _},
    time::{Duration, Instant},
};

/// Off a terminal, a line is printed this often instead.
pub const PLAIN_EVERY: Duration = Duration::from_secs(10);

/// Shows how a run goes.
pub struct Progress {
    bar: ProgressBar,
    plain: bool,
    printed: Option<Instant>,
}

impl Progress {
    /// A line on the terminal, or plain lines where there is none; nothing when `quiet`.
    pub fn new(env_steps_max: u64, quiet: bool) -> Self {
        let terminal = io::stderr().is_terminal();
        let target = if quiet || !terminal {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr_with_hz(5)
        };
        let bar = ProgressBar::with_draw_target(Some(env_steps_max), target);
        if let Ok(style) = ProgressStyle::with_template("{bar:24.cyan/blue} {percent:>3}%  {msg}") {
            bar.set_style(style);
        }
        Self { bar, plain: !quiet && !terminal, printed: None }
    }

    /// Whether lines go to something that is no terminal.
    pub fn is_plain(&self) -> bool {
        self.plain
    }

    /// Shows a newer status.
    pub fn update(&mut self, status: &RunStatus) {
        self.bar.set_position(status.env_steps);
        let message = report::status_line(status);
        if self.plain && self.printed.is_none_or(|printed| printed.elapsed() >= PLAIN_EVERY) {
            self.printed = Some(Instant::now());
            self.say(&message);
        }
        self.bar.set_message(message);
    }

    /// Prints a line above the bar.
    #[allow(clippy::print_stderr, reason = "progress off a terminal")]
    pub fn say(&self, line: &str) {
        if self.plain {
            eprintln!("{line}");
        } else {
            self.bar.println(line);
        }
    }

    /// Takes the line away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
