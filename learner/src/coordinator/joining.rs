//! Decides whether an actor may join, and which earlier actor it replaces.

use super::{Actor, Coordinator, Effect, Joining, Refusal};
use crate::{gauges::Stopwatch, ledger::ActorId};
use rit_episode::wire;

impl Coordinator {
    pub(super) fn join(&mut self, joining: Joining, effects: &mut Vec<Effect>) {
        match self.admit(joining, effects) {
            Ok(id) => {
                effects.push(Effect::Admit(id));
                self.hand_out(effects);
            }
            Err(refusal) => effects.push(Effect::Refuse(refusal)),
        }
    }

    fn admit(&mut self, joining: Joining, effects: &mut Vec<Effect>) -> Result<ActorId, Refusal> {
        let Joining { name, pid, layout_version, instance, remote, slot } = joining;
        if self.over_since.is_some() {
            return Err(Refusal::Over);
        }
        if layout_version != wire::LAYOUT_VERSION {
            return Err(Refusal::Layout { name, theirs: layout_version, ours: wire::LAYOUT_VERSION });
        }
        // The same process, whose link broke before this side noticed; the successor of one given up; or, in a slot,
        // the one that comes later: the supervisor starts no actor beside another.
        let follows = |other: &Actor| match (slot, other.slot) {
            (None, None) => other.name == name && (other.instance == instance || other.hung),
            (ours, theirs) => ours == theirs,
        };
        if let Some(former) = self.actors.iter().find(|(_, other)| follows(other)).map(|(&id, _)| id) {
            self.replace(former, instance, effects);
        }
        let max = self.config.actors.remote;
        if remote && self.actors.values().filter(|actor| actor.remote).count() >= max {
            return Err(Refusal::Remote { name, max });
        }
        let same_name = self.actors.values().find(|actor| actor.name == name);
        if let Some(other) = same_name.filter(|_| slot.is_none()) {
            return Err(Refusal::Taken { name, pid: other.pid });
        }
        let id = self.next_actor;
        self.next_actor += 1;
        self.joins += 1;
        tracing::info!(name, pid, remote, actor = id, "an actor joined");
        self.happened(format!("{name} joined"));
        let actor = Actor {
            name,
            pid,
            instance,
            slot,
            remote,
            episodes: 0,
            leases: 0,
            leaving: false,
            heard: self.now,
            hung: false,
            waiting: Stopwatch::default(),
        };
        self.actors.insert(id, actor);
        Ok(id)
    }

    /// Lets a process of this instance take an actor's place. Another process that should still live is told.
    fn replace(&mut self, former: ActorId, instance: u64, effects: &mut Vec<Effect>) {
        if self.actors.get(&former).is_some_and(|actor| actor.instance != instance) {
            effects.push(Effect::Replaced(former));
        }
        self.gone(former, effects);
    }
}
