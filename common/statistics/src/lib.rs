//! What is said of several runs: pure functions of numbers.
//!
//! Over seeds: mean, sample standard deviation, 95 % interval of Student's t. Over tasks and seeds: the aggregates of
//! rliable (Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice*, 2021), as marl-eval
//! (Gorsane et al., *Towards a Standardised Performance Evaluation Protocol for Cooperative MARL*, 2022) has them, with
//! percentile intervals of the stratified bootstrap: tasks are strata, within each of which runs are resampled. Of
//! points with labels: the silhouette (Rousseeuw, 1987), and a map of them ([`t_sne`]).
//!
//! What is drawn at random comes from the generator that the caller names.

pub mod shapley;
pub mod t_sne;

use rand::RngExt as _;
use rit_episode::Rng;
use statrs::distribution::{ContinuousCDF as _, StudentsT};

/// How sure the intervals are.
pub const CONFIDENCE: f64 = 0.95;

/// Fewer seeds than this make no interval that one may rely on.
pub const SEEDS_MIN: usize = 5;

/// Where a value lies with [`CONFIDENCE`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// What of it lies in a range. A mean of values that lie there lies there too, so what is cut off holds nothing, and the
    /// interval covers the mean as often as before.
    #[must_use]
    pub fn within(self, [lowest, highest]: [f64; 2]) -> Self {
        Self { low: self.low.clamp(lowest, highest), high: self.high.clamp(lowest, highest) }
    }
}

/// A value and where it lies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Of the runs as they are.
    pub value: f64,
    /// Of runs like them.
    pub interval: Interval,
}

/// The mean; NaN of nothing.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The sample standard deviation, with n − 1; none of fewer than two values.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values);
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// The standard error of the mean, s/√n; none of fewer than two values.
pub fn standard_error(values: &[f64]) -> Option<f64> {
    standard_deviation(values).map(|deviation| deviation / (values.len() as f64).sqrt())
}

/// The mean's interval after Student: mean ± t(n − 1) · s/√n; none of fewer than two values.
pub fn t_interval(values: &[f64]) -> Option<Interval> {
    let error = standard_error(values)?;
    let t = StudentsT::new(0.0, 1.0, (values.len() - 1) as f64).ok()?.inverse_cdf(0.5 + CONFIDENCE / 2.0);
    let mean = mean(values);
    Some(Interval { low: mean - t * error, high: mean + t * error })
}

/// The value below which this share of all values lies, between two of them in a straight line, as NumPy has it; NaN of
/// nothing.
pub fn percentile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    percentile_of_sorted(&sorted, share)
}

fn percentile_of_sorted(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let place = share * last as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (place - below as f64)
}

/// The median; NaN of nothing.
pub fn median(values: &[f64]) -> f64 {
    percentile(values, 0.5)
}

/// The mean of the middle half: a quarter of the values, rounded down, is left out at either end (Agarwal et al., section
/// 4.3; `scipy.stats.trim_mean`). The values are put into another order. NaN of nothing.
pub fn interquartile_mean(values: &mut [f64]) -> f64 {
    let (count, cut) = (values.len(), values.len() / 4);
    if cut > 0 {
        values.select_nth_unstable_by(cut, f64::total_cmp);
        values[cut..].select_nth_unstable_by(count - 2 * cut - 1, f64::total_cmp);
    }
    mean(&values[cut..count - cut])
}

/// Scores of one method: a row for each run, a column for each task.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// `[task][run]`, one after another.
    by_task: Vec<f64>,
    runs: usize,
}

impl Scores {
    /// Of `[run][task]`; none where runs have another number of tasks, or there is nothing.
    pub fn new(rows: &[Vec<f64>]) -> Option<Self> {
        let tasks = rows.first()?.len();
        if tasks == 0 || rows.iter().any(|row| row.len() != tasks) {
            return None;
        }
        let by_task = (0..tasks).flat_map(|task| rows.iter().map(move |row| row[task])).collect();
        Some(Self { by_task, runs: rows.len() })
    }

    /// Number of runs.
    pub fn runs(&self) -> usize {
        self.runs
    }

    /// Each task's scores, by run.
    pub fn tasks(&self) -> impl Iterator<Item = &[f64]> {
        self.by_task.chunks_exact(self.runs)
    }

    /// All scores.
    pub fn all(&self) -> &[f64] {
        &self.by_task
    }

    /// Every score by this function of its task and itself.
    #[must_use]
    pub fn map(&self, mut of: impl FnMut(usize, f64) -> f64) -> Self {
        let by_task = self.by_task.iter().enumerate().map(|(at, &score)| of(at / self.runs, score));
        Self { by_task: by_task.collect(), runs: self.runs }
    }

    /// Mean over tasks and runs.
    pub fn mean(&self) -> f64 {
        mean(&self.by_task)
    }

    /// Median over tasks of the mean over runs.
    pub fn median(&self) -> f64 {
        median(&self.tasks().map(mean).collect::<Vec<_>>())
    }

    /// How far scores fall short of 1 on average; what lies above 1 counts as 1.
    pub fn optimality_gap(&self) -> f64 {
        1.0 - self.by_task.iter().map(|score| score.min(1.0)).sum::<f64>() / self.by_task.len() as f64
    }

    /// Scores of as many runs, drawn with replacement within each task.
    fn resample(&self, into: &mut Self, rng: &mut Rng) {
        for (from, to) in self.tasks().zip(into.by_task.chunks_exact_mut(into.runs)) {
            to.fill_with(|| from[rng.random_range(0..from.len())]);
        }
    }
}

/// Each task's lowest and highest score of all that was ever measured: along the curves of all methods and at their ends.
#[derive(Clone, Debug, PartialEq)]
pub struct Spans(Vec<Interval>);

impl Spans {
    /// Of these scores; none of nothing.
    pub fn of<'a>(measured: impl IntoIterator<Item = &'a Scores>) -> Self {
        let mut spans: Vec<Interval> = Vec::new();
        for scores in measured {
            let nothing = Interval { low: f64::INFINITY, high: f64::NEG_INFINITY };
            spans.resize(spans.len().max(scores.by_task.len() / scores.runs), nothing);
            for (span, of_task) in spans.iter_mut().zip(scores.tasks()) {
                span.low = of_task.iter().copied().fold(span.low, f64::min);
                span.high = of_task.iter().copied().fold(span.high, f64::max);
            }
        }
        Self(spans)
    }

    /// Scores from 0, the lowest of their task, to 1, the highest. Where all are the same there is nothing to tell apart:
    /// 0, as marl-eval has it.
    pub fn normalise(&self, scores: &Scores) -> Scores {
        scores.map(|task, score| match self.0.get(task) {
            Some(span) if span.high > span.low => (score - span.low) / (span.high - span.low),
            _ => 0.0,
        })
    }
}

/// The aggregates over tasks and runs of normalised scores (Agarwal et al., section 4.3).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aggregates {
    /// Interquartile mean over all of them.
    pub iqm: Estimate,
    /// [`Scores::median`].
    pub median: Estimate,
    /// [`Scores::mean`].
    pub mean: Estimate,
    /// [`Scores::optimality_gap`].
    pub optimality_gap: Estimate,
}

/// All aggregates, their intervals from the same replications.
pub fn aggregates(scores: &Scores, replications: usize, rng: &mut Rng) -> Aggregates {
    // The interquartile mean puts scores into another order, so it comes last.
    let statistic = |scores: &mut Scores| {
        let [median, mean, gap] = [scores.median(), scores.mean(), scores.optimality_gap()];
        [median, mean, gap, interquartile_mean(&mut scores.by_task)]
    };
    let [median, mean, optimality_gap, iqm] = bootstrap(scores, replications, rng, statistic);
    Aggregates { iqm, median, mean, optimality_gap }
}

/// The interquartile mean alone, as along a curve.
pub fn iqm(scores: &Scores, replications: usize, rng: &mut Rng) -> Estimate {
    let [iqm] = bootstrap(scores, replications, rng, |scores| [interquartile_mean(&mut scores.by_task)]);
    iqm
}

/// The performance profile: at each threshold the share of scores above it (Agarwal et al., section 4.2).
pub fn profile(scores: &Scores, thresholds: &[f64], replications: usize, rng: &mut Rng) -> Vec<Estimate> {
    let shares = |scores: &mut Scores| {
        scores.by_task.sort_unstable_by(f64::total_cmp);
        let sorted = &scores.by_task;
        let above = |&threshold: &f64| sorted.len() - sorted.partition_point(|&score| score <= threshold);
        thresholds.iter().map(|threshold| above(threshold) as f64 / sorted.len() as f64).collect::<Vec<_>>()
    };
    let mut drawn = scores.clone();
    let values = shares(&mut drawn.clone());
    let mut replicas: Vec<Vec<f64>> = vec![Vec::with_capacity(replications); thresholds.len()];
    for _ in 0..replications {
        scores.resample(&mut drawn, rng);
        for (replicas, share) in replicas.iter_mut().zip(shares(&mut drawn)) {
            replicas.push(share);
        }
    }
    values.into_iter().zip(replicas).map(|(value, replicas)| estimate(value, replicas)).collect()
}

/// How probably a run of the first method is better than one of the second, on a task picked at random; a draw counts
/// half (Agarwal et al., section 4.4: the mean over tasks of Mann and Whitney's U).
pub fn improvement(first: &Scores, second: &Scores) -> f64 {
    let of_task = |(first, second): (&[f64], &[f64])| {
        let pairs = first.iter().flat_map(|x| second.iter().map(move |y| (x, y)));
        let wins: f64 = pairs
            .map(|(x, y)| {
                if x > y {
                    1.0
                } else if x == y {
                    0.5
                } else {
                    0.0
                }
            })
            .sum();
        wins / (first.len() * second.len()) as f64
    };
    mean(&first.tasks().zip(second.tasks()).map(of_task).collect::<Vec<_>>())
}

/// [`improvement`] with its interval: both methods' runs are resampled, each for itself.
pub fn improvement_estimate(first: &Scores, second: &Scores, replications: usize, rng: &mut Rng) -> Estimate {
    let (mut x, mut y) = (first.clone(), second.clone());
    let replicas = (0..replications).map(|_| {
        first.resample(&mut x, rng);
        second.resample(&mut y, rng);
        improvement(&x, &y)
    });
    let replicas = replicas.collect();
    estimate(improvement(first, second), replicas)
}

/// Statistics of the scores, and between which percentiles they lie in replications.
fn bootstrap<const N: usize>(
    scores: &Scores,
    replications: usize,
    rng: &mut Rng,
    statistic: impl Fn(&mut Scores) -> [f64; N],
) -> [Estimate; N] {
    let mut drawn = scores.clone();
    let values = statistic(&mut drawn);
    let mut replicas: [Vec<f64>; N] = std::array::from_fn(|_| Vec::with_capacity(replications));
    for _ in 0..replications {
        scores.resample(&mut drawn, rng);
        for (replicas, value) in replicas.iter_mut().zip(statistic(&mut drawn)) {
            replicas.push(value);
        }
    }
    std::array::from_fn(|at| estimate(values[at], std::mem::take(&mut replicas[at])))
}

fn estimate(value: f64, mut replicas: Vec<f64>) -> Estimate {
    replicas.sort_unstable_by(f64::total_cmp);
    let tail = (1.0 - CONFIDENCE) / 2.0;
    let [low, high] = [tail, 1.0 - tail].map(|share| percentile_of_sorted(&replicas, share));
    Estimate { value, interval: Interval { low, high } }
}

/// What the mean over tasks that a run was trained on has above that over tasks it has never seen.
pub fn generalisation_gap(seen: &[f64], unseen: &[f64]) -> f64 {
    mean(seen) - mean(unseen)
}

/// Pearson's correlation; none of fewer than two pairs, or where one side does not vary.
pub fn correlation(pairs: &[(f64, f64)]) -> Option<f64> {
    let (xs, ys): (Vec<f64>, Vec<f64>) = pairs.iter().copied().unzip();
    let (x, y) = (mean(&xs), mean(&ys));
    let sum = |of: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|&(a, b)| of(a - x, b - y)).sum::<f64>();
    let spread = (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt();
    (pairs.len() > 1 && spread > 0.0).then(|| sum(&|a, b| a * b) / spread)
}

/// How much nearer each point lies to its own label's points than to those of the nearest other label, from −1 to 1:
/// (b − a)/max(a, b), by Euclidean distances (Rousseeuw, 1987). 0 for a point whose label has no other, or where there
/// is one label alone.
pub fn silhouette(points: &[Vec<f32>], labels: &[usize]) -> Vec<f64> {
    let kinds = labels.iter().max().map_or(0, |&label| label + 1);
    let mut sizes = vec![0_usize; kinds];
    labels.iter().for_each(|&label| sizes[label] += 1);
    let of_point = |(at, point): (usize, &Vec<f32>)| {
        let mut sums = vec![0.0; kinds];
        points.iter().zip(labels).for_each(|(other, &label)| sums[label] += distance(point, other));
        let own = labels[at];
        let others = (0..kinds).filter(|&label| label != own && sizes[label] > 0);
        let nearest = others.map(|label| sums[label] / sizes[label] as f64).fold(f64::INFINITY, f64::min);
        if sizes[own] < 2 || nearest.is_infinite() {
            return 0.0;
        }
        let within = sums[own] / (sizes[own] - 1) as f64;
        let larger = within.max(nearest);
        if larger > 0.0 { (nearest - within) / larger } else { 0.0 }
    };
    points.iter().enumerate().map(of_point).collect()
}

/// Euclidean distance.
pub fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt()
}
