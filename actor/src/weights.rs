//! The weights a lease asks for: from the stream of newest snapshots, or by name if that one was skipped.

use rit_proto::{
    snapshot::{Assembly, Snapshot, SnapshotError},
    transport::{Client, status_words},
    v1::{GetRequest, SnapshotPiece, WatchRequest, weights_client::WeightsClient},
};
use std::{collections::VecDeque, sync::Arc};
use tokio::sync::watch;
use tonic::{Code, Status, Streaming};

/// Why there are no weights.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The learner says so, or has gone.
    #[error("no weights from the learner: {}", status_words(.0))]
    Learner(#[from] Status),
    /// They are no weights of this model.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}

impl WeightsError {
    /// Whether it may be different when the learner is back.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Learner(status) => matches!(
                status.code(),
                Code::Unavailable
                    | Code::Cancelled
                    | Code::Unknown
                    | Code::ResourceExhausted
                    | Code::DeadlineExceeded
                    // Weights that are not kept any more: the lease is another's by now.
                    | Code::NotFound
            ),
            Self::Snapshot(_) => false,
        }
    }

    /// Whether the same learner would send the same again: weights of another model, or in another order than this
    /// build knows.
    pub fn is_permanent(&self) -> bool {
        matches!(self, Self::Snapshot(SnapshotError::Length { .. } | SnapshotError::Order { .. }))
    }
}

/// What the stream has brought.
#[derive(Default)]
struct Newest {
    /// Oldest first: as many as leases ask for at a time.
    kept: VecDeque<Arc<Snapshot>>,
    /// Why no more will come.
    failed: Option<SnapshotError>,
}

/// Follows the learner's weights.
#[derive(Clone)]
pub(crate) struct Weights {
    client: WeightsClient<Client>,
    newest: watch::Receiver<Newest>,
    /// Bytes of the model's acting weights.
    bytes: usize,
}

impl Weights {
    /// Begins to watch weights of so many bytes. A lease asks for those that are up to `policy_lag` updates behind the
    /// newest.
    pub(crate) async fn watch(client: Client, policy_lag: usize, bytes: usize) -> Result<Self, Status> {
        let mut client = WeightsClient::new(client);
        let mut stream = client.watch(WatchRequest {}).await?.into_inner();
        let (sender, newest) = watch::channel(Newest::default());
        tokio::spawn(async move {
            let mut assembly = Assembly::new(bytes);
            // Read as fast as they come, so that what stands here is the newest; ends with the learner.
            loop {
                let next = next(&mut stream, &mut assembly).await;
                if sender.is_closed() {
                    return;
                }
                match next {
                    Ok(snapshot) => sender.send_modify(|newest| {
                        newest.kept.push_back(Arc::new(snapshot));
                        while newest.kept.len() > policy_lag + 1 {
                            newest.kept.pop_front();
                        }
                    }),
                    Err(WeightsError::Snapshot(error)) => {
                        sender.send_modify(|newest| newest.failed = Some(error));
                        return;
                    }
                    // Whoever waits sees that nothing more comes.
                    Err(WeightsError::Learner(_)) => return,
                }
            }
        });
        Ok(Self { client, newest, bytes })
    }

    /// The snapshot of this version, which the learner has made or is about to send.
    pub(crate) async fn get(&mut self, version: u64) -> Result<Arc<Snapshot>, WeightsError> {
        let is_there = |newest: &Newest| {
            newest.failed.is_some() || newest.kept.back().is_some_and(|newest| newest.version >= version)
        };
        let newest = self.newest.wait_for(is_there).await;
        let newest = newest.map_err(|_| Status::unavailable("it sends none any more"))?;
        let found = newest.kept.iter().find(|snapshot| snapshot.version == version).map(Arc::clone);
        let failed = newest.failed.clone();
        // Nothing may be held while the learner is asked.
        drop(newest);
        match (found, failed) {
            (Some(found), _) => Ok(found),
            (None, Some(failed)) => Err(failed.into()),
            // Skipped: this actor was slow, or came when newer ones were out already.
            (None, None) => {
                let mut stream = self.client.get(GetRequest { version }).await?.into_inner();
                Ok(Arc::new(next(&mut stream, &mut Assembly::new(self.bytes)).await?))
            }
        }
    }
}

/// The next whole snapshot of a stream.
async fn next(
    stream: &mut Streaming<SnapshotPiece>,
    assembly: &mut Assembly,
) -> Result<Snapshot, WeightsError> {
    loop {
        let Some(piece) = stream.message().await? else {
            return Err(Status::unavailable("its stream has ended").into());
        };
        if let Some(snapshot) = assembly.push(piece)? {
            return Ok(snapshot);
        }
    }
}
