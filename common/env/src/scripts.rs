//! Scripted policies: reference points between which a learned policy can be placed.

use crate::{TaskSet, UnknownName, combat::CombatScript, particle};
use rit_episode::{Action, Policy, Turn};
use std::{fmt, str::FromStr};

/// A policy without parameters. It reads the whole state, also what an agent does not see: it is a reference
/// point, not a rival.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Script {
    /// Any available action, uniformly. For every environment.
    Random,
    /// Each agent's first available action always: what stands still in every environment that comes with the
    /// program.
    Still,
    /// Each agent to a landmark of its own, by the assignment of least total distance at each step. Made for
    /// cooperative navigation; needs the features of a particle world.
    NearestAssignment,
    /// All predators to the same prey, at each step the one that is nearest to any of them. Made for predator
    /// and prey; needs the features of a particle world.
    Chase,
    /// One of the combat sets' scripts.
    Combat(CombatScript),
}

impl Script {
    /// Every script.
    pub const ALL: [Self; 7] = [
        Self::Random,
        Self::Still,
        Self::NearestAssignment,
        Self::Chase,
        Self::Combat(CombatScript::Nearest),
        Self::Combat(CombatScript::Focus),
        Self::Combat(CombatScript::Kite),
    ];

    /// Whether it has something to do in the tasks of this set.
    ///
    /// # Errors
    /// When it was made for others: it would stand still, or look for features that are not there.
    pub fn check(self, task_set: TaskSet) -> Result<(), UnfitScript> {
        if self.fits(task_set) { Ok(()) } else { Err(UnfitScript { script: self, task_set }) }
    }

    fn fits(self, task_set: TaskSet) -> bool {
        match self {
            Self::Random | Self::Still => true,
            Self::NearestAssignment => task_set == TaskSet::CooperativeNavigation,
            Self::Chase => matches!(task_set, TaskSet::PredatorPrey | TaskSet::PredatorPreyPro),
            Self::Combat(_) => matches!(task_set, TaskSet::Combat(_)),
        }
    }
}

/// A script made for other tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("script {script} is not made for {task_set}; those that are: {}", fitting(*task_set))]
pub struct UnfitScript {
    /// The script.
    pub script: Script,
    /// The task set it does not fit.
    pub task_set: TaskSet,
}

fn fitting(task_set: TaskSet) -> String {
    let fitting = Script::ALL.into_iter().filter(|script| script.fits(task_set));
    fitting.map(|script| script.to_string()).collect::<Vec<_>>().join(", ")
}

impl Policy for Script {
    fn begin(&mut self, _: usize, _: usize) {}

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        for turn in turns {
            match self {
                Self::Random => act_randomly(turn),
                Self::Still => stand_still(turn),
                Self::NearestAssignment => particle::act_by_nearest_assignment(turn),
                Self::Chase => particle::chase(turn),
                Self::Combat(script) => script.act(turn),
            }
        }
    }
}

fn act_randomly(turn: &mut Turn<'_>) {
    for (agent, to) in turn.actions.iter_mut().enumerate() {
        *to = turn.exploration.any(turn.observation.available_to(agent));
    }
}

fn stand_still(turn: &mut Turn<'_>) {
    for (agent, to) in turn.actions.iter_mut().enumerate() {
        let first = turn.observation.available_to(agent).iter().position(|&flag| flag == 1);
        *to = first.unwrap_or_default() as Action;
    }
}

impl fmt::Display for Script {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Random => "random",
            Self::Still => "still",
            Self::NearestAssignment => "nearest-assignment",
            Self::Chase => "chase",
            Self::Combat(CombatScript::Nearest) => "nearest",
            Self::Combat(CombatScript::Focus) => "focus",
            Self::Combat(CombatScript::Kite) => "kite",
        })
    }
}

impl FromStr for Script {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        UnknownName::look_up("script", name, &Self::ALL)
    }
}
