//! What a sweep shows while it runs: a line for the whole, a line for each cell that runs, and what happens above them.
//!
//! Written by a thread of its own, as the progress of a run is: a terminal that is stopped holds up no cell.

use crate::{
    output,
    progress::{PLAIN_EVERY, WAITING_MAX},
};
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::{
    io::{self, IsTerminal as _},
    sync::mpsc::{self, Receiver, SyncSender},
    thread,
    time::{Duration, Instant},
};

/// How long the end waits for what was said to be written.
const FINISH_TIMEOUT: Duration = Duration::from_secs(2);

enum News {
    /// The whole in a line, and a line for each cell that runs.
    Table(String, Vec<String>),
    /// What happened.
    Line(String),
}

/// The way to the thread that writes.
pub struct Screen {
    news: Option<SyncSender<News>>,
    /// Closed when all is written.
    written: Receiver<()>,
}

impl Screen {
    /// On standard error; nothing when `quiet`.
    pub fn new(quiet: bool) -> Self {
        let (news, queue) = mpsc::sync_channel(WAITING_MAX);
        let (writing, written) = mpsc::channel();
        // Without the thread nothing is shown; `rit sweep status` tells it all the same.
        let _ = thread::Builder::new().name("screen".into()).spawn(move || {
            match (quiet, io::stderr().is_terminal()) {
                (true, _) => queue.into_iter().for_each(drop),
                (false, true) => on_terminal(&queue),
                (false, false) => plainly(&queue),
            }
            drop::<mpsc::Sender<()>>(writing);
        });
        Self { news: Some(news), written }
    }

    /// Says what happened.
    pub fn say(&self, line: &str) {
        self.send(News::Line(line.to_owned()));
    }

    /// Shows how all stands now.
    pub fn show(&self, whole: String, rows: Vec<String>) {
        self.send(News::Table(whole, rows));
    }

    fn send(&self, news: News) {
        if let Some(sender) = &self.news {
            // What waits already has no reader.
            let _ = sender.try_send(news);
        }
    }

    /// Takes the table away when all is written, or it has no reader.
    pub fn finish(&mut self) {
        self.news = None;
        // Nothing is ever sent: it ends when the thread does.
        let _ = self.written.recv_timeout(FINISH_TIMEOUT);
    }
}

fn on_terminal(queue: &Receiver<News>) {
    let table = MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(5));
    let new_line = || {
        let line = table.add(ProgressBar::no_length());
        if let Ok(style) = ProgressStyle::with_template("{wide_msg}") {
            line.set_style(style);
        }
        line
    };
    let (whole, mut lines) = (new_line(), Vec::<ProgressBar>::new());
    for news in queue {
        match news {
            News::Table(message, rows) => {
                whole.set_message(message);
                while lines.len() < rows.len() {
                    lines.push(new_line());
                }
                for gone in lines.drain(rows.len()..) {
                    table.remove(&gone);
                }
                lines.iter().zip(rows).for_each(|(line, row)| line.set_message(row));
            }
            // A terminal that has gone reads nothing.
            News::Line(line) => drop(table.println(line)),
        }
    }
    let _ = table.clear();
}

/// Off a terminal what happens is said, and now and then how the cells that run stand.
fn plainly(queue: &Receiver<News>) {
    let mut printed = Instant::now();
    for news in queue {
        // There may be no reader.
        match news {
            News::Table(whole, rows) if printed.elapsed() >= PLAIN_EVERY => {
                printed = Instant::now();
                let _ = output::say(&rows.into_iter().chain([whole]).collect::<Vec<_>>().join("\n"));
            }
            News::Table(..) => {}
            News::Line(line) => drop(output::say(&line)),
        }
    }
}
