//! Replay: the last `buffer_size` episodes, sampled uniformly.

use rand::seq::index;
use rit_episode::{Episode, Rng};
use std::{collections::VecDeque, sync::Arc};

/// The last episodes, oldest first, real rows only. The thread that writes them to disk shares them.
#[derive(Debug)]
pub struct Replay {
    episodes: VecDeque<Arc<Episode>>,
    capacity: usize,
}

impl Replay {
    /// An empty replay of this many episodes at most.
    pub fn new(capacity: usize) -> Self {
        Self { episodes: VecDeque::with_capacity(capacity), capacity }
    }

    /// Puts an episode after the others; the oldest goes when there is no room.
    pub fn insert(&mut self, episode: Arc<Episode>) {
        if self.episodes.len() == self.capacity {
            self.episodes.pop_front();
        }
        self.episodes.push_back(episode);
    }

    /// Episodes it holds.
    pub fn len(&self) -> usize {
        self.episodes.len()
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.episodes.is_empty()
    }

    /// So many different episodes, every choice equally likely.
    ///
    /// # Panics
    /// When it holds fewer.
    pub fn sample(&self, count: usize, rng: &mut Rng) -> Vec<&Episode> {
        index::sample(rng, self.len(), count).iter().map(|index| &*self.episodes[index]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_episode::{End, RunSeed, Stream};
    use std::collections::HashSet;

    fn episode(number: u64) -> Episode {
        Episode {
            number,
            weights_version: 0,
            task: 0,
            n_agents: 0,
            n_entities: 0,
            decision_order: vec![],
            entities: vec![],
            observable: vec![],
            available: vec![],
            actions: vec![],
            rewards: vec![],
            shaping: vec![],
            end: End::Terminated,
            won: false,
        }
    }

    #[test]
    fn keeps_the_last_and_samples_them_evenly() {
        let mut replay = Replay::new(5);
        for number in 0..8 {
            replay.insert(Arc::new(episode(number)));
        }
        let mut counts = [0; 8];
        for update in 0..2000 {
            let rng = &mut RunSeed(1).stream(Stream::Replay, update);
            let numbers: HashSet<_> = replay.sample(2, rng).iter().map(|episode| episode.number).collect();
            assert_eq!(numbers.len(), 2, "different episodes");
            numbers.into_iter().for_each(|number| counts[number as usize] += 1);
        }
        assert_eq!(counts[..3], [0; 3]);
        // 800 of each expected, standard deviation 22.
        assert!(counts[3..].iter().all(|count| (690..910).contains(count)), "{counts:?}");
    }
}
