//! Shards of a batch, and sums over them.
//!
//! A batch is cut into a fixed number of shards, which is part of the result; threads, which are not, work on them. Sums
//! over shards are taken in a binary tree over their indices: ((0 + 1) + (2 + 3)) + …, so that several hosts that hold
//! aligned ranges of shards can share a batch and get the same bits.

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder, prelude::*};
use rit_nn::{Stock, math, vectorized};
use std::{
    ops::Range,
    sync::{Mutex, PoisonError},
};

/// Threads for an update.
pub(crate) fn pool(threads: usize) -> Result<ThreadPool, ThreadPoolBuildError> {
    ThreadPoolBuilder::new()
        .num_threads(threads.max(1))
        .thread_name(|index| format!("update-{index}"))
        .build()
}

/// The elements of a batch that a shard holds.
pub(crate) fn part(len: usize, shards: usize, shard: usize) -> Range<usize> {
    let share = len.div_ceil(shards).max(1);
    (shard * share).min(len)..((shard + 1) * share).min(len)
}

/// What a thread needs while it works on a shard, whichever that is.
#[derive(Default)]
pub(crate) struct Worker {
    /// Of the online network's tape.
    pub(crate) online: Stock,
    /// Of the target network's.
    pub(crate) target: Stock,
}

/// As many workers as threads have worked at once.
#[derive(Default)]
pub(crate) struct Workers(Mutex<Vec<Worker>>);

impl Workers {
    pub(crate) fn with<T>(&self, work: impl FnOnce(&mut Worker) -> T) -> T {
        // Nothing that could panic happens under the lock.
        let idle = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = idle().pop();
        let mut worker = taken.unwrap_or_default();
        let result = work(&mut worker);
        idle().push(worker);
        result
    }
}

/// Numbers that shards sum: one of each loss.
pub type Sums = Vec<f64>;

/// Sums of the shards' numbers, element by element.
pub fn tree_sum_f64(shards: &[Sums]) -> Sums {
    match shards {
        [] => Sums::new(),
        [one] => one.clone(),
        _ => {
            let (left, right) = shards.split_at(half(shards.len()));
            let (left, right) = (tree_sum_f64(left), tree_sum_f64(right));
            left.iter().zip(&right).map(|(a, b)| a + b).collect()
        }
    }
}

/// Writes the sum of the shards' vectors, of its own length each.
pub fn tree_sum(sums: &mut [f32], shards: &[&[f32]]) {
    /// A part of the sum that stays in the cache.
    const PART: usize = 1 << 13;
    sums.par_chunks_mut(PART).enumerate().for_each(|(index, sums)| {
        let part = index * PART..index * PART + sums.len();
        tree_sum_part(sums, shards, &part);
    });
}

fn tree_sum_part(sums: &mut [f32], shards: &[&[f32]], part: &Range<usize>) {
    match shards {
        [] => sums.fill(0.0),
        [one] => sums.copy_from_slice(&one[part.clone()]),
        [one, other] => add_both(sums, &one[part.clone()], &other[part.clone()]),
        _ => {
            let (left, right) = shards.split_at(half(shards.len()));
            let mut of_right = vec![0.0; sums.len()];
            tree_sum_part(sums, left, part);
            tree_sum_part(&mut of_right, right, part);
            add(sums, &of_right);
        }
    }
}

/// How many of the shards the left branch holds: the largest power of two below all.
fn half(shards: usize) -> usize {
    shards.next_power_of_two() / 2
}

vectorized! {
    fn add<'a>(sums: &'a mut [f32], part: &'a [f32]) {
        math::add_scaled(sums, 1.0, part);
    }
}

vectorized! {
    fn add_both<'a>(sums: &'a mut [f32], one: &'a [f32], other: &'a [f32]) {
        for (sum, (one, other)) in sums.iter_mut().zip(one.iter().zip(other)) {
            *sum = one + other;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_is_cut_into_parts_that_cover_it() {
        let parts = |len, shards| (0..shards).map(|shard| part(len, shards, shard)).collect::<Vec<_>>();
        assert_eq!(parts(5, 2), [0..3, 3..5]);
        assert_eq!(parts(2, 3), [0..1, 1..2, 2..2]);
        assert_eq!(parts(0, 2), [0..0, 0..0]);
    }

    /// In f32 the order of a sum shows: 1 is lost beside 2^24, and 1 + 1 is not.
    #[test]
    fn sums_follow_the_tree() {
        let large = (1 << 24) as f32;
        let sum = |values: &[f32]| {
            let shards: Vec<[f32; 1]> = values.iter().map(|&value| [value]).collect();
            let shards: Vec<&[f32]> = shards.iter().map(|shard| &shard[..]).collect();
            let mut sums = [f32::NAN];
            tree_sum(&mut sums, &shards);
            sums[0]
        };
        assert_eq!(sum(&[]), 0.0);
        assert_eq!(sum(&[3.0]), 3.0);
        // (large + 1) + (1 + 1), not ((large + 1) + 1) + 1.
        assert_eq!(sum(&[large, 1.0, 1.0, 1.0]), large + 2.0);
        // ((large + 1) + (1 + 1)) + (1 + 1).
        assert_eq!(sum(&[large, 1.0, 1.0, 1.0, 1.0, 1.0]), large + 4.0);
    }

    #[test]
    fn aligned_halves_sum_to_the_same_bits() {
        let shards: Vec<Vec<f32>> = (0..8).map(|seed| rit_nn::gradcheck::noise(seed, 20_000)).collect();
        let views: Vec<&[f32]> = shards.iter().map(|shard| &shard[..]).collect();
        let sum = |views: &[&[f32]]| {
            let mut sums = vec![0.0; 20_000];
            tree_sum(&mut sums, views);
            sums
        };
        let (left, right) = (sum(&views[..4]), sum(&views[4..]));
        assert_eq!(sum(&views), sum(&[&left, &right]));
    }

    #[test]
    fn losses_sum_in_the_same_tree() {
        let large = 2_f64.powi(53);
        let sums = tree_sum_f64(&[vec![large, 1.0], vec![1.0, 2.0], vec![1.0, 3.0], vec![1.0, 4.0]]);
        assert_eq!(sums, [large + 2.0, 10.0]);
    }
}
