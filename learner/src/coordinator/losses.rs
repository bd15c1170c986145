//! Episodes that an actor's environments lost: counted by their reason, said, and handed out again.

use super::{Actor, Coordinator, Effect};
use crate::ledger::{ActorId, Reason};
use rit_env::FailureKind;

/// Episodes of a lease that were lost for one reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Loss {
    /// The reason.
    pub kind: FailureKind,
    /// Their numbers.
    pub episodes: Vec<u64>,
    /// What happened to the last of them, in words.
    pub detail: String,
}

impl Coordinator {
    /// Takes the lost episodes of an actor's last lease back.
    pub(super) fn take_losses(&mut self, actor: ActorId, losses: Vec<Loss>, effects: &mut Vec<Effect>) {
        for Loss { kind, episodes, detail } in losses {
            let lost = self.ledger.take_back_some(actor, &episodes, Reason::Environment(kind));
            let Some(Actor { name, .. }) = self.actors.get(&actor).filter(|_| lost > 0) else { continue };
            tracing::warn!(name, actor, lost, reason = kind.name(), detail, "episodes are lost");
            let what = format!("{name} lost {lost} episodes, which are handed out again: {detail}");
            self.last_loss = Some(detail);
            // Of many of a kind the first is said aloud.
            if self.losses_said.insert(kind) { self.warned(what) } else { self.happened(what) }
        }
        self.part_if_done(actor, effects);
        self.hand_out(effects);
    }
}
