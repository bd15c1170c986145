//! Where worlds come from. The worlds of this crate run in this process; factories for all others, such as games across
//! a network, are in crates that depend on this one.

use crate::{Environment, EnvironmentError, EnvironmentOptions, Spec, Task};

/// Makes the worlds of tasks. A rollout asks for a world when it has none that is idle, and again after
/// one has failed.
pub trait EnvironmentFactory: Send + Sync {
    /// What a task is in these worlds, as data: nothing is built for it.
    fn spec(&self, task: Task) -> Spec {
        task.spec()
    }

    /// Makes a world. What takes its time, such as starting a process, belongs into [`Environment::begin_reset`],
    /// so that several worlds do it side by side.
    ///
    /// # Errors
    /// When there can be none. The episode that it was for is lost.
    fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError>;

    /// No world is needed for a while: what those that have ended left running may end as well.
    fn rest(&self) {}

    /// Whether worlds step in processes of their own, while this one acts. A rollout then acts for half of its worlds
    /// while the other half steps, so that neither side waits for the other.
    fn steps_elsewhere(&self) -> bool {
        false
    }

    /// Most worlds that may play at once; embedded ones are not limited.
    fn worlds_max(&self) -> usize {
        usize::MAX
    }
}

/// The worlds of this crate, played with these options.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Embedded(pub EnvironmentOptions);

impl EnvironmentFactory for Embedded {
    fn build(&self, task: Task) -> Result<Box<dyn Environment>, EnvironmentError> {
        Ok(task.environment(self.0))
    }
}
