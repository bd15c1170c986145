//! The processor time that a run's processes take: its learner's own, and what actors say of theirs.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
};

/// Milliseconds of processor time by actor process, those that have gone included. For people, never for training.
#[derive(Debug, Default)]
pub struct CpuTime {
    actors: Mutex<BTreeMap<u64, u64>>,
}

impl CpuTime {
    /// The actor process that drew this number at its start has taken so much.
    pub fn note(&self, instance: u64, cpu_ms: u64) {
        let mut actors = self.actors.lock().unwrap_or_else(PoisonError::into_inner);
        let known = actors.entry(instance).or_default();
        // A link that broke may deliver late what was said earlier.
        *known = cpu_ms.max(*known);
    }

    /// Seconds that this learner and its actors have taken.
    pub fn seconds(&self) -> f64 {
        let actors = self.actors.lock().unwrap_or_else(PoisonError::into_inner);
        let actors_ms = actors.values().fold(0_u64, |total, ms| total.saturating_add(*ms));
        rit_record::cpu_seconds() + actors_ms as f64 / 1000.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_process_counts_once_with_its_newest_time() {
        let cpu = CpuTime::default();
        let own = cpu.seconds();
        assert!(own > 0.0 && own < 1e4, "{own}");
        for (instance, cpu_ms) in [(1, 1_000_000), (2, 500_000), (1, 3_000_000), (1, 2_000_000)] {
            cpu.note(instance, cpu_ms);
        }
        let actors = cpu.seconds() - own;
        assert!((3500.0..3600.0).contains(&actors), "{actors}");
        cpu.note(3, u64::MAX);
        assert!(cpu.seconds().is_finite());
    }
}
