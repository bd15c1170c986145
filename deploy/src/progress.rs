//! The live line of `rit train`, and what happens, said as it happens.
//!
//! Written by a thread of its own: a terminal that is stopped, or a pipe without a reader, holds up nothing but what is
//! said there. Everything that is said is in the log too.

use crate::{output, report};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rit_config::in_program_words;
use rit_proto::v1::RunStatus;
use std::{
    io::{self, IsTerminal as _},
    sync::mpsc::{self, Receiver, SyncSender},
    thread,
    time::{Duration, Instant},
};

/// Off a terminal, a line is printed this often instead.
pub const PLAIN_EVERY: Duration = Duration::from_secs(10);

/// Lines that may wait to be written; what comes beyond is in the log alone.
pub const WAITING_MAX: usize = 256;

/// How long the end of a run waits for what was said to be written.
const FINISH_TIMEOUT: Duration = Duration::from_secs(2);

/// Something to show.
enum News {
    /// How the run stands: environment steps, and all of it in a line.
    Status(u64, String),
    /// What happened.
    Line(String),
}

/// Shows how a run goes.
pub struct Progress {
    /// None when it is over.
    news: Option<SyncSender<News>>,
    /// Closed when all is written.
    written: Receiver<()>,
    plain: bool,
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
        let plain = !quiet && !terminal;
        let (news, queue) = mpsc::sync_channel(WAITING_MAX);
        let (writing, written) = mpsc::channel();
        let screen = Screen { bar, plain, printed: None, unwritable: false };
        // Without the thread nothing is shown; the log has it all the same.
        let _ = thread::Builder::new().name("progress".into()).spawn(move || {
            screen.show(&queue);
            drop::<mpsc::Sender<()>>(writing);
        });
        Self { news: Some(news), written, plain }
    }

    /// Whether lines go to something that is no terminal.
    pub fn is_plain(&self) -> bool {
        self.plain
    }

    /// Shows a newer status.
    pub fn update(&self, status: &RunStatus) {
        self.send(News::Status(status.env_steps, report::status_line(status)));
    }

    /// Says what happened, on a line above the bar and in the log.
    pub fn say(&self, line: &str) {
        let line = in_program_words(line);
        tracing::info!("{line}");
        self.send(News::Line(line.into_owned()));
    }

    fn send(&self, news: News) {
        if let Some(sender) = &self.news {
            // What waits already has no reader.
            let _ = sender.try_send(news);
        }
    }

    /// Takes the line away when all is written, or it has no reader.
    pub fn finish(&mut self) {
        self.news = None;
        // Nothing is ever sent: it ends when the thread does.
        let _ = self.written.recv_timeout(FINISH_TIMEOUT);
    }
}

/// What the thread writes to.
struct Screen {
    bar: ProgressBar,
    plain: bool,
    printed: Option<Instant>,
    /// Whether writing has failed, which is said once.
    unwritable: bool,
}

impl Screen {
    /// Shows what comes, to the end.
    fn show(mut self, queue: &Receiver<News>) {
        for news in queue {
            match news {
                News::Status(env_steps, message) => {
                    self.bar.set_position(env_steps);
                    if self.plain && self.printed.is_none_or(|printed| printed.elapsed() >= PLAIN_EVERY) {
                        self.printed = Some(Instant::now());
                        self.print(&message);
                    }
                    self.bar.set_message(message);
                }
                News::Line(line) if self.plain => self.print(&line),
                News::Line(line) => self.bar.println(line),
            }
        }
        self.bar.finish_and_clear();
    }

    fn print(&mut self, line: &str) {
        let Err(error) = output::say(line) else { return };
        if !std::mem::replace(&mut self.unwritable, true) {
            tracing::warn!("what happens is in this log alone: standard error cannot be written: {error}");
        }
    }
}
