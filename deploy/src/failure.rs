//! How a command ends when it does not end well: a one-line message and an exit code.

use crate::{output, traceback};
use rit_actor::ActorError;
use rit_config::{ConfigError, RunDirError};
use rit_env::{TaskError, UnfitScript, UnknownName, rollout::LostEpisode};
use rit_learner::{LearnerError, evaluation::TasksError, trainer::TrainError};
use rit_policy::{CarryOverError, WeightsFileError};
use rit_proto::transport::{ConnectError, CredentialsError, status_words};
use std::{fmt, process::ExitCode};

/// Exit code of a learner under `rit train` when the system refuses now what it may grant later (shared memory, a port),
/// as `sysexits.h` has it for a failure that passes: the supervisor starts it again.
pub const UNAVAILABLE: u8 = 75;

/// Exit code of an actor that cannot use what its learner sends, or whose environments do not work, as `sysexits.h` has it
/// for an error of the protocol: another try would end the same way.
pub const INCOMPATIBLE: u8 = 76;

/// A failed command.
#[derive(Debug)]
pub enum Failure {
    /// Something typed or given was wrong: exit code 2, nothing was overwritten.
    Input(anyhow::Error),
    /// Something failed on the way: exit code 1.
    Runtime(anyhow::Error),
    /// The system refuses what it may grant later: exit code 75.
    Unavailable(anyhow::Error),
    /// What the learner sends, or the environments, cannot be used, now or later: exit code 76.
    Incompatible(anyhow::Error),
}

impl Failure {
    /// Something given was wrong.
    pub fn input(error: impl Into<anyhow::Error>) -> Self {
        Self::Input(error.into())
    }

    /// Something given was wrong, in words.
    pub fn input_message(message: impl fmt::Display) -> Self {
        Self::Input(anyhow::anyhow!("{message}"))
    }

    /// Something failed.
    pub fn runtime(error: impl Into<anyhow::Error>) -> Self {
        Self::Runtime(error.into())
    }

    /// Something failed, in words.
    pub fn runtime_message(message: impl fmt::Display) -> Self {
        Self::Runtime(anyhow::anyhow!("{message}"))
    }

    /// Says the message, and before it where in an environment's code it comes from; returns the exit code.
    pub fn report(&self) -> ExitCode {
        let (Self::Input(error)
        | Self::Runtime(error)
        | Self::Unavailable(error)
        | Self::Incompatible(error)) = self;
        traceback::say(error);
        // The exit code says it too, should there be no reader.
        let _ = output::say(&format!("error: {self}"));
        ExitCode::from(match self {
            Self::Input(_) => 2,
            Self::Runtime(_) => 1,
            Self::Unavailable(_) => UNAVAILABLE,
            Self::Incompatible(_) => INCOMPATIBLE,
        })
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Input(error)
            | Self::Runtime(error)
            | Self::Unavailable(error)
            | Self::Incompatible(error) => f.write_str(&in_one_line(error)),
        }
    }
}

/// An error and its causes, each said once: many an error's words hold those of its cause already. On one line.
fn in_one_line(error: &anyhow::Error) -> String {
    let mut words = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if words.is_empty() {
            words = cause;
        } else if !words.contains(&cause) {
            words += &format!(": {cause}");
        }
    }
    let lines = words.lines().map(str::trim).filter(|line| !line.is_empty());
    lines.collect::<Vec<_>>().join("; ").replace(char::is_control, " ")
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::input(error)
    }
}

impl From<RunDirError> for Failure {
    fn from(error: RunDirError) -> Self {
        Self::input(error)
    }
}

impl From<TaskError> for Failure {
    fn from(error: TaskError) -> Self {
        Self::input(error)
    }
}

impl From<LostEpisode> for Failure {
    fn from(error: LostEpisode) -> Self {
        Self::runtime(error)
    }
}

impl From<UnknownName> for Failure {
    fn from(error: UnknownName) -> Self {
        Self::input(error)
    }
}

impl From<TasksError> for Failure {
    fn from(error: TasksError) -> Self {
        Self::input(error)
    }
}

impl From<UnfitScript> for Failure {
    fn from(error: UnfitScript) -> Self {
        Self::input(error)
    }
}

impl From<WeightsFileError> for Failure {
    fn from(error: WeightsFileError) -> Self {
        Self::input(error)
    }
}

impl From<CarryOverError> for Failure {
    fn from(error: CarryOverError) -> Self {
        Self::input(error)
    }
}

impl From<ConnectError> for Failure {
    fn from(error: ConnectError) -> Self {
        if error.may_pass() { Self::runtime(error) } else { Self::input(error) }
    }
}

impl From<CredentialsError> for Failure {
    fn from(error: CredentialsError) -> Self {
        Self::input(error)
    }
}

impl From<LearnerError> for Failure {
    fn from(error: LearnerError) -> Self {
        match error {
            LearnerError::Listen(_)
            | LearnerError::Web(_)
            | LearnerError::Life(_)
            | LearnerError::SharedMemory(_) => Self::Unavailable(error.into()),
            LearnerError::Access(_)
            | LearnerError::Address(_)
            | LearnerError::Model(_)
            | LearnerError::Initial(_)
            | LearnerError::Checkpoint(_)
            | LearnerError::Train(TrainError::Metrics { .. }) => Self::input(error),
            _ => Self::runtime(error),
        }
    }
}

impl From<ActorError> for Failure {
    fn from(error: ActorError) -> Self {
        match error {
            ActorError::Connect(error) => error.into(),
            ActorError::NoAddress { .. }
            | ActorError::Address(_)
            | ActorError::Refused(_)
            | ActorError::Config(_)
            | ActorError::Worlds(_)
            | ActorError::RunId
            | ActorError::Model(_) => Self::input(error),
            error if error.is_permanent() => Self::Incompatible(error.into()),
            _ => Self::runtime(error),
        }
    }
}

impl From<tonic::Status> for Failure {
    fn from(status: tonic::Status) -> Self {
        let message = status.message().to_owned();
        match status.code() {
            tonic::Code::InvalidArgument | tonic::Code::NotFound | tonic::Code::AlreadyExists => {
                Self::input_message(message)
            }
            _ => Self::runtime_message(match status_words(&status) {
                words if words == message => format!("the learner answers: {words}"),
                words => format!("{words}; is the run still going, and not under load or stopped?"),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_that_was_said_is_not_said_again_and_lines_are_one() {
        #[derive(Debug, thiserror::Error)]
        #[error("run/config.toml: {0}")]
        struct Outer(#[source] ConfigError);
        let inner = rit_config::set("algorithm.gama=1").unwrap_err();
        let words = inner.to_string();
        assert_eq!(Failure::input(Outer(inner)).to_string(), format!("run/config.toml: {words}"));
        let failure = Failure::runtime(anyhow::anyhow!("disk\nfull\u{1b}[0m").context("cannot write"));
        assert_eq!(failure.to_string(), "cannot write: disk; full [0m");
    }

    #[test]
    fn weights_that_an_actor_cannot_use_have_an_exit_code_of_their_own() {
        use rit_actor::{RolloutError, WeightsError};
        use rit_proto::snapshot::SnapshotError;
        let failure = |error: SnapshotError| {
            Failure::from(ActorError::Rollout(RolloutError::Weights(WeightsError::Snapshot(error))))
        };
        let length = SnapshotError::Length { found: 8, expected: 4 };
        let order = SnapshotError::Order { version: 7, found: 4, expected: 0 };
        for error in [length, order] {
            assert!(matches!(failure(error), Failure::Incompatible(_)));
        }
        // A byte may have been turned on the way, and the next try brings it right.
        assert!(matches!(failure(SnapshotError::Altered(7)), Failure::Runtime(_)));
    }

    #[test]
    fn environments_that_do_not_work_end_a_run_and_those_that_died_may_come_back() {
        use rit_actor::RolloutError;
        use rit_env::{EnvironmentError, FailureKind};
        let failure = |kind| {
            let error = EnvironmentError::new(kind, "the bridge is out");
            let lost = LostEpisode { number: 7, task: "two".into(), error };
            Failure::from(ActorError::Rollout(RolloutError::Environment { rounds: 3, lost }))
        };
        for kind in FailureKind::ALL {
            let failure = failure(kind);
            assert_eq!(matches!(failure, Failure::Incompatible(_)), kind != FailureKind::Died, "{kind:?}");
            assert!(failure.to_string().starts_with("3 times in a row every episode was lost, the last: "));
        }
    }

    #[test]
    fn a_broken_connection_is_said_without_the_words_of_its_libraries() {
        let cause = std::io::Error::other("h2 protocol error: error reading a body from connection");
        let broken = Failure::from(tonic::Status::from_error(Box::new(cause)));
        assert!(broken.to_string().starts_with("the connection broke; is the run still going"), "{broken}");
        let said = Failure::from(tonic::Status::unavailable("the run is over"));
        assert_eq!(said.to_string(), "the learner answers: the run is over");
    }
}
