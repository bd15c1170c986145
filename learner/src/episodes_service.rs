//! `rit.v1.Episodes`: frames from other hosts, into the same events as those from shared memory.

use crate::{coordinator::Event, receive};
use rit_episode::wire::{Expected, Header};
use rit_proto::v1::{Frame, Receipt, episodes_server};
use std::{pin::Pin, sync::Arc};
use tokio::sync::{mpsc, watch};
use tokio_stream::{Stream, StreamExt as _, wrappers::WatchStream};
use tonic::{Request, Response, Status, Streaming};

/// Bytes of a message beside header and payload: the fields' tags and lengths.
const MESSAGE_OVERHEAD: usize = 64;

/// `rit.v1.Episodes`.
#[derive(Clone, Debug)]
pub struct EpisodesService {
    /// Leads to the coordinator.
    pub events: mpsc::Sender<Event>,
    /// What every frame of the run must look like.
    pub expected: Arc<Expected>,
}

impl EpisodesService {
    /// Largest message it takes: a frame of the run.
    pub fn message_bytes_max(&self) -> usize {
        size_of::<Header>() + self.expected.layout.len() + MESSAGE_OVERHEAD
    }
}

#[tonic::async_trait]
impl episodes_server::Episodes for EpisodesService {
    type SendStream = Pin<Box<dyn Stream<Item = Result<Receipt, Status>> + Send>>;

    async fn send(&self, request: Request<Streaming<Frame>>) -> Result<Response<Self::SendStream>, Status> {
        let mut frames = request.into_inner();
        let Self { events, expected } = self.clone();
        // The newest count is all that matters, so receipts never wait for their reader.
        let (count, counts) = watch::channel(0);
        tokio::spawn(async move {
            // The next frame is read when the coordinator has taken the one before: so long the actor waits.
            while let Ok(Some(Frame { header, payload })) = frames.message().await {
                let input = receive::read(Header::from_bytes(&header), &payload, &expected);
                if events.send(input.into()).await.is_err() {
                    return;
                }
                count.send_modify(|frames| *frames += 1);
            }
        });
        let receipts = WatchStream::new(counts).map(|frames| Ok(Receipt { frames }));
        Ok(Response::new(Box::pin(receipts)))
    }
}
