//! What the faults of a plan do to a simulated world.

use super::{
    actor::{Down, Up},
    faults::Fault,
    world::{Control, Machines, What, World},
};
use crate::supervisor::{Event, Exit, Place};
use rit_learner::coordinator::Input;
use std::time::Duration;

impl<M: Machines> World<M> {
    /// A child that lives, and whether it is the learner.
    pub(super) fn victim(&self, which: usize) -> Option<usize> {
        let living: Vec<usize> =
            self.children.values().copied().filter(|&process| !self.processes[process].dead).collect();
        (!living.is_empty()).then(|| living[which % living.len()])
    }

    pub(super) fn suffers(&mut self, fault: Fault) {
        match fault {
            Fault::Signal { which, signal } => {
                let Some(victim) = self.victim(which) else { return };
                if matches!(signal, 2 | 15) {
                    self.may_end_early |= self.processes[victim].place == Place::Learner;
                    self.after(Duration::ZERO, What::Asked(victim));
                } else {
                    self.dies(victim, Exit::Signal(signal));
                }
            }
            Fault::Stop { which, ms } => {
                let Some(victim) = self.victim(which) else { return };
                self.processes[victim].stopped.get_or_insert_default();
                self.after(Duration::from_millis(ms), What::GoesOn(victim));
            }
            Fault::Count(count) => self.set_config(|config| config.actors.count = count as usize),
            Fault::Pause { ms } => {
                self.learner_is_asked(Input::Pause);
                self.after(Duration::from_millis(ms), What::Control(Control::Resume));
            }
            Fault::DiskFull { ms } => self.disk_full_until = self.now + Duration::from_millis(ms),
            Fault::MemoryFull { ms } => self.memory_full_until = self.now + Duration::from_millis(ms),
            Fault::Damage { frames } => self.damaged_frames += frames,
            Fault::Lose { episodes } => self.lost_episodes += episodes,
            Fault::BreakLink { which } => self.breaks_link(which),
            Fault::Slow { ms } => self.latency_ms = ms + 1,
            Fault::PowerLoss => self.loses_power(),
            Fault::KillSupervisor => self.loses_supervisor(),
            Fault::Interrupt => {
                self.may_end_early = true;
                // One that does not answer is killed.
                self.may_fail = true;
                self.tell_supervisor(Event::Interrupted);
            }
            Fault::StopRun { drain } => {
                self.may_end_early |= self.learner.is_some();
                self.after(Duration::ZERO, What::Control(Control::Stop { drain }));
            }
        }
    }

    pub(super) fn breaks_link(&mut self, which: usize) {
        let Some(victim) = self.victim(which) else { return };
        if let Some(link) = self.processes[victim].actor.link {
            self.up(link, Up::End);
            self.down(link, Down::End);
        }
    }

    pub(super) fn loses_power(&mut self) {
        if self.supervisor.take().is_none() {
            return;
        }
        for process in std::mem::take(&mut self.children).into_values() {
            self.dies(process, Exit::Signal(9));
        }
        let wait = self.millis(500..2000);
        self.after(wait, What::Resumed);
    }

    /// Its children find that their lifelines are closed; one that is stopped finds it later.
    pub(super) fn loses_supervisor(&mut self) {
        if self.supervisor.take().is_none() {
            return;
        }
        for process in std::mem::take(&mut self.children).into_values() {
            if self.processes[process].place == Place::Learner {
                self.goes_on(process);
            }
            let delay = self.latency();
            self.after(delay, What::Asked(process));
        }
        self.after(Duration::from_millis(500), What::Resumed);
    }

    /// `rit train --resume`, which is refused while a learner lives.
    pub(super) fn is_resumed(&mut self) {
        let learner_lives =
            self.processes.iter().any(|process| process.place == Place::Learner && !process.dead);
        if learner_lives {
            self.after(Duration::from_millis(500), What::Resumed);
        } else {
            self.begin_supervisor();
        }
    }

    pub(super) fn goes_on(&mut self, process: usize) {
        for what in self.processes[process].stopped.take().into_iter().flatten() {
            self.at(self.now, what);
        }
    }

    pub(super) fn peace(&mut self) {
        self.peace_since = Some(self.now);
        (self.disk_full_until, self.memory_full_until) = (self.now, self.now);
        (self.damaged_frames, self.lost_episodes) = (0, 0);
        for process in 0..self.processes.len() {
            self.goes_on(process);
        }
        self.after(Duration::ZERO, What::Control(Control::Resume));
    }
}
