//! An actor's process in a simulated world: it finds the learner, rolls its leases and sends frames, as
//! `actor/src/run.rs` does it.

use super::world::{Link, Machines, What, World};
use crate::supervisor::{Exit, Place};
use rit_env::FailureKind;
use rit_learner::{
    coordinator::{Input, Loss},
    ledger::ActorId,
};
use std::{collections::VecDeque, time::Duration};

/// From one sign of life to the next.
const HEARTBEAT_EVERY: Duration = Duration::from_secs(1);

/// How long an actor waits for a learner that has gone.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(60);

/// What goes up to the learner by a link.
#[derive(Clone, Debug)]
pub enum Up {
    Hello,
    /// With the numbers that were lost.
    Done(u64, Vec<u64>),
    Heartbeat,
    Leaving,
    End,
}

/// What comes down to an actor by a link.
#[derive(Clone, Debug)]
pub enum Down {
    Welcome,
    Refused,
    Lease { lease: u64, episodes: Vec<u64>, version: u64 },
    Farewell,
    Replaced,
    End,
}

/// What an actor is rolling.
#[derive(Clone, Debug)]
pub struct Rolling {
    lease: u64,
    left: VecDeque<u64>,
    lost: Vec<u64>,
    version: u64,
}

impl<M: Machines> World<M> {
    /// An actor looks for the learner.
    pub fn connects(&mut self, process: usize) {
        let Some(gone_since) = self.actor_mut(process, |actor| actor.gone_since) else { return };
        if self.processes[process].leaving {
            return self.dies(process, Exit::Code(0));
        }
        if let Some(learner) = &self.learner {
            let life = learner.life;
            let link = self.links.len();
            self.links.push(Link { process, learner: life, ..Link::default() });
            self.actor_mut(process, |actor| actor.link = Some(link));
            self.up(link, Up::Hello);
        } else if self.now.saturating_sub(gone_since) >= RECONNECT_TIMEOUT {
            self.dies(process, Exit::Code(1));
        } else {
            let wait = self.millis(200..800);
            self.after(wait, What::Connects(process));
        }
    }

    /// Sends a message up; links keep its order.
    pub fn up(&mut self, link: usize, message: Up) {
        let at = (self.now + self.latency()).max(self.links[link].next_up);
        self.links[link].next_up = at + Duration::from_nanos(1);
        self.at(at, What::Up(link, message));
    }

    /// Sends a message down; likewise.
    pub fn down(&mut self, link: usize, message: Down) {
        let at = (self.now + self.latency()).max(self.links[link].next_down);
        self.links[link].next_down = at + Duration::from_nanos(1);
        self.at(at, What::Down(link, message));
    }

    /// The learner reads a message.
    pub fn arrives_up(&mut self, link: usize, message: &Up) {
        if self.learner.as_ref().is_none_or(|learner| learner.life != self.links[link].learner) {
            return;
        }
        let actor = self.links[link].actor;
        match (message, actor) {
            (Up::Hello, _) => self.joins(link),
            (Up::Done(lease, lost), Some(actor)) => {
                let (kind, detail) = (FailureKind::Died, String::new());
                let loss = Loss { kind, episodes: lost.clone(), detail };
                self.tell(Input::Done(actor, *lease, vec![loss]));
            }
            (Up::Heartbeat, Some(actor)) => self.tell(Input::Heartbeat(actor)),
            (Up::Leaving, Some(actor)) => self.tell(Input::Leaving(actor)),
            (Up::End, Some(actor)) => self.tell(Input::Gone(actor)),
            (_, None) => {}
        }
    }

    /// The actor reads a message.
    pub fn arrives_down(&mut self, link: usize, message: Down) {
        let process = self.links[link].process;
        if self.actor_mut(process, |actor| actor.link) != Some(Some(link)) {
            return;
        }
        match message {
            Down::Welcome => {
                self.links[link].joined = true;
                self.actor_mut(process, |actor| actor.gone_since = Duration::MAX);
                self.beats(link);
                if self.processes[process].leaving {
                    self.up(link, Up::Leaving);
                }
            }
            Down::Lease { lease, episodes, version } => {
                let rolling = Rolling { lease, left: episodes.into(), lost: Vec::new(), version };
                let idle = self.actor_mut(process, |actor| {
                    actor.leases.push_back(rolling);
                    actor.leases.len() == 1
                });
                if idle == Some(true) {
                    self.rolls(link);
                }
            }
            Down::Farewell => self.dies(process, Exit::Code(0)),
            Down::Replaced => self.dies(process, Exit::Code(1)),
            Down::Refused => self.dies(process, Exit::Code(2)),
            Down::End => self.loses(process),
        }
    }

    /// A link is no more.
    pub fn loses(&mut self, process: usize) {
        let now = self.now;
        self.actor_mut(process, |actor| {
            actor.link = None;
            actor.leases.clear();
            if actor.gone_since == Duration::MAX {
                actor.gone_since = now;
            }
        });
        let wait = self.millis(50..100);
        self.after(wait, What::Connects(process));
    }

    pub fn beats(&mut self, link: usize) {
        if self.actor_mut(self.links[link].process, |actor| actor.link) == Some(Some(link)) {
            self.up(link, Up::Heartbeat);
            self.after(HEARTBEAT_EVERY, What::Beats(link));
        }
    }

    fn rolls(&mut self, link: usize) {
        let time = self.millis(self.roll_ms / 2..self.roll_ms + 1);
        self.after(time, What::Rolled(link));
    }

    /// An episode is rolled: its frame goes into shared memory. Or its environment lost it.
    pub fn rolled(&mut self, link: usize) {
        let Link { process, actor: Some(id), .. } = self.links[link] else { return };
        if self.actor_mut(process, |actor| actor.link) != Some(Some(link)) {
            return;
        }
        let is_lost = self.lost_episodes > 0;
        let sent = self.actor_mut(process, |actor| {
            let rolling = actor.leases.front_mut()?;
            let number = rolling.left.pop_front()?;
            rolling.lost.extend(is_lost.then_some(number));
            Some((number, rolling.version, rolling.left.is_empty()))
        });
        let Some(Some((number, version, last))) = sent else { return };
        if is_lost {
            self.lost_episodes -= 1;
        } else {
            self.sends_frame(link, id, number, version);
        }
        if last {
            let done = self.actor_mut(process, |actor| actor.leases.pop_front()).flatten();
            done.into_iter().for_each(|Rolling { lease, lost, .. }| self.up(link, Up::Done(lease, lost)));
        }
        if self.actor_mut(process, |actor| !actor.leases.is_empty()) == Some(true) {
            self.rolls(link);
        }
    }

    fn sends_frame(&mut self, link: usize, actor: ActorId, number: u64, version: u64) {
        let learner = self.links[link].learner;
        let damaged = self.damaged_frames > 0;
        self.damaged_frames = self.damaged_frames.saturating_sub(1);
        // What is in shared memory is read, whether or not its sender lives.
        let at = (self.now + self.latency()).max(self.links[link].next_frame);
        self.links[link].next_frame = at + Duration::from_nanos(1);
        if let Some(reader) = self.learner.as_mut().filter(|reader| reader.life == learner) {
            reader.frames_until = reader.frames_until.max(at);
        }
        self.at(at, What::Frame { learner, actor, number, version, damaged });
    }

    /// TERM, INT, or the end of its lifeline: it leaves in peace.
    pub fn leaves(&mut self, process: usize) {
        if std::mem::replace(&mut self.processes[process].leaving, true) {
            return;
        }
        match self.actor_mut(process, |actor| actor.link) {
            Some(Some(link)) if self.links[link].joined => self.up(link, Up::Leaving),
            // Said once it is welcome, or when it looks for the learner again.
            Some(_) | None => {}
        }
    }

    /// Something of an actor that lives.
    pub fn actor_mut<T>(
        &mut self,
        process: usize,
        of: impl FnOnce(&mut super::world::Actor) -> T,
    ) -> Option<T> {
        let process = &mut self.processes[process];
        (!process.dead && matches!(process.place, Place::Actor(_))).then(|| of(&mut process.actor))
    }
}
