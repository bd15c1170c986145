//! The weights a lease asks for: from the stream of newest snapshots, or by name if that one was skipped.

use rit_proto::{
    MESSAGE_BYTES_MAX,
    transport::Client,
    v1::{GetRequest, Snapshot, WatchRequest, weights_client::WeightsClient},
};
use std::{collections::VecDeque, sync::Arc};
use tokio::sync::watch;
use tonic::Status;

/// Follows the learner's weights.
#[derive(Clone)]
pub(crate) struct Weights {
    client: WeightsClient<Client>,
    /// The newest, oldest first: as many as leases ask for at a time.
    newest: watch::Receiver<VecDeque<Arc<Snapshot>>>,
}

impl Weights {
    /// Begins to watch. A lease asks for weights that are up to `policy_lag` updates behind the newest.
    pub(crate) async fn watch(client: Client, policy_lag: usize) -> Result<Self, Status> {
        let mut client = WeightsClient::new(client).max_decoding_message_size(MESSAGE_BYTES_MAX);
        let mut snapshots = client.watch(WatchRequest {}).await?.into_inner();
        let (sender, newest) = watch::channel(VecDeque::new());
        tokio::spawn(async move {
            // Read as fast as they come, so that what stands here is the newest; ends with the learner.
            while let Ok(Some(snapshot)) = snapshots.message().await {
                if sender.is_closed() {
                    return;
                }
                sender.send_modify(|kept| {
                    kept.push_back(Arc::new(snapshot));
                    while kept.len() > policy_lag + 1 {
                        kept.pop_front();
                    }
                });
            }
        });
        Ok(Self { client, newest })
    }

    /// The snapshot of this version, which the learner has made or is about to send.
    pub(crate) async fn get(&mut self, version: u64) -> Result<Arc<Snapshot>, Status> {
        let is_there =
            |kept: &VecDeque<Arc<Snapshot>>| kept.back().is_some_and(|newest| newest.version >= version);
        let kept = self.newest.wait_for(is_there).await;
        let kept = kept.map_err(|_| Status::unavailable("the learner sends no weights any more"))?;
        let found = kept.iter().find(|snapshot| snapshot.version == version).map(Arc::clone);
        // Nothing may be held while the learner is asked.
        drop(kept);
        match found {
            Some(found) => Ok(found),
            // Skipped: this actor was slow, or came when newer ones were out already.
            None => Ok(Arc::new(self.client.get(GetRequest { version }).await?.into_inner())),
        }
    }
}
