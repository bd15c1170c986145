//! Around the coordinator: the clock, the channels, and the ways to answer.

use super::{Coordinator, Effect, Input, Joining, LOOK_EVERY, Refusal};
use crate::{
    ledger::{ActorId, Terms},
    receive::Fence,
    trainer::{Checkpointed, Work},
};
use rit_config::Config;
use rit_proto::v1::{self, LearnerMessage, learner_message::Message};
use rit_record::Ended;
use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, mpsc},
};
use tokio::{
    sync::{mpsc as async_mpsc, oneshot},
    time::{Instant, MissedTickBehavior},
};
use tonic::Status;

/// Messages an actor's stream may hold: far more than one lease at a time can fill.
pub const ACTOR_QUEUE: usize = 64;

/// The way to an actor.
pub type ToActor = async_mpsc::Sender<Result<LearnerMessage, Status>>;

/// What happens to a run, with the ways to answer.
#[derive(Debug)]
pub enum Event {
    /// What needs no answer: all but [`Input::Join`].
    Input(Input),
    /// An actor wants to join.
    Join(v1::Hello, ToActor, oneshot::Sender<Result<ActorId, Status>>),
    /// A caller asks or wants something.
    Control(Control),
}

impl From<Input> for Event {
    fn from(input: Input) -> Self {
        Self::Input(input)
    }
}

/// What callers want, each with the way to answer.
#[derive(Debug)]
pub enum Control {
    /// How the run stands.
    Status(oneshot::Sender<v1::RunStatus>),
    /// No further lease.
    Pause(oneshot::Sender<v1::RunStatus>),
    /// Leases again.
    Resume(oneshot::Sender<v1::RunStatus>),
    /// A checkpoint.
    Checkpoint(oneshot::Sender<Checkpointed>),
    /// The end of the run, with what is under way (`drain`) or without.
    Stop {
        /// Whether episodes under way are waited for.
        drain: bool,
        /// What the run then ends as.
        ended: Ended,
        /// The way to answer.
        answer: oneshot::Sender<v1::RunStatus>,
    },
    /// Other settings from now on.
    Set(Arc<Config>, oneshot::Sender<v1::RunStatus>),
}

/// The coordinator at work.
pub struct Shell {
    coordinator: Coordinator,
    /// The moment that the coordinator's times count from.
    began: Instant,
    /// What every actor is told when it joins, but for its own number.
    welcome: v1::Welcome,
    actors: BTreeMap<ActorId, ToActor>,
    work: mpsc::Sender<Work>,
    fences: mpsc::Sender<Fence>,
    closed: bool,
}

/// Who waits to be admitted or refused.
type Waiting = (ToActor, oneshot::Sender<Result<ActorId, Status>>);

impl Shell {
    /// A coordinator whose actors are told `welcome`; `work` leads to the trainer, `fences` to the receiving thread.
    pub fn new(
        coordinator: Coordinator,
        welcome: v1::Welcome,
        work: mpsc::Sender<Work>,
        fences: mpsc::Sender<Fence>,
    ) -> Self {
        let (began, actors) = (Instant::now(), BTreeMap::new());
        Self { coordinator, began, welcome, actors, work, fences, closed: false }
    }

    /// Works until the trainer is done and the actors have gone.
    pub async fn run(mut self, mut events: async_mpsc::Receiver<Event>) {
        let mut looks = tokio::time::interval(LOOK_EVERY);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        while !self.closed {
            tokio::select! {
                event = events.recv() => match event {
                    Some(event) => self.take(event),
                    None => return,
                },
                _ = looks.tick() => self.tell(Input::Look),
            }
        }
        tracing::info!(counts = ?self.coordinator.counts(), "the ledger is closed");
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Input(input) => self.tell(input),
            Event::Join(hello, to, answer) => {
                let v1::Hello { name, pid, layout_version, instance, remote, slot } = hello;
                let joining = Joining { name, pid, layout_version, instance, remote, slot };
                self.tell_with(Input::Join(joining), Some((to, answer)));
            }
            Event::Control(control) => self.control(control),
        }
    }

    /// The caller may have gone; the answer is then dropped.
    fn control(&mut self, control: Control) {
        let (input, answer) = match control {
            Control::Checkpoint(answer) => {
                // Without a trainer the run is over, and no answer comes.
                let _ = self.work.send(Work::Checkpoint(answer));
                return;
            }
            Control::Status(answer) => (None, answer),
            Control::Pause(answer) => (Some(Input::Pause), answer),
            Control::Resume(answer) => (Some(Input::Resume), answer),
            Control::Stop { drain, ended, answer } => (Some(Input::Stop { drain, ended }), answer),
            Control::Set(config, answer) => (Some(Input::Set(config)), answer),
        };
        if let Some(input) = input {
            self.tell(input);
        }
        let _ = answer.send(self.coordinator.status(self.began.elapsed()));
    }

    fn tell(&mut self, input: Input) {
        self.tell_with(input, None);
    }

    fn tell_with(&mut self, input: Input, mut waiting: Option<Waiting>) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            for effect in self.coordinator.handle(input, self.began.elapsed()) {
                inputs.extend(self.perform(effect, &mut waiting));
            }
        }
    }

    /// Carries an effect out; returns what comes of it.
    fn perform(&mut self, effect: Effect, waiting: &mut Option<Waiting>) -> Option<Input> {
        match effect {
            Effect::Admit(id) => return self.admit(id, waiting.take()?),
            Effect::Refuse(refusal) => {
                let (_, answer) = waiting.take()?;
                // The actor that wanted to join may have gone.
                let _ = answer.send(Err(refused(&refusal)));
            }
            Effect::Lease { actor, lease, episodes, terms: Terms { weights_version, epsilon } } => {
                let lease = v1::Lease { episodes, weights_version, epsilon, lease };
                self.send(actor, Ok(Message::Lease(lease)));
            }
            Effect::Farewell(actor) => self.send(actor, Ok(Message::Farewell(v1::Farewell {}))),
            Effect::Replaced(actor) => {
                self.send(actor, Err(Status::already_exists("another process has taken this actor's place")));
            }
            Effect::Dismiss(actor) => {
                self.actors.remove(&actor);
            }
            // Without a trainer or a receiver the run is over, which `Over` says.
            Effect::Train(batch) => {
                let _ = self.work.send(Work::Batch(batch));
            }
            Effect::Configure(config) => {
                let _ = self.work.send(Work::Set(config));
            }
            Effect::EndTraining(ended) => {
                let _ = self.work.send(Work::Stop(ended));
            }
            Effect::Fence(fence) => {
                let _ = self.fences.send(fence);
            }
            Effect::Close => self.closed = true,
        }
        None
    }

    fn admit(&mut self, id: ActorId, (to, answer): Waiting) -> Option<Input> {
        if answer.send(Ok(id)).is_err() {
            return Some(Input::Gone(id));
        }
        self.actors.insert(id, to);
        let welcome = v1::Welcome { actor: id, ..self.welcome.clone() };
        self.send(id, Ok(Message::Welcome(welcome)));
        None
    }

    fn send(&self, id: ActorId, message: Result<Message, Status>) {
        let Some(to) = self.actors.get(&id) else { return };
        let message = message.map(|message| LearnerMessage { message: Some(message) });
        // A full queue is an actor that does not read; a closed one is an actor that has gone, and says so.
        if to.try_send(message).is_err() {
            tracing::debug!(actor = id, "an actor could not be told");
        }
    }
}

fn refused(refusal: &Refusal) -> Status {
    let message = refusal.to_string();
    match refusal {
        Refusal::Layout { .. } | Refusal::Remote { .. } => Status::failed_precondition(message),
        Refusal::Taken { .. } => Status::already_exists(message),
        Refusal::Over => Status::unavailable(message),
    }
}
