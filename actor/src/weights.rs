//! The weights a lease asks for: from the stream of newest snapshots, or by name if that one was skipped.

use rit_proto::{
    MESSAGE_BYTES_MAX,
    transport::Client,
    v1::{GetRequest, Snapshot, WatchRequest, weights_client::WeightsClient},
};
use std::sync::Arc;
use tokio::sync::watch;
use tonic::Status;

/// Follows the learner's weights.
#[derive(Clone)]
pub(crate) struct Weights {
    client: WeightsClient<Client>,
    newest: watch::Receiver<Option<Arc<Snapshot>>>,
}

impl Weights {
    /// Begins to watch.
    pub(crate) async fn watch(client: Client) -> Result<Self, Status> {
        let mut client = WeightsClient::new(client).max_decoding_message_size(MESSAGE_BYTES_MAX);
        let mut snapshots = client.watch(WatchRequest {}).await?.into_inner();
        let (sender, newest) = watch::channel(None);
        tokio::spawn(async move {
            // Read as fast as they come, so that what stands here is the newest; ends with the learner.
            while let Ok(Some(snapshot)) = snapshots.message().await {
                if sender.send(Some(Arc::new(snapshot))).is_err() {
                    return;
                }
            }
        });
        Ok(Self { client, newest })
    }

    /// The snapshot of this version, which the learner has made or is about to send.
    pub(crate) async fn get(&mut self, version: u64) -> Result<Arc<Snapshot>, Status> {
        let is_there =
            |newest: &Option<Arc<Snapshot>>| newest.as_ref().is_some_and(|newest| newest.version >= version);
        let newest = self.newest.wait_for(is_there).await;
        let newest =
            newest.map_err(|_| Status::unavailable("the learner sends no weights any more"))?.clone();
        match newest {
            Some(newest) if newest.version == version => Ok(newest),
            // Skipped: this actor was slow, or came when newer ones were out already.
            _ => Ok(Arc::new(self.client.get(GetRequest { version }).await?.into_inner())),
        }
    }
}
