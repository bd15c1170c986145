//! Where an actor's episodes go: into shared memory, or over gRPC to a learner on another host. Either way a frame is
//! sent until taken, the learner's reading sets the pace, and nothing is dropped.

use bytes::Bytes;
use rit_episode::wire::Frame;
use rit_ipc::{EpisodeSender, SendError};
use rit_proto::{
    transport::Client,
    v1::{self, episodes_client::EpisodesClient},
};
use std::time::Duration;
use tokio::{
    runtime::Handle,
    sync::{mpsc, watch},
};
use tokio_stream::wrappers::ReceiverStream;

/// From one look whether to give up to the next.
const GIVE_UP_EVERY: Duration = Duration::from_millis(50);

/// Why a frame was not sent.
#[derive(Debug, thiserror::Error)]
pub enum SinkError {
    /// Not into shared memory.
    #[error(transparent)]
    SharedMemory(#[from] SendError),
    /// The learner reads no more of them.
    #[error("the stream of episodes to the learner broke")]
    Broken,
    /// The caller's `give_up` said so.
    #[error("gave up sending a frame: the learner is gone or too slow")]
    GaveUp,
}

/// Where an actor's episodes go.
#[derive(Debug)]
pub(crate) enum EpisodeSink {
    /// To a learner on this host.
    SharedMemory(Box<EpisodeSender>),
    /// To a learner on any host.
    Stream(FrameStream),
}

impl EpisodeSink {
    /// Sends a frame; waits while the learner cannot keep up. `give_up` is asked now and then while waiting.
    pub(crate) fn send(&mut self, frame: &Frame, give_up: &dyn Fn() -> bool) -> Result<(), SinkError> {
        match self {
            Self::SharedMemory(sender) => Ok(sender.send(frame, give_up)?),
            Self::Stream(stream) => stream.send(frame, give_up),
        }
    }

    /// Waits until what is told to the learner from now on comes after the frames sent. In shared memory that is so
    /// by itself: the learner reads it before it takes up what it is told.
    pub(crate) fn flush(&mut self, give_up: &dyn Fn() -> bool) -> Result<(), SinkError> {
        match self {
            Self::SharedMemory(_) => Ok(()),
            Self::Stream(stream) => stream.wait_until_read(stream.sent, give_up),
        }
    }
}

/// Frames on the way that the learner has not read.
const UNREAD_MAX: usize = 8;

/// `rit.v1.Episodes`, an actor's end.
#[derive(Debug)]
pub(crate) struct FrameStream {
    frames: mpsc::Sender<v1::Frame>,
    sent: u64,
    /// Frames that the learner says it has read.
    read: watch::Receiver<u64>,
    runtime: Handle,
}

impl FrameStream {
    /// Begins a stream.
    pub(crate) async fn open(client: Client) -> Result<Self, tonic::Status> {
        let (frames, queue) = mpsc::channel(UNREAD_MAX);
        let answer = EpisodesClient::new(client).send(ReceiverStream::new(queue)).await?;
        let mut receipts = answer.into_inner();
        let (count, read) = watch::channel(0);
        tokio::spawn(async move {
            // Ends with the stream, which tells those that wait for more.
            while let Ok(Some(receipt)) = receipts.message().await {
                if count.send(receipt.frames).is_err() {
                    return;
                }
            }
        });
        Ok(Self { frames, sent: 0, read, runtime: Handle::current() })
    }

    fn send(&mut self, frame: &Frame, give_up: &dyn Fn() -> bool) -> Result<(), SinkError> {
        self.wait_until_read((self.sent + 1).saturating_sub(UNREAD_MAX as u64), give_up)?;
        let frame = v1::Frame {
            header: Bytes::copy_from_slice(frame.header.as_bytes()),
            payload: Bytes::copy_from_slice(&frame.payload),
        };
        // The queue has room for all that are on the way; it is closed when the stream has broken.
        self.frames.try_send(frame).map_err(|_| SinkError::Broken)?;
        self.sent += 1;
        Ok(())
    }

    fn wait_until_read(&mut self, frames: u64, give_up: &dyn Fn() -> bool) -> Result<(), SinkError> {
        let Self { read, runtime, .. } = self;
        loop {
            let enough = runtime.block_on(async {
                tokio::time::timeout(GIVE_UP_EVERY, read.wait_for(|&read| read >= frames)).await
            });
            match enough {
                Ok(Ok(_)) => return Ok(()),
                Ok(Err(_)) => return Err(SinkError::Broken),
                Err(_) if give_up() => return Err(SinkError::GaveUp),
                Err(_) => {}
            }
        }
    }
}
