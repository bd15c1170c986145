//! Snapshots of the acting weights: the newest, and the few that leases still ask for.

use bytes::Bytes;
use rit_proto::{
    snapshot::pieces,
    v1::{self, weights_server},
};
use std::{
    collections::VecDeque,
    mem,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};
use tokio_stream::Stream;
use tonic::{Request, Response, Status};

/// The acting weights after so many updates.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Updates that made them.
    pub version: u64,
    /// Environment steps collected by then.
    pub env_steps: u64,
    /// Little-endian f32 in the layout's order.
    pub params: Bytes,
}

impl Snapshot {
    /// Copies the acting parameters.
    pub fn new(version: u64, env_steps: u64, params: &[f32]) -> Self {
        Self { version, env_steps, params: params.iter().flat_map(|x| x.to_le_bytes()).collect() }
    }

    /// The parameters again.
    pub fn to_params(&self) -> Vec<f32> {
        let (words, _) = self.params.as_chunks::<4>();
        words.iter().map(|&word| f32::from_le_bytes(word)).collect()
    }
}

/// Where the trainer puts snapshots and all others find them.
#[derive(Debug)]
pub struct WeightsBoard {
    kept: Mutex<Kept>,
    /// How many updates the oldest version that a lease can ask for is older than the newest.
    policy_lag: usize,
}

/// All that leases can ask for.
#[derive(Debug)]
struct Kept {
    /// Oldest first.
    older: VecDeque<Arc<Snapshot>>,
    newest: Arc<Snapshot>,
}

impl Kept {
    /// Oldest first.
    fn all(&self) -> impl Iterator<Item = &Arc<Snapshot>> {
        self.older.iter().chain([&self.newest])
    }
}

impl WeightsBoard {
    /// A board with its newest snapshot. The oldest version that a lease can ask for is `policy_lag` updates
    /// older than the newest.
    pub fn new(newest: Snapshot, policy_lag: usize) -> Self {
        let kept = Kept { older: VecDeque::new(), newest: Arc::new(newest) };
        Self { kept: Mutex::new(kept), policy_lag }
    }

    /// All that leases can ask for, oldest first.
    pub fn all_kept(&self) -> Vec<Arc<Snapshot>> {
        self.kept().all().map(Arc::clone).collect()
    }

    /// Puts up a newer snapshot.
    pub fn publish(&self, snapshot: Snapshot) {
        let mut kept = self.kept();
        let before = mem::replace(&mut kept.newest, Arc::new(snapshot));
        kept.older.push_back(before);
        while kept.older.len() > self.policy_lag {
            kept.older.pop_front();
        }
    }

    /// The newest snapshot.
    pub fn newest(&self) -> Arc<Snapshot> {
        Arc::clone(&self.kept().newest)
    }

    /// The snapshot of a version, if a lease can still ask for it.
    pub fn get(&self, version: u64) -> Option<Arc<Snapshot>> {
        self.kept().all().find(|snapshot| snapshot.version == version).map(Arc::clone)
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        // Nothing that could panic happens under the lock; what it guards is whole in any case.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// `rit.v1.Weights`.
#[derive(Clone, Debug)]
pub struct WeightsService(pub Arc<WeightsBoard>);

#[tonic::async_trait]
impl weights_server::Weights for WeightsService {
    type GetStream = Pin<Box<dyn Stream<Item = Result<v1::SnapshotPiece, Status>> + Send>>;

    async fn get(&self, request: Request<v1::GetRequest>) -> Result<Response<Self::GetStream>, Status> {
        let version = request.into_inner().version;
        // The trainer puts weights up before the coordinator hands out leases that ask for them.
        let newest = self.0.newest().version;
        let snapshot = self.0.get(version);
        let gone = || Status::not_found(format!("weights {version} are not kept; the newest are {newest}"));
        let snapshot = snapshot.ok_or_else(gone)?;
        let pieces = pieces(snapshot.version, snapshot.params.clone());
        Ok(Response::new(Box::pin(tokio_stream::iter(pieces.map(Ok)))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio_stream::StreamExt as _;
    use weights_server::Weights as _;

    fn snapshot(version: u64) -> Snapshot {
        Snapshot::new(version, 10 * version, &[version as f32, -0.5])
    }

    #[tokio::test]
    async fn what_a_lease_can_ask_for_is_kept() {
        let board = Arc::new(WeightsBoard::new(snapshot(0), 1));
        for version in 1..=5 {
            board.publish(snapshot(version));
        }
        let service = WeightsService(board);
        let get = async |version| service.get(Request::new(v1::GetRequest { version })).await;
        for version in [4, 5] {
            let pieces = get(version).await.unwrap().into_inner().collect::<Vec<_>>().await;
            assert_eq!((pieces.len(), pieces[0].as_ref().unwrap().version), (1, version));
        }
        assert_eq!(get(3).await.err().unwrap().code(), tonic::Code::NotFound);
    }
}
