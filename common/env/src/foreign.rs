//! Tasks whose worlds are not of this crate: what they are is part of the run's configuration.

use crate::{Environment, EnvironmentError, FailureKind, Spec, Split, Step};
use rit_episode::{Action, Observation, Rng};
use std::sync::{Mutex, PoisonError};

/// The tasks of a run whose worlds others made.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct ForeignSet {
    /// Tasks to learn from.
    pub training: Vec<ForeignTask>,
    /// Tasks kept for zero-shot evaluation.
    pub testing: Vec<ForeignTask>,
    /// What features are called.
    pub feature_names: Vec<String>,
    /// What actions are called.
    pub action_names: Vec<String>,
}

/// One of them.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct ForeignTask {
    /// Its name: what its maker is asked for.
    pub name: String,
    /// What it is.
    pub spec: Spec,
}

/// Before a configuration says which tasks there are.
pub(crate) static NO_TASKS: ForeignSet = ForeignSet {
    training: Vec::new(),
    testing: Vec::new(),
    feature_names: Vec::new(),
    action_names: Vec::new(),
};

impl ForeignSet {
    /// The set that is equal to this one and lives as long as the process: a task can then be copied like any other. Each
    /// set that differs takes memory once.
    pub fn kept(self) -> &'static Self {
        static KEPT: Mutex<Vec<&'static ForeignSet>> = Mutex::new(Vec::new());
        let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = kept.iter().find(|known| ***known == self) {
            return known;
        }
        let new: &'static Self = Box::leak(Box::new(self));
        kept.push(new);
        new
    }

    /// The tasks of one split.
    pub fn tasks(&self, split: Split) -> &[ForeignTask] {
        match split {
            Split::Training => &self.training,
            Split::Testing => &self.testing,
        }
    }
}

/// The world of such a task where no factory makes one: it says so.
#[derive(Debug)]
pub(crate) struct Nowhere(pub(crate) &'static ForeignTask);

impl Environment for Nowhere {
    fn spec(&self) -> Spec {
        self.0.spec
    }

    fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
        let detail = format!("the world of {} is not one of this program's own", self.0.name);
        Err(EnvironmentError { kind: FailureKind::Raised, detail })
    }

    fn observe(&self, _: &mut Observation) {}

    fn step(&mut self, _: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError> {
        self.reset(rng).map(|()| Step { reward: 0.0, shaping: 0.0, end: None, won: false })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_sets_are_one_and_the_same() {
        let set = |name: &str| {
            let task = ForeignTask { name: name.to_owned(), spec: crate::matrix_game::MatrixGame::SPEC };
            let names = || vec!["x".to_owned()];
            ForeignSet {
                training: vec![task],
                testing: vec![],
                feature_names: names(),
                action_names: names(),
            }
        };
        assert!(std::ptr::eq(set("two").kept(), set("two").kept()));
        assert!(!std::ptr::eq(set("two").kept(), set("three").kept()));
    }
}
