//! Tasks whose worlds are not of this crate: a run's configuration says what they are, or the program that registered
//! them.

use crate::{
    Environment, EnvironmentError, FailureKind, PYTHON, Spec, Split, Step,
    own::{self, Held, Maker},
};
use rit_episode::{Action, Observation, Rng};
use std::sync::{Mutex, PoisonError};

/// The tasks of a run whose worlds others made.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct ForeignSet {
    /// What it is called.
    pub name: String,
    /// Tasks to learn from.
    pub training: Vec<ForeignTask>,
    /// Tasks kept for zero-shot evaluation.
    pub testing: Vec<ForeignTask>,
    /// What features are called.
    pub feature_names: Vec<String>,
    /// What actions are called.
    pub action_names: Vec<String>,
    /// Makes their worlds in this process; `None` where they are elsewhere.
    pub maker: Option<Maker>,
}

/// One of them.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct ForeignTask {
    /// Its name: what its maker is asked for.
    pub name: String,
    /// What it is.
    pub spec: Spec,
    /// Makes its world in this process; `None` where it is elsewhere.
    pub maker: Option<Maker>,
}

impl ForeignSet {
    /// Environments in Python, before a configuration says which tasks there are.
    pub(crate) fn unknown_python() -> &'static Self {
        let set = Self {
            name: PYTHON.to_owned(),
            training: Vec::new(),
            testing: Vec::new(),
            feature_names: Vec::new(),
            action_names: Vec::new(),
            maker: None,
        };
        set.kept()
    }

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

    /// A task that no list of a set in this process names, if its maker knows it; or what is wrong with its world. As
    /// [`Self::kept`], each takes memory once.
    pub(crate) fn unlisted(&self, name: &str) -> Result<Option<&'static ForeignTask>, String> {
        static KEPT: Mutex<Vec<&'static ForeignTask>> = Mutex::new(Vec::new());
        let Some(maker) = self.maker else { return Ok(None) };
        let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = kept.iter().find(|known| known.name == name && known.maker == Some(maker)) {
            return Ok(Some(known));
        }
        let sizes = [self.feature_names.len(), self.action_names.len()];
        let Some(described) = own::described(maker, name, sizes)? else { return Ok(None) };
        let new: &'static ForeignTask = Box::leak(Box::new(described));
        kept.push(new);
        Ok(Some(new))
    }
}

impl ForeignTask {
    /// Its world.
    pub(crate) fn world(&'static self) -> Box<dyn Environment> {
        let elsewhere = || {
            let detail = format!("the world of {} is not one of this program's own", self.name);
            EnvironmentError::new(FailureKind::Raised, detail)
        };
        let made = self.maker.ok_or_else(elsewhere).and_then(|maker| Held::make(maker, self));
        match made {
            Ok(world) => Box::new(world),
            Err(error) => Box::new(Nowhere(self.spec, error)),
        }
    }
}

/// The world of a task that cannot be made: it says so.
#[derive(Debug)]
struct Nowhere(Spec, EnvironmentError);

impl Environment for Nowhere {
    fn spec(&self) -> Spec {
        self.0
    }

    fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
        Err(self.1.clone())
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
            let spec = crate::matrix_game::MatrixGame::SPEC;
            let task = ForeignTask { name: name.to_owned(), spec, maker: None };
            let names = || vec!["x".to_owned()];
            ForeignSet {
                name: PYTHON.to_owned(),
                training: vec![task],
                testing: vec![],
                feature_names: names(),
                action_names: names(),
                maker: None,
            }
        };
        assert!(std::ptr::eq(set("two").kept(), set("two").kept()));
        assert!(!std::ptr::eq(set("two").kept(), set("three").kept()));
    }
}
