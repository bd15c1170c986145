//! Where the view goes: the whole terminal, redrawn in place, or plain lines where there is none.

use super::{model::Model, view};
use crate::{
    failure::Failure,
    output::{self, Reader},
    progress::PLAIN_EVERY,
    report,
};
use ratatui::{
    DefaultTerminal,
    crossterm::event::{self, Event, KeyCode, KeyEvent, KeyModifiers},
};
use std::{
    io::{self, IsTerminal as _},
    thread,
    time::{Duration, Instant},
};
use tokio::sync::mpsc;

/// Where the view goes.
pub enum Screen {
    /// A terminal, and the signals that end it.
    Terminal(Box<DefaultTerminal>, mpsc::Receiver<()>),
    /// Lines.
    Plain {
        /// When the last line on the run's state was printed.
        printed: Option<Instant>,
        /// Happenings printed.
        happened: usize,
    },
}

impl Screen {
    /// The terminal that this process has, if it has one.
    ///
    /// # Errors
    /// When the terminal will not do.
    pub fn open() -> Result<Self, Failure> {
        if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
            return Ok(Self::Plain { printed: None, happened: 0 });
        }
        let terminal = ratatui::try_init().map_err(Failure::runtime)?;
        let (quit, quits) = mpsc::channel(1);
        // Ends with the process: nothing wakes it but a key.
        thread::spawn(move || {
            while let Ok(event) = event::read() {
                if is_quit(&event) && quit.blocking_send(()).is_err() {
                    return;
                }
            }
        });
        Ok(Self::Terminal(Box::new(terminal), quits))
    }

    /// Shows how the run stands; says whether the terminal is still there. A terminal that does not take it has gone.
    ///
    /// # Errors
    /// When lines cannot be written.
    pub fn show(&mut self, model: &Model) -> Result<Reader, Failure> {
        match self {
            Self::Terminal(terminal, _) => {
                let drawn = terminal.draw(|frame| view::draw(frame, model));
                Ok(if drawn.is_ok() { Reader::There } else { Reader::Gone })
            }
            Self::Plain { printed, happened } => {
                let new = model.happened.saturating_sub(std::mem::replace(happened, model.happened));
                let known = model.happenings.len();
                let news = model.happenings.iter().skip(known.saturating_sub(new));
                let mut lines: Vec<_> = news.map(view::happening).collect();
                if !model.away && printed.is_none_or(|printed| printed.elapsed() >= PLAIN_EVERY) {
                    *printed = Some(Instant::now());
                    lines.push(report::status_line(&model.status));
                }
                output::print(&lines.into_iter().map(|line| line + "\n").collect::<String>())
            }
        }
    }

    /// Resolves when `q` or Ctrl-C ends the view.
    pub async fn quit(&mut self) {
        let quit = match self {
            Self::Terminal(_, quits) => quits.recv().await,
            Self::Plain { .. } => None,
        };
        if quit.is_none() {
            std::future::pending::<()>().await;
        }
    }

    /// Waits for so long; whether `q` or Ctrl-C ended the view.
    pub async fn quits_within(&mut self, time: Duration) -> bool {
        tokio::time::timeout(time, self.quit()).await.is_ok()
    }

    /// Gives the terminal back.
    pub fn close(self) {
        if let Self::Terminal(mut terminal, _) = self {
            // Each of these may fail because the terminal has gone: then there is nothing to give back.
            let _ = terminal.show_cursor();
            let _ = ratatui::try_restore();
            // Its end would show the cursor again, and print where it cannot.
            std::mem::forget(terminal);
        }
    }
}

/// In raw mode Ctrl-C is a key like any other.
fn is_quit(event: &Event) -> bool {
    match event {
        Event::Key(KeyEvent { code: KeyCode::Char('c'), modifiers, .. }) => {
            modifiers.contains(KeyModifiers::CONTROL)
        }
        Event::Key(KeyEvent { code, .. }) => matches!(code, KeyCode::Char('q') | KeyCode::Esc),
        _ => false,
    }
}
