//! What the coordinator measures beside what it decides: for people, never for training. Moments count from the
//! learner's beginning.

use rit_record::Progress;
use std::{collections::VecDeque, time::Duration};

/// Rates are taken over so long.
const RATES_OVER: Duration = Duration::from_secs(10);

/// Happenings that are remembered.
const HAPPENINGS: usize = 20;

/// How long something lasted, all together.
#[derive(Clone, Copy, Debug, Default)]
pub struct Stopwatch {
    since: Option<Duration>,
    total: Duration,
}

impl Stopwatch {
    /// Whether it runs from now on.
    pub fn set(&mut self, runs: bool, now: Duration) {
        match (self.since, runs) {
            (None, true) => self.since = Some(now),
            (Some(since), false) => {
                self.total += now - since;
                self.since = None;
            }
            _ => {}
        }
    }

    /// Seconds until now.
    pub fn seconds(&self, now: Duration) -> f64 {
        (self.total + self.since.map_or(Duration::ZERO, |since| now - since)).as_secs_f64()
    }
}

/// How fast a run goes, over the last seconds.
#[derive(Debug, Default)]
pub struct RateWindow {
    samples: VecDeque<(Duration, Progress)>,
}

impl RateWindow {
    /// Notes how far training has come. Call it a few times a second.
    pub fn note(&mut self, now: Duration, progress: Progress) {
        self.samples.push_back((now, progress));
        while self.samples.front().is_some_and(|(then, _)| now - *then > RATES_OVER) {
            self.samples.pop_front();
        }
    }

    /// The rates; zero before there are two notes.
    pub fn rates(&self) -> Rates {
        let (Some((then, before)), Some((now, after))) = (self.samples.front(), self.samples.back()) else {
            return Rates::default();
        };
        let seconds = (*now - *then).as_secs_f64();
        let rate = |before: u64, after: u64| {
            if seconds > 0.0 { after.saturating_sub(before) as f64 / seconds } else { 0.0 }
        };
        Rates {
            env_steps_per_s: rate(before.env_steps, after.env_steps),
            episodes_per_s: rate(before.episodes, after.episodes),
            updates_per_s: rate(before.updates, after.updates),
        }
    }
}

/// What a run does in a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rates {
    /// Environment steps collected.
    pub env_steps_per_s: f64,
    /// Episodes collected.
    pub episodes_per_s: f64,
    /// Updates made.
    pub updates_per_s: f64,
}

/// What became of checkpoints since the learner's beginning.
#[derive(Clone, Copy, Debug, Default)]
pub struct Checkpoints {
    /// Those written.
    pub written: u64,
    /// Those that the disk refused.
    pub failed: u64,
    /// What writing took, all together.
    pub total: Duration,
    /// What it took the last time.
    pub last: Duration,
    /// Environment steps of the newest one written.
    pub env_steps: u64,
}

/// Something that happened.
#[derive(Clone, Debug)]
pub struct Happening {
    /// Since the learner's beginning.
    pub at: Duration,
    /// Environment steps collected by then.
    pub env_steps: u64,
    /// In words.
    pub what: String,
    /// Whether it is a warning.
    pub warning: bool,
}

/// The last things that happened.
#[derive(Debug, Default)]
pub struct Happenings {
    last: VecDeque<Happening>,
}

impl Happenings {
    /// Remembers what happened, after so many environment steps.
    pub fn note(&mut self, now: Duration, env_steps: u64, what: String) {
        self.push(now, env_steps, what, false);
    }

    /// Remembers a warning: it is kept when older ordinary entries are dropped.
    pub fn warn(&mut self, now: Duration, env_steps: u64, what: String) {
        self.push(now, env_steps, what, true);
    }

    fn push(&mut self, now: Duration, env_steps: u64, what: String, warning: bool) {
        if self.last.len() == HAPPENINGS {
            let oldest = self.last.iter().position(|happening| !happening.warning).unwrap_or(0);
            self.last.remove(oldest);
        }
        self.last.push_back(Happening { at: now, env_steps, what, warning });
    }

    /// Oldest first.
    pub fn list(&self) -> &VecDeque<Happening> {
        &self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stopwatch_counts_while_it_runs() {
        let at = Duration::from_secs;
        let mut watch = Stopwatch::default();
        watch.set(false, at(1));
        watch.set(true, at(2));
        watch.set(true, at(3));
        assert_eq!(watch.seconds(at(5)), 3.0);
        watch.set(false, at(6));
        assert_eq!(watch.seconds(at(9)), 4.0);
        watch.set(true, at(10));
        assert_eq!(watch.seconds(at(11)), 5.0);
    }

    #[test]
    fn rates_are_those_of_the_last_seconds() {
        let mut window = RateWindow::default();
        assert_eq!(window.rates(), Rates::default());
        for s in 0..=30 {
            // A fast beginning that is long past.
            let env_steps = if s < 5 { 1000 * s } else { 5000 + 20 * (s - 5) };
            let progress = Progress { env_steps, episodes: 2 * s, updates: s };
            window.note(Duration::from_secs(s), progress);
            if s == 0 {
                assert_eq!(window.rates(), Rates::default());
            }
        }
        let expected = Rates { env_steps_per_s: 20.0, episodes_per_s: 2.0, updates_per_s: 1.0 };
        assert_eq!(window.rates(), expected);
    }

    #[test]
    fn the_last_happenings_are_remembered() {
        let mut happenings = Happenings::default();
        for step in 0..50 {
            happenings.note(Duration::ZERO, step, format!("step {step}"));
        }
        let list = happenings.list();
        assert_eq!((list.len(), list[0].env_steps, list[19].what.as_str()), (20, 30, "step 49"));
    }

    #[test]
    fn warnings_outlive_what_is_none() {
        let mut happenings = Happenings::default();
        happenings.warn(Duration::ZERO, 0, "the disk is full".into());
        (0..50).for_each(|step| happenings.note(Duration::ZERO, step, "an actor joined".into()));
        let list = happenings.list();
        assert_eq!((list.len(), list[0].what.as_str(), list[0].warning), (20, "the disk is full", true));
        assert!(list.iter().skip(1).all(|happening| !happening.warning));
        (0..30).for_each(|step| happenings.warn(Duration::ZERO, step, format!("warning {step}")));
        assert_eq!((happenings.list().len(), happenings.list()[0].what.as_str()), (20, "warning 10"));
    }
}
