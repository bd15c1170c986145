//! What is known of the run that is watched.

use rit_proto::v1::{Happening, Measure, MetricsLine, RunStatus};
use std::collections::VecDeque;

/// Lines of metrics that curves go back.
pub const HISTORY: usize = 60;

/// A number over the last lines of metrics.
#[derive(Debug)]
pub struct Curve {
    pub name: String,
    pub values: VecDeque<f64>,
}

impl Curve {
    fn new(name: &str) -> Self {
        Self { name: name.to_owned(), values: VecDeque::with_capacity(HISTORY) }
    }

    fn push(&mut self, value: f64) {
        if self.values.len() == HISTORY {
            self.values.pop_front();
        }
        self.values.push_back(value);
    }

    /// The last values as a row of blocks, from the lowest of them to the highest.
    pub fn sparkline(&self, width: usize) -> String {
        const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
        let shown = self.values.iter().skip(self.values.len().saturating_sub(width));
        let low = shown.clone().copied().fold(f64::INFINITY, f64::min);
        let high = shown.clone().copied().fold(f64::NEG_INFINITY, f64::max);
        let scale = if high > low { 7.0 / (high - low) } else { 0.0 };
        // The cast saturates: a number that is none is drawn low.
        shown.map(|value| BLOCKS[(((value - low) * scale).round() as usize).min(7)]).collect()
    }
}

/// The run, as far as it is known.
#[derive(Debug)]
pub struct Model {
    pub name: String,
    pub status: RunStatus,
    /// Whether its learner is away.
    pub away: bool,
    /// Of what the run's updates report, in the order in which it came.
    pub curves: Vec<Curve>,
    /// Of all learners that were watched, the newest last.
    pub happenings: VecDeque<Happening>,
    /// How many there ever were.
    pub happened: usize,
    /// Happenings of the present learner that are known, by their time.
    known_until_s: f64,
    next_env_steps: u64,
}

impl Model {
    /// Nothing is known yet.
    pub fn new(name: String) -> Self {
        Self {
            name,
            status: RunStatus::default(),
            away: false,
            curves: Vec::new(),
            happenings: VecDeque::new(),
            happened: 0,
            known_until_s: f64::NEG_INFINITY,
            next_env_steps: 0,
        }
    }

    /// Where lines of metrics are not known yet, in environment steps.
    pub fn next_env_steps(&self) -> u64 {
        self.next_env_steps
    }

    /// Takes a line of metrics in.
    pub fn line(&mut self, line: &MetricsLine) {
        self.next_env_steps = self.next_env_steps.max(line.env_steps + 1);
        let Some(training) = &line.training else { return };
        for Measure { name, value, .. } in &training.measures {
            let known = self.curves.iter().position(|curve| curve.name == *name);
            let index = known.unwrap_or_else(|| {
                self.curves.push(Curve::new(name));
                self.curves.len() - 1
            });
            self.curves[index].push(*value);
        }
    }

    /// Takes a status in.
    pub fn status(&mut self, status: RunStatus) {
        if status.pid != self.status.pid {
            self.known_until_s = f64::NEG_INFINITY;
        }
        for happening in &status.happenings {
            if happening.wall_s > self.known_until_s {
                self.known_until_s = happening.wall_s;
                self.happened(happening.clone());
            }
        }
        (self.status, self.away) = (status, false);
    }

    /// The learner has gone.
    pub fn lost(&mut self) {
        if !std::mem::replace(&mut self.away, true) {
            let (wall_s, env_steps) = (self.status.wall_s, self.status.env_steps);
            let what = "the learner has gone; waiting for it to come back".to_owned();
            self.happened(Happening { wall_s, env_steps, what, warning: false });
        }
    }

    fn happened(&mut self, happening: Happening) {
        if self.happenings.len() == HISTORY {
            self.happenings.pop_front();
        }
        self.happenings.push_back(happening);
        self.happened += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_proto::v1::Training;

    #[test]
    fn curves_show_the_last_values_between_their_extremes() {
        let mut curve = Curve::new("loss");
        assert_eq!(curve.sparkline(10), "");
        [100.0, -7.0, 0.0, -3.5, -7.0].into_iter().for_each(|value| curve.push(value));
        assert_eq!(curve.sparkline(4), "▁█▅▁");
        assert_eq!(curve.sparkline(9), "█▁▁▁▁");
        assert_eq!(curve.sparkline(1), "▁");
        curve.push(f64::NAN);
        assert_eq!(curve.sparkline(2), "▁▁");
    }

    #[test]
    fn a_restarted_learner_repeats_nothing() {
        let happening = |wall_s, what: &str| Happening { wall_s, what: what.into(), ..Happening::default() };
        let status = |pid, happenings| RunStatus { pid, happenings, ..RunStatus::default() };
        let mut model = Model::new("run".into());
        model.status(status(1, vec![happening(1.0, "a")]));
        model.status(status(1, vec![happening(1.0, "a"), happening(2.0, "b")]));
        model.lost();
        model.lost();
        model.status(status(2, vec![happening(0.5, "c")]));
        let what: Vec<_> = model.happenings.iter().map(|happening| happening.what.as_str()).collect();
        assert_eq!(what, ["a", "b", "the learner has gone; waiting for it to come back", "c"]);

        let measure = |value| Measure { name: "td_loss".into(), value, ..Measure::default() };
        let line = |env_steps| MetricsLine {
            env_steps,
            training: Some(Training { measures: vec![measure(env_steps as f64)], ..Training::default() }),
            ..MetricsLine::default()
        };
        model.line(&line(10));
        model.line(&MetricsLine { env_steps: 12, ..MetricsLine::default() });
        assert_eq!((model.next_env_steps(), model.curves[0].values.len()), (13, 1));
    }
}
