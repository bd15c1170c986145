//! What of an evaluation is compared.

use rit_env::{Split, TaskSet};
use rit_record::{Occasion, Record, TaskResult};
use rit_statistics::Interval;
use std::collections::BTreeMap;

/// What of an evaluation is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measure {
    /// Mean of undiscounted returns.
    Return,
    /// Share of episodes won.
    WinRate,
}

impl Measure {
    /// For people.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Return => "return",
            Self::WinRate => "win rate",
        }
    }

    /// What the paper compares on a task set.
    pub fn of_task_set(task_set: &str) -> Self {
        match task_set.parse::<TaskSet>() {
            Ok(task_set) if task_set.has_wins() => Self::WinRate,
            _ => Self::Return,
        }
    }

    /// Where values can lie at all.
    pub const fn range(self) -> Option<[f64; 2]> {
        match self {
            Self::Return => None,
            Self::WinRate => Some([0.0, 1.0]),
        }
    }

    /// What of an interval of its mean can be.
    pub fn possible(self, interval: Interval) -> Interval {
        self.range().map_or(interval, |range| interval.within(range))
    }

    /// What a caption says of intervals or bands, by their name, of which some are of these measures: nothing, or where they
    /// end.
    pub fn ends(what: &str, measures: impl IntoIterator<Item = Self>) -> String {
        if measures.into_iter().any(|measure| measure.range().is_some()) {
            format!(" {what} of win rates end at 0 and 1, beyond which no win rate lies.")
        } else {
            String::new()
        }
    }

    /// As people read it: win rates with two decimals, returns with one.
    pub fn number(self, value: f64) -> String {
        match self {
            _ if !value.is_finite() => "–".to_owned(),
            Self::Return => signed(value, 1),
            Self::WinRate => signed(value, 2),
        }
    }

    /// Of one result.
    pub fn of(self, result: &TaskResult) -> Option<f64> {
        match self {
            Self::Return => Some(result.mean_return),
            Self::WinRate => result.win_rate,
        }
        .filter(|value| value.is_finite())
    }

    /// What a run came to on a task: its evaluation at the end, or else its last one on schedule.
    pub fn at_the_end(self, run: &Record, split: Split, task: &str) -> Option<f64> {
        [Occasion::Final, Occasion::Scheduled].into_iter().find_map(|occasion| {
            let evaluations = run.evaluations.iter().rev();
            let mut of_split = evaluations.filter(|it| (it.occasion, it.split) == (occasion, split));
            of_split.find_map(|evaluation| self.of(evaluation.tasks.get(task)?))
        })
    }

    /// What a run's best policy came to, where that was measured; what the run came to otherwise.
    pub fn absolute(self, run: &Record, split: Split, task: &str) -> Option<f64> {
        let best = run.latest(Occasion::Best, split).and_then(|it| self.of(it.tasks.get(task)?));
        best.or_else(|| self.at_the_end(run, split, task))
    }

    /// What a run came to over tasks, each counting the same; none where one was not measured.
    pub fn over_tasks(self, run: &Record, split: Split, tasks: &[String]) -> Option<f64> {
        let all: Option<Vec<f64>> = tasks.iter().map(|task| self.at_the_end(run, split, task)).collect();
        all.filter(|all| !all.is_empty()).map(|all| rit_statistics::mean(&all))
    }

    /// A run's learning curve, by environment steps: each task's value, where all were measured.
    pub fn curve(self, run: &Record, split: Split, tasks: &[String]) -> BTreeMap<u64, Vec<f64>> {
        let point = |(env_steps, evaluation): (u64, &rit_record::Evaluation)| {
            let values = tasks.iter().map(|task| self.of(evaluation.tasks.get(task)?));
            Some((env_steps, values.collect::<Option<Vec<_>>>()?))
        };
        run.curve(split).into_iter().filter_map(point).collect()
    }
}

/// A number with a real minus sign; nothing is minus nought.
pub fn signed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(digits) if digits.bytes().all(|digit| digit == b'0' || digit == b'.') => digits.to_owned(),
        Some(digits) => format!("−{digits}"),
        None => text,
    }
}
