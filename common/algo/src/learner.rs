//! What a trainer knows of an algorithm: it takes batches of episodes and has weights to act with. Everything else
//! that it has, it declares: numbers to watch, and numbers that a checkpoint must hold.

use crate::Regime;
use rit_episode::{Episode, RunSeed, Stream, streams::Rng};
use rit_nn::Layout;
use std::{borrow::Cow, ops::Range};

/// A number that an update reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Measure {
    /// What it is called wherever it is written or shown, in `snake_case`.
    pub name: &'static str,
    /// What it is, in a few words that begin a sentence.
    pub help: &'static str,
}

/// Where an update's random numbers come from: the streams of the run's seed, at the update's number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Draw {
    /// The run's.
    pub seed: RunSeed,
    /// Updates made before this one.
    pub update: u64,
}

impl Draw {
    /// The generator of a stream that is indexed by update.
    pub fn stream(self, stream: Stream) -> Rng {
        self.seed.stream(stream, self.update)
    }
}

/// A loss, or a gradient's norm, that is no finite number. The weights are as they were before the update.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} is not finite")]
pub struct NotFinite {
    /// The name of the measure.
    pub what: &'static str,
}

impl NotFinite {
    /// Whether every measure's value is finite.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(measures: &[Measure], values: &[f64]) -> Result<(), Self> {
        debug_assert_eq!(measures.len(), values.len(), "a value for each measure");
        let mut named = measures.iter().zip(values);
        let found = named.find(|(_, value)| !value.is_finite());
        found.map_or(Ok(()), |(measure, _)| Err(Self { what: measure.name }))
    }
}

/// Numbers under a name, beside the parameters, that training goes on from.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedState<'a> {
    /// What they are called in a checkpoint.
    pub name: &'static str,
    /// The numbers.
    pub numbers: Numbers<'a>,
}

/// Numbers of one kind, in a row.
#[derive(Clone, Debug, PartialEq)]
pub enum Numbers<'a> {
    /// Of single precision: a target network, an optimiser's moments.
    F32(Cow<'a, [f32]>),
    /// Of double precision: averages over a whole run.
    F64(Cow<'a, [f64]>),
    /// Counts.
    U64(Cow<'a, [u64]>),
}

impl<'a> NamedState<'a> {
    /// Single precision.
    pub fn f32(name: &'static str, numbers: &'a [f32]) -> Self {
        Self { name, numbers: Numbers::F32(numbers.into()) }
    }

    /// Double precision.
    pub fn f64(name: &'static str, numbers: &'a [f64]) -> Self {
        Self { name, numbers: Numbers::F64(numbers.into()) }
    }

    /// Counts.
    pub fn u64(name: &'static str, numbers: &'a [u64]) -> Self {
        Self { name, numbers: Numbers::U64(numbers.into()) }
    }

    /// A copy that lasts.
    pub fn into_owned(self) -> NamedState<'static> {
        let numbers = match self.numbers {
            Numbers::F32(numbers) => Numbers::F32(numbers.into_owned().into()),
            Numbers::F64(numbers) => Numbers::F64(numbers.into_owned().into()),
            Numbers::U64(numbers) => Numbers::U64(numbers.into_owned().into()),
        };
        NamedState { name: self.name, numbers }
    }
}

impl Numbers<'_> {
    /// How many.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(numbers) => numbers.len(),
            Self::F64(numbers) => numbers.len(),
            Self::U64(numbers) => numbers.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Where a state's numbers belong.
#[derive(Debug)]
pub enum Place<'a> {
    /// Single precision.
    F32(&'a mut [f32]),
    /// Double precision.
    F64(&'a mut [f64]),
    /// Counts.
    U64(&'a mut [u64]),
}

/// A state that is not the learner's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StateError {
    /// Numbers that it needs and the state has not.
    #[error("there is no {0}")]
    Missing(&'static str),
    /// Another kind, or another number of them.
    #[error("{name} has other numbers than this learner's {len}")]
    Other {
        /// Their name.
        name: &'static str,
        /// As many as there should be.
        len: usize,
    },
}

/// Copies a state's numbers to where they belong; all of them, or none.
///
/// # Errors
/// When one is missing, or not of its place's kind and length.
pub fn restore(places: Vec<(&'static str, Place<'_>)>, state: &[NamedState<'_>]) -> Result<(), StateError> {
    let find = |name| state.iter().find(|state| state.name == name).ok_or(StateError::Missing(name));
    for (name, place) in &places {
        let (fits, len) = match (place, &find(name)?.numbers) {
            (Place::F32(place), Numbers::F32(numbers)) => (place.len() == numbers.len(), place.len()),
            (Place::F64(place), Numbers::F64(numbers)) => (place.len() == numbers.len(), place.len()),
            (Place::U64(place), Numbers::U64(numbers)) => (place.len() == numbers.len(), place.len()),
            (Place::F32(place), _) => (false, place.len()),
            (Place::F64(place), _) => (false, place.len()),
            (Place::U64(place), _) => (false, place.len()),
        };
        if !fits {
            return Err(StateError::Other { name, len });
        }
    }
    for (name, place) in places {
        match (place, &find(name)?.numbers) {
            (Place::F32(place), Numbers::F32(numbers)) => place.copy_from_slice(numbers),
            (Place::F64(place), Numbers::F64(numbers)) => place.copy_from_slice(numbers),
            (Place::U64(place), Numbers::U64(numbers)) => place.copy_from_slice(numbers),
            // The first loop has refused every other combination.
            _ => {}
        }
    }
    Ok(())
}

/// An algorithm under training: all that a trainer knows of it.
pub trait Learner: Send {
    /// What it learns from.
    fn regime(&self) -> Regime;

    /// Names and shapes of all parameters.
    fn layout(&self) -> &Layout;

    /// The parameters that acting needs.
    fn acting(&self) -> Range<usize>;

    /// What an update reports, in the order of its values.
    fn measures(&self) -> &'static [Measure];

    /// One update on a batch. Returns the measures' values.
    ///
    /// # Errors
    /// When a loss or the gradient's norm is not finite; the weights are then as they were.
    fn learn(&mut self, batch: &[&Episode], draw: Draw) -> Result<Vec<f64>, NotFinite>;

    /// Copies the weights into the target network, where there is one.
    fn update_target(&mut self) {}

    /// All parameters, in the layout's order.
    fn params(&self) -> &[f32];

    /// What training goes on from, beside the parameters: target network, optimiser, and the method's own state.
    /// The same names, kinds and lengths at every time of a run.
    fn state(&self) -> Vec<NamedState<'_>>;

    /// Goes on from these parameters, of the layout's length, and from this state.
    ///
    /// # Errors
    /// When they are not this learner's, which is then as it was.
    fn restore(&mut self, params: &[f32], state: &[NamedState<'_>]) -> Result<(), StateError>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_comes_back_whole_or_not_at_all() {
        let state = [
            NamedState::f32("target", &[1.0, 2.0]),
            NamedState::u64("optimizer.steps", &[7]),
            NamedState::f64("value_normalizer", &[0.25]),
        ];
        let (mut target, mut steps, mut normalizer) = ([0.0; 2], [0], [0.0]);
        let places = vec![
            ("target", Place::F32(&mut target)),
            ("optimizer.steps", Place::U64(&mut steps)),
            ("value_normalizer", Place::F64(&mut normalizer)),
        ];
        assert_eq!(restore(places, &state), Ok(()));
        assert_eq!((target, steps, normalizer), ([1.0, 2.0], [7], [0.25]));

        let mut target = [9.0; 2];
        let (mut other_kind, mut longer) = ([0.0], [0.0; 2]);
        let normalizer = "value_normalizer";
        for (name, place, message) in [
            ("mean", Place::F32(&mut []), "there is no mean"),
            (
                normalizer,
                Place::F32(&mut other_kind),
                "value_normalizer has other numbers than this learner's 1",
            ),
            (normalizer, Place::F64(&mut longer), "value_normalizer has other numbers than this learner's 2"),
        ] {
            let places = vec![("target", Place::F32(&mut target)), (name, place)];
            assert_eq!(restore(places, &state).unwrap_err().to_string(), message);
            assert_eq!(target, [9.0; 2], "nothing was copied");
        }
    }

    #[test]
    fn the_first_measure_that_is_not_finite_is_named() {
        let measures = [Measure { name: "td_loss", help: "" }, Measure { name: "grad_norm", help: "" }];
        assert_eq!(NotFinite::check(&measures, &[1.0, 2.0]), Ok(()));
        let error = NotFinite::check(&measures, &[1.0, f64::NAN]).unwrap_err();
        assert_eq!(error.to_string(), "grad_norm is not finite");
        assert_eq!(NotFinite::check(&measures, &[f64::INFINITY, 0.0]), Err(NotFinite { what: "td_loss" }));
    }

    /// Values have no names but by their places: one too few would give every later one another's.
    #[test]
    #[cfg(debug_assertions)]
    #[should_panic(expected = "a value for each measure")]
    fn a_measure_without_a_value_is_noticed() {
        let measures = [Measure { name: "td_loss", help: "" }, Measure { name: "grad_norm", help: "" }];
        let _ = NotFinite::check(&measures, &[1.0]);
    }
}
