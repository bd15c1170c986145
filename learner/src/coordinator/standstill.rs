//! A run that should go on and does not says so, and why.

use super::{Coordinator, State};
use std::time::Duration;

/// Joins without an episode between them that are no accident any more.
const REJOINS: u32 = 3;

impl Coordinator {
    /// Notes that the run goes on: an episode came, or a batch is done.
    pub(super) fn moved(&mut self) {
        self.moved_at = self.now;
        self.joins = 0;
        self.last_loss = None;
        if self.stands_still.take().is_some() {
            self.warned("the run goes on".into());
        }
    }

    /// Why the run stands still, if it does.
    pub fn stands_still(&self) -> Option<&str> {
        self.stands_still.as_deref()
    }

    pub(super) fn look_for_standstill(&mut self) {
        if self.state != State::Running || self.stands_still.is_some() {
            return;
        }
        let still = self.now.saturating_sub(self.moved_at);
        if still >= Duration::from_millis(self.config.learner.stall_timeout_ms) {
            let why = self.why_still();
            self.warned(format!("no step for {} s: {why}", still.as_secs()));
            self.stands_still = Some(why);
        }
    }

    /// Why it stands. Processes of this host say more in their logs.
    fn why_still(&self) -> String {
        let (all, outstanding) = (self.actors.len(), self.ledger.counts().outstanding);
        let hung = self.actors.values().filter(|actor| actor.hung).count();
        if self.batches_in_training > 0 {
            "training is busy with one batch or an evaluation".into()
        } else if let Some(detail) = &self.last_loss {
            format!("environments fail: {detail}")
        } else if self.joins >= REJOINS {
            format!(
                "actors joined {} times and brought nothing; logs/actor-0.log and others say why",
                self.joins
            )
        } else if all == 0 {
            "no actor is there; logs/actor-0.log and others say why".into()
        } else if hung == all {
            format!("no sign of life from any of {all} actors")
        } else if outstanding > 0 {
            format!("{all} actors roll {outstanding} episodes, and none of these arrives")
        } else {
            format!("{all} actors are there, and none of them rolls an episode")
        }
    }
}
