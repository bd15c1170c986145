//! What interrupts do to a run: the first asks the learner for a graceful end, the second ends its retries of last files
//! that cannot be written, the third kills all processes.

use super::{
    Contact, Phase, Supervisor,
    messages::{Effect, Outcome, Place},
};
use std::time::Duration;

const FIRST: &str = "interrupted: shutting the run down gracefully; a second interrupt ends the retries of last files that \
                     cannot be written";
const FIRST_ENDING: &str = "interrupted: the processes are ending already; a third interrupt kills them";
const SECOND: &str = "interrupted again: last files that cannot be written are not tried again; a third interrupt kills the \
                      processes";
const SECOND_STARTING: &str = "interrupted again: the learner has not begun and is not waited for; a third interrupt kills \
                               the processes";
const SECOND_ENDING: &str = "interrupted again: the processes are ending; a third interrupt kills them";
const THIRD: &str = "interrupted a third time: the processes are killed";
/// Why the run failed then.
const KILLED: &str = "interrupted three times, and its processes were killed; `rit train --resume` goes on from the newest \
                      checkpoint";

impl Supervisor {
    pub(super) fn interrupt(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        self.interrupts = self.interrupts.saturating_add(1);
        match self.interrupts {
            _ if matches!(self.phase, Phase::Over) => {}
            1 => self.first_interrupt(now, effects),
            2 => self.second_interrupt(now, effects),
            3 => self.third_interrupt(now, effects),
            _ => {}
        }
    }

    fn first_interrupt(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        if matches!(self.phase, Phase::Ending(_)) {
            effects.push(Effect::Say(FIRST_ENDING.to_owned()));
            return;
        }
        effects.push(Effect::Say(FIRST.to_owned()));
        // Actors that are down are not started again.
        self.actors.retain(|_, actor| actor.is_up());
        match (&self.phase, &self.contact) {
            (Phase::Running, Contact::Answering(..)) if self.learner.is_up() => {
                effects.push(Effect::StopRun);
            }
            // One that has not answered yet is asked when it does.
            (Phase::Running, Contact::Starting { .. }) if self.learner.is_up() => {}
            _ => self.end(Outcome::Interrupted, now, effects),
        }
    }

    fn second_interrupt(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        match (&self.phase, &self.contact) {
            (Phase::Running, Contact::Answering(..)) => {
                effects.extend([Effect::Say(SECOND.to_owned()), Effect::StopRun]);
            }
            (Phase::Running, Contact::Starting { .. }) => {
                effects.push(Effect::Say(SECOND_STARTING.to_owned()));
                self.end(Outcome::Interrupted, now, effects);
            }
            _ => effects.push(Effect::Say(SECOND_ENDING.to_owned())),
        }
    }

    fn third_interrupt(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        effects.push(Effect::Say(THIRD.to_owned()));
        // A learner that has ended has said how; a failure keeps its reason.
        let has_ended = matches!(self.phase, Phase::Ending(_)) && !self.learner.is_up();
        if !has_ended && !matches!(self.phase, Phase::Ending(Outcome::Failed { .. })) {
            self.phase = Phase::Ending(Outcome::Failed { input: false, message: KILLED.to_owned() });
        }
        self.end_processes(now, effects);
        let up = self.actors.iter().filter(|(_, actor)| actor.is_up()).map(|(&slot, _)| Place::Actor(slot));
        let up: Vec<Place> = up.chain(Some(Place::Learner).filter(|_| self.learner.is_up())).collect();
        up.into_iter().for_each(|place| self.kill(place, effects));
        self.go_on_if_all_are_down(effects);
    }
}
