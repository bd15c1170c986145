//! The supervisor in a simulated world, and the processes that are its children.

use super::{
    actor::{Down, Up},
    world::{ASK_TIMEOUT, Actor, Control, Link, Machines, POLL_EVERY, Process, Supervises as _, What, World},
};
use crate::supervisor::{Effect, Event, Exit, Hung, Place, Standing};
use rand::RngExt as _;
use rit_learner::coordinator::Input;
use rit_proto::v1::RunState;
use rit_record::Ended;
use std::{
    collections::{BTreeSet, VecDeque},
    time::Duration,
};

impl<M: Machines> World<M> {
    pub(super) fn begin_supervisor(&mut self) {
        self.supervisors += 1;
        self.supervisor = Some(M::Supervisor::new(self.config.actors.count as u32));
        (self.contacted, self.begun) = (false, false);
        self.tell_supervisor(Event::Begin);
        self.after(POLL_EVERY, What::Poll(self.supervisors));
    }

    pub(super) fn tell_supervisor(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            let now = self.now;
            let Some(supervisor) = &mut self.supervisor else { return };
            for effect in supervisor.handle(event, now) {
                self.notes(|| format!("  {effect:?}"));
                events.extend(self.supervisor_does(effect));
            }
        }
    }

    pub(super) fn supervisor_does(&mut self, effect: Effect) -> Option<Event> {
        match effect {
            Effect::Start(place) => return Some(self.starts(place)),
            Effect::AskToEnd(place) => {
                if let Some(&process) = self.children.get(&place) {
                    let delay = self.latency();
                    self.after(delay, What::Asked(process));
                }
            }
            Effect::Kill(place) => {
                if let Some(&process) = self.children.get(&place) {
                    self.dies(process, Exit::Signal(9));
                }
            }
            Effect::StopRun => {
                let delay = self.latency();
                self.after(delay, What::Control(Control::Stop { drain: false }));
            }
            Effect::RemoveSharedMemory => {
                if !self.children.is_empty() {
                    self.breaks(format!("shared memory of {:?} is removed", self.children.keys()));
                }
            }
            Effect::Say(_) => {}
            Effect::Over(outcome) => {
                if !self.children.is_empty() {
                    self.breaks(format!("the run is over, and there are {:?}", self.children.keys()));
                }
                self.outcome = Some(outcome);
            }
        }
        None
    }

    pub(super) fn starts(&mut self, place: Place) -> Event {
        let number = self.processes.len();
        let actor = Actor { gone_since: self.now, ..Actor::default() };
        let supervisor = self.supervisors;
        let process =
            Process { number, place, supervisor, dead: false, stopped: None, leaving: false, actor };
        let pid = process.pid();
        self.processes.push(process);
        if let Some(before) = self.children.insert(place, number) {
            self.breaks(format!("{place} is process {before} and is started as process {number} too"));
        }
        if place == Place::Learner {
            self.contacted = false;
        }
        let time = self.millis(5..300);
        self.after(time, What::Begins(number));
        Event::Started(place, pid)
    }

    pub(super) fn begins(&mut self, process: usize) {
        match self.processes[process].place {
            Place::Learner => self.learner_begins(process),
            // Memory that cannot be had is a signal to the process that writes to it.
            Place::Actor(_) if self.now < self.memory_full_until => self.dies(process, Exit::Signal(7)),
            Place::Actor(_) => self.connects(process),
        }
    }

    /// A process ends, whatever of.
    pub fn dies(&mut self, process: usize, exit: Exit) {
        if std::mem::replace(&mut self.processes[process].dead, true) {
            return;
        }
        self.tally.deaths += 1;
        let Process { place, supervisor, .. } = self.processes[process];
        self.notes(|| format!("  {place}, process {process}, {exit}"));
        if place == Place::Learner {
            self.learner = None;
            for link in 0..self.links.len() {
                let Link { process: actor, learner, .. } = self.links[link];
                if learner == process && !self.processes[actor].dead {
                    self.down(link, Down::End);
                }
            }
        } else if let Some(link) = self.processes[process].actor.link {
            // Now and then the learner notices only after the successor has come.
            if self.rng.random_range(0..4) == 0 {
                self.links[link].next_up = self.now + self.millis(0..3000);
            }
            self.up(link, Up::End);
        }
        let delay = self.latency();
        self.after(delay, What::Reaped(supervisor, place, exit));
    }

    pub(super) fn reaped(&mut self, supervisor: u32, place: Place, exit: Exit) {
        if supervisor == self.supervisors && self.supervisor.is_some() {
            self.children.remove(&place);
            self.tell_supervisor(Event::Ended { place, exit, last_words: "its last words".into() });
        }
    }

    pub(super) fn is_asked(&mut self, process: usize) {
        match self.processes[process].place {
            Place::Actor(_) => self.leaves(process),
            Place::Learner if self.learner.is_some() => {
                self.learner_is_asked(Input::Stop { drain: false, ended: Ended::Interrupted });
            }
            // It hears of it once it has begun.
            Place::Learner => {
                let wait = self.millis(50..100);
                self.after(wait, What::Asked(process));
            }
        }
    }

    /// The supervisor asks the learner how the run stands.
    pub(super) fn polls(&mut self, supervisor: u32) {
        if supervisor != self.supervisors || self.supervisor.is_none() {
            return;
        }
        let answers =
            self.learner.as_ref().is_some_and(|learner| self.processes[learner.life].stopped.is_none());
        let event = match (answers, self.contacted) {
            (true, false) => {
                (self.contacted, self.begun) = (true, true);
                Some(Event::Answers)
            }
            (true, true) => self.status(),
            (false, _) => {
                self.children.contains_key(&Place::Learner).then(|| Event::NoAnswer("silent".into()))
            }
        };
        if let Some(event) = event {
            self.tell_supervisor(event);
        }
        self.after(if answers { POLL_EVERY } else { ASK_TIMEOUT }, What::Poll(supervisor));
    }

    pub(super) fn status(&mut self) -> Option<Event> {
        let now = self.now;
        let learner = self.learner.as_ref()?;
        let status = learner.status(now);
        let stands = now.saturating_sub(learner.moved);
        let says = learner.coordinator.stands_still().is_some();
        let hung = status.actors.iter().filter(|actor| actor.hung);
        let standing = Standing {
            actors_wanted: status.actors_wanted,
            hung: hung.map(|actor| Hung { pid: actor.pid, silent_s: actor.silent_s as u64 }).collect(),
            ending: status.state() == RunState::Stopping,
        };
        let names: BTreeSet<&str> = status.actors.iter().map(|actor| actor.name.as_str()).collect();
        if names.len() != status.actors.len() {
            self.breaks(format!("the learner counts a slot twice: {:?}", status.actors));
        } else if status.state() == RunState::Running
            && stands > Duration::from_millis(self.config.learner.stall_timeout_ms) + Duration::from_secs(60)
            && !says
        {
            self.breaks(format!("the run stands still for {} s and does not say why", stands.as_secs()));
        }
        Some(Event::Status(standing))
    }
}
