//! Episodes that an actor's environments lost: what the learner is told of them, and when the actor gives up.

use rit_env::{FailureKind, rollout::LostEpisode};
use rit_proto::{LOSS_DETAIL_CHARS_MAX, v1};
use std::collections::BTreeMap;

/// The episodes of one lease that were lost.
#[derive(Debug, Default)]
pub(crate) struct Losses {
    by_kind: BTreeMap<FailureKind, v1::Loss>,
    last: Option<LostEpisode>,
}

impl Losses {
    /// Takes note of one, and logs it.
    pub(crate) fn note(&mut self, lost: LostEpisode) {
        let kind = lost.error.kind;
        tracing::warn!(%lost, reason = kind.name(), "an episode is lost");
        let loss = self
            .by_kind
            .entry(kind)
            .or_insert_with(|| v1::Loss { reason: kind.name().to_owned(), ..v1::Loss::default() });
        loss.episodes.push(lost.number);
        loss.detail = format!("{}: {}", lost.task, lost.error).chars().take(LOSS_DETAIL_CHARS_MAX).collect();
        self.last = Some(lost);
    }

    /// As the learner is told.
    pub(crate) fn to_messages(&self) -> Vec<v1::Loss> {
        self.by_kind.values().cloned().collect()
    }
}

/// Leases in a row that brought no episode, because the environments lost all of them.
#[derive(Debug)]
pub(crate) struct LostLeases {
    in_a_row: usize,
    max: usize,
}

impl LostLeases {
    /// After `max` in a row it is time to give up.
    pub(crate) fn new(max: usize) -> Self {
        Self { in_a_row: 0, max }
    }

    /// As many in a row as it takes to give up.
    pub(crate) fn max(&self) -> usize {
        self.max
    }

    /// Takes note of a lease; returns the last loss when it is time to give up.
    pub(crate) fn note(&mut self, losses: Losses, brought_any: bool) -> Option<LostEpisode> {
        self.in_a_row = if brought_any { 0 } else { self.in_a_row + 1 };
        losses.last.filter(|_| self.in_a_row >= self.max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_env::EnvironmentError;

    fn lost(number: u64, kind: FailureKind, detail: &str) -> LostEpisode {
        let error = EnvironmentError::new(kind, detail);
        LostEpisode { number, task: "3m".into(), error }
    }

    #[test]
    fn the_learner_is_told_the_numbers_by_reason_and_the_last_words_of_each() {
        let mut losses = Losses::default();
        losses.note(lost(3, FailureKind::Died, "it crashed"));
        losses.note(lost(4, FailureKind::TimedOut, "no answer"));
        losses.note(lost(5, FailureKind::Died, &"x".repeat(9000)));
        let messages = losses.to_messages();
        let facts: Vec<_> = messages.iter().map(|loss| (loss.reason.as_str(), &loss.episodes[..])).collect();
        assert_eq!(
            facts,
            [("environment_timed_out", [4].as_slice()), ("environment_died", [3, 5].as_slice())]
        );
        assert_eq!(messages[0].detail, "3m: no answer");
        assert_eq!(messages[1].detail.len(), LOSS_DETAIL_CHARS_MAX);
    }

    #[test]
    fn leases_in_a_row_that_bring_nothing_end_it() {
        let losing = || {
            let mut losses = Losses::default();
            (0..8).for_each(|number| losses.note(lost(number, FailureKind::Died, "it crashed")));
            losses
        };
        let mut leases = LostLeases::new(3);
        assert_eq!(leases.note(losing(), false), None);
        assert_eq!(leases.note(losing(), false), None);
        assert_eq!(leases.note(losing(), true), None, "one came after all");
        assert_eq!(leases.note(Losses::default(), true), None);
        assert_eq!(leases.note(losing(), false), None);
        assert_eq!(leases.note(losing(), false), None);
        assert_eq!(leases.note(losing(), false).map(|lost| lost.number), Some(7));
    }
}
