//! How the process of one place stands: down, due to start, or up.

use super::restarts::Restarts;
use std::time::Duration;

/// The process of one place.
#[derive(Debug, Default)]
pub(super) struct Process {
    pub(super) state: State,
    pub(super) restarts: Restarts,
}

#[derive(Debug, Default)]
pub(super) enum State {
    /// None, and none is awaited.
    #[default]
    Down,
    /// None, and it is started at this moment, with these words if any.
    Due(Duration, Option<String>),
    Up(Up),
}

/// A process that was started and has not ended.
#[derive(Debug, Default)]
pub(super) struct Up {
    pub(super) pid: Option<u32>,
    pub(super) asked_to_end: bool,
    /// When it is killed unless it has ended.
    pub(super) kill_at: Option<Duration>,
    pub(super) killed: bool,
}

impl Process {
    pub(super) fn up(&mut self) -> Option<&mut Up> {
        match &mut self.state {
            State::Up(up) => Some(up),
            _ => None,
        }
    }

    pub(super) fn is_up(&self) -> bool {
        matches!(self.state, State::Up(_))
    }

    /// When something is to be done about it.
    pub(super) fn deadline(&self) -> Option<Duration> {
        match &self.state {
            State::Down => None,
            State::Due(at, _) => Some(*at),
            State::Up(up) => up.kill_at.filter(|_| !up.killed),
        }
    }
}
