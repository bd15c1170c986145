//! Between actors, trainer and callers: hands out leases, takes episodes in, answers for the run's state.
//!
//! One task owns the ledger and the list of actors; everybody else sends it [`Event`]s. It never waits for
//! the trainer or for an actor, so a slow one holds up nobody.

mod control;
mod status;

use crate::{
    evaluation::in_words,
    gauges::{Happenings, RateWindow, Stopwatch},
    ledger::{ActorId, Lease, Ledger, Reason, Terms},
    receive::Fence,
    trainer::{Beginning, News, Standing, Work},
    writer::CheckpointEnded,
};
use rit_algo::learner::Measure;
use rit_config::Config;
use rit_episode::{Episode, wire};
use rit_proto::v1::{self, LearnerMessage, learner_message::Message};
use std::{
    collections::BTreeMap,
    sync::mpsc,
    time::{Duration, Instant},
};
use tokio::sync::{mpsc as async_mpsc, oneshot};
use tonic::Status;

pub use control::Control;

/// How long the end of a run waits for actors to go.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(5);

/// From one look for hung actors, at rates and at the ledger's balance to the next.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Messages an actor's stream may hold: far more than one lease at a time can fill.
pub const ACTOR_QUEUE: usize = 64;

/// What happens to a run.
#[derive(Debug)]
pub enum Event {
    /// An episode was read and found valid.
    Episode(ActorId, Box<Episode>),
    /// A frame was refused.
    FrameRefused(&'static str),
    /// An actor wants to join.
    Join(
        v1::Hello,
        async_mpsc::Sender<Result<LearnerMessage, Status>>,
        oneshot::Sender<Result<ActorId, Status>>,
    ),
    /// An actor has sent all of this lease.
    Done(ActorId, u64),
    /// All that an actor had sent by `Done` has been read.
    Fenced(Fence),
    /// An actor is there.
    Heartbeat(ActorId),
    /// An actor wants to go.
    Leaving(ActorId),
    /// An actor's stream has ended.
    Gone(ActorId),
    /// Shared memory is elsewhere from now on, with what somebody should know of the new place: whoever sends there has
    /// to join again.
    PlaceLost(Option<String>),
    /// The trainer speaks.
    News(News),
    /// The writer is done with a checkpoint.
    CheckpointEnded(CheckpointEnded),
    /// The trainer or the receiving thread is done, well or not: nothing more can happen.
    Over,
    /// Somebody asks or wants something.
    Control(Control),
}

/// An actor that is there.
#[derive(Debug)]
struct Actor {
    name: String,
    pid: u32,
    /// Tells the process from another of this name.
    instance: u64,
    /// Its identity, where a supervisor fills slots.
    slot: Option<u32>,
    /// On another host.
    remote: bool,
    to: async_mpsc::Sender<Result<LearnerMessage, Status>>,
    /// Episodes inserted.
    episodes: u64,
    /// Leases it was given; the last one's number.
    leases: u64,
    leaving: bool,
    /// When it last said anything.
    heard: Instant,
    /// Silent for too long: its episodes went to another.
    hung: bool,
    /// Runs while the ledger hands nothing out to it.
    waiting: Stopwatch,
}

impl Actor {
    /// Whether it could roll and has nothing to.
    fn is_idle(&self, id: ActorId, ledger: &Ledger) -> bool {
        !self.leaving && !self.hung && ledger.outstanding_with(id).next().is_none()
    }
}

/// The coordinator.
pub struct Coordinator {
    config: Config,
    /// What every actor is told when it joins, but for its own number.
    welcome: v1::Welcome,
    ledger: Ledger,
    actors: BTreeMap<ActorId, Actor>,
    next_actor: ActorId,
    state: v1::RunState,
    /// The run ends when nothing is under way any more.
    draining: bool,
    standing: Standing,
    /// What updates report.
    measures: &'static [Measure],
    epsilon: f32,
    frames_refused: BTreeMap<&'static str, u64>,
    /// Frames that were read, refused ones too.
    frames: u64,
    /// Batches that training was given and has not done.
    batches_in_training: u64,
    /// Runs while training has no batch.
    learner_waiting: Stopwatch,
    rates: RateWindow,
    checkpoints: v1::CheckpointsStatus,
    /// Whether the last one was not written.
    checkpoints_fail: bool,
    happenings: Happenings,
    /// How often the ledger was found not to balance.
    imbalances: u64,
    started: Instant,
    work: mpsc::Sender<Work>,
    fences: mpsc::Sender<Fence>,
}

impl Coordinator {
    /// A coordinator where a run begins. Actors are told `welcome`; `work` leads to the trainer, `fences` to the receiving thread.
    pub fn new(
        config: Config,
        welcome: v1::Welcome,
        beginning: Beginning,
        work: mpsc::Sender<Work>,
        fences: mpsc::Sender<Fence>,
    ) -> Self {
        let Beginning { batches, terms, standing, measures, warnings } = beginning;
        let started = Instant::now();
        let mut happenings = Happenings::new(started);
        warnings.into_iter().for_each(|what| happenings.warn(standing.progress.env_steps, what));
        Self {
            epsilon: config.epsilon(standing.progress.env_steps),
            standing,
            measures,
            ledger: Ledger::new(config.algorithm.n_rollout_threads, batches, terms),
            actors: BTreeMap::new(),
            next_actor: 0,
            state: v1::RunState::Running,
            draining: false,
            frames_refused: BTreeMap::new(),
            frames: 0,
            batches_in_training: 0,
            learner_waiting: Stopwatch::default(),
            rates: RateWindow::default(),
            checkpoints: v1::CheckpointsStatus::default(),
            checkpoints_fail: false,
            happenings,
            imbalances: 0,
            started,
            config,
            welcome,
            work,
            fences,
        }
    }

    /// Works until the trainer is done and the actors have gone.
    pub async fn run(mut self, mut events: async_mpsc::Receiver<Event>) {
        let mut looks = tokio::time::interval(LOOK_EVERY);
        loop {
            tokio::select! {
                event = events.recv() => match event {
                    None | Some(Event::Over) => break,
                    Some(event) => self.handle(event),
                },
                _ = looks.tick() => {
                    self.look_for_hung_actors();
                    self.rates.note(Instant::now(), self.standing.progress);
                    self.check_balance();
                }
            }
            self.time_waits();
            self.stop_if_drained();
        }
        self.state = v1::RunState::Stopping;
        self.part_with_actors(&mut events).await;
        self.check_balance();
        tracing::info!(counts = ?self.ledger.counts(), "the ledger is closed");
    }

    /// Who waits for whom. Nobody does while the run is paused or ending.
    fn time_waits(&mut self) {
        let (now, running) = (Instant::now(), self.state == v1::RunState::Running);
        self.learner_waiting.set(running && self.batches_in_training == 0, now);
        for (&id, actor) in &mut self.actors {
            actor.waiting.set(running && actor.is_idle(id, &self.ledger), now);
        }
    }

    fn check_balance(&mut self) {
        let counts = self.ledger.counts();
        if counts.balance() {
            return;
        }
        if self.imbalances == 0 {
            tracing::error!(?counts, "the ledger does not balance: a fault of the program");
        }
        self.imbalances += 1;
        debug_assert!(counts.balance(), "{counts:?}");
    }

    fn happened(&mut self, what: String) {
        self.happenings.note(self.standing.progress.env_steps, what);
    }

    /// What somebody should know of.
    fn warned(&mut self, what: String) {
        self.happenings.warn(self.standing.progress.env_steps, what);
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Episode(actor, episode) => {
                self.frames += 1;
                self.insert(actor, *episode);
            }
            Event::FrameRefused(reason) => {
                self.frames += 1;
                *self.frames_refused.entry(reason).or_default() += 1;
            }
            Event::Join(hello, to, answer) => {
                let joined = self.join(hello, to);
                let id = joined.as_ref().ok().copied();
                if answer.send(joined).is_ok() {
                    if let Some(id) = id {
                        self.send(id, Message::Welcome(v1::Welcome { actor: id, ..self.welcome.clone() }));
                        self.hand_out();
                    }
                } else if let Some(id) = id {
                    self.gone(id);
                }
            }
            Event::Done(actor, lease) => {
                self.heard(actor);
                // Not all of it has come through yet, or a frame was refused: look again once all that was
                // sent before has been read.
                if self.has_outstanding(actor, lease) {
                    let _ = self.fences.send(Fence { actor, lease });
                }
            }
            Event::Fenced(Fence { actor, lease }) => {
                if self.has_outstanding(actor, lease) {
                    let missing = self.ledger.take_back(actor, Reason::NotArrived);
                    tracing::warn!(actor, missing, "episodes did not arrive and are handed out again");
                    self.happened(format!("{missing} episodes did not arrive and are handed out again"));
                    self.hand_out();
                }
            }
            Event::Heartbeat(actor) => self.heard(actor),
            Event::Leaving(actor) => {
                self.heard(actor);
                if let Some(leaving) = self.actors.get_mut(&actor) {
                    leaving.leaving = true;
                }
                self.part_if_done(actor);
            }
            Event::Gone(actor) => self.gone(actor),
            Event::PlaceLost(notice) => self.place_lost(notice),
            Event::News(News::Trained(terms, standing)) => {
                self.ledger.open(terms);
                self.epsilon = terms.epsilon;
                self.batches_in_training = self.batches_in_training.saturating_sub(1);
                let evaluated_at = |standing: &Standing| standing.evaluation.as_ref().map(|(at, _)| *at);
                let evaluated = evaluated_at(&standing) != evaluated_at(&self.standing);
                self.standing = standing;
                if evaluated && let Some((_, results)) = &self.standing.evaluation {
                    self.happened(format!("evaluated: {}", in_words(results)));
                }
                self.hand_out();
            }
            Event::News(News::Ending) => self.state = v1::RunState::Stopping,
            Event::CheckpointEnded(ended) => self.checkpoint_ended(ended),
            Event::Over => {}
            Event::Control(control) => self.control(control),
        }
    }

    fn checkpoint_ended(&mut self, CheckpointEnded { env_steps, duration, failed }: CheckpointEnded) {
        if let Some(why) = failed {
            self.checkpoints.failed += 1;
            // Of many in a row the first is said aloud.
            if !std::mem::replace(&mut self.checkpoints_fail, true) {
                self.warned(format!("the checkpoint at {env_steps} steps was not written: {why}"));
            }
            return;
        }
        if std::mem::take(&mut self.checkpoints_fail) {
            self.warned("checkpoints are written again".into());
        }
        let checkpoints = &mut self.checkpoints;
        (checkpoints.written, checkpoints.env_steps) = (checkpoints.written + 1, env_steps);
        checkpoints.last_s = duration.as_secs_f64();
        checkpoints.total_s += checkpoints.last_s;
        self.happened(format!("wrote the checkpoint at {env_steps} steps in {} ms", duration.as_millis()));
    }

    fn join(
        &mut self,
        hello: v1::Hello,
        to: async_mpsc::Sender<Result<LearnerMessage, Status>>,
    ) -> Result<ActorId, Status> {
        let v1::Hello { name, pid, layout_version, instance, remote, slot } = hello;
        if layout_version != wire::LAYOUT_VERSION {
            return Err(Status::failed_precondition(format!(
                "actor {name} writes frame layout {layout_version}, this learner reads {}; use the same build",
                wire::LAYOUT_VERSION
            )));
        }
        // The same process, whose link broke before this side noticed; the successor of one given up; or, in a slot,
        // whoever comes later: the supervisor starts nobody beside another.
        let follows = |other: &Actor| match (slot, other.slot) {
            (None, None) => other.name == name && (other.instance == instance || other.hung),
            (ours, theirs) => ours == theirs,
        };
        if let Some(former) = self.actors.iter().find(|(_, other)| follows(other)).map(|(&id, _)| id) {
            self.replace(former, instance);
        }
        let remote_max = self.config.actors.remote;
        if remote && self.actors.values().filter(|actor| actor.remote).count() >= remote_max {
            return Err(Status::failed_precondition(format!(
                "actor {name} is on another host, and the learner takes {remote_max} of those; set actors.remote higher"
            )));
        }
        let same_name = self.actors.values().find(|actor| actor.name == name);
        if let Some(other) = same_name.filter(|_| slot.is_none()) {
            return Err(Status::already_exists(format!(
                "an actor named {name} is there already (process {}); choose another --name",
                other.pid
            )));
        }
        let id = self.next_actor;
        self.next_actor += 1;
        tracing::info!(name, pid, remote, actor = id, "an actor joined");
        self.happened(format!("{name} joined"));
        self.actors.insert(
            id,
            Actor {
                name,
                pid,
                instance,
                slot,
                remote,
                to,
                episodes: 0,
                leases: 0,
                leaving: false,
                heard: Instant::now(),
                hung: false,
                waiting: Stopwatch::default(),
            },
        );
        Ok(id)
    }

    /// Lets a process of this instance take an actor's place. Another process that should still live is told.
    fn replace(&mut self, former: ActorId, instance: u64) {
        if let Some(actor) = self.actors.get(&former).filter(|actor| actor.instance != instance) {
            let what = format!("another process has taken the place of {}", actor.name);
            // One that is dead or does not read needs no word.
            let _ = actor.to.try_send(Err(Status::already_exists(what)));
        }
        self.gone(former);
    }

    fn heard(&mut self, id: ActorId) {
        let Some(actor) = self.actors.get_mut(&id) else { return };
        actor.heard = Instant::now();
        if std::mem::take(&mut actor.hung) {
            tracing::info!(name = actor.name, actor = id, "an actor that hung is back");
            let what = format!("{} is back", actor.name);
            self.happened(what);
            self.hand_out();
        }
    }

    fn look_for_hung_actors(&mut self) {
        let timeout = Duration::from_millis(self.config.actors.heartbeat_timeout_ms);
        let silent = |actor: &Actor| !actor.hung && actor.heard.elapsed() >= timeout;
        let hung: Vec<ActorId> = self.actors.iter().filter(|(_, a)| silent(a)).map(|(&id, _)| id).collect();
        for id in hung {
            let had = self.ledger.take_back(id, Reason::ActorHung);
            if let Some(actor) = self.actors.get_mut(&id) {
                actor.hung = true;
                let silent_s = actor.heard.elapsed().as_secs_f64();
                tracing::warn!(name = actor.name, actor = id, had, silent_s, "an actor hangs");
                let what = format!("{} hangs; its {had} episodes go to another", actor.name);
                self.happened(what);
            }
            self.hand_out();
        }
    }

    fn gone(&mut self, id: ActorId) {
        let Some(actor) = self.actors.remove(&id) else { return };
        let had = self.ledger.take_back(id, Reason::ActorGone);
        tracing::info!(name = actor.name, actor = id, had, "an actor has gone");
        self.happened(format!("{} has gone; it had {had} episodes", actor.name));
        self.hand_out();
    }

    /// Ends the sessions of this host's actors, which join again where shared memory is now.
    fn place_lost(&mut self, notice: Option<String>) {
        self.warned(
            "the folder of the run's shared memory was removed while it ran; it is made anew, and actors join again"
                .into(),
        );
        notice.into_iter().for_each(|notice| self.warned(notice));
        let here: Vec<ActorId> =
            self.actors.iter().filter(|(_, actor)| !actor.remote).map(|(&id, _)| id).collect();
        here.into_iter().for_each(|id| self.gone(id));
    }

    fn insert(&mut self, id: ActorId, episode: Episode) {
        if let Err(refused) = self.ledger.insert(id, episode) {
            // A late frame of an actor that was given up: its episode is rolled by another.
            tracing::debug!(%refused, "a frame nobody waits for");
            *self.frames_refused.entry("not_outstanding").or_default() += 1;
            return;
        }
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.episodes += 1;
        }
        while let Some(batch) = self.ledger.take_batch() {
            // Without a trainer the run is over, which `Over` says.
            let _ = self.work.send(Work::Batch(batch));
            self.batches_in_training += 1;
        }
        self.part_if_done(id);
        self.hand_out();
    }

    /// Gives every actor that has nothing to do its share of what may be rolled.
    fn hand_out(&mut self) {
        if self.state != v1::RunState::Running {
            return;
        }
        let share = self.config.algorithm.n_rollout_threads.div_ceil(self.actors.len().max(1));
        let limit = share.min(self.config.actors.episodes_at_once);
        let idle = |(id, actor): (&ActorId, &Actor)| actor.is_idle(*id, &self.ledger).then_some(*id);
        for id in self.actors.iter().filter_map(idle).collect::<Vec<_>>() {
            let Some(Lease { episodes, terms }) = self.ledger.lease(id, limit) else { return };
            let Terms { weights_version, epsilon } = terms;
            let lease = self.actors.get_mut(&id).map_or(0, |actor| {
                actor.leases += 1;
                actor.leases
            });
            self.send(id, Message::Lease(v1::Lease { episodes, weights_version, epsilon, lease }));
        }
    }

    /// Whether an actor still has episodes of this lease: its last one, since it gets none while it has any.
    fn has_outstanding(&self, actor: ActorId, lease: u64) -> bool {
        self.actors.get(&actor).is_some_and(|actor| actor.leases == lease)
            && self.ledger.outstanding_with(actor).next().is_some()
    }

    fn send(&mut self, id: ActorId, message: Message) {
        let Some(actor) = self.actors.get(&id) else { return };
        // A full queue is an actor that does not read; a closed one is an actor that has gone, and says so.
        if actor.to.try_send(Ok(LearnerMessage { message: Some(message) })).is_err() {
            tracing::debug!(actor = id, "an actor could not be told");
        }
    }

    /// Lets an actor go that wants to, once all it has sent is here.
    fn part_if_done(&mut self, id: ActorId) {
        let leaving = self.actors.get(&id).is_some_and(|actor| actor.leaving);
        if leaving && self.ledger.outstanding_with(id).next().is_none() {
            self.send(id, Message::Farewell(v1::Farewell {}));
        }
    }

    /// The end of the run: takes back what is outstanding and waits, for a while, for everybody to go.
    async fn part_with_actors(&mut self, events: &mut async_mpsc::Receiver<Event>) {
        for id in self.actors.keys().copied().collect::<Vec<_>>() {
            self.ledger.take_back(id, Reason::RunEnded);
            self.send(id, Message::Farewell(v1::Farewell {}));
        }
        let deadline = tokio::time::Instant::now() + FAREWELL_TIMEOUT;
        while !self.actors.is_empty() {
            match tokio::time::timeout_at(deadline, events.recv()).await {
                Ok(Some(Event::Join(_, _, answer))) => {
                    let _ = answer.send(Err(Status::unavailable("the run is over")));
                }
                Ok(Some(event)) => self.handle(event),
                Ok(None) => return,
                Err(_) => {
                    let names: Vec<_> = self.actors.values().map(|actor| actor.name.as_str()).collect();
                    tracing::warn!(?names, "actors have not gone in time");
                    return;
                }
            }
        }
    }
}
