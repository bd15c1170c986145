//! `rit.v1.Rollout`: turns an actor's stream into events.

use crate::coordinator::{ACTOR_QUEUE, Event};
use rit_proto::v1::{ActorMessage, LearnerMessage, actor_message::Message, rollout_server};
use std::pin::Pin;
use tokio::sync::{mpsc, oneshot};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status, Streaming};

/// `rit.v1.Rollout`.
#[derive(Clone, Debug)]
pub struct RolloutService(pub mpsc::Sender<Event>);

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
        let (to, from_learner) = mpsc::channel(ACTOR_QUEUE);
        let (answer, joined) = oneshot::channel();
        let over = |_| Status::unavailable("the run is over");
        self.0.send(Event::Join(hello, to, answer)).await.map_err(|_| over(()))?;
        let actor = joined.await.map_err(|_| over(()))??;
        let events = self.0.clone();
        tokio::spawn(async move {
            // A message, the end, or an error: what is no message ends the actor's time here.
            while let Ok(Some(message)) = messages.message().await {
                let event = match message.message {
                    Some(Message::Done(done)) => Event::Done(actor, done.lease),
                    Some(Message::Leaving(_)) => Event::Leaving(actor),
                    Some(Message::Heartbeat(_)) => Event::Heartbeat(actor),
                    Some(Message::Hello(_)) | None => continue,
                };
                if events.send(event).await.is_err() {
                    return;
                }
            }
            let _ = events.send(Event::Gone(actor)).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(from_learner))))
    }
}
