//! The live line of `rit train`.

use crate::report;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rit_proto::v1::{RunState, RunStatus};
use std::{
    io::{self, IsTerminal as _},
    time::{Duration, Instant},
};

/// Off a terminal, a line is printed this often instead.
const PLAIN_EVERY: Duration = Duration::from_secs(10);

/// Shows how a run goes.
pub struct Progress {
    bar: ProgressBar,
    plain: bool,
    printed: Option<Instant>,
    /// Environment steps and time at the last update, for rates.
    last: Option<(u64, u64, Instant)>,
    /// (environment steps, updates) per second, smoothed.
    rates: Option<(f64, f64)>,
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
        Self { bar, plain: !quiet && !terminal, printed: None, last: None, rates: None }
    }

    /// Shows a newer status.
    pub fn update(&mut self, status: &RunStatus) {
        let now = Instant::now();
        if let Some((env_steps, updates, then)) = self.last {
            let seconds = now.duration_since(then).as_secs_f64().max(1e-3);
            let rate = |now: u64, then: u64| now.saturating_sub(then) as f64 / seconds;
            let new = (rate(status.env_steps, env_steps), rate(status.updates, updates));
            let (a, b) = self.rates.unwrap_or(new);
            self.rates = Some((0.8 * a + 0.2 * new.0, 0.8 * b + 0.2 * new.1));
        }
        self.last = Some((status.env_steps, status.updates, now));
        self.bar.set_position(status.env_steps);
        let message = self.message(status);
        if self.plain && self.printed.is_none_or(|printed| printed.elapsed() >= PLAIN_EVERY) {
            self.printed = Some(now);
            self.say(&message);
        }
        self.bar.set_message(message);
    }

    fn message(&self, status: &RunStatus) -> String {
        let mut parts = vec![
            format!(
                "{} of {} steps",
                report::grouped(status.env_steps),
                report::grouped(status.env_steps_max)
            ),
            format!("{} updates", report::grouped(status.updates)),
        ];
        parts.extend(report::in_words(&status.recent));
        if let Some(words) =
            status.evaluation.as_ref().and_then(|evaluation| report::in_words(&evaluation.tasks))
        {
            parts.push(format!("greedy: {words}"));
        }
        if let Some((steps, updates)) = self.rates {
            parts.push(format!("{steps:.0} steps/s, {updates:.0} updates/s"));
            let left = status.env_steps_max.saturating_sub(status.env_steps) as f64;
            if steps > 0.5 {
                parts.push(format!("{} left", report::duration(left / steps)));
            }
        }
        match status.state() {
            RunState::Paused => parts.push("paused".into()),
            RunState::Stopping => parts.push("ending".into()),
            RunState::Running | RunState::Unspecified => {}
        }
        parts.join(" · ")
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
