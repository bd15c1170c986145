//! The episode ledger: who rolls which episode with which weights, and in which order episodes enter replay.
//!
//! Episode i belongs to batch i / `n_rollout_threads`. A batch may be rolled once its *terms* are known: the
//! weights version and the ε that a fixed number of updates (`policy_lag`) earlier left. Batches are
//! released to training in order of number, each whole. So what training sees does not depend on which actor
//! rolled what, on how many there are, or on which of them died.
//!
//! Nothing here waits, sends or draws: it is the bookkeeping alone.

use rit_env::FailureKind;
use rit_episode::Episode;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Names an actor for as long as it is there; never used again.
pub type ActorId = u32;

/// What a batch is rolled with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Terms {
    /// Weights, counted in updates.
    pub weights_version: u64,
    /// Probability of a random action.
    pub epsilon: f32,
}

/// Episodes handed to an actor, all of one batch.
#[derive(Clone, Debug, PartialEq)]
pub struct Lease {
    /// Their numbers.
    pub episodes: Vec<u64>,
    /// What they are rolled with.
    pub terms: Terms,
}

/// Why an outstanding episode will not be inserted by the actor that had it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// The actor died.
    ActorGone,
    /// The actor gave no sign of life for too long.
    ActorHung,
    /// The actor says it has sent it, and it is not there: its frame was refused.
    NotArrived,
    /// Its environment could not go on.
    Environment(FailureKind),
    /// The run ended first.
    RunEnded,
}

impl Reason {
    /// A short name for counting.
    pub fn name(self) -> &'static str {
        match self {
            Self::ActorGone => "actor_gone",
            Self::ActorHung => "actor_hung",
            Self::NotArrived => "not_arrived",
            Self::Environment(kind) => kind.name(),
            Self::RunEnded => "run_ended",
        }
    }
}

/// An episode that is not awaited from this actor: a late one of an actor given up, or a forged one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("episode {number} with weights {weights_version} is not outstanding with actor {actor}")]
pub struct NotOutstanding {
    /// Its number.
    pub number: u64,
    /// Its weights.
    pub weights_version: u64,
    /// Who sent it.
    pub actor: ActorId,
}

/// `handed_out = inserted + outstanding + Σ rejected`, at every moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Episodes handed to actors, again and again counted each time.
    pub handed_out: u64,
    /// Episodes that arrived and were taken.
    pub inserted: u64,
    /// Episodes that actors have.
    pub outstanding: u64,
    /// Episodes taken back from actors.
    pub rejected: BTreeMap<Reason, u64>,
}

impl Counts {
    /// Whether every episode handed out is accounted for.
    pub fn balance(&self) -> bool {
        self.handed_out == self.inserted + self.outstanding + self.rejected.values().sum::<u64>()
    }
}

/// The ledger.
#[derive(Debug)]
pub struct Ledger {
    episodes_per_batch: u64,
    /// Terms of the batches from `next_batch` on, as far as they are known.
    terms: VecDeque<Terms>,
    /// The batch that training gets next.
    next_batch: u64,
    /// The smallest number never handed out.
    next_number: u64,
    /// Numbers taken back, to be handed out again before any other.
    returned: BTreeSet<u64>,
    outstanding: BTreeMap<u64, ActorId>,
    /// Arrived episodes of batches that are not whole yet.
    arrived: BTreeMap<u64, Episode>,
    handed_out: u64,
    inserted: u64,
    rejected: BTreeMap<Reason, u64>,
}

impl Ledger {
    /// A ledger of which so many batches are done; the next ones are rolled on `terms`, in order.
    ///
    /// # Panics
    /// When a batch has no episode.
    pub fn new(episodes_per_batch: usize, batches_done: u64, terms: Vec<Terms>) -> Self {
        assert!(episodes_per_batch > 0, "a batch has episodes");
        let episodes_per_batch = episodes_per_batch as u64;
        let done = batches_done * episodes_per_batch;
        Self {
            episodes_per_batch,
            terms: terms.into(),
            next_batch: batches_done,
            next_number: done,
            returned: BTreeSet::new(),
            outstanding: BTreeMap::new(),
            arrived: BTreeMap::new(),
            handed_out: done,
            inserted: done,
            rejected: BTreeMap::new(),
        }
    }

    /// The terms of the first batch that has none yet: training has done with another.
    pub fn open(&mut self, terms: Terms) {
        self.terms.push_back(terms);
    }

    /// Hands up to `limit` episodes of one batch to an actor, the oldest first. `None` while there is none to
    /// hand out.
    pub fn lease(&mut self, actor: ActorId, limit: usize) -> Option<Lease> {
        let first = self.returned.first().copied().unwrap_or(self.next_number);
        let batch = first / self.episodes_per_batch;
        let terms = *self.terms.get((batch - self.next_batch) as usize)?;
        let end = (batch + 1) * self.episodes_per_batch;
        let mut episodes: Vec<u64> = self.returned.range(first..end).copied().take(limit).collect();
        for number in &episodes {
            self.returned.remove(number);
        }
        while episodes.len() < limit && self.next_number < end {
            episodes.push(self.next_number);
            self.next_number += 1;
        }
        if episodes.is_empty() {
            return None;
        }
        self.handed_out += episodes.len() as u64;
        self.outstanding.extend(episodes.iter().map(|&number| (number, actor)));
        Some(Lease { episodes, terms })
    }

    /// Takes an episode that arrived.
    ///
    /// # Errors
    /// When it is not outstanding with this actor on these terms.
    pub fn insert(&mut self, actor: ActorId, episode: Episode) -> Result<(), NotOutstanding> {
        let Episode { number, weights_version, .. } = episode;
        let batch = number / self.episodes_per_batch;
        let terms = batch.checked_sub(self.next_batch).and_then(|ahead| self.terms.get(ahead as usize));
        let as_leased = self.outstanding.get(&number) == Some(&actor)
            && terms.is_some_and(|terms| terms.weights_version == weights_version);
        if !as_leased {
            return Err(NotOutstanding { number, weights_version, actor });
        }
        self.outstanding.remove(&number);
        self.inserted += 1;
        self.arrived.insert(number, episode);
        Ok(())
    }

    /// The next batch in order of number, once it is whole.
    pub fn take_batch(&mut self) -> Option<Vec<Episode>> {
        let end = (self.next_batch + 1) * self.episodes_per_batch;
        let whole = self.arrived.range(..end).count() as u64 == self.episodes_per_batch;
        if !whole {
            return None;
        }
        let later = self.arrived.split_off(&end);
        let batch = std::mem::replace(&mut self.arrived, later);
        self.next_batch += 1;
        self.terms.pop_front();
        Some(batch.into_values().collect())
    }

    /// Takes back what an actor still has, to be handed out again. Returns how many episodes that were.
    pub fn take_back(&mut self, actor: ActorId, reason: Reason) -> usize {
        let numbers: Vec<u64> = self.outstanding_with(actor).collect();
        self.take_back_some(actor, &numbers, reason)
    }

    /// Takes these back, as far as the actor still has them. Returns how many episodes that were.
    pub fn take_back_some(&mut self, actor: ActorId, numbers: &[u64], reason: Reason) -> usize {
        let mut count = 0;
        for number in numbers {
            if self.outstanding.get(number) == Some(&actor) {
                self.outstanding.remove(number);
                self.returned.insert(*number);
                count += 1;
            }
        }
        if count > 0 {
            *self.rejected.entry(reason).or_default() += count as u64;
        }
        count
    }

    /// The numbers an actor has.
    pub fn outstanding_with(&self, actor: ActorId) -> impl Iterator<Item = u64> {
        self.outstanding.iter().filter(move |(_, holder)| **holder == actor).map(|(&number, _)| number)
    }

    /// All counts.
    pub fn counts(&self) -> Counts {
        Counts {
            handed_out: self.handed_out,
            inserted: self.inserted,
            outstanding: self.outstanding.len() as u64,
            rejected: self.rejected.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rit_episode::End;

    fn terms(version: u64) -> Terms {
        Terms { weights_version: version, epsilon: 0.5 }
    }

    fn episode(number: u64, weights_version: u64) -> Episode {
        Episode {
            number,
            weights_version,
            task: 0,
            n_agents: 1,
            n_entities: 1,
            decision_order: vec![0],
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

    fn numbers(batch: Option<Vec<Episode>>) -> Option<Vec<u64>> {
        batch.map(|batch| batch.iter().map(|episode| episode.number).collect())
    }

    #[test]
    fn a_batch_waits_for_its_terms_and_for_all_its_episodes() {
        let mut ledger = Ledger::new(2, 0, vec![terms(0); 2]);
        let lease =
            |ledger: &mut Ledger, actor, limit| ledger.lease(actor, limit).map(|lease| lease.episodes);
        // Batches 0 and 1 are open: a lag of one.
        assert_eq!(lease(&mut ledger, 1, 1), Some(vec![0]));
        assert_eq!(lease(&mut ledger, 2, 9), Some(vec![1]), "a lease stays within one batch");
        assert_eq!(lease(&mut ledger, 1, 9), Some(vec![2, 3]));
        assert_eq!(lease(&mut ledger, 1, 9), None, "batch 2 has no terms yet");
        ledger.insert(1, episode(3, 0)).unwrap();
        ledger.insert(2, episode(1, 0)).unwrap();
        assert_eq!(ledger.take_batch(), None);
        ledger.insert(1, episode(0, 0)).unwrap();
        assert_eq!(numbers(ledger.take_batch()), Some(vec![0, 1]));
        assert_eq!(ledger.take_batch(), None);
        ledger.open(terms(1));
        assert_eq!(ledger.lease(2, 9), Some(Lease { episodes: vec![4, 5], terms: terms(1) }));
        ledger.insert(1, episode(2, 0)).unwrap();
        assert_eq!(numbers(ledger.take_batch()), Some(vec![2, 3]));
    }

    #[test]
    fn what_a_dead_actor_had_goes_to_another_first() {
        let mut ledger = Ledger::new(4, 0, vec![terms(7)]);
        ledger.lease(1, 3);
        ledger.insert(1, episode(1, 7)).unwrap();
        assert_eq!(ledger.take_back(1, Reason::ActorGone), 2);
        assert_eq!(ledger.lease(2, 9).unwrap().episodes, [0, 2, 3]);
        // The dead one's frame arrives after all: refused, and the other's is taken.
        assert!(ledger.insert(1, episode(0, 7)).is_err());
        ledger.insert(2, episode(0, 7)).unwrap();
        let counts = ledger.counts();
        assert!(counts.balance());
        assert_eq!((counts.handed_out, counts.inserted, counts.outstanding), (6, 2, 2));
        assert_eq!(counts.rejected, BTreeMap::from([(Reason::ActorGone, 2)]));
    }

    #[test]
    fn what_an_environment_lost_is_handed_out_again_under_its_reason() {
        let mut ledger = Ledger::new(4, 0, vec![terms(7)]);
        ledger.lease(1, 3);
        ledger.lease(2, 1);
        let reason = Reason::Environment(FailureKind::Died);
        // Another actor's, and one that no actor has, stay where they are.
        assert_eq!(ledger.take_back_some(1, &[0, 2, 2, 3, 9], reason), 2);
        assert_eq!(ledger.lease(1, 9).unwrap().episodes, [0, 2]);
        let counts = ledger.counts();
        assert!(counts.balance());
        assert_eq!((counts.handed_out, counts.outstanding), (6, 4));
        assert_eq!(counts.rejected, BTreeMap::from([(reason, 2)]));
        assert_eq!(reason.name(), "environment_died");
    }

    #[test]
    fn a_ledger_continues_after_what_is_done() {
        let mut ledger = Ledger::new(2, 5, vec![terms(4), terms(5)]);
        assert_eq!(ledger.lease(1, 9), Some(Lease { episodes: vec![10, 11], terms: terms(4) }));
        assert_eq!(ledger.lease(1, 9), Some(Lease { episodes: vec![12, 13], terms: terms(5) }));
        assert_eq!(ledger.lease(1, 9), None);
        assert!(ledger.insert(1, episode(9, 4)).is_err(), "done already");
        ledger.insert(1, episode(11, 4)).unwrap();
        ledger.insert(1, episode(10, 4)).unwrap();
        assert_eq!(numbers(ledger.take_batch()), Some(vec![10, 11]));
        assert!(ledger.counts().balance());
    }

    #[test]
    fn what_is_not_outstanding_is_refused() {
        let mut ledger = Ledger::new(2, 0, vec![terms(3)]);
        ledger.lease(1, 1);
        assert!(ledger.insert(2, episode(0, 3)).is_err(), "another actor's");
        assert!(ledger.insert(1, episode(0, 2)).is_err(), "other weights");
        assert!(ledger.insert(1, episode(1, 3)).is_err(), "never handed out");
        assert!(ledger.insert(1, episode(u64::MAX, 3)).is_err(), "far beyond");
        ledger.insert(1, episode(0, 3)).unwrap();
        assert!(ledger.insert(1, episode(0, 3)).is_err(), "twice");
        ledger.lease(1, 1);
        ledger.insert(1, episode(1, 3)).unwrap();
        ledger.take_batch().unwrap();
        assert!(ledger.insert(1, episode(0, 3)).is_err(), "of a batch long gone");
        assert!(ledger.counts().balance());
    }

    /// What may happen to a run, as small numbers that choose among what is possible then.
    #[derive(Clone, Debug)]
    enum Happens {
        Lease { actor: ActorId, limit: usize },
        Arrive { which: usize },
        Die { actor: ActorId },
        Train,
    }

    fn happens() -> impl Strategy<Value = Happens> {
        prop_oneof![
            3 => (0..4_u32, 1..6_usize).prop_map(|(actor, limit)| Happens::Lease { actor, limit }),
            6 => (0..100_usize).prop_map(|which| Happens::Arrive { which }),
            1 => (0..4_u32).prop_map(|actor| Happens::Die { actor }),
            2 => Just(Happens::Train),
        ]
    }

    proptest! {
        /// In whichever order things happen, every number enters training exactly once, in order, with the
        /// version its batch was given, and the counts balance.
        #[test]
        fn every_episode_enters_exactly_once_and_in_order(
            size in 1..5_usize,
            lag in 0..3_usize,
            course in prop::collection::vec(happens(), 0..300),
        ) {
            let mut ledger = Ledger::new(size, 0, vec![terms(0); lag + 1]);
            let mut rolling: Vec<(ActorId, u64, u64)> = vec![];
            let (mut next, mut version) = (0, 0);
            for event in course {
                match event {
                    Happens::Lease { actor, limit } => {
                        if let Some(lease) = ledger.lease(actor, limit) {
                            prop_assert!(lease.episodes.len() <= limit);
                            for number in lease.episodes {
                                let batch = number / size as u64;
                                prop_assert_eq!(lease.terms.weights_version, batch.saturating_sub(lag as u64));
                                rolling.push((actor, number, lease.terms.weights_version));
                            }
                        }
                    }
                    Happens::Arrive { which } if !rolling.is_empty() => {
                        let (actor, number, version) = rolling.swap_remove(which % rolling.len());
                        prop_assert!(ledger.insert(actor, episode(number, version)).is_ok());
                    }
                    Happens::Arrive { .. } => {}
                    Happens::Die { actor } => {
                        let had = rolling.iter().filter(|(holder, ..)| *holder == actor).count();
                        rolling.retain(|(holder, ..)| *holder != actor);
                        prop_assert_eq!(ledger.take_back(actor, Reason::ActorGone), had);
                    }
                    Happens::Train => {
                        if let Some(batch) = ledger.take_batch() {
                            for episode in &batch {
                                prop_assert_eq!(episode.number, next);
                                next += 1;
                            }
                            prop_assert_eq!(batch.len(), size);
                            version += 1;
                            ledger.open(terms(version));
                        }
                    }
                }
                let counts = ledger.counts();
                prop_assert!(counts.balance());
                prop_assert_eq!(counts.outstanding as usize, rolling.len());
            }
        }
    }
}
