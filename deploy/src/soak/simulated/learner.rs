//! The learner's process in a simulated world: the real coordinator with its ledger, a trainer that only counts, and
//! a receiver of frames.

use super::{
    actor::Down,
    world::{Machines, Process, What, World},
};
use crate::supervisor::Exit;
use rit_config::Config;
use rit_episode::{End, Episode};
use rit_learner::{
    coordinator::{Coordinator, Effect, Input, Joining, LOOK_EVERY, Refusal},
    ledger::{ActorId, Terms},
    receive::Fence,
    trainer::{Beginning, News, Standing},
    writer::CheckpointEnded,
};
use rit_proto::v1::RunStatus;
use rit_record::{Ended, Progress};
use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
    time::Duration,
};

/// What a learner goes on from.
#[derive(Clone, Debug)]
pub struct Saved {
    pub batches: u64,
    pub terms: VecDeque<Terms>,
    pub progress: Progress,
}

impl Saved {
    /// Where a run begins.
    pub fn fresh(policy_lag: usize) -> Self {
        let first = Terms { weights_version: 0, epsilon: 1.0 };
        Self { batches: 0, terms: vec![first; policy_lag + 1].into(), progress: Progress::default() }
    }
}

/// What the trainer is asked to do, one after another.
enum Work {
    Batch(Vec<Episode>),
    Stop(Ended),
}

/// A learner that listens.
pub struct Learner {
    /// Its process.
    pub life: usize,
    pub coordinator: Coordinator,
    began: Duration,
    state: Saved,
    work: VecDeque<Work>,
    busy: bool,
    ending: bool,
    ended: Ended,
    closed: bool,
    /// By actor, the link it has.
    links: BTreeMap<ActorId, usize>,
    /// Who is joining now.
    joining: Option<usize>,
    /// When the last frame that is on its way will have been read.
    pub frames_until: Duration,
    /// When the disk is done with what it was given: it writes in order.
    written_until: Duration,
    /// When a batch was trained last, or training may have gone on last.
    pub moved: Duration,
}

/// An episode of which only its number and weights matter.
pub fn episode(number: u64, weights_version: u64) -> Box<Episode> {
    Box::new(Episode {
        number,
        weights_version,
        task: 0,
        n_agents: 1,
        n_entities: 1,
        decision_order: vec![],
        entities: vec![],
        observable: vec![],
        available: vec![],
        actions: vec![],
        rewards: vec![],
        shaping: vec![],
        end: End::Terminated,
        won: false,
    })
}

impl Learner {
    pub fn status(&self, now: Duration) -> RunStatus {
        self.coordinator.status(now - self.began)
    }
}

impl<M: Machines> World<M> {
    /// The learner's process has started up.
    pub fn learner_begins(&mut self, life: usize) {
        if self.now < self.memory_full_until {
            // A run that cannot begin says so at once, and nothing is lost.
            self.may_fail |= !self.begun;
            return self.dies(life, Exit::Code(crate::failure::UNAVAILABLE.into()));
        }
        if self.saved.batches > 0 {
            self.tally.resumed += 1;
        }
        let state = self.saved.clone();
        let beginning = Beginning {
            batches: state.batches,
            terms: state.terms.iter().copied().collect(),
            standing: Standing { progress: state.progress, ..Standing::default() },
            measures: &[],
            warnings: vec![],
        };
        self.learner = Some(Learner {
            life,
            coordinator: Coordinator::new(Config::clone(&self.config), beginning),
            began: self.now,
            state,
            work: VecDeque::new(),
            busy: false,
            ending: false,
            ended: Ended::Finished,
            closed: false,
            links: BTreeMap::new(),
            joining: None,
            frames_until: self.now,
            written_until: self.now,
            moved: self.now,
        });
        self.after(LOOK_EVERY, What::Look(life));
        if self.saved.batches >= self.plan.batches {
            self.training_ends(Ended::Finished);
        }
    }

    /// Tells the coordinator, and does what it wants.
    pub fn tell(&mut self, input: Input) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            let Some(learner) = &mut self.learner else { return };
            if learner.closed {
                return;
            }
            let effects = learner.coordinator.handle(input, self.now - learner.began);
            let counts = learner.coordinator.counts();
            if !counts.balance() {
                self.breaks(format!("the ledger does not balance: {counts:?}"));
            }
            for effect in effects {
                inputs.extend(self.learner_does(effect));
            }
        }
    }

    fn learner_does(&mut self, effect: Effect) -> Option<Input> {
        let learner = self.learner.as_mut()?;
        match effect {
            Effect::Admit(actor) => {
                let link = learner.joining.take()?;
                learner.links.insert(actor, link);
                self.links[link].actor = Some(actor);
                self.down(link, Down::Welcome);
            }
            Effect::Refuse(refusal) => {
                let link = learner.joining.take()?;
                if matches!(refusal, Refusal::Taken { .. } | Refusal::Layout { .. }) {
                    self.breaks(format!("an actor of the supervisor was refused: {refusal}"));
                }
                // One that comes when the run is over looks for the next learner.
                let over = refusal == Refusal::Over;
                self.down(link, if over { Down::End } else { Down::Refused });
            }
            Effect::Lease { actor, lease, episodes, terms } => {
                let link = *learner.links.get(&actor)?;
                self.check_lease(&episodes, terms);
                self.down(link, Down::Lease { lease, episodes, version: terms.weights_version });
            }
            Effect::Farewell(actor) => {
                let link = *learner.links.get(&actor)?;
                self.down(link, Down::Farewell);
            }
            Effect::Replaced(actor) => {
                let link = *learner.links.get(&actor)?;
                self.down(link, Down::Replaced);
            }
            Effect::Dismiss(actor) => {
                let link = learner.links.remove(&actor)?;
                self.down(link, Down::End);
            }
            Effect::Train(batch) => {
                learner.work.push_back(Work::Batch(batch));
                self.train_on();
            }
            Effect::EndTraining(ended) => {
                learner.work.push_back(Work::Stop(ended));
                self.train_on();
            }
            Effect::Configure(_) => {}
            Effect::Fence(fence) => {
                let (at, life) = (learner.frames_until.max(self.now), learner.life);
                self.at(at, What::Fenced(life, fence));
            }
            Effect::Close => {
                learner.closed = true;
                let (life, exit) = (learner.life, Exit::Code(i32::from(learner.ended.exit_code())));
                let delay = self.latency();
                self.after(delay, What::Dies(life, exit));
            }
        }
        None
    }

    /// A lease is of one batch, on the terms that training has set for it.
    fn check_lease(&mut self, episodes: &[u64], terms: Terms) {
        let Some(learner) = &self.learner else { return };
        let size = self.plan.episodes_per_batch as u64;
        let batch = episodes.first().map_or(0, |number| number / size);
        let expected = batch.checked_sub(learner.state.batches);
        let expected = expected.and_then(|ahead| learner.state.terms.get(ahead as usize));
        if expected != Some(&terms) || episodes.iter().any(|number| number / size != batch) {
            self.breaks(format!("episodes {episodes:?} are leased on {terms:?}, not on {expected:?}"));
        }
    }

    pub fn joins(&mut self, link: usize) {
        let process = &self.processes[self.links[link].process];
        let joining = M::joining(Joining {
            name: process.place.to_string(),
            pid: process.pid(),
            layout_version: rit_episode::wire::LAYOUT_VERSION,
            instance: self.links[link].process as u64,
            remote: false,
            slot: process.slot(),
        });
        if let Some(learner) = &mut self.learner {
            learner.joining = Some(link);
        }
        self.tell(Input::Join(joining));
    }

    pub fn look(&mut self, life: usize) {
        self.tell(Input::Look);
        if self.learner.is_some() {
            self.after(LOOK_EVERY, What::Look(life));
        }
    }

    pub fn fenced(&mut self, fence: Fence) {
        self.tell(Input::Fenced(fence));
    }

    fn train_on(&mut self) {
        let Some(learner) = &mut self.learner else { return };
        if learner.busy || learner.ending {
            return;
        }
        match learner.work.front() {
            Some(Work::Batch(_)) => {
                learner.busy = true;
                let life = learner.life;
                let time = self.millis(1..60);
                self.after(time, What::Trained(life));
            }
            Some(&Work::Stop(ended)) => self.training_ends(ended),
            None => {}
        }
    }

    /// A batch is done: each number in its turn, with the weights that are its batch's own.
    pub fn trained(&mut self, life: usize) {
        let Some(learner) = &mut self.learner else { return };
        learner.busy = false;
        let Some(Work::Batch(batch)) = learner.work.pop_front() else { return };
        let size = self.plan.episodes_per_batch as u64;
        let (index, terms) = (learner.state.batches, learner.state.terms.pop_front());
        let numbers: Vec<u64> = batch.iter().map(|episode| episode.number).collect();
        let expected: Vec<u64> = (index * size..(index + 1) * size).collect();
        let version = terms.map(|terms| terms.weights_version);
        let of_other_weights = batch.iter().any(|episode| Some(episode.weights_version) != version);
        learner.state.batches += 1;
        let progress = &mut learner.state.progress;
        progress.episodes += size;
        progress.env_steps += size;
        progress.updates += 1;
        let terms = Terms { weights_version: progress.updates, epsilon: 1.0 };
        let standing = Standing { progress: *progress, ..Standing::default() };
        learner.state.terms.push_back(terms);
        learner.moved = self.now;
        self.tally.trained += size;
        if numbers != expected || of_other_weights {
            self.breaks(format!("batch {index} holds {numbers:?} of weights other than {version:?}"));
        }
        self.remember(index, version.unwrap_or_default());
        self.tell(Input::News(News::Trained(terms, standing)));
        let Some(learner) = &self.learner else { return };
        if learner.state.batches >= self.plan.batches {
            self.training_ends(Ended::Finished);
        } else if learner.state.batches.is_multiple_of(self.plan.checkpoint_every_batches) {
            let state = Box::new(learner.state.clone());
            self.writes(1..200, What::Written(life, state));
        }
        self.train_on();
    }

    /// A batch that is trained on again after a checkpoint must be what it was.
    fn remember(&mut self, index: u64, version: u64) {
        match self.versions.get(index as usize) {
            Some(&before) if before != version => {
                self.breaks(format!("batch {index} was of weights {before} and is now of {version}"));
            }
            Some(_) => {}
            None => self.versions.push(version),
        }
    }

    pub fn written(&mut self, state: &Saved) {
        let full = self.now < self.disk_full_until;
        if !full {
            self.saved = state.clone();
        }
        self.tell(Input::CheckpointEnded(CheckpointEnded {
            env_steps: state.progress.env_steps,
            duration: Duration::from_millis(1),
            failed: full.then(|| "no space left".to_owned()),
        }));
    }

    fn training_ends(&mut self, ended: Ended) {
        let Some(learner) = &mut self.learner else { return };
        if std::mem::replace(&mut learner.ending, true) {
            return;
        }
        learner.ended = ended;
        let life = learner.life;
        self.tell(Input::News(News::Ending));
        self.writes(1..2000, What::Finished(life));
    }

    /// What is on disk after so many milliseconds, and after all that was to be written before.
    fn writes(&mut self, ms: std::ops::Range<u64>, what: What) {
        let time = self.millis(ms);
        let Some(learner) = &mut self.learner else { return };
        learner.written_until = learner.written_until.max(self.now + time);
        let at = learner.written_until;
        self.at(at, what);
    }

    /// The last files are written, or not.
    pub fn finished(&mut self) {
        let full = self.now < self.disk_full_until;
        let Some(learner) = &mut self.learner else { return };
        if full {
            learner.ended = Ended::Failed;
            self.may_fail = true;
        } else {
            self.saved = learner.state.clone();
        }
        self.tell(Input::Over);
    }

    /// `rit ctl`, or a signal that asks the learner to end.
    pub fn learner_is_asked(&mut self, input: Input) {
        if let Input::Resume = input
            && let Some(learner) = &mut self.learner
        {
            learner.moved = self.now;
        }
        self.tell(input);
    }

    pub fn set_config(&mut self, change: impl FnOnce(&mut Config)) {
        let mut config = Config::clone(&self.config);
        change(&mut config);
        self.config = Arc::new(config);
        let config = Arc::clone(&self.config);
        self.tell(Input::Set(config));
    }
}

impl Process {
    /// A number that no other process has.
    pub fn pid(&self) -> u32 {
        self.number as u32 + 1
    }
}
