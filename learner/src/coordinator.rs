//! Between actors, trainer and callers: hands out leases, takes episodes in, answers for the run's state.
//!
//! A state machine that owns the ledger and the list of actors: it is told what happened and at what time, and answers
//! with what is to be done. Channels, clocks and connections are its [`Shell`]'s, which all other tasks send
//! [`Event`]s. It never waits for the trainer or for an actor, so a slow one holds up no other. `rit soak --simulated`
//! drives this very code.

mod control;
mod joining;
mod losses;
mod messages;
mod shell;
mod standstill;
mod status;

use crate::{
    gauges::{Checkpoints, Happenings, RateWindow, Stopwatch},
    ledger::{ActorId, Counts, Lease, Ledger, Reason, Terms},
    receive::Fence,
    trainer::{Beginning, News, Standing},
    writer::CheckpointEnded,
};
use rit_algo::learner::Measure;
use rit_config::Config;
use rit_env::FailureKind;
use rit_episode::Episode;
use rit_record::{Ended, in_words};
use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

pub use losses::Loss;
pub use messages::{Effect, Input, Joining, Refusal};
pub use shell::{ACTOR_QUEUE, Control, Event, Shell};

/// How long the end of a run waits for actors to go.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(5);

/// From one look for hung actors, at rates and at the ledger's balance to the next.
pub const LOOK_EVERY: Duration = Duration::from_millis(250);

/// A look that comes so much later finds that this process itself stood still.
const LATE_LOOK: Duration = Duration::from_secs(1);

/// Whether the run goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Running,
    Paused,
    /// It ends.
    Stopping,
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
    /// Episodes inserted.
    episodes: u64,
    /// Leases it was given; the last one's number.
    leases: u64,
    leaving: bool,
    /// When it last said anything.
    heard: Duration,
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
#[derive(Debug)]
pub struct Coordinator {
    config: Config,
    /// When the last event came, since this learner began.
    now: Duration,
    /// When the last look was.
    looked: Duration,
    /// When something went on last.
    moved_at: Duration,
    /// Actors that joined since.
    joins: u32,
    /// Why nothing goes on, once that was said.
    stands_still: Option<String>,
    /// When the trainer was done.
    over_since: Option<Duration>,
    ledger: Ledger,
    actors: BTreeMap<ActorId, Actor>,
    next_actor: ActorId,
    state: State,
    /// The run ends when nothing is under way any more.
    draining: Option<Ended>,
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
    checkpoints: Checkpoints,
    /// Whether the last one was not written.
    checkpoints_fail: bool,
    happenings: Happenings,
    /// Kinds of failures of environments that were said aloud.
    losses_said: BTreeSet<FailureKind>,
    /// The last of them since something went on.
    last_loss: Option<String>,
    /// How often the ledger was found not to balance.
    imbalances: u64,
}

impl Coordinator {
    /// A coordinator where a run begins.
    pub fn new(config: Config, beginning: Beginning) -> Self {
        let Beginning { batches, terms, standing, measures, warnings } = beginning;
        let mut happenings = Happenings::default();
        let steps = standing.progress.env_steps;
        warnings.into_iter().for_each(|what| happenings.warn(Duration::ZERO, steps, what));
        Self {
            epsilon: config.epsilon(standing.progress.env_steps),
            standing,
            measures,
            ledger: Ledger::new(config.algorithm.n_rollout_threads, batches, terms),
            actors: BTreeMap::new(),
            next_actor: 0,
            state: State::Running,
            draining: None,
            frames_refused: BTreeMap::new(),
            frames: 0,
            batches_in_training: 0,
            learner_waiting: Stopwatch::default(),
            rates: RateWindow::default(),
            checkpoints: Checkpoints::default(),
            checkpoints_fail: false,
            happenings,
            losses_said: BTreeSet::new(),
            last_loss: None,
            imbalances: 0,
            now: Duration::ZERO,
            looked: Duration::ZERO,
            moved_at: Duration::ZERO,
            joins: 0,
            stands_still: None,
            over_since: None,
            config,
        }
    }

    /// What is to be done after what happened at this moment, counted from the learner's beginning.
    pub fn handle(&mut self, input: Input, now: Duration) -> Vec<Effect> {
        self.now = now;
        let mut effects = Vec::new();
        self.take(input, &mut effects);
        self.time_waits();
        self.stop_if_drained(&mut effects);
        let waited = self.over_since.is_some_and(|since| now.saturating_sub(since) >= FAREWELL_TIMEOUT);
        if waited && !self.actors.is_empty() {
            let names: Vec<_> = self.actors.values().map(|actor| actor.name.as_str()).collect();
            tracing::warn!(?names, "actors have not gone in time");
        }
        if self.over_since.is_some() && (waited || self.actors.is_empty()) {
            effects.push(Effect::Close);
        }
        effects
    }

    /// The ledger's counts.
    pub fn counts(&self) -> Counts {
        self.ledger.counts()
    }

    /// Times training that waits for actors, and actors that wait for training; neither does while the run is paused or
    /// ending.
    fn time_waits(&mut self) {
        let (now, running) = (self.now, self.state == State::Running);
        self.learner_waiting.set(running && self.batches_in_training == 0, now);
        for (&id, actor) in &mut self.actors {
            actor.waiting.set(running && actor.is_idle(id, &self.ledger), now);
        }
    }

    fn look(&mut self, effects: &mut Vec<Effect>) {
        let late = self.now.saturating_sub(self.looked);
        if late > LATE_LOOK {
            // This process stood still: an actor that could not be heard is not silent.
            let shift = late - LOOK_EVERY;
            self.actors.values_mut().for_each(|actor| actor.heard += shift);
            self.moved_at += shift;
        }
        self.looked = self.now;
        self.look_for_hung_actors(effects);
        self.look_for_standstill();
        self.rates.note(self.now, self.standing.progress);
        self.check_balance();
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
        self.happenings.note(self.now, self.standing.progress.env_steps, what);
    }

    /// Notes a warning: `rit train` prints it, the page shows it.
    fn warned(&mut self, what: String) {
        self.happenings.warn(self.now, self.standing.progress.env_steps, what);
    }

    fn take(&mut self, input: Input, effects: &mut Vec<Effect>) {
        match input {
            Input::Episode(actor, episode) => {
                self.frames += 1;
                self.insert(actor, *episode, effects);
            }
            Input::FrameRefused(reason) => {
                self.frames += 1;
                *self.frames_refused.entry(reason).or_default() += 1;
            }
            Input::Join(joining) => self.join(joining, effects),
            Input::Done(actor, lease, losses) => self.done(actor, lease, losses, effects),
            Input::Fenced(fence) => self.fenced(fence, effects),
            Input::Heartbeat(actor) => self.heard(actor, effects),
            Input::Leaving(actor) => self.leaving(actor, effects),
            Input::Gone(actor) => self.gone(actor, effects),
            Input::PlaceLost(notice) => self.place_lost(notice, effects),
            Input::News(News::Trained(terms, standing)) => self.trained(terms, standing, effects),
            Input::News(News::Warning(what)) => self.warned(what),
            Input::News(News::Ending) => self.state = State::Stopping,
            Input::CheckpointEnded(ended) => self.checkpoint_ended(ended),
            Input::Pause => self.pause(),
            Input::Resume => self.resume(effects),
            Input::Stop { drain, ended } => self.stop(drain, ended, effects),
            Input::Set(config) => self.set(config, effects),
            Input::Look => self.look(effects),
            Input::Over => self.part_with_actors(effects),
        }
    }

    fn done(&mut self, actor: ActorId, lease: u64, losses: Vec<Loss>, effects: &mut Vec<Effect>) {
        self.heard(actor, effects);
        if self.has_outstanding(actor, lease) {
            self.take_losses(actor, losses, effects);
        }
        // Not all of it has come through yet, or a frame was refused: look again once all that was sent before has
        // been read.
        if self.has_outstanding(actor, lease) {
            effects.push(Effect::Fence(Fence { actor, lease }));
        }
    }

    fn fenced(&mut self, Fence { actor, lease }: Fence, effects: &mut Vec<Effect>) {
        if self.has_outstanding(actor, lease) {
            let missing = self.ledger.take_back(actor, Reason::NotArrived);
            tracing::warn!(actor, missing, "episodes did not arrive and are handed out again");
            self.happened(format!("{missing} episodes did not arrive and are handed out again"));
            self.part_if_done(actor, effects);
            self.hand_out(effects);
        }
    }

    fn leaving(&mut self, id: ActorId, effects: &mut Vec<Effect>) {
        self.heard(id, effects);
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.leaving = true;
        }
        self.part_if_done(id, effects);
    }

    /// A batch is done, and another may be rolled on these terms.
    fn trained(&mut self, terms: Terms, standing: Standing, effects: &mut Vec<Effect>) {
        self.moved();
        self.ledger.open(terms);
        self.epsilon = terms.epsilon;
        self.batches_in_training = self.batches_in_training.saturating_sub(1);
        let evaluated_at = |standing: &Standing| standing.evaluation.as_ref().map(|(at, _)| *at);
        let evaluated = evaluated_at(&standing) != evaluated_at(&self.standing);
        self.standing = standing;
        if evaluated && let Some((_, results)) = &self.standing.evaluation {
            self.happened(format!("evaluated: {}", in_words(results)));
        }
        self.hand_out(effects);
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
        (checkpoints.last, checkpoints.total) = (duration, checkpoints.total + duration);
        self.happened(format!("wrote the checkpoint at {env_steps} steps in {} ms", duration.as_millis()));
    }

    fn heard(&mut self, id: ActorId, effects: &mut Vec<Effect>) {
        let Some(actor) = self.actors.get_mut(&id) else { return };
        actor.heard = self.now;
        if std::mem::take(&mut actor.hung) {
            tracing::info!(name = actor.name, actor = id, "an actor that hung is back");
            let what = format!("{} is back", actor.name);
            self.happened(what);
            self.part_if_done(id, effects);
            self.hand_out(effects);
        }
    }

    fn look_for_hung_actors(&mut self, effects: &mut Vec<Effect>) {
        let timeout = Duration::from_millis(self.config.actors.heartbeat_timeout_ms);
        let now = self.now;
        let silent = |actor: &Actor| !actor.hung && now.saturating_sub(actor.heard) >= timeout;
        let hung: Vec<ActorId> = self.actors.iter().filter(|(_, a)| silent(a)).map(|(&id, _)| id).collect();
        for id in hung {
            let had = self.ledger.take_back(id, Reason::ActorHung);
            if let Some(actor) = self.actors.get_mut(&id) {
                actor.hung = true;
                let silent_s = now.saturating_sub(actor.heard).as_secs_f64();
                tracing::warn!(name = actor.name, actor = id, had, silent_s, "an actor hangs");
                let what = format!("{} hangs; its {had} episodes go to another", actor.name);
                self.happened(what);
            }
            self.hand_out(effects);
        }
    }

    fn gone(&mut self, id: ActorId, effects: &mut Vec<Effect>) {
        let Some(actor) = self.actors.remove(&id) else { return };
        effects.push(Effect::Dismiss(id));
        let had = self.ledger.take_back(id, Reason::ActorGone);
        tracing::info!(name = actor.name, actor = id, had, "an actor has gone");
        self.happened(format!("{} has gone; it had {had} episodes", actor.name));
        self.hand_out(effects);
    }

    /// Ends the sessions of this host's actors, which join again where shared memory is now.
    fn place_lost(&mut self, notice: Option<String>, effects: &mut Vec<Effect>) {
        self.warned(
            "the folder of the run's shared memory was removed while it ran; it is made anew, and actors join again"
                .into(),
        );
        notice.into_iter().for_each(|notice| self.warned(notice));
        let here: Vec<ActorId> =
            self.actors.iter().filter(|(_, actor)| !actor.remote).map(|(&id, _)| id).collect();
        here.into_iter().for_each(|id| self.gone(id, effects));
    }

    fn insert(&mut self, id: ActorId, episode: Episode, effects: &mut Vec<Effect>) {
        if let Err(refused) = self.ledger.insert(id, episode) {
            // A late frame of an actor that was given up: its episode is rolled by another.
            tracing::debug!(%refused, "a frame that the ledger does not wait for");
            *self.frames_refused.entry("not_outstanding").or_default() += 1;
            return;
        }
        self.moved();
        if let Some(actor) = self.actors.get_mut(&id) {
            actor.episodes += 1;
        }
        while let Some(batch) = self.ledger.take_batch() {
            effects.push(Effect::Train(batch));
            self.batches_in_training += 1;
        }
        self.part_if_done(id, effects);
        self.hand_out(effects);
    }

    /// Gives every actor that has nothing to do its share of what may be rolled.
    fn hand_out(&mut self, effects: &mut Vec<Effect>) {
        if self.state != State::Running {
            return;
        }
        let share = self.config.algorithm.n_rollout_threads.div_ceil(self.actors.len().max(1));
        let limit = share.min(self.config.actors.episodes_at_once);
        let idle = |(id, actor): (&ActorId, &Actor)| actor.is_idle(*id, &self.ledger).then_some(*id);
        for id in self.actors.iter().filter_map(idle).collect::<Vec<_>>() {
            let Some(Lease { episodes, terms }) = self.ledger.lease(id, limit) else { return };
            let lease = self.actors.get_mut(&id).map_or(0, |actor| {
                actor.leases += 1;
                actor.leases
            });
            effects.push(Effect::Lease { actor: id, lease, episodes, terms });
        }
    }

    /// Whether an actor still has episodes of this lease: its last one, since it gets none while it has any.
    fn has_outstanding(&self, actor: ActorId, lease: u64) -> bool {
        self.actors.get(&actor).is_some_and(|actor| actor.leases == lease)
            && self.ledger.outstanding_with(actor).next().is_some()
    }

    /// Lets an actor go that wants to, once all it has sent is here.
    fn part_if_done(&mut self, id: ActorId, effects: &mut Vec<Effect>) {
        let leaving = self.actors.get(&id).is_some_and(|actor| actor.leaving);
        if leaving && self.ledger.outstanding_with(id).next().is_none() {
            effects.push(Effect::Farewell(id));
        }
    }

    /// The end of the run: takes outstanding leases back and tells all actors to end.
    fn part_with_actors(&mut self, effects: &mut Vec<Effect>) {
        if self.over_since.is_some() {
            return;
        }
        self.over_since = Some(self.now);
        self.state = State::Stopping;
        for &id in self.actors.keys() {
            self.ledger.take_back(id, Reason::RunEnded);
            effects.push(Effect::Farewell(id));
        }
        self.check_balance();
    }
}
