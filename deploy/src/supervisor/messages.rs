//! What the supervisor is told, and what it wants done. Plain data: no process, clock or socket in it.

use super::INTERRUPTED;
use std::fmt;

/// A process of the run, by the place it holds. However often a process was started anew there, the place
/// is its identity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Place {
    /// The learner.
    Learner,
    /// The actor of this slot, counted from 0.
    Actor(u32),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Learner => f.write_str("learner"),
            Self::Actor(slot) => write!(f, "actor-{slot}"),
        }
    }
}

/// How a process ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Exit {
    /// By itself, with this exit code.
    Code(i32),
    /// By a signal.
    Signal(i32),
    /// It never began, for this reason.
    NotStarted(String),
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(INTERRUPTED) => f.write_str("was asked to end by a signal"),
            Self::Code(code) => write!(f, "ended with exit code {code}"),
            Self::Signal(signal) => write!(f, "was ended by signal {signal}"),
            Self::NotStarted(why) => write!(f, "could not be started ({why})"),
        }
    }
}

/// How the learner says that its run stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    /// Actors that this host is to run.
    pub actors_wanted: u32,
    /// Actors of this host that give no sign of life.
    pub hung: Vec<Hung>,
    /// It is writing its last files: what goes now is not to come back.
    pub ending: bool,
}

/// An actor without a sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hung {
    /// Its process.
    pub pid: u32,
    /// For so many seconds.
    pub silent_s: u64,
}

/// What happens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// The run shall begin.
    Begin,
    /// A process was started, and has this number.
    Started(Place, u32),
    /// A process has ended, or could not be started.
    Ended {
        /// Which.
        place: Place,
        /// How.
        exit: Exit,
        /// The last line of its log.
        last_words: String,
    },
    /// The learner can be reached.
    Answers,
    /// The learner says how the run stands.
    Status(Standing),
    /// The learner was asked in vain, for this reason.
    NoAnswer(String),
    /// Ctrl-C, SIGTERM or SIGHUP: the run shall shut down gracefully.
    Interrupted,
    /// Time has passed.
    Tick,
}

/// What is to be done. Effects are carried out in their order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Start a process. There is none in its place.
    Start(Place),
    /// Ask a process to shut down gracefully, by closing its lifeline.
    AskToEnd(Place),
    /// Kill a process.
    Kill(Place),
    /// Ask the learner to end the run gracefully.
    StopRun,
    /// Remove what the run has in shared memory. None of its processes lives.
    RemoveSharedMemory,
    /// Say something on the terminal.
    Say(String),
    /// The run is over, and none of its processes lives.
    Over(Outcome),
}

/// How a run came to its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The learner says that it is done, or was asked to stop; `summary.json` says which.
    Finished,
    /// It was interrupted, and ended gracefully.
    Interrupted,
    /// It failed.
    Failed {
        /// Something given was wrong: exit code 2.
        input: bool,
        /// Why, in one line.
        message: String,
    },
}
