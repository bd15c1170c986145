//! Statistics against tables computed by hand, and against printed tables of Student's t.

use rit_episode::{RunSeed, Stream};
use rit_statistics::{
    Estimate, Scores, Spans, aggregates, correlation, generalisation_gap, improvement, improvement_estimate,
    interquartile_mean, iqm, mean, median, percentile, profile, silhouette, standard_deviation,
    standard_error, t_interval,
};

fn rng() -> rit_episode::Rng {
    RunSeed(1).stream(Stream::Resampling, 0)
}

#[allow(clippy::unwrap_used, reason = "a table of a test")]
fn scores(rows: &[&[f64]]) -> Scores {
    Scores::new(&rows.iter().map(|row| row.to_vec()).collect::<Vec<_>>()).unwrap()
}

fn near(value: f64, expected: f64) {
    assert!((value - expected).abs() < 1e-9, "{value} is not {expected}");
}

#[test]
fn mean_deviation_and_interval_over_seeds() {
    // 2, 4, 4, 6: mean 4, squares 4 + 0 + 0 + 4, s = √(8/3), s/√4 = 0.8165; t(3) = 3.18245.
    let seeds = [2.0, 4.0, 4.0, 6.0];
    near(mean(&seeds), 4.0);
    near(standard_deviation(&seeds).unwrap(), (8.0_f64 / 3.0).sqrt());
    near(standard_error(&seeds).unwrap(), (2.0_f64 / 3.0).sqrt());
    let interval = t_interval(&seeds).unwrap();
    assert!((interval.high - (4.0 + 3.182_446 * 0.816_497)).abs() < 1e-5, "{interval:?}");
    near(interval.low + interval.high, 8.0);
    // Student's t at 0.975, as tables print it.
    for (count, t) in [(2, 12.706), (3, 4.303), (5, 2.776), (10, 2.262), (31, 2.042)] {
        let seeds: Vec<f64> = (0..count).map(f64::from).collect();
        let half = t_interval(&seeds).unwrap().high - mean(&seeds);
        assert!((half / standard_error(&seeds).unwrap() - t).abs() < 5e-4, "{count} seeds");
    }
    assert_eq!((standard_deviation(&[3.0]), t_interval(&[3.0])), (None, None));
    assert!(mean(&[]).is_nan() && median(&[]).is_nan());
}

#[test]
fn an_interval_ends_where_the_measure_does() {
    // Win rates 1, 1, 1, 0.5: mean 0.875, s = 0.25, s/√4 = 0.125, t(3) = 3.18245: 0.875 ± 0.39781.
    let interval = t_interval(&[1.0, 1.0, 1.0, 0.5]).unwrap();
    assert!((interval.high - 1.272_806).abs() < 1e-5, "{interval:?}");
    let within = interval.within([0.0, 1.0]);
    assert!((within.low - 0.477_194).abs() < 1e-5, "{within:?}");
    near(within.high, 1.0);
    // 0, 0, 0.3: mean 0.1, error 0.1, t(2) = 4.30265.
    let within = t_interval(&[0.0, 0.0, 0.3]).unwrap().within([0.0, 1.0]);
    near(within.low, 0.0);
    assert!((within.high - 0.530_265).abs() < 1e-5, "{within:?}");
}

#[test]
fn percentiles_lie_between_two_values_in_a_straight_line() {
    let values = [10.0, 40.0, 20.0, 30.0];
    for (share, expected) in [(0.0, 10.0), (0.25, 17.5), (0.5, 25.0), (0.9, 37.0), (1.0, 40.0)] {
        near(percentile(&values, share), expected);
    }
    near(percentile(&[7.0], 0.3), 7.0);
}

#[test]
fn the_interquartile_mean_leaves_a_quarter_out_at_either_end() {
    // 8 values: 2 out at either end, mean of 3, 4, 5, 9. 10 values: ⌊2.5⌋ = 2. 3 values: none.
    near(interquartile_mean(&mut [100.0, 3.0, 9.0, 1.0, 4.0, 5.0, 20.0, -50.0]), 5.25);
    near(interquartile_mean(&mut [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 90.0]), 4.5);
    near(interquartile_mean(&mut [1.0, 2.0, 6.0]), 3.0);
}

#[test]
fn scores_are_normalised_task_by_task_over_all_methods() {
    let [first, second] = [scores(&[&[0.0, -30.0, 5.0], &[5.0, -10.0, 5.0]]), scores(&[&[8.0, -20.0, 5.0]])];
    // Along a curve the first task once had 10.
    let spans = Spans::of([&first, &second, &scores(&[&[10.0, -15.0, 5.0]])]);
    // Task 3 is the same everywhere.
    assert_eq!(spans.normalise(&first), scores(&[&[0.0, 0.0, 0.0], &[0.5, 1.0, 0.0]]));
    assert_eq!(spans.normalise(&second), scores(&[&[0.8, 0.5, 0.0]]));
    assert!(Scores::new(&[]).is_none() && Scores::new(&[vec![1.0], vec![1.0, 2.0]]).is_none());
}

#[test]
fn aggregates_by_hand() {
    // Means by task: 0.3, 0.6, 1.1. Sorted: .2 .4 .5 .7 1 1.2, one out at either end: 2.6/4.
    let table = scores(&[&[0.2, 0.5, 1.0], &[0.4, 0.7, 1.2]]);
    let found = aggregates(&table, 2000, &mut rng());
    near(found.iqm.value, 0.65);
    near(found.median.value, 0.6);
    near(found.mean.value, 2.0 / 3.0);
    // 1.2 counts as 1: 1 − 3.8/6.
    near(found.optimality_gap.value, 1.0 - 3.8 / 6.0);
    near(iqm(&table, 10, &mut rng()).value, 0.65);
    // Two runs a task: every replication's mean is one of few, so the interval's ends are known. The mean of a task is
    // its lower score with 1/4, and of all three with 1/64, which is less than 2.5 %: the ends lie a little inside.
    let Estimate { interval, .. } = found.mean;
    assert!(interval.low > 1.7 / 3.0 - 1e-9 && interval.low < 0.64, "{interval:?}");
    assert!(interval.high < 2.3 / 3.0 + 1e-9 && interval.high > 0.69, "{interval:?}");
}

#[test]
fn an_interval_has_the_width_that_theory_gives_it() {
    // One task, 100 runs 0 … 99: a bootstrapped mean has deviation σ/√100 with σ = √((100² − 1)/12) = 28.866.
    let rows: Vec<Vec<f64>> = (0..100).map(|run| vec![f64::from(run)]).collect();
    let found = aggregates(&Scores::new(&rows).unwrap(), 20_000, &mut rng()).mean;
    let half = (found.interval.high - found.interval.low) / 2.0;
    assert!((half / (1.96 * 2.8866) - 1.0).abs() < 0.03, "{half}");
    assert_eq!(
        found,
        aggregates(&Scores::new(&rows).unwrap(), 20_000, &mut rng()).mean,
        "a fact of its stream"
    );
}

#[test]
fn tasks_are_strata() {
    // Runs of a task are all alike: however they are resampled, nothing changes.
    let found = aggregates(&scores(&[&[0.1, 0.9], &[0.1, 0.9]]), 500, &mut rng());
    near(found.mean.interval.low, 0.5);
    near(found.mean.interval.high, 0.5);
}

#[test]
fn a_profile_says_which_share_lies_above() {
    let table = scores(&[&[0.0, 0.5], &[0.5, 1.0]]);
    let shares: Vec<f64> =
        profile(&table, &[-0.1, 0.0, 0.49, 0.5, 1.0], 100, &mut rng()).iter().map(|it| it.value).collect();
    assert_eq!(shares, [1.0, 0.75, 0.75, 0.25, 0.0]);
}

#[test]
fn improvement_counts_pairs_and_halves_draws() {
    // Task 1: (1, 3) against (2, 2): 0 + 0 + 1 + 1 of 4. Task 2: (5, 5) against (5, 4): .5 + 1 + .5 + 1 of 4.
    let (x, y) = (scores(&[&[1.0, 5.0], &[3.0, 5.0]]), scores(&[&[2.0, 5.0], &[2.0, 4.0]]));
    near(improvement(&x, &y), (0.5 + 0.75) / 2.0);
    near(improvement(&y, &x), 1.0 - 0.625);
    let found = improvement_estimate(&x, &y, 500, &mut rng());
    assert!(found.interval.low < 0.625 && found.interval.high > 0.625, "{found:?}");
    // Methods may have another number of runs.
    near(improvement(&x, &scores(&[&[0.0, 9.0]])), 0.5);
}

#[test]
fn gap_and_correlation() {
    near(generalisation_gap(&[0.9, 0.7], &[0.5]), 0.3);
    near(correlation(&[(1.0, 2.0), (2.0, 4.0), (3.0, 6.0)]).unwrap(), 1.0);
    // Deviations (−1, 0, 1) and (0, −1, 1): 1/√(2 · 2).
    near(correlation(&[(1.0, 1.0), (2.0, 0.0), (3.0, 2.0)]).unwrap(), 0.5);
    assert_eq!(correlation(&[(1.0, 1.0), (1.0, 2.0)]), None);
}

#[test]
fn silhouettes_by_hand() {
    // On a line: label 0 at 0 and 1, label 1 at 4 and 6, label 2 alone at 100.
    let points: Vec<Vec<f32>> = [0.0, 1.0, 4.0, 6.0, 100.0].map(|x| vec![x]).to_vec();
    let found = silhouette(&points, &[0, 0, 1, 1, 2]);
    // a = 1, b = (4 + 6)/2; a = 1, b = 4; a = 2, b = 3.5; a = 2, b = 5.5; alone.
    for (found, expected) in found.iter().zip([0.8, 0.75, 1.5 / 3.5, 3.5 / 5.5, 0.0]) {
        near(*found, expected);
    }
    assert_eq!(silhouette(&points[..2], &[0, 0]), [0.0, 0.0]);
}
