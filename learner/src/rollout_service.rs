//! `rit.v1.Rollout`: turns an actor's stream into events.

use crate::{
    coordinator::{ACTOR_QUEUE, Event, Input, Loss},
    cpu_time::CpuTime,
};
use rit_env::FailureKind;
use rit_proto::{
    LOSS_DETAIL_CHARS_MAX,
    v1::{self, ActorMessage, LearnerMessage, actor_message::Message, rollout_server},
};
use std::{pin::Pin, sync::Arc};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status, Streaming};

/// `rit.v1.Rollout`.
#[derive(Clone, Debug)]
pub struct RolloutService {
    /// To the coordinator.
    pub events: mpsc::Sender<Event>,
    /// What actors say of the processor time they take.
    pub cpu: Arc<CpuTime>,
}

/// Longest name of an actor, in bytes.
const NAME_BYTES_MAX: usize = 64;

/// Names are shown on terminals and pages and stand in logs: they are short and of characters that do nothing there.
fn check_name(name: &str) -> Result<(), Status> {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    if (1..=NAME_BYTES_MAX).contains(&name.len()) && name.bytes().all(is_plain) {
        return Ok(());
    }
    let begin: String = name.chars().take(NAME_BYTES_MAX).collect();
    Err(Status::invalid_argument(format!(
        "{begin:?} is no name for an actor; use up to {NAME_BYTES_MAX} letters, digits, '-', '_' and '.'"
    )))
}

/// What was lost, for the reasons that there are: episodes of others are missed when all that was sent has been read.
fn losses(losses: Vec<v1::Loss>) -> Vec<Loss> {
    let loss = |v1::Loss { reason, episodes, detail }| {
        let kind = FailureKind::ALL.into_iter().find(|kind| kind.name() == reason)?;
        Some(Loss { kind, episodes, detail: detail.chars().take(LOSS_DETAIL_CHARS_MAX).collect() })
    };
    losses.into_iter().filter_map(loss).collect()
}

#[tonic::async_trait]
impl rollout_server::Rollout for RolloutService {
    type JoinStream = Pin<Box<dyn Stream<Item = Result<LearnerMessage, Status>> + Send>>;

    async fn join(
        &self,
        request: Request<Streaming<ActorMessage>>,
    ) -> Result<Response<Self::JoinStream>, Status> {
        let mut messages = request.into_inner();
        let first = messages.message().await?.and_then(|message| message.message);
        let Some(Message::Hello(hello)) = first else {
            return Err(Status::invalid_argument("an actor's first message is Hello"));
        };
        check_name(&hello.name)?;
        let instance = hello.instance;
        let (to, from_learner) = mpsc::channel(ACTOR_QUEUE);
        let (answer, joined) = oneshot::channel();
        let over = |_| Status::unavailable("the run is over");
        self.events.send(Event::Join(hello, to, answer)).await.map_err(|_| over(()))?;
        let actor = joined.await.map_err(|_| over(()))??;
        let (events, cpu) = (self.events.clone(), Arc::clone(&self.cpu));
        tokio::spawn(async move {
            // A message, the end, or an error: what is no message ends the actor's time here.
            while let Ok(Some(message)) = messages.message().await {
                let input = match message.message {
                    Some(Message::Done(done)) => {
                        cpu.note(instance, done.cpu_ms);
                        Input::Done(actor, done.lease, losses(done.losses))
                    }
                    Some(Message::Leaving(_)) => Input::Leaving(actor),
                    Some(Message::Heartbeat(heartbeat)) => {
                        cpu.note(instance, heartbeat.cpu_ms);
                        Input::Heartbeat(actor)
                    }
                    Some(Message::Hello(_)) | None => continue,
                };
                if events.send(input.into()).await.is_err() {
                    return;
                }
            }
            let _ = events.send(Input::Gone(actor).into()).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(from_learner))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_short_and_do_nothing_to_a_terminal() {
        for good in ["actor-0", "a", "node_7.example.org", &"x".repeat(NAME_BYTES_MAX)] {
            assert!(check_name(good).is_ok(), "{good}");
        }
        let long = "x".repeat(60_000);
        for bad in ["", "two words", "line\nline", "\u{1b}[31mred", "\0", "naïve", "<b>", &long] {
            let message = check_name(bad).unwrap_err().message().to_owned();
            assert!(message.contains("is no name for an actor"), "{message}");
            assert!(message.len() < 300 && !message.contains(char::is_control), "{message}");
        }
    }
}
