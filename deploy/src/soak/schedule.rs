//! What a soak does to a run, and when: drawn from its seed before the run begins, so that the same seed does the same
//! again.

use rand::RngExt as _;
use rit_episode::{Rng, RunSeed, Stream};
use rustix::process::Signal;
use serde::Serialize;

/// The last tenth of a run is left in peace, else something might come after its end.
const WITHIN: f64 = 0.9;

/// A process that dies again and again is given up; so often each may before the run gets a new supervisor.
const BLOWS_PER_SUPERVISOR: usize = 3;

/// Something that is done to a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Blow {
    /// An actor is killed.
    ActorKilled,
    /// An actor is told to end, by SIGTERM: it leaves gracefully.
    ActorTold,
    /// Likewise, by SIGINT.
    ActorInterrupted,
    /// An actor's terminal is gone: SIGHUP.
    ActorHungUp,
    /// An actor is stopped: it is noticed by its silence.
    ActorStopped,
    /// The learner is killed.
    LearnerKilled,
    /// The learner is killed while it writes a checkpoint.
    LearnerKilledAtCheckpoint,
    /// The learner's terminal is gone.
    LearnerHungUp,
    /// The learner is stopped: it is noticed by its silence.
    LearnerStopped,
    /// The learner alone is told to shut down gracefully: another goes on.
    LearnerTold,
    /// `rit train` is told to end; the run is resumed.
    TrainTold,
    /// The terminal of `rit train` is gone, which takes its children along; the run is resumed.
    TrainHungUp,
    /// All processes at once, as when the machine loses power; the run is resumed.
    Everything,
    /// `rit train` is told to end, and resumed without a reader of what it says.
    OutputClosed,
    /// Another learner is started for the run, and another `rit train --resume`: both are refused.
    SecondLearner,
    /// The run is copied, and the copy is resumed beside it: a run of its own.
    Copied,
}

impl Blow {
    /// For people.
    pub fn words(self) -> &'static str {
        match self {
            Self::ActorKilled => "an actor killed",
            Self::ActorTold => "an actor told to end",
            Self::ActorInterrupted => "an actor interrupted",
            Self::ActorHungUp => "an actor hung up",
            Self::ActorStopped => "an actor stopped",
            Self::LearnerKilled => "the learner killed",
            Self::LearnerKilledAtCheckpoint => "the learner killed at a checkpoint",
            Self::LearnerHungUp => "the learner hung up",
            Self::LearnerStopped => "the learner stopped",
            Self::LearnerTold => "the learner told to end",
            Self::TrainTold => "rit train told to end; resumed",
            Self::TrainHungUp => "rit train hung up; resumed",
            Self::Everything => "everything killed; resumed",
            Self::OutputClosed => "resumed, its output closed",
            Self::SecondLearner => "a second learner and a second train",
            Self::Copied => "copied, and the copy resumed",
        }
    }

    /// The signal that an actor or the learner gets, and which of them.
    pub fn signal(self) -> Option<Signal> {
        match self {
            Self::ActorKilled | Self::LearnerKilled | Self::LearnerKilledAtCheckpoint | Self::Everything => {
                Some(Signal::KILL)
            }
            Self::ActorTold | Self::LearnerTold | Self::TrainTold | Self::OutputClosed => Some(Signal::TERM),
            Self::ActorInterrupted => Some(Signal::INT),
            Self::ActorHungUp | Self::LearnerHungUp | Self::TrainHungUp => Some(Signal::HUP),
            Self::ActorStopped | Self::LearnerStopped => Some(Signal::STOP),
            Self::SecondLearner | Self::Copied => None,
        }
    }

    /// Whether a new supervisor resumes the run.
    pub fn is_resumed(self) -> bool {
        match self {
            Self::TrainTold | Self::TrainHungUp | Self::Everything | Self::OutputClosed => true,
            Self::ActorKilled
            | Self::ActorTold
            | Self::ActorInterrupted
            | Self::ActorHungUp
            | Self::ActorStopped
            | Self::LearnerKilled
            | Self::LearnerKilledAtCheckpoint
            | Self::LearnerHungUp
            | Self::LearnerStopped
            | Self::LearnerTold
            | Self::SecondLearner
            | Self::Copied => false,
        }
    }

    fn draw(rng: &mut Rng) -> Self {
        match rng.random_range(0..40) {
            0..8 => Self::ActorKilled,
            8..11 => Self::ActorTold,
            11..13 => Self::ActorInterrupted,
            13..14 => Self::ActorHungUp,
            14..16 => Self::ActorStopped,
            16..22 => Self::LearnerKilled,
            22..27 => Self::LearnerKilledAtCheckpoint,
            27..28 => Self::LearnerHungUp,
            // It takes half a minute to be noticed.
            28..29 => Self::LearnerStopped,
            29..30 => Self::LearnerTold,
            30..31 => Self::TrainTold,
            31..32 => Self::TrainHungUp,
            32..35 => Self::Everything,
            35..36 => Self::OutputClosed,
            36..38 => Self::SecondLearner,
            _ => Self::Copied,
        }
    }
}

/// A blow and its moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planned {
    /// In environment steps.
    pub at: f64,
    /// What is done.
    pub blow: Blow,
    /// Chooses among the actors there are then.
    pub which: usize,
}

/// So many blows, spread over a run of so many environment steps.
pub fn draw(seed: u64, blows: usize, env_steps: u64) -> Vec<Planned> {
    let mut rng = RunSeed(seed).derive("soak", 0).stream(Stream::Exploration, 0);
    let mut with_this_supervisor = 0;
    (0..blows)
        .map(|index| {
            let at = (index as f64 + rng.random::<f64>()) / blows as f64 * WITHIN * env_steps as f64;
            let (drawn, which) = (Blow::draw(&mut rng), rng.random_range(0..1024));
            let blow = if with_this_supervisor < BLOWS_PER_SUPERVISOR { drawn } else { Blow::Everything };
            with_this_supervisor = if blow.is_resumed() { 0 } else { with_this_supervisor + 1 };
            Planned { at, blow, which }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn a_seed_is_a_schedule() {
        assert_eq!(draw(4, 30, 2000), draw(4, 30, 2000));
        assert_ne!(draw(4, 30, 2000), draw(5, 30, 2000));
    }

    #[test]
    fn every_kind_of_blow_comes_in_its_time() {
        let schedule = draw(1, 1000, 50_000);
        let kinds: BTreeSet<Blow> = schedule.iter().map(|planned| planned.blow).collect();
        assert_eq!(kinds.len(), 16, "{kinds:?}");
        assert!(schedule.is_sorted_by_key(|planned| planned.at));
        assert!(schedule.last().unwrap().at < 45_000.0);
        let without_resume = schedule.split(|planned| planned.blow.is_resumed());
        assert!(without_resume.map(<[Planned]>::len).max() <= Some(BLOWS_PER_SUPERVISOR));
    }
}
